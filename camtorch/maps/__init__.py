"""Warps as lookup tables for other runtimes, one file a format, each with its error."""
