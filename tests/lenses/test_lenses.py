"""Lenses that exist: their numbers are the collection's, names find them, and what is drawn from them is whole."""

import csv
import hashlib
import math
from pathlib import Path

import pytest
import torch
from PIL import Image

import camtorch as ct
from camtorch.cli.main import main
from camtorch.lenses.collection import columns
from camtorch.lenses.drawing import lenses_for
from camtorch.warp.boxes import along_edges

COLUMNS = ("fx", "fy", "cx", "cy", "k1", "k2", "k3", "k4", "height", "width", "rms_px", "readout_ms")
SAMPLE = Path(__file__).parents[1] / "files" / "lenses.csv"
"""Some rows of the collection, as they were published, with their numbers."""
NUMBERS = "ad94623534940b7809d22a2b41f3526d4c7fc6e703053c5101587317b8e97c0e"
TEXTS = "1c52d1c7241fd41fef74081697c57e0d68169f82c32077cbc7f17324b0c217b0"


def rows():
    with SAMPLE.open(newline="") as lines:
        return list(csv.DictReader(lines))


def test_every_number_of_the_collection_is_there_to_the_bit():
    texts, numbers = columns()
    assert hashlib.sha256(numbers.astype("<f8").tobytes()).hexdigest() == NUMBERS
    by_row = [list(row) for row in zip(*texts.values(), strict=True)]
    assert hashlib.sha256(repr(by_row).encode()).hexdigest() == TEXTS
    assert len(ct.lenses.search()) == 9810


@pytest.mark.parametrize("row", rows(), ids=lambda row: row["index"])
def test_an_entry_says_what_the_collection_says(row):
    lens = ct.lenses.search()[int(row["index"])]
    texts = [row[n] for n in ("brand", "camera", "lens", "setting")]
    numbers = [float(row[n]) if row[n] else None for n in COLUMNS]
    assert [lens.brand, lens.body, lens.lens, lens.setting] == texts
    assert [*lens.intrinsics, *lens.distortion, *lens.image_size, lens.rms, lens.readout_ms] == numbers
    whole = all(row[n] in ("", "1", "1.0") for n in ("h_stretch", "v_stretch"))
    assert lens.is_optical == (not row["digital_lens"] and float(row["fx"]) > 0 and whole)
    assert lens.name in repr(lens)
    if float(row["fx"]) < 0:
        with pytest.raises(ValueError, match="focal lengths must be positive"):
            lens.camera()
    else:
        camera = lens.camera()
        assert camera.intrinsics.tolist() == list(lens.intrinsics)
        assert camera.distortion.tolist() == list(lens.distortion)
        assert not camera.intrinsics.requires_grad


@pytest.mark.parametrize(
    ("body", "written"),
    [
        ("Sony a7sIII", ["Sony A7S III", "a 7s iii"]),
        ("Sony a7III", ["Sony A7 III"]),
        ("Sony ZV-E10", ["zve10", "zv-e 10"]),
        ("GoPro HERO9 Black Wide", ["GoPro HERO9 wide", "gopro hero 9 black wide", "HERO9-black  WIDE", "wide hero9"]),
        ("DJI OsmoPocket3", ["osmo-pocket 3"]),
    ],
)
def test_case_spaces_and_signs_do_not_count(body, written):
    plain = body.casefold().replace(" ", "").replace("-", "")
    for words in written:
        names = [lens.name.casefold().replace(" ", "").replace("-", "") for lens in ct.lenses.search(words)[:1]]
        assert [name[: len(plain)] for name in names] == [plain], (words, names)


def test_the_best_match_has_the_fewest_other_words_then_the_smallest_error():
    found = ct.lenses.search("GoPro HERO9 wide")
    names = [len(lens.name.split()) for lens in found[:3]]
    assert names == sorted(names)
    assert found[0].rms < found[1].rms
    assert found[0].name == found[1].name == "GoPro HERO9 Black Wide"
    assert all("9" in lens.body and "ide" in lens.name for lens in found)
    # what the camera reprojects comes after what the lens made
    views = [lens.is_optical for lens in ct.lenses.search("GoPro HERO12 Black Hyperview")]
    assert not all(views)


def test_what_is_not_there_is_answered_with_what_is_like_it():
    with pytest.raises(ValueError, match=r"'GoPro HERO99 wide'\. The nearest are .*'GoPro HERO9 Black Wide'"):
        ct.lenses.find("GoPro HERO99 wide")
    with pytest.raises(ValueError, match=r"known lens; got 'xqzzk'\. KannalaBrandt.from_fov"):
        ct.lenses.find("xqzzk")
    with pytest.raises(ValueError, match="must name a camera"):
        ct.lenses.find("  ")
    with pytest.raises(TypeError, match="words must be a text; got int"):
        ct.lenses.find(9)
    assert ct.lenses.search("xqzzk") == []


def test_a_lens_for_the_images_at_hand():
    whole, small = (ct.lenses.find("GoPro HERO9 Black Wide", image_size=size) for size in (None, (1080, 1920)))
    assert small.image_size == (1080, 1920)
    assert torch.allclose(small.intrinsics[:2], whole.intrinsics[:2] / 2)
    assert ct.lenses.find("GoPro HERO9 Black Wide", image_size=(3984, 5312)).intrinsics[0] != whole.intrinsics[0]
    with pytest.raises(ValueError, match=r"aspect ratio calibrated for .*; got \(1000, 3000\)"):
        ct.lenses.find("GoPro HERO9 Black Wide", image_size=(1000, 3000))


