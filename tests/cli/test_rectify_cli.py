"""`camtorch rectify`: its files, what they say, and what is refused before any is written."""

import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import command, opened, pixels
from PIL import Image

import camtorch as ct
from camtorch.rotations import rotation_matrix

cv2 = pytest.importorskip("cv2")

SIZE, DISTANCE, BASELINE = (240, 320), 3.0, 0.25
PLY = np.dtype([(name, "<f4") for name in "xyz"] + [("colour", "u1", 3)])


def rig():
    lens = ct.KannalaBrandt([180.0, 180, 159.5, 119.5], [0.01, 0.0, 0.0, 0.0], image_size=SIZE)
    other = ct.BrownConrady([200.0, 202, 160, 120], [-0.05, 0.0, 0.0, 0.0, 0.0], image_size=SIZE)
    turns, shifts = ([0.1, 0.2, 0.3], [0.02, -0.03, 0.01]), ([1.0, 2.0, 3.0], [-BASELINE, 0.0, 0.0])
    poses = [ct.Extrinsics(*pose).double().requires_grad_(False) for pose in zip(turns, shifts, strict=True)]
    between = poses[1].compose(poses[0])
    cameras = {"left": lens, "right": other, "third": lens}
    return ct.Rig(cameras, {"left": poses[0], "right": between}).double().requires_grad_(False)


@pytest.fixture(scope="module")
def seen(tmp_path_factory):
    """A wall with a texture, seen by both."""
    folder, cameras = tmp_path_factory.mktemp("pair"), rig()
    coarse = torch.rand(1, 3, 80, 107, generator=torch.Generator().manual_seed(0))
    texture = torch.nn.functional.interpolate(coarse, SIZE, mode="bicubic").clamp(0, 1)
    between = cameras.between("left", "right")
    normal = rotation_matrix(between.rotation)[:, 2]
    distance = DISTANCE + float(normal @ between.translation)
    view = ct.PlaneWarp(cameras["left"], cameras["right"], between.inverse(), normal, distance)
    for name, image in (("left", texture), ("right", view(texture.double()))):
        Image.fromarray((255 * image[0].permute(1, 2, 0)).round().byte().numpy()).save(folder / f"{name}.png")
    ct.save(cameras, folder / "three.json")
    del cameras.cameras["third"]
    ct.save(cameras, folder / "rig.json")
    return folder


@pytest.fixture
def folder(seen, tmp_path, monkeypatch):
    for path in seen.iterdir():
        shutil.copy(path, tmp_path)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def cloud(path):
    content = Path(path).read_bytes()
    header, rows = content.split(b"end_header\n", 1)
    assert header.startswith(b"ply\nformat binary_little_endian 1.0\n")
    points = np.frombuffer(rows, PLY)
    assert f"element vertex {len(points)}\n".encode() in header
    return np.stack([points[name] for name in "xyz"], -1), points["colour"]


def test_a_pair_its_cameras_and_their_images(folder, capsys):
    command("rectify", "left.png", "right.png", "--camera", "rig.json", "-o", "out")
    out = capsys.readouterr().out
    assert out.startswith("out: kannala_brandt and brown_conrady rectified to perspective, ")
    assert "rows correspond, baseline 0.25; " in out
    names = ["left.png", "opencv.yml", "pair.png", "rectified.json", "right.png"]
    assert [path.name for path in sorted(Path("out").iterdir())] == names
    given, made = ct.load("rig.json"), ct.load("out/rectified.json")
    expected = ct.rectify(given["left"], given["right"], given.between("left", "right"))
    images = [torch.from_numpy(pixels(f"{name}.png")).permute(2, 0, 1)[None] for name in ("left", "right")]
    for name, image in zip(("left", "right"), expected(*images), strict=True):
        assert np.array_equal(pixels(f"out/{name}.png"), image[0].permute(1, 2, 0).numpy())
        assert torch.equal(made[name].intrinsics, expected.camera_left.intrinsics)
    height, width = expected.camera_left.image_size
    assert pixels("out/pair.png").shape == (height, 2 * width, 3)
    # the cameras stand where they stood in the rig
    between = made.between("left", "right")
    assert between.translation.tolist() == pytest.approx([-BASELINE, 0.0, 0.0], abs=1e-14)
    assert between.rotation.abs().max() < 1e-14
    torch.testing.assert_close(made.extrinsics["right"].position, given.extrinsics["right"].position)
    storage = cv2.FileStorage("out/opencv.yml", cv2.FileStorage_READ)
    np.testing.assert_allclose(storage.getNode("R1").mat(), expected.rotation_left, atol=1e-15)
    storage.release()


