"""`camtorch dewarp` on one image, and what all commands have in common."""

import importlib.metadata
import io
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from command_line import FILES, LEVEL, MATRIX, PROFILE, camera, command, opened, pixels, refused
from PIL import Image

import camtorch as ct
from camtorch.boards.finding import IMAGES
from camtorch.io.photographs import size_of


def test_dewarp_writes_what_dewarp_makes(folder, capsys):
    command("dewarp", "in.png", "--camera", "camera.yml", "--fov", 90, "--size", "80x60", "-o", "out.png")
    assert capsys.readouterr().out == (
        "out.png: kannala_brandt dewarped to perspective, 90.0 degrees wide, 80x60, fx 40 fy 40 cx 39.5 cy 29.5; "
        "100.0 % of it is filled and shows 23 % of the photograph\n"
    )
    image = torch.from_numpy(pixels("in.png")).permute(2, 0, 1)[None]
    expected = ct.Dewarp(camera(), fov=90, image_size=(60, 80))(image)[0].permute(1, 2, 0)
    assert np.array_equal(pixels("out.png"), expected.numpy())
    assert [path.name for path in sorted(folder.iterdir())] == ["camera.yml", "in.png", "out.png"]


def test_camera_without_size_takes_the_images(folder, capsys):
    command("dewarp", "in.png", "--camera", FILES / "opencv_stereo.yml", "--name", "1", "-o", "named.png")
    Path("bare.yml").write_text(MATRIX + "camera_model: something\n")
    assert "--from-model kannala_brandt" in refused(capsys, "dewarp", "in.png", "--camera", "bare.yml")
    command("dewarp", "in.png", "--camera", "camera.yml", "-o", "a.png")
    command("dewarp", "in.png", "--camera", "bare.yml", "--model", "kannala_brandt", "-o", "b.png")
    command("dewarp", "in.png", "--camera", "bare.yml", "--from-model", "kannala_brandt", "-o", "c.png")
    assert Path("a.png").read_bytes() == Path("b.png").read_bytes() == Path("c.png").read_bytes()


def test_another_resolution_needs_rescale(folder, capsys):
    opened("in.png").resize((48, 32)).save("half.png")
    error = refused(capsys, "dewarp", "half.png", "--camera", "camera.yml", "-o", "out.png")
    assert "half.png: must be 96x64, as the camera in camera.yml; got 48x32. --rescale" in error
    assert "cropped" not in error
    for size, reason in (
        ((48, 48), "aspect ratios, 1 and 1.5, differ by more than 1 %: the image may be cropped"),
        ((64, 96), "as the camera in camera.yml; got 64x96. Width and height are exchanged"),
    ):
        opened("in.png").resize(size).save("other.png")
        for words in ([], ["--rescale"]):
            assert reason in refused(capsys, "dewarp", "other.png", "--camera", "camera.yml", "-o", "new.png", *words)
    for size, status in (((48, 32), 0), ((193, 128), 0), ((195, 128), 2)):  # the last two are 0.5 and 1.6 % wider
        opened("in.png").resize(size).save("near.png")
        command("dewarp", "near.png", "--camera", "camera.yml", "--rescale", "-o", f"{size}.png", expect=status)
    assert opened("(48, 32).png").size == (48, 32)


def test_where_the_result_goes(folder, capsys, monkeypatch):
    words = ["dewarp", "in.png", "--camera", "camera.yml", "-o"]
    command(*words, "new/folder/out.png")
    assert opened("new/folder/out.png").size == (96, 64)
    Path("out.png").write_text("old")
    command(*words, "out.png", "--force")
    assert opened("out.png").size == (96, 64)
    assert Path("out.png").stat().st_mode & 0o777 == Path("in.png").stat().st_mode & 0o777
    Path("nothing.png").symlink_to("elsewhere.png")
    assert "nothing.png: exists already; --force" in refused(capsys, *words, "nothing.png")
    command(*words, "nothing.png", "--force")
    assert Path("nothing.png").is_symlink()
    assert opened("elsewhere.png").size == (96, 64)
    # nothing that is read is overwritten, by whatever name
    image = Path("in.png").read_bytes()
    Path("link.png").symlink_to("in.png")
    Path("hard.png").hardlink_to("in.png")
    Path("camera.png").symlink_to("camera.yml")
    for name in (folder / "in.png", "link.png", "hard.png", "camera.png"):
        assert "which is read. Name another file" in refused(capsys, *words, name, "--force")
    assert Path("in.png").read_bytes() == image
    for stdout in (None, io.TextIOWrapper(io.BytesIO(), "ascii")):  # it is closed, or lacks a letter
        monkeypatch.setattr(sys, "stdout", stdout)
        command(*words, "späce.png", "--force")
    assert sys.stdout.buffer.getvalue().startswith(rb"sp\xe4ce.png: kannala_brandt")


