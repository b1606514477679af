"""What `camtorch dewarp` does to each file, in whatever process."""

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

_TOLERANCE = 0.001  # pixels that nobody sees, for a lattice of positions also where a calibration is in float64
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
        names = ("rescale", "projection", "fov", "image_size")
        settings = {"camtorch": __version__, "camera": cameras.settings_of(self.camera), **vars(self.encoder)}
        return settings | {name: getattr(self, name) for name in names}

    def __call__(self, item: Item, listener: Listener) -> dict[str, Any]:
        """What the new camera is."""
        (source,), (target,) = item.inputs, item.outputs
        if videos.is_video(source):
            return videos.remake(source, target, lambda size: self._warp(source, size), self.encoder, listener)
        image, orientation = images.read(source, tell=listener.note)
        rows, columns = image.shape[-2:]
        warp, facts = self._warp(source, (rows, columns))
        with torch.no_grad():
            result = warp(image[None])[0]
        del image  # of hundreds of megabytes, perhaps
        made = images.from_tensor(result)
        images.write(target, made, orientation=orientation, tell=listener.note, synced=False)
        return facts

    def warp_of(self, camera: Camera) -> Dewarp:
        """That of images of a camera."""
        return Dewarp(
            camera, projection=self.projection, fov=self.fov, image_size=self.image_size, tolerance=_TOLERANCE
        )

    def _warp(self, source: Path, size: tuple[int, int]) -> tuple[Dewarp, dict[str, Any]]:
        if size not in self._warps:
            if len(self._warps) >= _MOST_KEPT:
                del self._warps[next(iter(self._warps))]
            warp = self.warp_of(cameras.fitting(self.camera, self.path, source, size, self.rescale))
            self._warps[size] = warp, _facts(warp)
        return self._warps[size]


@torch.no_grad()
def _facts(warp: Dewarp) -> dict[str, Any]:
    """What is to be known of new images; `shown` is the part that they show of 64 x 64 pixels of the old one."""
    source, target = warp.source, warp.target
    part = torch.tensor([source.width / 64, source.height / 64])
    lattice = (source.resize(64, 64).pixel_grid() + 0.5) * part - 0.5
    return {
        "model": source.key,
        "width": target.width,
        "height": target.height,
        "intrinsics": target.intrinsics.tolist(),
        "degrees": float(target.fov[0]),
        "filled": images.filled(warp),
        "shown": float(warp.transform_points(lattice)[1].double().mean()),
    }
