"""Calibration files, one file per format."""

from camtorch.io import opencv
from camtorch.io._errors import CameraFileError
from camtorch.io.formats import FORMATS, load, save

__all__ = ["FORMATS", "CameraFileError", "load", "opencv", "save"]