def test_what_pillow_does_not_read_is_said(folder, capsys):
    deep = np.random.default_rng(0).integers(0, 65536, (64, 96, 3)).astype(np.uint16)
    for name in ("deep.png", "deep.tif", "deep.ppm"):
        assert cv2.imwrite(name, deep)
        command("dewarp", name, "--camera", "camera.yml", "-o", "out.png", "--force")
        assert capsys.readouterr().err == f"camtorch: note: {name}: only the upper 8 of 16 bits a colour are read\n"
    frames = [Image.new("RGB", (96, 64), colour) for colour in ("red", "blue")]
    frames[0].save("moving.gif", save_all=True, append_images=frames[1:])
    command("dewarp", "moving.gif", "--camera", "camera.yml", "-o", "out.png", "--force")
    assert capsys.readouterr().err == "camtorch: note: moving.gif: only the first of 2 images is read\n"
    command("dewarp", "in.png", "--camera", "camera.yml", "-o", "out.png", "--force")
    assert capsys.readouterr().err == ""


def test_pixels_that_16_bits_do_not_hold(folder, capsys):
    Image.fromarray(np.linspace(0, 1e9, 64 * 96).astype(np.int32).reshape(64, 96)).save("deep.tif")
    words = ["dewarp", "deep.tif", "--camera", "camera.yml", "-o", "out.tif"]
    assert "deep.tif: pixels must have 8 or 16 bits; got int32, up to 1000000000" in refused(capsys, *words)
    Image.fromarray(np.linspace(0, 65535, 64 * 96).astype(np.int32).reshape(64, 96)).save("deep.tif")
    command(*words)
    assert opened("out.tif").mode == "I;16"


@pytest.mark.parametrize("mode", ["L", "LA", "RGB", "RGBA", "1", "P", "CMYK", "I;16"])
def test_kinds_of_image(folder, mode):
    ramp = np.broadcast_to(np.linspace(0, 255, 96).astype(np.uint8), (64, 96))
    deep = Image.fromarray(ramp.astype(np.uint16) * 257)
    image = deep if mode == "I;16" else Image.fromarray(np.stack((ramp,) * 3, -1)).convert(mode)
    image.save("kind.tif", icc_profile=PROFILE)
    Path("level.yml").write_text(LEVEL)
    command("dewarp", "kind.tif", "--camera", "level.yml", "-o", "out.tif")
    out = opened("out.tif")
    assert out.mode == {"1": "L", "P": "RGB", "CMYK": "RGB"}.get(mode, mode)
    assert ("icc_profile" in out.info) == out.mode.startswith("RGB")  # as it is of such colours
    if mode not in ("1", "P"):
        # the camera of an image without distortion: nothing may change
        expected = image if mode == "I;16" else image.convert(out.mode)
        assert np.abs(np.asarray(out).astype(int) - np.asarray(expected).astype(int)).max() <= 1


@pytest.mark.parametrize(("mode", "clear"), [("L", 7), ("1", 0), ("RGB", (7, 7, 7))])
def test_transparency_by_a_colour_stays(folder, mode, clear):
    image = Image.new(mode, (96, 64), clear)
    image.paste(1 if mode == "1" else 200 if mode == "L" else (200, 9, 9), (48, 0, 96, 64))
    image.save("clear.png", transparency=clear)
    Path("level.yml").write_text(LEVEL)
    command("dewarp", "clear.png", "--camera", "level.yml", "-o", "out.png")
    out = opened("out.png")
    assert out.mode == ("LA" if mode in "L1" else "RGBA")
    assert [out.getpixel((x, 32))[-1] for x in (10, 80)] == [0, 255]


