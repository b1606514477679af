"""What is written for renderers: read back by the renderers' own formulas, which share nothing with what wrote it."""

import json
import math
import re
import sys
import types

import numpy as np
import pytest
import torch
from rigs import float64

import camtorch as ct

SIZE = (60, 80)
CORE, SQUARE = [40.0, 43.0, 38.3, 31.2], [40.0, 40.0, 38.3, 31.2]
RATIONAL = [0.1, 0.1, 1e-3, 1e-3, 0.1, 0.1, 0.1, 0.1, 1e-3, 1e-3, 1e-3, 1e-3]
PRISM = [0.01, 2e-3, 0, 0, 0, 0, 1e-3, -2e-3, 3e-3, 1e-3, -2e-3, 1e-3]
LENSES = {
    "pinhole": ct.Pinhole(float64(CORE), image_size=SIZE),
    "brown_conrady": ct.BrownConrady(float64(CORE), float64([-0.1, 0.02, 1e-3, -2e-3, 0.01]), image_size=SIZE),
    "rational": ct.BrownConrady(float64(CORE), float64(RATIONAL), image_size=SIZE),
    "kannala_brandt": ct.KannalaBrandt(float64(CORE), float64([0.01, 2e-3, -1e-3]), image_size=SIZE),
    "kannala_brandt_5": ct.KannalaBrandt(float64(SQUARE), float64([0.01, 2e-3, -1e-3, 0, 1e-3]), image_size=SIZE),
    "fisheye624": ct.Fisheye624(float64(SQUARE), float64(PRISM), image_size=SIZE),
    "f_theta_backward": ct.FThetaBackward(float64(SQUARE), float64([0.02, -0.01, 3e-3]), image_size=SIZE),
    "f_theta_backward_2": ct.FThetaBackward(float64(CORE), float64([0.02, -0.01]), image_size=SIZE),
    "stereographic": ct.Stereographic(float64(CORE), float64([0.0]), image_size=SIZE),
    "equisolid": ct.Equisolid(float64(CORE), float64([0.0] * 4), image_size=SIZE),
    "orthographic_fisheye": ct.OrthographicFisheye(float64([60.0, 60, 39, 30]), float64([0.0]), image_size=SIZE),
    "equirectangular": ct.Equirectangular(float64([14.0, 20, 38.3, 31.2]), image_size=SIZE),
    "double_sphere": ct.DoubleSphere(float64(CORE), float64([-0.2, 0.6]), image_size=SIZE),
}
EXACT = {
    "usda": {*list(LENSES)[:7]},
    "carla": {*LENSES} - {"rational", "kannala_brandt_5", "fisheye624", "equirectangular", "double_sphere"},
    "blender": {"pinhole", "equirectangular", "f_theta_backward", "f_theta_backward_2"},
}
SLOW = {"brown_conrady", "rational", "orthographic_fisheye"}
POSE = ct.Extrinsics(float64([0.3, -0.2, 0.5]), float64([1.0, 2.0, -3.0]))


# -- the formulas of the renderers


def polar(rays):
    """The angle from the axis, and the unit vectors of the azimuth."""
    rho = np.hypot(rays[:, 0], rays[:, 1])
    return np.arctan2(rho, rays[:, 2]), rays[:, :2] / np.maximum(rho, 1e-300)[:, None]


def radius_of(polynomial, theta):
    """The distance at which the polynomial of it, from the constant on, is an angle."""
    steps = np.linspace(0, 4, 400_001) / polynomial[1]
    angles = np.polynomial.polynomial.polyval(steps, polynomial)
    rising = np.logical_and.accumulate(np.diff(angles, prepend=-1) > 0)
    return np.interp(theta, angles[rising], steps[rising])


def opencv(x, y, k1, k2, p1, p2, k3, k4, k5, k6, s1, s2, s3, s4):
    r2 = x * x + y * y
    radial = (1 + r2 * (k1 + r2 * (k2 + r2 * k3))) / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
    a = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x) + s1 * r2 + s2 * r2 * r2
    return a, y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y + s3 * r2 + s4 * r2 * r2


def rows_of(text):
    return np.array(json.loads(re.search(r"xformOp:transform = (.+)", text)[1].replace("(", "[").replace(")", "]")))


