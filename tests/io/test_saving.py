"""Writing files: whole or not at all, in the format that was meant, and nothing lost in silence."""

import json
import os
import stat

import pytest
import torch
from hypothesis import strategies as st
from rigs import FILES, SUFFIXES, assert_same, float64, load

import camtorch as ct

CORE = [500.0, 501.0, 320.25, 240.5]
numbers = st.floats(-1e3, 1e3)


def camera(key="brown_conrady", distortion=None, core=CORE, **options):
    arguments = () if distortion is None else (float64(distortion),)
    return ct.MODELS[key](float64(core), *arguments, **{"image_size": (480, 640)} | options)


LOST = [
    ("opencv", camera("fisheye624"), "for OpenCV; got fisheye624"),
    ("opencv", camera("kannala_brandt", [1e-3] * 5), "at most 4 coefficients for OpenCV.* got 5, of which k5 would be"),
    ("kalibr", camera(distortion=[0.1, 0, 0, 0, 0.2]), "at most 4 coefficients for Kalibr .* k3 would be lost"),
    ("kalibr", camera(image_size=None), "must have an image_size for Kalibr"),
    ("colmap", camera(distortion=[0.1] * 12), "at most 8 coefficients for COLMAP .* s1 s2 s3 s4 would"),
    ("colmap", camera("equirectangular"), "a part of a panorama"),
    ("aria", camera("fisheye624"), "must have one focal length for Aria; got fx = 500.0"),
    ("mrcal", camera("kannala_brandt"), r"must be one of brown.* splined, .* camera.convert\(key\)"),
    ("mrcal", ct.Rig({"a": camera(), "b": camera()}), "must be one for mrcal; got 2"),
    ("ros", ct.Rig({"a": camera()}, {"a": ct.Extrinsics([0, 0, 0.1], [0, 0, 0])}), "must have no extrinsics for"),
    ("basalt", ct.Rig({"a": camera(), "b": camera()}), "a: must have extrinsics for Basalt; got none"),
    ("opencv", ct.Rig({"1": camera(), "2": camera("kannala_brandt")}), "must be a lens like those before it"),
    ("opencv", ct.Rig({"1": camera(), "2": camera(image_size=(482, 640))}), "must have the size of those before it"),
    ("nerfstudio", ct.Rig({"1": camera(), "2": camera("pinhole")}), "must have one camera_model"),
    ("kalibr", camera(core=[CORE] * 2, distortion=[[0.0] * 4] * 2), r"a batch of cameras \(2,\)"),
]


@pytest.mark.parametrize(("format", "rig", "lost"), LOST)
def test_what_would_be_lost_is_said(format, rig, lost, tmp_path):
    path = tmp_path / f"cameras{SUFFIXES[format]}"
    with pytest.raises(ct.CameraFileError, match=lost):
        ct.save(rig, path, format)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("format", [format for format in SUFFIXES if format != "aria"])
def test_values_that_are_not_finite_are_not_written(format, tmp_path):
    broken = camera().requires_grad_(False)
    broken.distortion[0] = torch.nan
    with pytest.raises(ct.CameraFileError, match="must be finite"):
        ct.save(broken, tmp_path / f"x{SUFFIXES[format]}", format)


@pytest.mark.parametrize("key", ["rotation", "translation"])
@pytest.mark.parametrize("shape", [(), (2,)])
def test_extrinsics_beyond_all_numbers_are_refused(key, shape):
    vectors = {"rotation": torch.zeros(*shape, 3), "translation": torch.zeros(*shape, 3)}
    content = {"camtorch": 1, "cameras": {"a": {"model": "pinhole", "intrinsics": [500, 500, 320, 240]}}}
    assert ct.loads(content | {"extrinsics": {"a": vectors}}).extrinsics["a"].batch_shape == shape
    vectors[key] = torch.full((*shape, 3), 1e200, dtype=torch.float64)
    with pytest.raises(ct.CameraFileError, match=rf"loads: extrinsics.a.{key}: numbers must be up to 1e\+100"):
        ct.loads(content | {"extrinsics": {"a": vectors}})


def test_poses_of_many_images_are_one_batch_in_every_format(tmp_path):
    names = [f"{i}.jpg" for i in range(50)]
    batch = ct.Extrinsics(torch.rand(50, 3, 1, dtype=torch.float64), torch.rand(50, 3, 1, dtype=torch.float64))
    rig = ct.Rig({"1": camera("pinhole")}, (names, batch), images=dict.fromkeys(names, "1"))
    for path in ("cameras.txt", "cameras.bin", "transforms.json", "own.json"):
        ct.save(rig, tmp_path / path)
        found = ct.load(tmp_path / path)
        assert list(found.extrinsics) == names
        assert torch.allclose(found.extrinsics.batch.matrix(), batch.matrix(), rtol=0, atol=1e-14)
        ct.save(found, tmp_path / path)
        assert_same(ct.load(tmp_path / path), found)
        with torch.no_grad():
            found.extrinsics.batch.translation[7] += 1
        ct.save(found, tmp_path / path)
        moved = ct.load(tmp_path / path).extrinsics.batch.matrix() - found.extrinsics.batch.matrix()
        assert moved.abs().max() < 1e-14


