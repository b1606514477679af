"""Images sampled by compiled code: its C sources, how they are built, found and called."""
