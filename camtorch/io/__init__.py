"""Calibration files, one file per format."""

from camtorch.io import opencv
from camtorch.io.formats import FORMATS, load, loads, save
from camtorch.io.record import CameraFileError

__all__ = ["FORMATS", "CameraFileError", "load", "loads", "opencv", "save"]
