"""What is refused is so in one line that names it, before anything is written."""

import shutil
import sys

import pytest
import torch
from command_line import FILES, LEVEL, opened, refused, write_photograph

import camtorch as ct

PHOTO = "in.png --camera camera.yml"
CASES = {
    "words": [
        ("", "the following arguments are required: COMMAND"),
        ("undistort", "invalid choice: 'undistort'"),
        ("rectify left.png right.png", "commands and options of 0.3 that are gone: docs/leaving-0.3.md"),
        ("dewarp", "required: IMAGE"),
        ("show", "required: FILE"),
        ("convert camera.yml", "which file is the new one"),
    ],
    "files": [
        ("dewarp none.png --camera camera.yml", "none.png: no such file"),
        ("dewarp camera.yml --camera camera.yml", "camera.yml: not an image"),
        ("dewarp cut.png --camera camera.yml", "cut.png: "),
        ("dewarp in.png --camera none.yml", "none.yml: No such file"),
        ("dewarp in.png --camera in.png", "in.png: byte 0: an image, where a file of a calibration is wanted"),
        ("dewarp in.png --camera bad.yml", "bad.yml: K: a camera matrix has 3 x 3"),
        ("dewarp in.png", "in.png: which camera took it? --camera FILE"),
        (f"dewarp {PHOTO} -o in.png/o.png", "in.png is no folder"),
        (f"dewarp {PHOTO} -o o.ico", "o.ico: .ico: no image is written as that; try .bmp"),
        (f"dewarp {PHOTO} -o a\0b.png", "'a\\x00b.png' is no name of a file"),
        (f"dewarp {PHOTO} -o o", "o: no suffix: no image is written as that"),
        (f"dewarp {PHOTO} -o .", "is a folder"),
        (f"dewarp {PHOTO} -o cut.png", "cut.png: exists already; --force"),
        (f"dewarp {PHOTO} -o in.png --force", "in.png: would overwrite in.png, which is read"),
        ("dewarp alpha.png --camera camera.yml -o o.jpg", "o.jpg: .jpg files hold no image of mode RGBA"),
    ],
    "dewarp": [
        (f"dewarp {PHOTO} --model x", "known are brown_conrady"),
        (f"dewarp {PHOTO} --model brown_conrady", "says that the model is kannala_brandt; do not name brown_conrady"),
        (f"dewarp {PHOTO} --size 80", "'80' is not WIDTHxHEIGHT"),
        (f"dewarp {PHOTO} --size 0x9", "each of 1 to 32768 pixels"),
        (f"dewarp {PHOTO} --fov 180", "below 180 for perspective; got 180"),
        (f"dewarp {PHOTO} --fov nan", "fov must be in degrees, above 0"),
        (f"dewarp {PHOTO} --fov 2.1", "2.1 seems to be radians"),
        ("dewarp in.png --guess-fov 2.1", "'2.1' is no field of view in degrees, as 120"),
        (f"dewarp in.png --camera {FILES}/opencv_stereo.yml", "several cameras; --name says which"),
    ],
    "many": [
        ("dewarp images --camera camera.yml", "into which folder? -o OUT/"),
        ("dewarp in.png camera.yml o.png", "--camera names the calibration, and -o the new image: camtorch dewarp"),
        ("dewarp images none --camera camera.yml -o out", "none: no such file or folder"),
        ("dewarp images --camera camera.yml -o camera.yml", "camera.yml: is no folder"),
        ("dewarp images --camera camera.yml -o o.png", "o.png: is the name of one file"),
        ("dewarp images --camera camera.yml -o images", "would overwrite images/in.png, which is read"),
        ("dewarp in.png images/in.png --camera camera.yml -o out", "would both be written to"),
        ("dewarp images --camera camera.yml -o out --fov 200", "below 180 for perspective; got 200"),
        ("dewarp images --camera camera.yml -o out --suffix .ico", ".ico: no image is written as that"),
        ("dewarp images --camera camera.yml -o out --suffix png", "'png' is no suffix, as .png is"),
        ("dewarp images --camera camera.yml -o out --jobs 0", "'0' is not a whole number from 1 to 1024"),
        ("dewarp images --camera camera.yml -o out --resume --force", "--force: not allowed with argument --resume"),
        (f"dewarp {PHOTO} -o o.png --resume", "--resume is for folders"),
    ],
    "show": [
        ("show bare.yml --against camera.yml", "bare.yml states no image size; --size says which"),
        ("show camera.yml --size 640x480", "camera.yml: camera is for 96x64, not 640x480"),
        (f"show {FILES}/opencv_stereo.yml -o o.png", "--name says which camera is meant: 1, 2"),
        ("show camera.yml --name left", "no camera is called 'left'; there are camera"),
        (f"show camera.yml --against {FILES}/opencv_camera.yml", "is for 1280x800, but camera.yml for 96x64"),
        ("show batch.json", "batch.json: camera is a batch of (2,) cameras; single ones are shown"),
        ("show camera.yml --against batch.json", "batch.json: camera is a batch of (2,) cameras; here one"),
        (f"show {FILES}/kalibr_camchain.yaml --from-model pinhole", "kalibr_camchain.yaml: "),
    ],
    "convert": [
        ("convert camera.yml bad.yml --model fisheye624", "bad.yml: exists already; --force"),
        ("convert camera.yml . --format opencv --force", ".: is a folder; opencv is one file"),
        ("convert camera.yml o.yml --model fisheye63", "did you mean 'fisheye62'? Known are"),
        ("convert camera.yml o.yml --model brown_conrady --count 6", "got count=6"),
        ("convert camera.yml o.yml --max-angle nan", "--max-angle must be above 0"),
    ],
    "map": [
        ("map camera.yml", "-o OUT writes one, --check MAP measures one"),
        ("map camera.yml a.npz --size 9x9", "unrecognized arguments: a.npz; -o a.npz names what is written (see camt"),
        ("show camera.yml bad.yml", "unrecognized arguments: bad.yml (see camtorch --help)"),
        ("map camera.yml --sise 9x9", "unrecognized arguments: --sise 9x9 (see camtorch --help; commands and options"),
        ("map camera.yml -o a.bin", "does not say the format"),
        ("map rig.json --name left -o rig --format dw100 --force", "rig.json: would overwrite"),
        ("map camera.yml -o a.npz --target camera.yml --size 10x10", "--size is for a dewarping"),
        ("map bare.yml -o a.npz", "bare.yml states no image size; --camera-size WxH says it"),
        ("map camera.yml -o a.npz --step 8", "opencv has no step"),
        ("map camera.yml --check rig.json", "say format"),
    ],
    "calibrate": [
        ("calibrate", "which images? Files, quoted patterns or folders"),
        ("calibrate in.png", "which board? --board COLUMNSxROWS"),
        ("calibrate none*.png --board 9x6", "none*.png: no file has such a name"),
        ("calibrate empty --board 9x6", "empty: a folder without images"),
        ("calibrate in.png --board 9", "'9' is not COLUMNSxROWS"),
        ("calibrate in.png --board 9x6 --left b.png", "one of these says what to calibrate"),
        ("calibrate --left b.png --board 9x6", "--left is one of a pair: --left and --right are both needed"),
        ("calibrate --rig in.png --board 9x6", "--rig takes NAME=IMAGE, as in cam0=folder"),
        ("calibrate --rig cam0=in.png --board 9x6", "--rig takes several cameras"),
        ("calibrate --left in.png --right in.png --board 9x6", "in.png: is given as an image of two cameras"),
        ("calibrate --left film.mkv --right film.mkv --board 9x6", "film.mkv: videos are for one camera"),
        ("calibrate in.png --board 9x6 --model lens", "--model: there is no camera model 'lens'; known are brown_con"),
        ("calibrate in.png --board 9x6 --model fisheye62 -o new.yml", "-o camera.json holds every model"),
        ("calibrate in.png --board 9x6 --model fisheye62 --count 3", "--count: fisheye62 takes n = 8"),
        ("calibrate in.png --board 9x6 --count 3", "--count is for a --model"),
        ("calibrate in.png --board 9x6 -o camera.foo", "camera.foo: the name does not say the format"),
        ("calibrate in.png --board 9x6 -o in.png --force", "would overwrite in.png, which is read"),
        ("calibrate in.png --board 9x6 --fixed fx,k3", "--fixed: no focal length is known to be held"),
    ],
}


