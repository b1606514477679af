"""Two cameras that look the same way: images whose rows correspond, and depth from their disparities."""
