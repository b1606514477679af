"""The place of a sample's crop, which follows its camera and rotation through all augmentations."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import torch

from camtorch.augment.change import one_or_batch
from camtorch.warp.views import place_of

PLACE = "crop_place"


def put_place(sample: Mapping[str, Any], moved: dict[str, Any], owner: str) -> None:
    """Put `crop_place` into a moved sample, by its camera and by all that turned it; see `ct.views.crop_place`."""
    if PLACE in sample and not ("rotation" in sample and "camera" in moved):
        raise ValueError(
            f"{owner}: a sample with {PLACE} must have the rotation and the camera that came with it, as it follows "
            f"from them; got {', '.join(sample)}. Leave {PLACE} out, or keep them"
        )
    rotation = moved["rotation"]
    rotation = torch.stack(rotation) if isinstance(rotation, list) else rotation
    camera = one_or_batch(moved["camera"])
    moved[PLACE] = place_of(camera, rotation.to(camera.intrinsics))
