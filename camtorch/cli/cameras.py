"""What the command line reads: the cameras of a calibration file, by the options --name and --model."""

from __future__ import annotations

import argparse
import warnings
from pathlib import Path

from camtorch.camera import Camera
from camtorch.cli.terminal import note
from camtorch.io import CameraFileError, load, opencv
from camtorch.rig import Rig


def read_rig(path: Path, name: str | None = None, model: str | None = None, size: tuple[int, int] | None = None) -> Rig:
    """The cameras of a file.

    Args:
        path: a file of any format.
        name: the only camera wanted.
        model: a key of `camtorch.MODELS`, for OpenCV's files, which may not say it.
        size: (height, width), for cameras whose file does not say it.

    Raises:
        CameraFileError: the file cannot be used. ValueError: no camera of that name, or of another size; a model for a
            file that says its own.
    """
    rig = load(path) if model is None else _of_model(path, model)
    if name is not None:
        if name not in rig.cameras and name not in rig.images:
            raise ValueError(f"{path}: no camera is called {name!r}; there are {', '.join(rig.cameras)}")
        pose = {name: rig.extrinsics[name]} if name in rig.extrinsics else {}
        rig = Rig({name: rig.camera_of(name)}, pose, format=rig.format)
    for found, camera in rig.cameras.items():
        if size is not None and camera.image_size not in (None, size):
            raise ValueError(f"{path}: {found} is for {_shown(camera.image_size)}, not {_shown(size)}")
        camera.image_size = camera.image_size or size
    return rig


def _of_model(path: Path, model: str) -> Rig:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of what the file might mean: the model says it
        try:
            format = load(path).format
        except CameraFileError:  # a model may be what it lacks
            format = "opencv"
    if format != "opencv":
        raise ValueError(
            f"{path}: a file of {format}, which says the models of its cameras; naming one is for files of OpenCV "
            "that leave it open"
        )
    return opencv.read_rig(path, model)


def read_camera(path: Path, name: str | None = None, model: str | None = None) -> Camera:
    """The one camera of a file, or the one of that name; see `read_rig`.

    Raises:
        ValueError: there are several, or a batch.
    """
    return _single(path, *_only(path, read_rig(path, name, model)))


def read_other(path: Path, name: str | None = None) -> Camera:
    """The camera to compare with: the only one of its file, or the one of that name.

    Raises:
        ValueError: there are several, and none of that name.
    """
    rig = read_rig(path)
    if name is None or len(rig.cameras) == 1:
        name, camera = _only(path, rig)
    else:
        camera = rig.camera_of(name)
    return _single(path, name, camera)


def read_camera_of(image: Path, size: tuple[int, int], arguments: argparse.Namespace) -> Camera:
    """The camera that took an image of that (height, width), by the options of `add_photograph`.

    Raises:
        ValueError: as `read_camera`; no file is given, or it is for another size and is not to be scaled.
    """
    path: Path | None = arguments.camera
    if path is None:
        raise ValueError(
            f"{image}: which camera took it? --camera FILE, its calibration, says so: an image alone does not tell"
        )
    camera = read_camera(path, arguments.name, arguments.model)
    if camera.image_size is None:
        camera.image_size = size
        note(f"{path} states no image size; taken to be for {_shown(size)}, as {image} is")
    elif camera.image_size != size:
        if not arguments.rescale:
            raise ValueError(_resolutions(image, size, path, camera.image_size))
        camera = camera.resize(*size)
    return camera


def _only(path: Path, rig: Rig) -> tuple[str, Camera]:
    if len(rig.cameras) > 1:
        raise ValueError(f"{path}: several cameras; --name says which: {', '.join(rig.cameras)}")
    return next(iter(rig.cameras.items()))


def _single(path: Path, name: str, camera: Camera) -> Camera:
    if camera.batch_shape:
        raise ValueError(f"{path}: {name} is a batch of {tuple(camera.batch_shape)} cameras; here one is needed")
    return camera


def _resolutions(image: Path, size: tuple[int, int], path: Path, camera: tuple[int, int]) -> str:
    text = (
        f"{image} is {_shown(size)}, but the camera in {path} is for {_shown(camera)}; "
        "--rescale scales the camera to the image"
    )
    if abs(size[1] / camera[1] - size[0] / camera[0]) * max(camera) > 1:
        text += ", but their shapes differ too, so the image may be cropped, which scaling does not undo"
    return text


def _shown(size: tuple[int, int]) -> str:
    return f"{size[1]}x{size[0]}"
