"""Pairs of cameras: images whose rows correspond, and depth from their disparities."""
