"""The ray of each pixel, exact for every lens: `.npz` of `directions` and `valid`, or `.exr`; written only.

Directions (H, W, 3) are float32 unit vectors in the camera's own frame, x right, y down, z forward: red, green and blue
of an EXR, which OpenEXR writes. Pixels without a ray have the direction 0 0 0.
"""

from __future__ import annotations

import io

import numpy as np
import torch

from camtorch.io.exr import as_exr
from camtorch.io.protocol import Names
from camtorch.io.writing import Lossy
from camtorch.rig import Rig

NAMES = Names("rays", "a ray field", (".npz", ".exr"), ("*.exr",))


@torch.no_grad()
def render(rig: Rig, path: str) -> dict[str, bytes]:
    """The rays of one camera, which loses its name. Raises what `as_exr` raises."""
    lossy = Lossy(path, NAMES.title)
    if not path.lower().endswith(NAMES.suffixes):
        lossy.fail("name", f"files of ray fields are called {' or '.join(NAMES.suffixes)}")
    lossy.no_pose(rig)
    name, camera = lossy.only_camera(rig)
    lossy.size(name, camera)
    lossy.model(name, camera, {camera.key})
    exact = camera.replace(camera.intrinsics.detach().double(), camera.distortion.detach().double())
    directions, valid = exact.rays()
    field = torch.where(valid[..., None], directions, 0.0).float().cpu().numpy()
    if path.lower().endswith(".exr"):
        return {path: as_exr(field, {})}
    content = io.BytesIO()
    np.savez(content, directions=field, valid=valid.cpu().numpy())
    return {path: content.getvalue()}
