"""`camtorch show` and `camtorch convert`."""

import math
import re
import zlib
from pathlib import Path

import pytest
import torch
from cameras import KEYS, one, slow_unless
from command_line import FILES, FISHEYE, MATRIX, command, opened, refused

import camtorch as ct
from camtorch.analysis.numbers import summarise


def test_show_prints_a_summary(folder, capsys):
    command("show", "camera.yml")
    out = capsys.readouterr().out
    assert out.startswith("camera.yml: camera\n")
    for label in ("model", "image", "valid rays", "field of view", "has rays", "distortion, px"):
        assert f"\n{label} " in out
    for text in ("KannalaBrandt (kannala_brandt)", "96 x 64", "fx 28, fy 28 px", "k1 -0.02, k2 0.004, k3 -0.003, k4 "):
        assert text in out


def test_show_writes_a_page(folder, capsys):
    command("show", "camera.yml", "--html", "lens.html", "--image", "in.png")
    assert capsys.readouterr().out.splitlines()[-1] == "lens.html: the lens, live, to be opened in a browser"
    text = Path("lens.html").read_text()
    assert '"distortion":[-0.02,0.004,-0.003,0.0006]' in text
    assert "data:image/jpeg;base64," in text
    command("show", "camera.yml", "--html", "new/lens.html", "--image", "in.png")  # its folder is made, as elsewhere
    assert Path("new/lens.html").read_text() == text
    assert "--force" in refused(capsys, "show", "camera.yml", "--html", "lens.html")
    assert "--html" in refused(capsys, "show", "camera.yml", "--image", "in.png")
    assert "in.png" in refused(capsys, "show", "camera.yml", "--html", "in.png", "--image", "in.png", "--force")
    whole = Path("in.png").read_bytes()
    huge = whole[:16] + 2 * (60_000).to_bytes(4, "big") + whole[24:29]  # of a bomb; what comes next is not read
    huge += zlib.crc32(huge[12:]).to_bytes(4, "big") + whole[33:]
    for content, reason in ((b"no image", "cannot identify"), (whole[:-40], "truncated"), (huge, "exceeds limit")):
        Path("broken.png").write_bytes(content)
        error = refused(capsys, "show", "camera.yml", "--html", "b.html", "--image", "broken.png")
        assert "broken.png: " in error
        assert reason in error
    assert not Path("b.html").exists()


@pytest.mark.slow
def test_show_draws_an_image(folder, capsys):
    pytest.importorskip("matplotlib")
    for words, end in ([], ""), (["--against", "camera.yml"], ", difference"):
        command("show", "camera.yml", *words, "-o", f"{len(words)}.png")
        assert f"{len(words)}.png: distortion, radius over angle{end}\n" in capsys.readouterr().out
    assert opened("2.png").width > opened("0.png").width
    assert len(opened("2.png").convert("L").histogram()) > 100


def test_convert_writes_the_new_camera(folder, capsys):
    command("convert", "camera.yml", "out.json", "--model", "fisheye624", "--format", "camtorch")
    assert capsys.readouterr().out == (
        "out.json: camera, kannala_brandt to fisheye624: exact, "
        "up to 123.1 degrees from the axis, 100 % of what the image has rays for\n"
    )
    camera = ct.load("out.json").camera
    assert (type(camera), camera.image_size) == (ct.Fisheye624, (64, 96))
    assert camera.distortion[:4].tolist() == [-0.02, 0.004, -0.003, 0.0006]
    command("convert", "camera.yml", "-o", "same.json", "--model", "fisheye624")
    assert Path("same.json").read_bytes() == Path("out.json").read_bytes()
    for names in ((), ("a.json", "-o", "b.json")):
        assert "camtorch convert IN -o OUT" in refused(capsys, "convert", "camera.yml", *names)


