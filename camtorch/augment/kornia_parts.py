"""The private parts of kornia that its front end needs, asked for when that is imported; no other file imports them."""

from __future__ import annotations

import importlib.metadata

import torch

try:
    from kornia.augmentation import AugmentationSequential, GeometricAugmentationBase2D
    from kornia.augmentation.base import _BasicAugmentationBase as BasicAugmentationBase
    from kornia.augmentation.container.image import ImageSequential
    from kornia.augmentation.container.params import ParamItem
    from kornia.augmentation.utils import _transform_output_shape as transform_output_shape
    from kornia.geometry.boxes import Boxes
    from kornia.geometry.keypoints import Keypoints
except ImportError as error:
    LACKS: list[str] = [str(error)]
else:
    _NEEDED = {
        GeometricAugmentationBase2D: ("_gate", "_blend_by_prob", "forward_parameters", "transform_tensor"),
        AugmentationSequential: ("_read_datakeys_from_dict", "_preproc_boxes", "autofill_dim"),
        ImageSequential: ("__getstate__",),
    }
    LACKS = [f"{kind.__name__}.{name}" for kind, names in _NEEDED.items() for name in names if not hasattr(kind, name)]
    for one, names in (
        (Boxes(torch.zeros(1, 1, 4, 2)), ("_data", "_valid")),
        (Keypoints(torch.zeros(1, 1, 2)), ("_data",)),
    ):
        LACKS += [f"{type(one).__name__}.{name}" for name in names if not hasattr(one, name)]
if LACKS:
    raise ImportError(
        f"camtorch.augment.kornia: kornia must have the parts of 0.9; got {importlib.metadata.version('kornia')}, "
        f"which lacks {', '.join(LACKS)}. Type pip install 'kornia==0.9.*'"
    )

__all__ = ["BasicAugmentationBase", "ParamItem", "transform_output_shape"]
