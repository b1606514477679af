"""Native code: the sampler of images and the geometry of cameras, how they are built and found."""