def by_usd(text, rays):
    """Pixels, (0, 0) the outer corner; the prim has x right, y up, looks along -z, and its matrix acts on rows."""
    rays = rays @ np.linalg.inv(rows_of(text)[:3, :3]) * (1, -1, -1)
    found = dict(re.findall(r"\w+ (?:omni:lensdistortion:)?(?:\w+:)?(\w+) = (.+)", text))
    value = {key: json.loads(v) for key, v in found.items() if re.fullmatch(r"[-\d.e]+", v)}
    model = json.loads(found["model"])
    assert f'["OmniLensDistortion{model[0].upper()}{model[1:].replace("cv", "Cv")}API"]' in text
    theta, azimuth = polar(rays)
    if model == "opencvPinhole":
        names = ["k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4"]
        plane = np.stack(opencv(*(rays[:, :2] / rays[:, 2:]).T, *(value[name] for name in names)), -1)
    elif model == "opencvFisheye":
        plane = azimuth * (theta + sum(value[f"k{i}"] * theta ** (2 * i + 1) for i in range(1, 5)))[:, None]
    elif model == "ftheta":
        return azimuth * radius_of([value[f"k{i}"] for i in range(5)], theta)[:, None] + json.loads(
            found["opticalCenter"].replace("(", "[").replace(")", "]")
        )
    else:
        r = theta + sum(value[f"k{i}"] * theta ** (2 * i + 3) for i in range(6))
        a, b = (azimuth * r[:, None]).T
        p0, p1, r2 = value["p0"], value["p1"], r * r
        x = a + p0 * (2 * a * a + r2) + 2 * p1 * a * b + value["s0"] * r2 + value["s1"] * r2 * r2
        y = b + p1 * (2 * b * b + r2) + 2 * p0 * a * b + value["s2"] * r2 + value["s3"] * r2 * r2
        focal = value["focalLength"] / value["horizontalAperture"] * value["nominalWidth"]
        centre = json.loads(found["opticalCenter"].replace("(", "[").replace(")", "]"))
        return np.stack((x, y), -1) * focal + centre
    return plane * (value["fx"], value["fy"]) + (value["cx"], value["cy"])


def by_carla(text, rays):
    said = json.loads(text)["attributes"]
    assert all(isinstance(value, str) for value in said.values())
    theta, azimuth = polar(rays)
    assert float(said["theta_max_deg"]) >= math.degrees(theta.max()) - 1e-9
    k = [float(word) for word in said["distortion_coeffs"].split(",") if word]
    if said["camera_model"] == "brown_conrady":
        k1, k2, k3, p1, p2 = k
        plane = np.stack(opencv(*(rays[:, :2] / rays[:, 2:]).T, k1, k2, p1, p2, k3, *[0] * 7), -1)
    else:
        radii = {
            "perspective": np.tan,
            "stereographic": lambda angle: 2 * np.tan(angle / 2),
            "equisolid": lambda angle: 2 * np.sin(angle / 2),
            "orthographic": np.sin,
            "kannala_brandt": lambda angle: angle * (1 + sum(c * angle ** (2 * i) for i, c in enumerate(k, 1))),
            "ftheta": lambda angle: radius_of(k, angle),
        }
        plane = azimuth * radii[said["camera_model"]](theta)[:, None]
    unit = plane * [float(said[name]) for name in ("fx", "fy")] + [float(said[name]) for name in ("cx", "cy")]
    return unit * [float(said[name]) for name in ("image_size_x", "image_size_y")]


def in_blender(text):
    """What a script sets, where `bpy` and `mathutils` only remember: the scene, the camera, its object."""
    space = types.SimpleNamespace
    scene = space(render=space(), collection=space(objects=space(link=lambda item: None)))
    data, item = space(fisheye_fov=0.0), space()
    new = space(
        cameras=space(new=lambda name: data), objects=space(new=lambda name, lens: vars(item).update(name=name) or item)
    )
    stubs = {"bpy": space(context=space(scene=scene), data=new), "mathutils": space(Matrix=np.array)}
    with pytest.MonkeyPatch.context() as patch:
        for name, module in stubs.items():
            patch.setitem(sys.modules, name, module)
        exec(compile(text, "script", "exec"), {})
    return scene.render, data, item


def by_blender(text, rays):
    render, data, item = in_blender(text)
    rays = rays @ np.linalg.inv(item.matrix_world[:3, :3] * (1, -1, -1)).T
    width, height = render.resolution_x, render.resolution_y
    aspect = render.pixel_aspect_y / render.pixel_aspect_x
    if getattr(data, "type", "PERSP") == "PERSP":
        plane = rays[:, :2] / rays[:, 2:] * data.lens
        shift = data.shift_x, -data.shift_y * width / aspect / height
    else:
        shift = data.shift_x, -data.shift_y
        if data.panorama_type == "EQUIRECTANGULAR":
            angles = np.stack((np.arctan2(rays[:, 0], rays[:, 2]), np.arcsin(-rays[:, 1])), -1)
            low = np.array([data.longitude_min, data.latitude_max])
            return ((angles - low) / ([data.longitude_max, data.latitude_min] - low) - shift) * (width, height)
        theta, azimuth = polar(rays)
        assert data.fisheye_fov >= 2 * theta.max() - 1e-9
        plane = azimuth * radius_of([-getattr(data, f"fisheye_polynomial_k{i}") for i in range(5)], theta)[:, None]
    sensor = np.array([data.sensor_width, data.sensor_width * height * aspect / width])
    return (plane / sensor + 0.5 - shift) * (width, height)


