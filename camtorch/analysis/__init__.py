"""Numbers about a camera, and about the difference of two."""