@pytest.mark.parametrize("name", ["\U0001f4f7 left", 'quote"', "line\nbreak"])
def test_names_that_yaml_and_json_have_to_escape(name, tmp_path):
    for path in (tmp_path / "camera_info.yaml", tmp_path / "own.json"):
        ct.save(ct.Rig({name: camera()}), path)
        assert list(ct.load(path).cameras) == [name]
    with pytest.raises(ct.CameraFileError, match="must be text that a file can hold"):
        ct.save(ct.Rig({"1": camera()}, {"\ud800": ct.Extrinsics([0.0] * 3, [0.0] * 3)}, images={"\ud800": "1"}),
                tmp_path / "cameras.txt")  # fmt: skip


def test_zeros_that_fill_a_message_of_ros():
    text = "image_width: 640\nimage_height: 480\ndistortion_model: {}\nK: [500, 0, 320, 0, 500, 240, 0, 0, 1]\nD: {}\n"
    for name, numbers, key, count in (
        ("equidistant", [0.1, 0, 0, 0, 0], "kannala_brandt", 4),
        ("fisheye", [0.1, 0, 0, 0], "kannala_brandt", 4),
        ("none", [0, 0, 0, 0, 0], "pinhole", 0),
    ):
        found = ct.loads(text.format(name, numbers)).camera
        assert (found.key, found.distortion.shape[-1]) == (key, count)
    message = text.format("plumb_bob", [0.1, 0.2, 0, 0, 0]).replace("image_", "")
    # as rostopic prints them
    assert ct.loads(message + "---\n").camera.intrinsics.tolist() == [500, 500, 320, 240]


@pytest.mark.parametrize("function", ["fsync", "open"])
@pytest.mark.parametrize("at", [0, 1])
def test_where_writing_fails_the_old_files_stay(function, at, tmp_path, monkeypatch):
    rig = ct.Rig({"1": camera("pinhole")}, {"a.jpg": ct.Extrinsics([0, 0, 0.1], [0, 0, 1])}, images={"a.jpg": "1"})
    ct.save(rig, tmp_path, "colmap")
    rig.cameras["1"] = camera("pinhole", core=[600.0, 600.0, 320.0, 240.0])
    files = {path.name: path.read_bytes() for path in tmp_path.iterdir()}
    right, calls = getattr(os, function), iter(range(100))

    def failing(*arguments):
        if next(calls) == at:
            raise OSError("no space left")
        return right(*arguments)

    with monkeypatch.context() as patch:
        patch.setattr(os, function, failing)
        with pytest.raises(OSError, match="no space left"):
            ct.save(rig, tmp_path, "colmap")
    assert {path.name: path.read_bytes() for path in tmp_path.iterdir()} == files


@pytest.mark.skipif(os.name == "nt", reason="POSIX modes")
def test_what_is_private_is_so_while_it_is_written(tmp_path, monkeypatch):
    path, seen = tmp_path / "camera.json", []
    path.touch(mode=0o600)
    monkeypatch.setattr(os, "fsync", lambda handle: seen.append(stat.S_IMODE(os.fstat(handle).st_mode)))
    ct.save(camera(), path)
    assert seen == [0o600]


@pytest.mark.parametrize("name", ["\U0001f4f7" * 50 + ".json", "a" * 240 + ".json"])
def test_names_as_long_as_file_systems_allow(name, tmp_path):
    ct.save(camera(), tmp_path / name)
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.skipif(os.name == "nt", reason="POSIX modes and links")
def test_mode_and_links_stay(tmp_path):
    path, link = tmp_path / "camera.json", tmp_path / "link.json"
    path.write_text("old")
    path.chmod(0o640)
    link.symlink_to(path)
    ct.save(camera(), link)
    assert link.is_symlink()
    assert stat.S_IMODE(path.stat().st_mode) == 0o640
    assert_same(ct.load(path), ct.Rig({"camera": camera()}))
    with pytest.raises(FileNotFoundError, match=r"no such folder: '.*nowhere'"):
        ct.save(camera(), tmp_path / "nowhere" / "camera.json")
    (tmp_path / "dangling.json").symlink_to(tmp_path / "target.json")
    ct.save(camera(), tmp_path / "dangling.json")
    assert (tmp_path / "dangling.json").is_symlink()
    assert_same(ct.load(tmp_path / "target.json"), ct.Rig({"camera": camera()}))