def test_convert_says_how_good_it_is(folder, capsys):
    command("convert", "camera.yml", "out.yml", "--model", "brown_conrady", "--count", "8", "--max-angle", "60")
    told = r"kannala_brandt to brown_conrady: rms .* px, at most .* px, up to 60.0 degrees from the axis"
    assert re.search(told, capsys.readouterr().out)
    assert len(ct.load("out.yml").camera.distortion_names) == 8
    command("convert", "camera.yml", "out.yml", "--force")
    assert "kannala_brandt to kannala_brandt: exact" in capsys.readouterr().out
    assert torch.equal(ct.load("out.yml").camera.distortion, ct.load("camera.yml").camera.distortion)


def test_convert_keeps_poses_and_takes_a_size(folder):
    words = "--from-model kannala_brandt --model kannala_brandt --format kalibr --size 1280x800 --count 4"
    command("convert", FILES / "opencv_stereo.yml", "chain.yaml", *words.split())
    before, after = ct.load(FILES / "opencv_stereo.yml"), ct.load("chain.yaml")
    assert [camera.image_size for camera in after.cameras.values()] == [(800, 1280)] * 2
    for pose, new in zip(before.extrinsics.values(), after.extrinsics.values(), strict=True):
        assert (new.translation - pose.translation).abs().max() < 1e-12


def test_convert_of_coefficients_of_no_model_wants_it_named(folder, capsys):
    Path("open.yml").write_text((FISHEYE + MATRIX).replace("fisheye_model: 1\n", ""))
    error = refused(capsys, "convert", "open.yml", "o.json", "--model", "kannala_brandt")
    assert "open.yml: the model of 4 coefficients must be named" in error
    assert "--from-model kannala_brandt" in error
    assert "--from-model brown_conrady" in error
    assert not Path("o.json").exists()
    command("convert", "open.yml", "o.json", "--model", "kannala_brandt", "--from-model", "brown_conrady")
    assert "brown_conrady to kannala_brandt: rms" in capsys.readouterr().out
    command("convert", "open.yml", "o.json", "--from-model", "kannala_brandt", "--force")
    assert torch.equal(ct.load("o.json").camera.distortion, ct.load("camera.yml").camera.distortion)
    capsys.readouterr()
    command("show", "open.yml")  # supposes it, and the note names the option
    captured = capsys.readouterr()
    assert "BrownConrady" in captured.out
    assert "--from-model" in captured.err
    # the option is for the other camera too
    command("show", "camera.yml", "--against", "open.yml", "--from-model", "kannala_brandt")
    captured = capsys.readouterr()
    assert "against open.yml: the same to rounding" in captured.out
    assert captured.err == ""


@pytest.mark.parametrize(
    ("file", "name"),
    [("mrcal_opencv5.cameramodel", None), ("kalibr_camchain.yaml", "cam1"), ("nerfstudio_transforms.json", None)],
)
def test_convert_takes_a_camera_out_of_its_poses(folder, capsys, file, name):
    rig = ct.load(FILES / file)
    name = name or next(iter(rig.extrinsics))
    camera = rig.camera_of(name)
    if len(rig.cameras) == len(rig.extrinsics) == 1:
        error = refused(capsys, "convert", FILES / file, "o.yml", "--format", "opencv")
        assert "must have no extrinsics for" in error
        assert f"--name {name}" in error
    command("convert", FILES / file, "o.yml", "--format", "opencv", "--name", name)
    assert capsys.readouterr().err == f"camtorch: note: o.yml: {name} alone; its pose is left out\n"
    new = ct.load("o.yml")
    assert len(new.extrinsics) == 0
    assert torch.equal(new.camera.distortion, camera.distortion)


def test_convert_overwrites_no_images_unasked(folder, capsys):
    rig = ct.load(FILES / "nerfstudio_transforms.json")
    ct.save(rig, "rig.json", "camtorch")
    Path("images.txt").write_text("# mine\n")
    assert "images.txt: exists already; --force" in refused(capsys, "convert", "rig.json", "cameras.txt")
    assert Path("images.txt").read_text() == "# mine\n"
    assert not Path("cameras.txt").exists()
    command("convert", "rig.json", "cameras.txt", "--force")
    assert list(ct.load("cameras.txt").extrinsics) == list(rig.extrinsics)


