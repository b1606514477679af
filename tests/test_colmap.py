"""COLMAP's models are ours: its numbers become ours, and back."""

import pytest
import torch
from cameras import GOLDEN

import camtorch as ct
from camtorch.models import colmap


@pytest.mark.parametrize("name", colmap.NAMES)
def test_numbers_return(name):
    numbers = tuple(0.01 * (i + 1) for i in range(len(colmap.parameter_names(name))))
    key, intrinsics, distortion = colmap.from_colmap(name, numbers)
    arguments = [torch.tensor(v, dtype=torch.float64) for v in (intrinsics, distortion) if v]
    assert ct.MODELS[key](*arguments).distortion.shape == (len(distortion),)
    assert colmap.to_colmap(name, key, intrinsics, distortion) == pytest.approx(numbers, rel=1e-15)


def test_every_model_has_reference_numbers():
    mentioned = {case["source"].removeprefix("pycolmap/") for case in GOLDEN.values()}
    same_formula = {"OPENCV_FISHEYE", "RAD_TAN_THIN_PRISM_FISHEYE"}
    assert set(colmap.NAMES) - same_formula <= mentioned


@pytest.mark.parametrize(
    ("name", "key", "intrinsics", "distortion"),
    [
        ("SIMPLE_RADIAL", "brown_conrady", (300, 301, 1, 1), (0.1, 0, 0, 0, 0)),
        ("SIMPLE_RADIAL", "brown_conrady", (300, 300, 1, 1), (0.1, 0, 1e-3, 0)),
        ("OPENCV", "brown_conrady", (300, 300, 1, 1), (0.1, 0, 1e-3, 0, 1e-3)),
        ("FISHEYE", "kannala_brandt", (300, 300, 1, 1), (0.1, 0, 0, 0)),
        ("FOV", "kannala_brandt", (300, 300, 1, 1), (0.1,)),
        ("EQUIRECTANGULAR", "equirectangular", (300, 300, 1, 1), ()),
    ],
)
def test_what_a_model_cannot_hold_is_refused(name, key, intrinsics, distortion):
    with pytest.raises(ValueError, match=name):
        colmap.to_colmap(name, key, intrinsics, distortion)
    with pytest.raises(ValueError, match="parameters"):
        colmap.from_colmap(name, (1.0,))
