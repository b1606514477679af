"""What the command line reads: the cameras of a calibration file, by the options --name and --model."""

from __future__ import annotations

import warnings
from pathlib import Path

from camtorch.camera import Camera
from camtorch.io import load, opencv
from camtorch.rig import Rig


def read_rig(path: Path, name: str | None = None, model: str | None = None, size: tuple[int, int] | None = None) -> Rig:
    """The cameras of a file, none of which learns.

    Args:
        path: a file of any format.
        name: the only camera wanted.
        model: a key of `camtorch.MODELS`, for OpenCV's files, which may not say it.
        size: (height, width), for cameras whose file does not say it.

    Raises:
        CameraFileError: the file cannot be used. ValueError: no camera of that name, or of another size.
    """
    with warnings.catch_warnings():
        if model is not None:  # then it does not matter what the file might mean
            warnings.simplefilter("ignore")
        rig = load(path, None if model is None else "opencv")
    if model is not None:
        rig = Rig({n: opencv.read(path, model, name=None if n == "camera" else n) for n in rig.cameras}, rig.extrinsics)
    if name is not None:
        if name not in rig.cameras and name not in rig.images:
            raise ValueError(f"{path}: no camera is called {name!r}; there are {', '.join(rig.cameras)}")
        pose = {name: rig.extrinsics[name]} if name in rig.extrinsics else {}
        rig = Rig({name: rig.camera_of(name)}, pose, format=rig.format)
    for found, camera in rig.cameras.items():
        camera.requires_grad_(False)
        if size is not None and camera.image_size not in (None, size):
            height, width = camera.image_size
            raise ValueError(f"{path}: {found} is for {width}x{height}, not {size[1]}x{size[0]}")
        camera.image_size = camera.image_size or size
    return rig


def read_camera(path: Path, name: str | None = None, model: str | None = None) -> Camera:
    """The one camera of a file, or the one of that name; see `read_rig`.

    Raises:
        ValueError: there are several.
    """
    return _only(path, read_rig(path, name, model))


def read_other(path: Path, name: str | None = None) -> Camera:
    """The camera to compare with: the only one of its file, or the one of that name.

    Raises:
        ValueError: there are several, and none of that name.
    """
    rig = read_rig(path)
    return _only(path, rig) if name is None or len(rig.cameras) == 1 else rig.camera_of(name)


def _only(path: Path, rig: Rig) -> Camera:
    if len(rig.cameras) > 1:
        raise ValueError(f"{path}: several cameras; --name says which: {', '.join(rig.cameras)}")
    return rig.camera
