"""Cameras in networks: layers that predict cameras, losses, and metric depth for any lens."""