BY = {"usda": by_usd, "carla": by_carla, "blender": by_blender}
SUFFIX = {"usda": ".usda", "carla": ".json", "blender": ".py"}


CASES = [
    # fits of Blender's polynomial to lenses that are nothing like it
    pytest.param(lens, format, marks=[pytest.mark.slow] * (format == "blender" and lens in SLOW))
    for lens in LENSES
    for format in BY
    if lens != "equirectangular" or format == "blender"
]


@pytest.mark.parametrize(("lens", "format"), CASES)
def test_renderers_see_what_the_camera_sees(lens, format, tmp_path):
    camera, path = LENSES[lens], tmp_path / f"camera{SUFFIX[format]}"
    if lens in EXACT[format]:
        ct.save(camera, path, format)
        text, limit = path.read_text(), 1e-4 if "f_theta" in lens else 1e-10  # the table of radius_of
        assert f"{camera.key}, exact" in text
    else:
        with pytest.warns(UserWarning, match=rf"{path.name}: camera: .* off by at most [\d.e-]+ px") as caught:
            ct.save(camera, path, format)
        text, limit = path.read_text(), 1.02 * float(re.search(r"at most ([\d.e-]+) px", str(caught[0].message))[1])
        assert str(caught[0].message).split("lens: ")[1] in text
        assert caught[0].filename == __file__
        assert len(caught) == 1
    rays, valid = (t.detach().reshape(-1, *t.shape[2:]).numpy() for t in camera.rays())
    off = np.abs(BY[format](text, rays) - 0.5 - camera.pixel_grid().reshape(-1, 2).numpy())[valid]
    assert off.max() < limit + 1e-4 * (limit > 1e-4)


@pytest.mark.parametrize("key", ["f_theta_backward", "pinhole"])
def test_a_pose_is_that_of_the_object(key, tmp_path):
    rig = ct.Rig({"front": LENSES[key]}, {"front": POSE})
    ct.save(rig, tmp_path / "a.py", "blender")
    ct.save(rig, tmp_path / "a.usda")
    _, _, item = in_blender((tmp_path / "a.py").read_text())
    assert item.name == "front"
    expected = np.linalg.inv(POSE.matrix().detach().numpy()) @ np.diag([1, -1, -1, 1])
    assert np.allclose(item.matrix_world, expected, rtol=0, atol=1e-14)
    assert np.allclose(rows_of((tmp_path / "a.usda").read_text()), expected.T, rtol=0, atol=1e-14)


def test_usd_reads_the_scene(tmp_path):
    """NVIDIA's schemas are not part of USD: their attributes are as they are written."""
    usd = pytest.importorskip("pxr.Usd", reason="usd-core is not installed")
    geometry = pytest.importorskip("pxr.UsdGeom")
    rig = ct.Rig({"1 left": LENSES["kannala_brandt"], "right": LENSES["fisheye624"]}, {"1 left": POSE, "right": POSE})
    ct.save(rig, tmp_path / "rig.usda")
    stage = usd.Stage.Open(str(tmp_path / "rig.usda"))
    prims = [prim for prim in stage.Traverse() if prim.IsA(geometry.Camera)]
    assert [str(prim.GetPath()) for prim in prims] == ["/rig/_1_left", "/rig/right"]
    assert geometry.GetStageMetersPerUnit(stage) == 1
    for prim, camera in zip(prims, rig.cameras.values(), strict=True):
        assert len(prim.GetMetadata("apiSchemas").GetAppliedItems()) == 1
        lens = {a.GetName().split(":")[-1]: a.Get() for a in prim.GetAttributes() if "omni:" in a.GetName()}
        names = camera.distortion_names if camera.key == "fisheye624" else ("k1", "k2", "k3")
        assert np.allclose([lens[name] for name in names], camera.distortion.tolist(), rtol=1e-6)
        frame = geometry.Camera(prim).GetCamera()
        point, here = np.array([0.2, 0.3, 4.0]), float64([0.2, 0.3, 4.0])
        seen = np.array(frame.transform.GetInverse().Transform(tuple(point))) * (1, -1, -1)
        assert np.allclose(seen, POSE(here).detach().numpy(), rtol=0, atol=1e-12)
        width, height = frame.horizontalAperture, frame.verticalAperture
        axis = [0.5 - frame.horizontalApertureOffset / width, 0.5 + frame.verticalApertureOffset / height]
        found = [frame.focalLength / width, frame.focalLength / height, *axis] * np.tile(SIZE[::-1], 2)
        assert np.allclose(found, np.add(camera.intrinsics.tolist(), (0, 0, 0.5, 0.5)), rtol=1e-6)


