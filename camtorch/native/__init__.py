"""Native code: the sampling of images and the geometry of cameras, how they are built and found."""
