"""The modules of `docs/make_images.py`."""