def tagged(path, orientation, **options):
    exif = Image.Exif()
    exif[0x0112] = orientation
    opened("in.png").save(path, exif=exif, icc_profile=PROFILE, **options)


def orientation_of(path):
    with Image.open(path) as image:  # before it is loaded: Pillow turns TIFFs then, and forgets the tag
        return image.getexif().get(0x0112)


@pytest.mark.parametrize(
    ("suffix", "options"),
    [(".png", {}), (".webp", {"lossless": True}), (".tif", {}), (".tif", {"compression": "jpeg"})],
)
def test_images_are_taken_as_they_are_stored(folder, suffix, options):
    opened("in.png").save(f"upright{suffix}", **options)
    command("dewarp", f"upright{suffix}", "--camera", "camera.yml", "-o", "expected.png")
    tagged(f"turned{suffix}", 6, **options)
    command("dewarp", f"turned{suffix}", "--camera", "camera.yml", "-o", "out.png")
    assert np.array_equal(pixels("out.png"), pixels("expected.png"))
    assert orientation_of("out.png") == 6
    assert size_of(Path(f"turned{suffix}")) == (64, 96)


def test_the_exif_orientation_and_the_profile_stay_or_their_loss_is_said(folder, capsys):
    tagged("turned.jpg", 3)
    for suffix in sorted(IMAGES):
        command("dewarp", "turned.jpg", "--camera", "camera.yml", "-o", f"out{suffix}", "--size", "9x6")
        notes = capsys.readouterr().err
        lost = f"the Exif orientation, which turns the image, is lost: {suffix} files hold none\n"
        assert (orientation_of(f"out{suffix}") == 3) != (lost in notes), suffix
        kept = opened(f"out{suffix}").info.get("icc_profile") == PROFILE
        assert kept != (f"the ICC profile of its colours is lost: {suffix} files hold none\n" in notes), suffix


@pytest.mark.parametrize("degrees", [70, 200])
def test_a_guessed_field_of_view(folder, capsys, degrees):
    model = ct.Pinhole if degrees == 70 else ct.KannalaBrandt
    guess = model.from_fov(degrees, image_size=(64, 96)).double()
    ct.save(guess, "guess.json")
    command("dewarp", "in.png", "--camera", "guess.json", "-o", "known.png")
    for name in ("guessed.png", "folder/"):
        command("dewarp", "in.png", "--guess-fov", degrees, "-o", name)
        told = f"camtorch: note: {degrees} degrees wide is a guess: {guess.key}, 96x64, focal length "
        assert capsys.readouterr().err.startswith(told)
    for name in ("guessed.png", "folder/in.png"):
        assert np.array_equal(pixels(name), pixels("known.png"))
    command("dewarp", "in.png", "--guess-fov", degrees, "--model", "equisolid", "-o", "other.png")
    assert "equisolid" in capsys.readouterr().err


def test_runs_as_a_module():
    done = subprocess.run([sys.executable, "-m", "camtorch", "--version"], capture_output=True, text=True, check=True)
    torch_version = importlib.metadata.version("torch")  # without a build's name, which some versions of torch add
    assert done.stdout.startswith(f"camtorch {ct.__version__}, torch {torch_version}, native sampler: ")
    assert done.stdout.count("\n") == 1


@pytest.mark.slow
@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="looks at memory in Linux's /proc")
def test_a_large_photograph_is_dewarped_in_little_memory(folder):
    # 42 million pixels: 0.13 GB as they are, and as much of the result; in floating point it would be 0.5 GB each
    colours = np.random.default_rng(0).integers(0, 256, (78, 117, 3), dtype=np.uint8)
    Image.fromarray(colours).resize((7950, 5300)).save("large.jpg")
    code = (
        "import sys; from camtorch.cli.main import main; status = main(sys.argv[1:]); "
        "print(open('/proc/self/status').read().partition('VmHWM:')[2].split()[0]); sys.exit(status)"
    )
    words = ["dewarp", "large.jpg", "--camera", "camera.yml", "--rescale", "-o", "out.jpg"]
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, check=True)
    assert opened("out.jpg").size == (7950, 5300)
    # not getrusage's: a process begins with the largest of the one that started it, here of all the tests before
    assert int(done.stdout.splitlines()[-1]) < 1.0e6  # kB
    assert done.stderr == ""