@pytest.mark.parametrize("suffix", [".npz", ".exr"])
@pytest.mark.parametrize("key", sorted(ct.MODELS))
def test_a_ray_field_is_unproject(key, suffix, tmp_path):
    camera = ct.MODELS[key](float64([14.0, 15, 38.3, 31.2]), image_size=SIZE)
    ct.save(camera, tmp_path / f"rays{suffix}", "rays")
    rays, valid = camera.unproject(camera.pixel_grid().double())
    if suffix == ".npz":
        with np.load(tmp_path / "rays.npz") as field:
            found, there = field["directions"], field["valid"]
        assert np.array_equal(there, valid.numpy())
    else:
        openexr = pytest.importorskip("OpenEXR", reason="OpenEXR is not installed")
        with openexr.File(str(tmp_path / "rays.exr")) as image:
            found = np.array(image.parts[0].channels["RGB"].pixels)
    assert found.dtype == np.float32
    assert np.array_equal(np.linalg.norm(found, axis=-1) > 0.5, valid.numpy())
    assert np.abs(found - rays.detach().numpy())[valid.numpy()].max() < 1e-6
    assert not found[~valid.numpy()].any()


PAIR = ct.Rig({"a b": LENSES["pinhole"], "a-b": LENSES["pinhole"]}, {"a b": POSE, "a-b": POSE})
BROKEN = LENSES["kannala_brandt"].clone().requires_grad_(False)
BROKEN.distortion[0] = torch.nan
BATCH = ct.Pinhole(float64([CORE] * 2), image_size=SIZE)
POSED = ct.Rig({"a": BATCH[0]}, {"a": POSE})


@pytest.mark.parametrize(
    ("format", "rig", "lost"),
    [
        *((format, BATCH, r"a batch of cameras \(2,\)") for format in (*BY, "rays")),
        *((format, ct.Pinhole(CORE), "no image_size, which") for format in (*BY, "rays")),
        *((format, BROKEN, "not finite") for format in (*BY, "rays")),
        ("blender", PAIR, "2 cameras; Blender holds one"),
        ("carla", POSED, "its extrinsics would be lost"),
        ("rays", POSED, "its extrinsics would be lost"),
        ("usda", PAIR, "a-b: a_b, which it is called in USD, is another camera, too"),
        ("usda", ct.Rig({"a": BATCH[0], "b": BATCH[0]}), "a: no extrinsics"),
        ("blender", ct.Equirectangular([12.0, 13, 40, 30], image_size=SIZE), "more than 360 x 180 degrees"),
        ("blender", ct.Pinhole([1.0, 1, 40, 30], image_size=SIZE), "a focal length of 0.0125 widths"),
    ],
)
def test_what_a_renderer_cannot_take_is_refused(format, rig, lost, tmp_path):
    path = tmp_path / f"x{SUFFIX.get(format, '.npz')}"
    with pytest.raises(ct.CameraFileError, match=lost):
        ct.save(rig, path, format)
    assert not path.exists()


@pytest.mark.parametrize("name", ['"); import os', "é\n}", "\\", "0", ""])
def test_names_stay_names(name, tmp_path):
    rig = ct.Rig({name: LENSES["pinhole"]})
    ct.save(rig, tmp_path / "a.py", "blender")
    assert in_blender((tmp_path / "a.py").read_text())[2].name == name
    ct.save(rig, tmp_path / "a.usda")
    (prim,) = re.findall(r'def Camera "(.*)" \(', (tmp_path / "a.usda").read_text())
    assert re.fullmatch(r"[A-Za-z_]\w*", prim, re.ASCII)


def test_what_is_written_only_is_not_read(tmp_path):
    with pytest.raises(ct.CameraFileError, match=r"files of ray fields are called \.npz or \.exr"):
        ct.save(LENSES["pinhole"], tmp_path / "a.txt", "rays")
    for name, format in (("a.usda", None), ("a.exr", None), ("b.npz", "rays"), ("b.json", "carla")):
        ct.save(LENSES["pinhole"], tmp_path / name, format)
        with pytest.raises(ct.CameraFileError, match="a file for renderers, which is written only"):
            ct.load(tmp_path / name)
    with pytest.raises(ValueError, match="format: 'carla' is not read; read are aria, "):
        ct.load(tmp_path / "a.usda", "carla")
    with pytest.raises(ValueError, match=r"a\.py: the name does not say the format; it may be blender"):
        ct.save(LENSES["pinhole"], tmp_path / "a.py")
