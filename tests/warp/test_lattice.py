"""Laws of positions from a lattice: they keep their tolerance, and lose no pixel."""

import pytest
import torch
from cameras import KEYS, drawn, each_kind, real
from hypothesis import given, settings
from hypothesis import strategies as st

import camtorch as ct
from camtorch.warp.routes import by_pixel

TOLERANCES = (0.1, 0.01)


def check(source, target, rotation):
    """Positions on the image, or of which one is, differ by no more than the tolerance; mapped are the same."""
    exact = by_pixel(ct.Warp(source, target, rotation))
    half = torch.tensor(source.image_size[::-1]) / 2
    for tolerance in TOLERANCES:
        close = by_pixel(ct.Warp(source, target, rotation, tolerance=tolerance))
        assert torch.equal(exact.mapped, close.mapped)
        on_image = (exact.grid.abs() <= 1).all(-1) | (close.grid.abs() <= 1).all(-1)
        error = ((exact.grid - close.grid) * half).norm(dim=-1)[exact.mapped & on_image]
        assert error.numel() == 0 or error.max() <= tolerance


def check_padded(source, target, rotation, padding):
    """An image of its own positions, shown beyond its rim too, shows them within the tolerance."""
    height, width = source.image_size
    v, u = torch.meshgrid(*(torch.arange(side, dtype=torch.float32) for side in (height, width)), indexing="ij")
    image = torch.stack((u, v))[None]
    exact = ct.Warp(source, target, rotation, padding_mode=padding, tolerance=0.0)(image)
    # a corner of a reflection is not where a float32 says, and far out the less so
    rounding = 1e-3 if padding == "border" else 2e-2
    for tolerance in (10.0, 0.1, 0.01):
        close = ct.Warp(source, target, rotation, padding_mode=padding, tolerance=tolerance)
        called = ct.Warp(source, target, rotation, tolerance=tolerance)
        called(image)
        for shown in (close(image), called(image, padding_mode=padding), called.pin()(image, padding_mode=padding)):
            assert (shown - exact).norm(dim=1).max() <= tolerance + rounding


@pytest.mark.parametrize(("key", "padding"), [("division", "border"), ("brown_conrady", "reflection")])
def test_tolerances_hold_beyond_the_rim(key, padding):
    camera = next(iter(real(key).values())).float().requires_grad_(False).resize(240, 320)
    wide = ct.KannalaBrandt(torch.tensor([50.0, 50.0, 159.5, 119.5]), torch.zeros(4), image_size=(240, 320))
    rotation = ct.augment.mount_rotation(*(torch.tensor(angle) for angle in (20.0, -10.0, 30.0)))
    check_padded(camera, wide.requires_grad_(False), rotation, padding)
    check_padded(camera, wide, None, padding)


@each_kind
def test_real_lenses_keep_their_tolerance(key):
    camera = next(iter(real(key).values())).float().requires_grad_(False).resize(240, 320)
    rotation = ct.augment.mount_rotation(*(torch.tensor(angle) for angle in (20.0, -10.0, 30.0)))
    check(camera, ct.Dewarp(camera).target, None)
    check(camera, camera, rotation)
    check(ct.Dewarp(camera).target, camera, rotation)


