"""Reports of calibrations: one HTML file to look at and to print."""
