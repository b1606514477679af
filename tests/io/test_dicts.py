"""Cameras and poses as plain values, and cameras by their file: what configurations hold."""

import json

import pytest
import torch
from cameras import every_model

import camtorch as ct

FISHEYE = ct.KannalaBrandt([300.1, 301, 320, 240], [0.1, -0.02, 0.003, 0.01], image_size=(480, 640))
GRID = "splined:order=3,columns=12,rows=9,fov_x=120"


def assert_same(back, one):
    assert type(back) is type(one)
    assert not any(p.requires_grad for p in back.parameters())
    for name in one.tensor_names:
        mine = getattr(one, name).detach()
        assert torch.equal(getattr(back, name), mine.expand(*one.batch_shape, -1))
        assert getattr(back, name).dtype == mine.dtype


@every_model
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_dict_gives_the_same_camera_to_the_last_bit(key, dtype):
    single = ct.MODELS[key]([300.1, 301.7, 319.3, 239.9], image_size=(480, 640)).to(dtype)
    batch = single.replace(intrinsics=single.intrinsics * torch.linspace(0.7, 1.3, 6).to(dtype).reshape(2, 3, 1))
    for camera in (single, batch):
        back = ct.Camera.from_dict(json.loads(json.dumps(camera.to_dict())))
        assert_same(back, camera)
        assert back.image_size == (480, 640)
        assert_same(type(camera).from_dict(camera.to_dict()), camera)


def test_a_dict_gives_the_same_pose_and_variant():
    pose = ct.Extrinsics(torch.rand(2, 3, dtype=torch.float64), torch.rand(3).double())
    assert_same(ct.Extrinsics.from_dict(json.loads(json.dumps(pose.to_dict()))), pose)
    splined = FISHEYE.convert(GRID).camera
    assert_same(ct.Camera.from_dict(splined.to_dict()), splined)


def test_a_dict_is_an_entry_of_a_file(tmp_path):
    ct.save(FISHEYE.double(), tmp_path / "camera.json")
    entry = json.loads((tmp_path / "camera.json").read_text())["cameras"]["camera"]
    assert entry == FISHEYE.double().to_dict()
    assert_same(ct.Camera.load(tmp_path / "camera.json"), ct.Camera.from_dict(entry))
    assert_same(ct.loads(json.dumps(entry)).camera, ct.loads(FISHEYE.to_dict()).camera)
    assert_same(ct.KannalaBrandt.load(tmp_path / "camera.json"), FISHEYE.double())
    by_hand = {"model": "kannala_brandt", "intrinsics": [300, 300, 320, 240], "distortion": [0.1, 0.2]}
    assert ct.Camera.from_dict(by_hand).distortion.tolist() == [0.1, 0.2]


def changed(**values):
    return {key: value for key, value in {**FISHEYE.to_dict(), **values}.items() if value is not None}


@pytest.mark.parametrize(
    ("make", "says"),
    [
        (lambda: ct.Camera.from_dict(changed(distorsion=[1.0])), "distorsion: keys must be among model, intr.*"),
        (lambda: ct.Camera.from_dict(changed(intrinsics=None)), "intrinsics: must be given; got keys 'model', .*"),
        (lambda: ct.Camera.from_dict(changed(model="kan")), "model: must be .*one of brown.* got 'kan'.*"),
        (lambda: ct.Camera.from_dict(changed(distortion=[0.1])), r"distortion: must be numbers \(\*B, 4\); got \(1,\)"),
        (
            lambda: ct.Camera.from_dict({"model": "kannala_brandt", "intrinsics": [3, 3, 2, 2], "distortion": []}),
            "distortion: must have coefficients n >= 1 .* got 0",
        ),
        (
            lambda: ct.Camera.from_dict(changed(distortion=[0.1, True, 0.0, 0.0])),
            r"distortion: must be numbers; got .*True.*",
        ),
        (
            lambda: ct.Camera.from_dict(changed(intrinsics=[1e-320, 3, 2, 2])),
            r"intrinsics: focal lengths must be positive; .*",
        ),
        (lambda: ct.Camera.from_dict(changed(image_size=[4.5, 6])), r"image_size\[0\]: must be a number of pix.*"),
        (lambda: ct.Pinhole.from_dict(changed()), "model: must be of Pinhole; got KannalaBrandt.*"),
        (lambda: ct.Extrinsics.from_dict({"rotation": [0, 0, 1]}), "translation: must be given; got keys 'rotation'"),
        (lambda: ct.Extrinsics.from_dict({"rotation": [0, "x"], "translation": [0, 0, 1]}), "rotation: must be numb.*"),
    ],
)
def test_a_wrong_dict_is_an_error_that_names_the_key(make, says):
    with pytest.raises(ct.CameraFileError, match=rf"^(Camera|Pinhole|Extrinsics)\.from_dict: (content: )?{says}$"):
        make()


def test_cameras_that_are_none_or_several(tmp_path):
    with pytest.raises(TypeError, match=r"Mixed\.to_dict: .* of one model with a key; got Mixed"):
        ct.Mixed([FISHEYE, FISHEYE]).to_dict()
    ct.save(ct.Rig({"left": FISHEYE, "right": FISHEYE}), tmp_path / "rig.json")
    with pytest.raises(ValueError, match=r"rig.json must have one camera; got 'left', 'right'\. Write ct\.load"):
        ct.Camera.load(tmp_path / "rig.json")
    ct.save(FISHEYE, tmp_path / "one.json")
    with pytest.raises(ValueError, match=r"^Pinhole\.load: .*one.json must have a Pinhole; got a KannalaBrandt"):
        ct.Pinhole.load(tmp_path / "one.json")