@pytest.mark.parametrize("projection", ["perspective", "latlon", pytest.param("cylindrical", marks=pytest.mark.slow)])
def test_disparities_and_points_of_a_wall(folder, capsys, projection):
    words = ["--projection", projection, "--disparity", "--points", "-o", "out"]
    command("rectify", "left.png", "right.png", "--camera", "rig.json", *words)
    points, colours = cloud("out/points.ply")
    # in the left camera's frame
    assert len(points) > 20_000
    assert abs(np.median(points[:, 2]) / DISTANCE - 1) < 0.01
    assert np.quantile(np.abs(points[:, 2] / DISTANCE - 1), 0.9) < 0.05
    given = ct.load("rig.json")
    at, _ = given["left"].project(torch.from_numpy(points).double())
    image = torch.from_numpy(pixels("left.png")).permute(2, 0, 1)[None].double()
    grid = (2 * at + 1) / torch.tensor([SIZE[1], SIZE[0]]) - 1
    there = torch.nn.functional.grid_sample(image, grid[None, None], align_corners=False)[0, :, 0].T
    assert np.median(np.abs(there.numpy() - colours)) < 2
    disparity = np.load("out/disparity.npy")
    assert disparity.dtype == np.float32
    found = ct.rectify(given["left"], given["right"], given.between("left", "right"), projection=projection)
    again, valid = found.disparity_to_points(torch.from_numpy(disparity).double())
    wall = again[valid] @ found.rotation_left
    assert abs(float(wall[:, 2].median()) / DISTANCE - 1) < 0.01
    assert pixels("out/disparity.png").shape == (*disparity.shape, 3)
    assert "% of left.png; disparity.png: in colour" in capsys.readouterr().out


@pytest.mark.slow
def test_depths_limit_points(folder, capsys):
    for near, far, some in ((2, 4, True), (5, "inf", False)):
        words = ["--points", "--depth", near, far, "-o", "out", "--force"]
        command("rectify", "left.png", "right.png", "--camera", "rig.json", *words)
        points, _ = cloud("out/points.ply")
        assert len(points) > 10_000 if some else len(points) < 1000
        # depth is along the rectified cameras' axis, which is turned
        assert not some or (points[:, 2].min() > 1.8 and points[:, 2].max() < 4.2)
    assert not Path("out/disparity.npy").exists()


def test_exchanged_cameras_have_negative_disparities(folder, capsys):
    words = ["--names", "right", "left", "--camera", "three.json", "--disparity", "--points", "-o", "out"]
    command("rectify", "right.png", "left.png", *words)
    disparity = np.load("out/disparity.npy")
    assert np.nanmax(disparity) < 0.1
    assert np.isfinite(disparity).mean() > 0.2
    assert abs(np.median(cloud("out/points.ply")[0][:, 2]) / DISTANCE - 1) < 0.05


def test_cameras_above_each_other(tmp_path, monkeypatch):
    """The same pair, turned by a quarter."""
    monkeypatch.chdir(tmp_path)
    lens = ct.Pinhole([90.0, 90, 59.5, 79.5], image_size=(160, 120))
    poses = {"upper": ct.Extrinsics([0.0] * 3, [0.0] * 3), "lower": ct.Extrinsics([0.0] * 3, [0.0, -BASELINE, 0.0])}
    ct.save(ct.Rig({"upper": lens, "lower": lens}, poses), "rig.json")
    coarse = np.random.default_rng(0).integers(0, 256, (50, 40), np.uint8)
    shift = round(90 * BASELINE / DISTANCE)
    image = np.asarray(Image.fromarray(coarse).resize((120, 170), Image.Resampling.BICUBIC))
    Image.fromarray(image[:160]).save("upper.png")
    Image.fromarray(image[shift:][:160]).save("lower.png")
    words = ["--camera", "rig.json", "--vertical", "--disparity", "--size", "120x160", "-o", "out"]
    command("rectify", "upper.png", "lower.png", *words)
    disparity = np.load("out/disparity.npy")
    assert disparity.shape == pixels("out/left.png").shape == (160, 120)
    focal = float(ct.load("out/rectified.json")["upper"].intrinsics[1])
    assert np.nanmedian(disparity) == pytest.approx(shift * focal / 90, abs=0.1)
    assert pixels("out/pair.png").shape == (320, 120, 3)


@pytest.mark.slow
def test_deep_images_stay_deep(folder):
    for name in ("left", "right"):
        grey = pixels(f"{name}.png").mean(2)
        Image.fromarray((16 * grey).astype(np.uint16)).save(f"{name}16.png")
    command("rectify", "left16.png", "right16.png", "--camera", "rig.json", "--points", "-o", "out")
    assert pixels("out/left.png").dtype == np.uint16
    assert abs(np.median(cloud("out/points.ply")[0][:, 2]) / DISTANCE - 1) < 0.02


def test_images_of_another_resolution_and_no_opencv(folder, monkeypatch):
    monkeypatch.setitem(sys.modules, "cv2", None)
    for name in ("left", "right"):
        opened(f"{name}.png").resize((160, 120)).save(f"{name}160.png")
    command("rectify", "left160.png", "right160.png", "--camera", "rig.json", "--rescale", "-o", "out")
    assert ct.load("out/rectified.json")["left"].image_size is not None
