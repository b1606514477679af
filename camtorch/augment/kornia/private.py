"""The private parts of kornia that its front end needs, asked for when that is imported; no other file imports them."""

from __future__ import annotations

import importlib.metadata

import torch

try:
    from kornia.augmentation import AugmentationSequential, GeometricAugmentationBase2D
    from kornia.augmentation._2d.base import _input_metadata_only as input_metadata_only
    from kornia.augmentation.base import _BasicAugmentationBase as BasicAugmentationBase
    from kornia.augmentation.container.params import ParamItem
    from kornia.augmentation.utils import _transform_output_shape as transform_output_shape
    from kornia.geometry.boxes import Boxes
    from kornia.geometry.keypoints import Keypoints
except ImportError as error:
    LACK = str(error)
else:
    _NEEDED = (
        (
            GeometricAugmentationBase2D(),
            "_blend_by_prob _compute_matrix_lazily _gate _params forward_parameters transform_tensor",
        ),
        (AugmentationSequential(), "_params _preproc_boxes _read_datakeys_from_dict autofill_dim forward_parameters"),
        (Boxes(torch.zeros(1, 1, 4, 2)), "_data _valid"),
        (Keypoints(torch.zeros(1, 1, 2)), "_data"),
    )
    _members = [(one, name) for one, names in _NEEDED for name in names.split()]
    LACK = ", ".join(f"{type(one).__name__}.{name} is missing" for one, name in _members if not hasattr(one, name))
if LACK:
    raise ImportError(
        f"camtorch.augment.kornia: kornia must have the parts of 0.9; got {importlib.metadata.version('kornia')}: "
        f"{LACK}. Type pip install 'kornia==0.9.*'"
    )

__all__ = ["BasicAugmentationBase", "ParamItem", "input_metadata_only", "transform_output_shape"]
