"""`write_viewer`: a page that shows a lens live, in one HTML file without other files.

The files in this folder become one text, with the camera, the photograph and the collection of real lenses:
`formulas.js` has the camera models, `drawing.js` the drawing and controls, `presets.json` a camera of every model.
"""

import base64
import json
import os
import re
import zlib
from functools import cache
from importlib import resources
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from PIL import Image

from camtorch.cameras.camera import MODELS, Camera
from camtorch.io.photographs import as_jpeg
from camtorch.io.writing import replacing
from camtorch.lenses.collection import columns
from camtorch.models import Splined
from camtorch.projection.rows import unusable
from camtorch.values.arguments import check_path, no_camera
from camtorch.values.module import model_of

_SIDE, _QUALITY = 1920, 85  # px of the longer side of a photograph, and of its JPEG file
_MOST_COUNT = 40  # most coefficients in the page for models with any number
_FOCAL, _BEND = 0.25, 0.1  # px: rounding of focal length and centre, and of coefficients, in packed lenses


@torch.no_grad()
def write_viewer(
    camera: Camera,
    path: str | os.PathLike[str],
    image: str | os.PathLike[str] | Image.Image | NDArray[Any] | torch.Tensor | None = None,
) -> None:
    """Write a page that shows a lens live: one HTML file without other files or network.

    It shows the image with the limit of the lens's rays, the image in another camera, and the radius over the angle.
    You can move coefficients, drop photographs, choose models and real lenses, and copy the lines of Python.

    Args:
        camera: A single camera with image_size, of a model in the gallery of models.
        path: The file; an existing one is replaced as a whole.
        image: A photograph of the camera: a path, a Pillow image, an array (H, W) or (H, W, C), a tensor
            (C, H, W). The page keeps it at up to 1920 pixels. Without one it shows drawn scenes through the lens.

    Raises:
        ValueError: If the camera is a batch, has no image_size, no pixels, or a model that the page has no formulas
            of, or if the image has another size. TypeError: If there is no camera or path. OSError: If the file cannot
            be written, or the image cannot be read.
    """
    check_path(path, "write_viewer")
    text = page(camera, image)
    with replacing(path) as (file,):
        file.write(text.encode())


def page(camera: Camera | None = None, image: Any = None) -> str:
    """Return the text of the page; without a camera it begins with a preset, or the camera of its address."""
    data: dict[str, Any] = {"camera": None, "photograph": None, "models": models(), "lenses": _lenses()}
    if camera is not None:
        data["camera"] = _describe(camera)
        if image is not None:
            name = os.fsdecode(image) if isinstance(image, (str, bytes, os.PathLike)) else "image"
            jpeg = as_jpeg(image, camera.size_for("write_viewer"), name, "write_viewer", _SIDE, _QUALITY)
            data["photograph"] = f"data:image/jpeg;base64,{base64.b64encode(jpeg).decode()}"
    # escaped, because no text may end the element that contains it
    parts = {"data": json.dumps(data, allow_nan=False, separators=(",", ":")).replace("</", "<\\/")}
    parts |= {name: _file(name) for name in ("page.css", "formulas.js", "drawing.js")}
    text = _file("page.html")
    for name, part in parts.items():
        text = text.replace(f"@@{name}@@", part)
    return text


def _file(name: str) -> str:
    return (resources.files(__package__) / name).read_text(encoding="utf-8")


