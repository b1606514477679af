"""What `camtorch dewarp` does to each of many files, in whatever process."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import torch

from camtorch import __version__
from camtorch.camera import Camera
from camtorch.cli import cameras, images, videos
from camtorch.jobs.items import Item, Listener
from camtorch.warp.dewarp import Dewarp, Projection

TOLERANCE = 0.001
"""Pixels that nobody sees, for a lattice of positions also where a calibration is in float64."""
_MOST_KEPT = 4  # warps of images of different sizes


@dataclass
class Dewarping:
    """Makes one item; a `camtorch.jobs.items.Work`. The map is computed once for each size of image."""

    camera: Camera
    """Of a known size."""
    path: Path
    """Of the file it is from."""
    rescale: bool
    projection: Projection
    fov: float | None
    """Degrees."""
    image_size: tuple[int, int] | None
    encoder: videos.Encoder
    _warps: dict[tuple[int, int], tuple[Dewarp, dict[str, Any]]] = field(default_factory=dict)

    def settings(self) -> dict[str, Any]:
        """All that outputs depend on; JSON."""
        camera = self.camera
        intrinsics, distortion = (values.detach().tolist() for values in (camera.intrinsics, camera.distortion))
        return {
            "camtorch": __version__,
            "camera": {
                "model": camera.key,
                "image_size": camera.image_size,
                "intrinsics": intrinsics,
                "distortion": dict(zip(camera.distortion_names, distortion, strict=True)),
            },
            "rescale": self.rescale,
            "projection": self.projection,
            "fov": self.fov,
            "image_size": self.image_size,
            "codec": self.encoder.codec,
            "crf": self.encoder.crf,
        }

    def __call__(self, item: Item, listener: Listener) -> dict[str, Any]:
        """What the new camera is."""
        (source,), (target,) = item.inputs, item.outputs
        if videos.is_video(source):
            return videos.remake(source, target, lambda size: self._warp(source, size), self.encoder, listener)
        image, orientation = images.read(source, tell=listener.note)
        rows, columns = image.shape[-2:]
        warp, told = self._warp(source, (rows, columns))
        with torch.no_grad():
            result = warp(image[None])[0]
        made = images.from_tensor(result)
        images.write(target, made, orientation=orientation, tell=listener.note, synced=False)
        return told

    def warp_of(self, camera: Camera) -> Dewarp:
        """That of images of a camera."""
        return Dewarp(camera, projection=self.projection, fov=self.fov, image_size=self.image_size, tolerance=TOLERANCE)

    def _warp(self, source: Path, size: tuple[int, int]) -> tuple[Dewarp, dict[str, Any]]:
        if size not in self._warps:
            while len(self._warps) >= _MOST_KEPT:
                del self._warps[next(iter(self._warps))]
            warp = self.warp_of(cameras.fitting(self.camera, self.path, source, size, self.rescale))
            self._warps[size] = warp, _facts(warp)
        return self._warps[size]


def _facts(warp: Dewarp) -> dict[str, Any]:
    """What is to be known of new images."""
    return {
        "model": warp.source.key,
        "width": warp.target.width,
        "height": warp.target.height,
        "intrinsics": warp.target.intrinsics.tolist(),
        "degrees": float(warp.target.fov[0]),
        "filled": float(warp.valid_mask().double().mean()),
    }
