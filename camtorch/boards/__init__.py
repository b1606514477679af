"""Boards that are photographed to calibrate: printed, found in images, kept in files of corners."""
