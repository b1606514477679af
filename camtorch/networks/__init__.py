"""What networks need of cameras: layers that predict them, losses, and depth that means the same behind any lens."""