NAMES = {"a.json": "camtorch", "transforms.json": "nerfstudio", "transforms_train.json": "nerfstudio"}
NAMES |= {"a.xml": "opencv", "cameras.txt": "colmap", "cameras.bin": "colmap", "a.cameramodel": "mrcal"}


def test_the_name_says_the_format(tmp_path):
    for name, format in NAMES.items():
        ct.save(camera(distortion=[0.1, 0, 0, 0]), tmp_path / name)
        assert ct.load(tmp_path / name).format == format
    ct.save(load("ros_plumb_bob.yaml"), tmp_path / "a.yaml")
    assert ct.load(tmp_path / "a.yaml").format == "ros"


@pytest.mark.parametrize(
    ("rig", "arguments", "error", "told"),
    [
        (camera(), ("a.yaml",), ValueError, "a.yaml: .* determine the format; got one that fits kalibr, opencv, ros"),
        (camera(), ("a.yaml", "ply"), ValueError, r"format must be one of aria.* got 'ply'.*docs/leaving-0\.3\.md"),
        (camera(), ("a.json", "woodscape"), ValueError, "format must be one of aria.* got 'woodscape'"),
        ([camera()], ("a.json",), TypeError, "rig must be a Rig or a Camera; got list"),
        (camera().convert("kannala_brandt"), ("a.json",), TypeError, r"got Conversion\. Pass its \.camera"),
        (ct.Rig({}), ("a.json",), ValueError, "rig must have a camera; got none"),
    ],
)
def test_what_cannot_be_saved_is_told(rig, arguments, error, told):
    with pytest.raises(error, match=told):
        ct.save(rig, *arguments)
    with pytest.raises(ValueError, match=r"format must be one of aria.* got 'ply'"):
        ct.load("a.yaml", "ply")


# -- what versions before this one saved

FIRST_FILE = (FILES / "camtorch_0.2.0.json").read_text()


def test_a_file_of_version_0_2_0_loads():
    rig = load("camtorch_0.2.0.json")
    lens = camera(distortion=[-0.25, 0.125, 0.0625, -0.03125, 0.5], core=[300.5, 301.25, 319.5, 239.5])
    pose = ct.Extrinsics(float64([0.5, 0, 0]), float64([0, 0.25, 0]))
    assert_same(rig, ct.Rig({"left": lens}, {"left": pose}))


def test_a_file_of_version_0_4_0_loads():
    rig, written = load("camtorch_0.4.0.json"), json.loads((FILES / "camtorch_0.4.0.json").read_text())
    assert list(rig) == list(written["cameras"])
    for name, camera in rig.items():
        assert camera.to_dict().items() >= written["cameras"][name].items()
        pose = written["extrinsics"][name]
        assert rig.extrinsics[name].rotation.tolist() == pose["rotation"]
        assert rig.extrinsics[name].translation.tolist() == pose["translation"]


def test_models_that_are_not_there_any_more_name_the_page():
    for model in ("gone", "brown_conrady:gone=3,3"):
        with pytest.raises(ct.CameraFileError, match=r"loads: cameras.left.model: .*gone.*docs/leaving-0\.3\.md"):
            ct.loads(FIRST_FILE.replace("brown_conrady", model))
    state = camera().state_dict()
    for name, hint in (("Gone", r"\. docs/leaving-0\.3\.md lists what left camtorch"), ("Pinhole", "$")):
        state._metadata[""]["model"] = name
        with pytest.raises(RuntimeError, match=f"the state must be of BrownConrady; got one of {name}{hint}"):
            camera().load_state_dict(state)


def test_state_of_version_0_2_0_loads():
    lens = camera("kannala_brandt", [0.1, 0.2, 0.3, 0.4])
    pose = ct.Extrinsics([0.5, 0.0, 0.0], [0.0, 0.25, 0.0])
    rig_names = "cameras.a.intrinsics cameras.a.distortion extrinsics.a.rotation extrinsics.a.translation"
    warp_names = "rotation source.intrinsics source.distortion target.intrinsics target.distortion"
    for module, names in (
        (lens, "intrinsics distortion"),
        (pose, "rotation translation"),
        (ct.Rig({"a": lens}, {"a": pose}), rig_names),
        (ct.Warp(lens, lens, torch.eye(3)), warp_names),
    ):
        state = module.state_dict()
        module.load_state_dict({name: 2 * state[name] for name in names.split()})
