"""Places that exist as formulas, for demonstrations and tests: every ray has a colour, every label is exact."""
