"""The cameras of a calibration file, chosen by options, and their model."""

import argparse
import warnings
from collections.abc import Iterable, Sequence
from itertools import chain
from pathlib import Path

from camtorch import lenses
from camtorch.cameras.camera import Camera, as_model
from camtorch.cameras.rig import Rig
from camtorch.cli.lenses import find
from camtorch.cli.terminal import note
from camtorch.cli.words import GUESS, LENS
from camtorch.io import load, opencv

_ASPECT = 0.01  # relative tolerance of aspect ratios, because sizes are rounded
_WIDE = 100  # horizontal degrees from which a lens is taken as a fisheye
Size = tuple[int, int]  # (height, width)


def read_rig(
    path: Path, name: str | None = None, model: str | None = None, size: Size | None = None, *, stated: bool = False
) -> Rig:
    """Read the cameras of a file, of `LENS` and the name of a real lens, or of `GUESS` and a field of view.

    `name` chooses one camera; `model` and `size` complete a file without them. `stated`: refuse an ambiguous model.
    """
    if str(path).startswith(LENS):
        words = str(path).removeprefix(LENS)
        known = (size and lenses.search(words, image_size=size)) or find(words)
        others = f", the best of {len(known)} that camtorch lenses lists" if len(known) > 1 else ""
        note(f"{words}: {known[0]!r}{others}")
        return Rig({"camera": known[0].camera()})
    if str(path).startswith(GUESS):
        fov = str(path).removeprefix(GUESS)
        if size is None:
            raise ValueError(f"{GUESS}{fov}: image size must be known for a guess; got none")
        kind = as_model(model or ("pinhole" if float(fov) < _WIDE else "kannala_brandt"), "--model")
        guessed = kind.from_fov(float(fov), image_size=size).double().requires_grad_(False)
        focal = float(guessed.intrinsics[0])
        note(f"{fov} degrees wide is a guess: {guessed.key}, {_shown(size)}, focal length {focal:.6g}")
        return Rig({"camera": guessed})
    rig = load(path) if model is None else opencv.read_rig(path, model)
    if stated and model is None and rig.format == "opencv" and _leaves_open(path):
        way = "Write --from-model kannala_brandt if they are from cv2.fisheye, else --from-model brown_conrady"
        raise ValueError(f"{path}: the model of 4 coefficients must be named; got none. {way}")
    if name is not None:
        if name not in rig.cameras and name not in rig.images:
            raise ValueError(f"{path}: name must be one of {', '.join(rig.cameras)}; got {name!r}")
        pose = {name: rig.extrinsics[name]} if name in rig.extrinsics else {}
        rig = Rig({name: rig.camera_of(name)}, pose, format=rig.format)
    for found, camera in rig.cameras.items():
        if size is not None and camera.image_size not in (None, size):
            raise ValueError(f"{path}: {found} must be for {_shown(size)}; got {_shown(camera.image_size)}")
        camera.image_size = camera.image_size or size
    return rig


def _leaves_open(path: Path) -> bool:
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        load(path)
    return any(issubclass(warning.category, opencv.AmbiguousModelWarning) for warning in caught)


def read_camera(path: Path, name: str | None = None, model: str | None = None, size: Size | None = None) -> Camera:
    """Read the only camera of a file, or the one called `name`; see `read_rig`."""
    return one(path, read_rig(path, name, model, size))


def read_other(path: Path, name: str | None = None, model: str | None = None) -> Camera:
    """Read the camera to compare with: the only one of its file, or the one called `name`."""
    rig = read_rig(path, model=model if model is not None and _leaves_open(path) else None)
    return one(path, rig, None if len(rig.cameras) == 1 else name)


def one(path: Path, rig: Rig, name: str | None = None) -> Camera:
    """Return the camera called `name`, or the only one."""
    if name is None and len(rig.cameras) > 1:
        raise ValueError(f"{path}: must have one camera; got several. Choose one with --name: {', '.join(rig.cameras)}")
    name = name or next(iter(rig.cameras))
    camera = rig.camera_of(name)
    if camera.batch_shape:
        raise ValueError(f"{path}: {name} must be one camera; got a batch of {tuple(camera.batch_shape)}")
    return camera


def read_for_images(images: Sequence[Path], sizes: Iterable[Size | None], arguments: argparse.Namespace) -> Camera:
    """Read the camera of images by `--camera`, `--lens` or `--guess-fov`, for the first image's size if it has none."""
    path: Path | None = arguments.camera
    sized = ((image, size) for image, size in zip(images, sizes, strict=True) if size)
    first, size = next(sized, (images[0], None))
    if path is None:
        way = "--camera FILE, its calibration, or --lens NAME. --guess-fov DEGREES guesses"
        raise ValueError(f"{first}: a camera must be given: {way}")
    is_file = not str(path).startswith((LENS, GUESS))
    camera = read_camera(path, arguments.name, arguments.from_model, None if is_file else size)
    if size is not None:
        known = chain([size], (other for _, other in sized))  # read as far as one fits
        if camera.image_size is None or all(_unfitting(camera, one, arguments.rescale) for one in known):
            camera = fitting(camera, path, first, size, arguments.rescale)
    return camera


def fitting(camera: Camera, path: Path, image: Path, size: Size, rescale: bool) -> Camera:
    """Return the camera of a file for an image of a size, which the camera gets if it has none."""
    if camera.image_size is None:
        camera.image_size = size
        note(f"{path} states no image size; taken to be for {_shown(size)}, as {image} is")
    if reason := _unfitting(camera, size, rescale):
        own = _shown((camera.height, camera.width))
        raise ValueError(f"{image}: must be {own}, as the camera in {path}; got {_shown(size)}. {reason}")
    return camera if camera.image_size == size else camera.resize(*size)


def _unfitting(camera: Camera, size: Size, rescale: bool) -> str:
    """Return the reason why a camera does not fit images of a size, or "" if it fits."""
    if camera.image_size == size:
        return ""
    if size == (camera.width, camera.height):
        return "Width and height are exchanged, which scaling does not undo: turn the photograph"
    shapes = size[1] / size[0], camera.width / camera.height
    if max(shapes) <= (1 + _ASPECT) * min(shapes):
        return "" if rescale else "--rescale scales the camera to the image"
    ratios = f"{shapes[0]:.4g} and {shapes[1]:.4g}, differ by more than {100 * _ASPECT:g} %"
    return f"Their aspect ratios, {ratios}: the image may be cropped, which --rescale does not undo"


def _shown(size: Size) -> str:
    return f"{size[1]}x{size[0]}"