# Key, intrinsics, distortion and image size of the source and of the target; the rotation. Drawn, and found to be hard.
HARD = {
    "the limit of what is mapped runs out thinner than a cell": (
        ("thin_prism_fisheye", (181.743, 351.899, 132.977, 198.767), (0.0135379, -0.0150059, 0.00090021, -0.000524041,
         0.0226065, -0.0145601, 0.000933579, -0.000408921), (392, 268)),
        ("fisheye62", (88.1312, 186.328, 129.49, 193.683), (0.0166121, -0.0135856, 0.0158969, -0.0128903, 0.0124873,
         -0.0149896, 0.000611236, -0.000563327), (382, 261)),
        [[-0.0797651708, -0.7260893583, 0.6829581261], [-0.6871442795, 0.5363937616, 0.4900148809],
         [-0.7221290469, -0.4302046001, -0.5417136550]],
    ),
    "likewise, with a tip of four pixels": (
        ("ucm", (61.1132, 39.3883, 205.193, 91.5083), (0.6652,), (181, 413)),
        ("thin_prism_fisheye", (143.21, 150.623, 233.582, 171.825), (0.00842008, -0.00460101, 0.000571139, -0.000656726,
         0.0250538, -0.0147517, 0.000404488, 0.000375158), (339, 470)),
        [[-0.9194191098, -0.0039543379, -0.3932592273], [0.2373904, 0.7916533, -0.5629663],
         [0.3135510981, -0.6109579206, -0.7269223928]],
    ),
    "what is mapped comes in from outside, thinner than a cell": (
        ("brown_conrady", (86.8274, 144.27, 156.883, 201.817), (0.058548, -0.0530774, 0.000458732, -0.000855083,
         0.0515541, -0.0876556, 0.0444812, -0.0832804, 0.00021738, -0.000729454, 0.000645089, -0.000697062, 0.0230295,
         -0.0141202), (398, 316)),
        ("ucm", (73.6419, 175.968, 101.102, 190.633), (0.675124,), (376, 204)),
        [[-0.3532485664, -0.9326806068, -0.0729540811], [-0.8416244984, 0.2827710807, 0.4601182044],
         [-0.4085140228, 0.2239360213, -0.8848553300]],
    ),
    "the source is cut open just beyond the rim of the target": (
        ("cylindrical", (31.7464, 38.2307, 100.604, 95.0667), (), (188, 203)),
        ("woodscape", (177.211, 179.965, 242.547, 189.108), (0.0274362, -0.0480651, 0.00982054), (373, 488)),
        [[-0.7090440392, -0.5343850255, 0.4600970149], [-0.5322012901, -0.0225200355, -0.8463182449],
         [0.4626212418, -0.8449411392, -0.2684327364]],
    ),
    "curvature has steps": (
        ("mei", (92.3534, 205.493, 83.6699, 152.508), (1.28354, -0.094304, 0.096669, -0.000614411, 0.000575029),
         (301, 169)),
        ("tabulated", (357.047, 145.905, 242.049, 76.7667), (0.31987, 0.589465, 0.938227, 1.16799, 1.54251, 1.78621,
         0.3112, 0.553693, 0.834033, 1.10703, 1.38374, 1.64503), (152, 487)),
        [[-0.6202418804, 0.2813250721, -0.7322268486], [-0.5303356648, 0.5374025106, 0.6557000875],
         [0.5779654384, 0.7950186729, -0.1841228157]],
    ),
    "cells on both sides of the axis meet the tolerance within a thousandth of it": (
        ("tabulated", (868.73376, 951.8356, 392.1125, 306.13748), (0.67461783, 1.1450148, 1.6574193, 1.8895897,
         2.1105397, 2.5912719, 3.1810648, 0.5185443, 0.5185443, 1.486181, 1.7968031, 2.6724687, 2.6724687, 2.9069364),
         (612, 784)),
        ("pinhole", (247.59793, 313.31616, 122.864525, 121.24709), (), (243, 246)),
        [[0.84, 0, 0.5426], [0, 1, 0], [-0.5426, 0, 0.84]],
    ),
    "curvature steps at the axis, in the middle of a cell, against that of the lens around it": (
        ("f_theta", (76.575363, 70.01177, 76.61903, 46.695038),
         (0.060716812, 0.0, 0.0, -0.06474075, 1e-11, 1e-10, -0.0053527234), (96, 154)),
        ("pinhole", (30.38603, 93.54958, 49.238407, 92.780914), (), (190, 99)),
        None,
    ),
    "and beside the limit of a table": (
        ("mei", (451.28162, 582.9246, 111.68861, 110.789246), (3.4664693, -0.4027524, -1e-5, 0.0, 0.0), (222, 224)),
        ("tabulated", (546.0527, 982.90094, 95.06072, 115.36195), (0.8, 1.300322, 2.02995, 2.291324, 0.16804501,
         0.82956624, 0.8295563, 1.638779), (246, 196)),
        None,
    ),
}  # fmt: skip
IN_FLOAT64 = list(HARD)[-3:]  # near a fold rounding costs nothing there


@pytest.mark.parametrize("what", HARD)
def test_hard_warps_keep_their_tolerance(what):
    *pair, rotation = HARD[what]
    dtype = torch.float64 if what in IN_FLOAT64 else torch.float32
    source, target = (
        ct.MODELS[key](list(k), *([list(d)] if d else []), image_size=size).to(dtype).requires_grad_(False)
        for key, k, d, size in pair
    )
    check(source, target, None if rotation is None else torch.tensor(rotation, dtype=dtype))


SIDES = st.integers(64, 260)


@st.composite
def pairs(draw):
    """Two cameras of any models, plausible or wild, of any zoom between them, and a rotation."""
    cameras = []
    for wild in (draw(st.booleans()), draw(st.booleans())):
        camera = draw(drawn(draw(st.sampled_from(KEYS)), wild=wild)).double().requires_grad_(False)
        cameras.append(camera.resize(draw(SIDES), draw(SIDES)))
    if draw(st.booleans()):
        height, width = cameras[0].image_size
        cameras[0] = cameras[0].resize(4 * height, 4 * width)
    if draw(st.booleans()):
        cameras[1] = ct.Dewarp(cameras[0]).target.resize(draw(SIDES), draw(SIDES))
    angles = [torch.tensor(draw(st.floats(-180, 180, width=32))) for _ in range(3)]
    return *cameras, draw(st.sampled_from([None, ct.augment.mount_rotation(*angles)]))


@pytest.mark.slow
@given(pairs())
@settings(max_examples=30)
def test_drawn_warps_keep_their_tolerance(pair):
    source, target, rotation = pair
    check(source, target, None if rotation is None else rotation.double())


def test_points_of_a_pinned_warp_are_those_of_its_cameras_and_learn_with_them():
    source = ct.KannalaBrandt.from_fov(150, image_size=(256, 320))
    target = ct.Pinhole.from_fov(80, image_size=(200, 240))
    rotation = ct.augment.mount_rotation(*torch.tensor([0.1, -0.05, 0.2]))
    pixels = torch.rand(50, 2) * torch.tensor([320.0, 256.0])
    fresh, pinned = (ct.Warp(source, target, rotation) for _ in range(2))
    with torch.no_grad():
        pinned.pin()
        expected, valid = fresh.transform_points(pixels)
        found, seen = pinned.transform_points(pixels)
    assert torch.equal(found, expected)
    assert torch.equal(seen, valid)
    moved, _ = pinned.transform_points(pixels)
    moved[valid].sum().backward()
    assert source.intrinsics.grad.abs().sum() > 0