@pytest.fixture(scope="module")
def files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("files")
    write_photograph(folder)
    (folder / "bad.yml").write_text("K: [1, 2]")
    (folder / "bare.yml").write_text(LEVEL)
    (folder / "cut.png").write_bytes((folder / "in.png").read_bytes()[:3000])
    (folder / "images").mkdir()
    (folder / "empty").mkdir()
    shutil.copy(folder / "in.png", folder / "images")
    (folder / "film.mkv").write_bytes(b"no video")
    opened(folder / "in.png").convert("RGBA").save(folder / "alpha.png")
    lens = ct.KannalaBrandt([28.0, 28, 47, 32], [0.0] * 4, image_size=(64, 96)).double().requires_grad_(False)
    ct.save(ct.KannalaBrandt(torch.tensor([[28.0, 28, 47, 32]] * 2), torch.zeros(2, 4)), folder / "batch.json")
    poses = {"left": ct.Extrinsics([0.0] * 3, [0.0] * 3), "right": ct.Extrinsics([0.0] * 3, [-0.25, 0.0, 0.0])}
    ct.save(ct.Rig({"left": lens, "right": lens}, poses), folder / "rig.json")
    return folder


@pytest.mark.parametrize("group", CASES)
def test_errors_are_one_line_and_leave_nothing(files, monkeypatch, capsys, group):
    monkeypatch.chdir(files)
    before = {path: path.read_bytes() for path in files.rglob("*.*")}
    for words, text in CASES[group]:
        assert text in refused(capsys, *words.split(" ")[: None if words else 0]), words
        assert {path: path.read_bytes() for path in files.rglob("*.*")} == before, words


@pytest.mark.parametrize(
    ("module", "words", "text"),
    [
        ("matplotlib", "show camera.yml -o out.png", "pip install -e '.[plot]' in a checkout"),
        ("av", "dewarp in.png film.mkv --camera camera.yml -o out/", "pip install -e '.[video]' in a checkout"),
    ],
)
def test_a_package_that_lacks_is_named(files, monkeypatch, capsys, module, words, text):
    monkeypatch.chdir(files)
    monkeypatch.setitem(sys.modules, module, None)
    before = sorted(files.iterdir())
    assert text in refused(capsys, *words.split())
    assert sorted(files.iterdir()) == before