def test_show_compares_without_an_image(folder, capsys):
    """Of a rig the camera of that name, of a file of one camera that one."""
    chain = FILES / "kalibr_camchain.yaml"
    ct.save(ct.load("camera.yml").camera.convert("fisheye624").camera, "other.json")
    ct.save(ct.load(chain).cameras["cam1"], "one.json")
    for words in ("camera.yml", "other.json"), (chain, chain, "--name", "cam1"), (chain, "one.json", "--name", "cam1"):
        command("show", words[0], "--against", *words[1:])
        assert f"against {words[1]}: the same to rounding, over " in capsys.readouterr().out


def test_show_says_how_much_is_alike_where_the_rim_is_not(folder, capsys):
    before = ct.load("camera.yml").camera
    ct.save(before.convert("brown_conrady", count=8, max_angle=math.radians(60)).camera, "other.json")
    command("show", "camera.yml", "--against", "other.json")
    says = r"rms (.+) px, at most .+ px, over (.+) % of the image; median (.+) px, (.+) % of the image within 1 px\n"
    found = re.search(says, capsys.readouterr().out)
    rms, over, median, alike = map(float, found.groups())
    assert median < 1 < rms
    assert 50 < alike < over


@pytest.mark.parametrize("key", slow_unless({"fisheye624", "ucm"}.__contains__, KEYS))
def test_every_model_has_a_summary(key):
    camera = one(key)
    summary = summarise(camera)
    assert 0 < summary.valid_angle[0] <= summary.valid_angle[1] <= math.pi + 1e-6
    assert all(0 < angle < 360 for angle in summary.fov)
    assert 0.5 < summary.seen <= 1
    assert not any("nan" in line or "inf" in line for line in summary.lines())


def test_the_summary_of_a_pinhole_is_known():
    camera = ct.Pinhole([320.0, 240.0, 319.5, 239.5], image_size=(480, 640)).double()
    summary = summarise(camera)
    assert summary.fov == pytest.approx((90, 90, math.degrees(2 * math.atan(2**0.5))))
    assert summary.valid_angle == pytest.approx((math.pi / 2,) * 2, abs=0.002)
    assert (summary.seen, summary.corners) == (1, ((0, 0),) * 4)
    right = summarise(camera.crop(0, 320, 480, 320))
    assert right.fov[0] == pytest.approx(45)


def test_a_summary_says_what_it_cannot_know():
    bare = summarise(ct.Pinhole([320.0, 240.0, 319.5, 239.5]))
    assert bare.fov is None
    assert any("not stated" in line for line in bare.lines())
    folded = ct.BrownConrady([300.0, 300, 320, 240], [-0.5, 0, 0, 0], image_size=(480, 640))
    assert summarise(folded).corners == ("no ray",) * 4
    lost = ct.BrownConrady([300.0, 300, 9e5, 240], [-0.5, 0, 0, 0], image_size=(480, 640))
    assert summarise(lost).fov == (0, 0, 0)
    with pytest.raises(ValueError, match="must be a single one"):
        summarise(ct.Pinhole(torch.ones(2, 4)))


def test_convert_overwrites_nothing_that_it_read(folder, capsys):
    camera = ct.KannalaBrandt([280.0, 280.0, 319.5, 239.5], [0.02, -0.01, 0.003, -0.001], image_size=(480, 640))
    poses = {"a.jpg": ct.Extrinsics([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])}
    ct.save(ct.Rig({"1": camera}, poses, images={"a.jpg": "1"}), "sparse", format="colmap")
    before = {path.name: path.read_bytes() for path in Path("sparse").iterdir()}
    for words in (["sparse", "sparse"], ["sparse", "sparse/cameras.txt"], ["sparse/cameras.txt", "sparse/images.txt"]):
        assert "is read" in refused(capsys, "convert", *words, "--model", "fisheye624", "--format", "colmap", "--force")
    assert {path.name: path.read_bytes() for path in Path("sparse").iterdir()} == before