def _describe(camera: Camera) -> dict[str, Any]:
    if not isinstance(camera, Camera) or camera.is_mixed:
        raise TypeError(f"write_viewer: camera must be a camera of one model; got {no_camera(camera)}")
    if camera.batch_shape:
        shape = tuple(camera.batch_shape)
        raise ValueError(f"write_viewer: camera must be a single one, as camera[0]; got a batch {shape}")
    lens = model_of(camera)
    if lens.key not in models() and not (issubclass(lens, Splined) and re.fullmatch("splined:order[^:]*", lens.key)):
        raise ValueError(
            f"write_viewer: model must be known to the page; got {camera.key or type(camera).__name__}; known are "
            f"{', '.join(sorted(models()))}. Convert it with camera.convert(...)"
        )
    size = camera.size_for("write_viewer")
    intrinsics, distortion = camera.intrinsics.detach().double(), camera.distortion.detach().double()
    if (trouble := unusable(camera, intrinsics, distortion)) is not None:
        raise ValueError(f"write_viewer: camera must have pixels; got none: {trouble[0]}: {trouble[1]}")
    return {
        "model": camera.key,
        "class": _constructor(lens),
        "intrinsics": _numbers(camera.intrinsics),
        "distortion": _numbers(camera.distortion),
        "names": list(camera.distortion_names)[: len(distortion)],
        "image_size": list(size),
    }


def _numbers(values: torch.Tensor) -> list[float]:
    """Return numbers as they would be written: 0.1 of float32 is 0.1, not 0.10000000149."""
    values = values.detach().cpu()
    return [float(str(value)) for value in (values if values.dtype == torch.float64 else values.float()).numpy()]


@cache
def models() -> dict[str, dict[str, Any]]:
    """Return for each model of the page a real camera, its class, names of coefficients, and their possible numbers."""
    known = {}
    for key, preset in json.loads(_file("presets.json")).items():
        kind = MODELS[key]
        counts = (*range(1, _MOST_COUNT + 1), kind.default_count) if kind.distortion_names else ()
        names = {n: of_count for n in counts if (of_count := kind.names_of(n))}
        known[key] = {
            "class": _constructor(kind),
            # the page itself names the coefficients of tables: angles come before radii, for any number of them
            "names": list(names[max(names)]) if names else [],
            "counts": list(names) or [0],
            "distortion": [],
            **preset,
        }
    return known


def _constructor(kind: type[Camera]) -> str:
    if not issubclass(kind, Splined) or kind is Splined:
        return kind.__name__
    return f"Splined.with_grid(columns={kind.columns}, rows={kind.rows}, fov_x={kind.fov_x}, order={kind.order})"


@cache
def _lenses() -> dict[str, Any]:
    """Return the collection of real lenses, packed by Deflate; integers are stored in byte planes, sign lowest.

    Focal lengths and centres are in steps of `_FOCAL` pixels, fy and the centre relative to fx and to the middle; k1 to
    k4 as the shift of a point at the corner of an image of an equidistant lens, in steps of `_BEND`.
    """
    texts, numbers = columns()
    exists = np.minimum(numbers[0], numbers[1]) > 0  # a few are not positive
    fx, fy, cx, cy, *k = numbers[:8, exists]
    width, height = (np.array(texts[side], float)[exists] for side in ("width", "height"))
    focal = np.rint(fx / _FOCAL)
    corner = np.hypot(width, height) / 2 / (focal * _FOCAL)
    steps = [focal, np.rint(fy / _FOCAL) - focal]
    steps += [np.rint((c - side / 2) / _FOCAL) for c, side in ((cx, width), (cy, height))]
    steps += [np.rint(c * focal * _FOCAL * corner ** (2 * i + 3) / _BEND) for i, c in enumerate(k)]
    widths, planes = [], []
    for step in steps:
        whole = step.astype(np.int64)
        code = (whole << 1) ^ (whole >> 63)
        widths.append((int(code.max()).bit_length() + 7) // 8)
        planes += [((code >> 8 * i) & 255).astype(np.uint8) for i in range(widths[-1])]
    names = "\0".join(
        "\0".join(value for value, there in zip(texts[name], exists, strict=True) if there)
        for name in ("brand", "camera", "lens", "setting", "width", "height")
    )
    return {
        "count": int(exists.sum()),
        "steps": [_FOCAL, _BEND],
        "widths": widths,
        "names": _deflate(names.encode()),
        "numbers": _deflate(np.concatenate(planes).tobytes()),
    }


def _deflate(content: bytes) -> str:
    """Return raw Deflate as Base64, which browsers can decode."""
    return base64.b64encode(zlib.compress(content, 9, wbits=-zlib.MAX_WBITS)).decode()