def source(size=(480, 640)):
    return ct.Pinhole([400.0, 400.0, (size[1] - 1) / 2, (size[0] - 1) / 2], image_size=size).requires_grad_(False)


def rim(height, width):
    corners = torch.tensor([[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]])
    return along_edges(corners[None], 64)[0]


@pytest.mark.parametrize(
    ("augmentation", "size", "fov", "count"),
    [
        (ct.augment.RandomLens, (480, 640), (100, 150), 64),
        pytest.param(ct.augment.RandomCamera, (1080, 1920), (150, 190), 400, marks=pytest.mark.slow),
        pytest.param(ct.augment.RandomLens, (640, 480), None, 400, marks=pytest.mark.slow),
    ],
)
def test_real_lenses_see_with_every_pixel_in_the_range(augmentation, size, fov, count):
    augment = augmentation("real", fov=fov, camera=source(size))
    target = augment.change(None, augment.draw(count, torch.Generator().manual_seed(1))).target
    edge = rim(*size)
    step = min(count, 200)
    assert all(bool(target[i : i + step].unproject(edge.expand(step, -1, -1))[1].all()) for i in range(0, count, step))
    wide = torch.cat([target[i : i + 50].field_of_view[:, 0] for i in range(0, count, 250)])  # some of them: it is slow
    low, high = fov or (0, 360)
    assert wide.min() >= math.radians(low)
    assert wide.max() <= math.radians(high)
    assert len(target.intrinsics[:, 0].unique()) > (0.3 * count if fov == (100, 150) else 10)


@pytest.mark.parametrize("size", [(480, 640), (400, 640)])
@pytest.mark.parametrize("name", ct.augment.PRESETS)
def test_every_draw_around_a_preset_has_a_ray_for_every_point_of_its_image(name, size):
    """Or, of Aria's, which folds before the corners, for every point for which the preset itself has one."""
    none, edge = dict.fromkeys(("focal", "centre")), rim(*size)
    bent = ct.augment.RandomLens(name, camera=source(size), **none)
    still = ct.augment.RandomLens(name, camera=source(size), distortion=None, **none)
    seen = still.change(None, still.draw(1)).target.unproject(edge[None])[1]
    assert seen.all() or name == "aria"
    kinds = (ct.augment.RandomLens, ct.augment.RandomCamera) if name != "aria" else ()
    for augmentation in (bent, *(kind(name, camera=source(size)) for kind in kinds)):
        target = augmentation.change(None, augmentation.draw(64, torch.Generator().manual_seed(0))).target
        assert (target.unproject(edge.expand(64, -1, -1))[1] | ~seen).all()
        assert len(target.distortion.unique(dim=0)) > 48


def test_a_jittered_real_lens_is_whole_too():
    jitter = {"focal": (0.7, 1.3), "centre": 0.1, "distortion": 0.2}
    augment = ct.augment.RandomLens("real", fov=(100, 150), camera=source(), **jitter)
    target = augment.change(None, augment.draw(24, torch.Generator().manual_seed(1))).target
    assert target.unproject(rim(480, 640).expand(24, -1, -1))[1].all()
    still = ct.augment.RandomLens("real", fov=(100, 150), camera=source())
    assert set(still.ranges) == {"lens"}


def test_a_calibration_covers_the_new_image_or_is_zoomed():
    """Of a lens without a fold: the calibrated image is scaled and cropped, and nothing else."""
    drawn = lenses_for((480, 640), None)
    lens = ct.lenses.search("GoPro HERO9 Black Wide 3840x2160")[0]
    (i,) = (drawn.distortion == torch.tensor(lens.distortion, dtype=torch.float64)).all(-1).nonzero()[0].tolist()
    expected = lens.camera().crop(0, 480, 2160, 2880).resize(480, 640)
    assert torch.allclose(drawn.intrinsics[i], expected.intrinsics, rtol=1e-12)


@pytest.mark.slow
def test_fields_of_view_that_no_lens_has_are_refused():
    with pytest.raises(ValueError, match="got 300 to 310; the widest"):
        ct.augment.RandomLens("real", fov=(300, 310), camera=source()).change(None, {"apply": [True], "lens": [0.5]})


def test_the_command_line_knows_them(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    assert main(["lenses", "GoPro", "HERO9", "wide", "-n", "2", "-o", "hero.json"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("GoPro HERO9 Black Wide: 3840x2160, 116 degrees wide")
    assert lines[2] == "and 13 more; -n 15 lists them all"
    camera = ct.lenses.find("GoPro HERO9 wide")
    assert torch.equal(ct.load("hero.json").camera.intrinsics, camera.intrinsics)
    Image.new("RGB", (384, 216), (90, 120, 30)).save("photo.png")
    assert main(["dewarp", "photo.png", "--lens", "GoPro HERO9 wide"]) == 2
    assert "--rescale scales the camera" in capsys.readouterr().err
    assert main(["dewarp", "photo.png", "--lens", "GoPro HERO9 wide", "--rescale"]) == 0
    told = capsys.readouterr()
    assert "the best of 13" in told.err
    assert Path("dewarped.png").exists()
    Image.new("RGB", (400, 300)).save("43.png")  # which the same name knows another calibration for
    assert main(["dewarp", "43.png", "--lens", "GoPro HERO9 Black Wide", "--rescale", "-o", "43/"]) == 0
    assert "5312x3984" in capsys.readouterr().err
    assert main(["show", "lens:GoPro HERO9 wide"]) == 0
    assert "KannalaBrandt" in capsys.readouterr().out
    assert main(["lenses", "GoPro", "HERO99"]) == 2
    assert "The nearest are" in capsys.readouterr().err
