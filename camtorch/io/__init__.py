"""Calibration files, one file per format."""

from camtorch.io import opencv
from camtorch.io.camtorch_json import dict_of as dict_of  # methods of cameras and poses call this and the next two
from camtorch.io.camtorch_json import made_of as made_of
from camtorch.io.formats import FORMATS, load, loads, save
from camtorch.io.formats import load_camera as load_camera
from camtorch.io.record import CameraFileError

__all__ = ["FORMATS", "CameraFileError", "load", "loads", "opencv", "save"]
