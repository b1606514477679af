"""`camtorch dewarp` on videos."""

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
import torch
from command_line import LEVEL, camera, command, refused
from PIL import Image
from test_folders import outputs
from videos import read_video, write_video

import camtorch as ct

av = pytest.importorskip("av")
WORDS = ["dewarp", "in.mkv", "--camera", "camera.yml", "-o", "out.mkv"]


def planes(frame):
    return [plane.astype(int) for plane in np.split(frame.to_ndarray().ravel(), [64 * 96, 64 * 96 * 5 // 4])]


def test_all_but_the_image_stays(folder, capsys):
    Path("words.srt").write_text("1\n00:00:00,100 --> 00:00:00,300\nhello\n")
    # at no steady rate
    times = [0, 33, 67, 200, 233, 400]
    write_video(
        "in.mkv", times, tick=Fraction(1, 1000), codec="libx264", rotation=90, sound="libopus", words="words.srt",
        matrix=1, full=2,
    )  # fmt: skip
    command(*WORDS, "--codec", "ffv1")
    assert capsys.readouterr() == (
        "out.mkv: kannala_brandt dewarped to perspective, 120.0 degrees wide, 96x64, fx 27.7128 fy 27.7128 cx 47.5 "
        "cy 31.5; 100.0 % of it is filled, 6 frames\n",
        "",
    )
    before, after = read_video("in.mkv"), read_video("out.mkv")
    assert after["codec"] == "ffv1"
    assert (before["pixels"], after["pixels"]) == ("yuvj420p", "yuv420p")  # two names for one, as the range is full
    same = ("times", "packets", "title", "languages", "rate", "rotation", "matrix")
    assert {name: before[name] for name in same} == {name: after[name] for name in same}
    assert {kind for kind, *_ in after["packets"]} == {"audio", "subtitle"}
    assert (after["rotation"], after["matrix"], after["title"], after["languages"]) == (90, (1, 2), "waves", ["fin"])
    # brightness goes through the warp as an image does, to the bit
    warp = ct.Dewarp(camera(), tolerance=0.001)
    for old, new in zip(before["frames"], after["frames"], strict=True):
        expected = warp(torch.from_numpy(planes(old)[0].astype(np.uint8).reshape(1, 1, 64, 96)))
        assert np.array_equal(expected.numpy().ravel(), planes(new)[0])
    # colours are where they are in RGB, whose rounding to and fro is within a few levels
    for old, new in zip(before["frames"], after["frames"], strict=True):
        rgb = torch.from_numpy(old.to_ndarray(format="rgb24")).permute(2, 0, 1)[None]
        expected = av.VideoFrame.from_ndarray(warp(rgb)[0].permute(1, 2, 0).numpy())
        expected = expected.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="JPEG")
        for number, (got, wanted) in enumerate(zip(planes(new)[1:], planes(expected)[1:], strict=True)):
            assert np.abs(got - wanted).mean() < 2, number


# brightness alone, colours of half and of the full resolution, ten bits, transparency; the first pixel is black in each
@pytest.mark.parametrize("pixels", ["yuv420p", "gray", "yuv444p", "yuv422p10le", "yuva420p"])
@pytest.mark.parametrize("full", [1, 2])
def test_what_shows_nothing_is_black_in_every_format(folder, pixels, full):
    write_video("in.mkv", [0], codec="ffv1", pixels=pixels, matrix=1, full=full)
    command(*WORDS, "--codec", "ffv1", "--projection", "equirectangular", "--fov", 360)
    made = read_video("out.mkv")
    assert made["pixels"] == pixels
    assert made["frames"][0].reformat(format="rgb24").to_ndarray()[0, 0].tolist() == [0, 0, 0]


def test_a_quarter_of_a_chroma_pixel(folder):
    # the camera of an image without distortion: colours of half the resolution stay where they are, at either side
    Path("level.yml").write_text(LEVEL)
    write_video("in.mkv", [0], codec="ffv1")
    command("dewarp", "in.mkv", "--camera", "level.yml", "-o", "out.mkv", "--codec", "ffv1")
    before, after = (planes(read_video(name)["frames"][0]) for name in ("in.mkv", "out.mkv"))
    for old, new in zip(before, after, strict=True):
        assert np.abs(old - new).max() <= 1


@pytest.mark.parametrize(
    ("suffix", "codec", "sound"),
    [(".mp4", "libx264", "aac"), *(pytest.param(*case, marks=pytest.mark.slow) for case in (
        (".mov", "mpeg4", "aac"), (".avi", "mpeg4", "libmp3lame"), (".ts", "libx264", "aac"),
        (".webm", "libvpx-vp9", "libopus"),
    ))],
)  # fmt: skip
def test_formats(folder, suffix, codec, sound):
    write_video(f"in{suffix}", range(8), codec=codec, sound=sound)
    command("dewarp", f"in{suffix}", "--camera", "camera.yml", "-o", f"out{suffix}")
    before, after = read_video(f"in{suffix}"), read_video(f"out{suffix}")
    assert after["codec"] == ("vp9" if suffix == ".webm" else "h264")
    assert len(after["frames"]) == 8
    assert [data for *_, data in after["packets"]] == [data for *_, data in before["packets"]]
    assert np.allclose(np.diff(after["times"]), 1 / 30, atol=1e-3)
    if suffix != ".avi":  # whose times are those in which decoders put them out
        assert np.allclose(before["times"], after["times"], atol=1e-4)
    command("dewarp", f"in{suffix}", "--camera", "camera.yml", "-o", f"again{suffix}")
    assert Path(f"again{suffix}").read_bytes() == Path(f"out{suffix}").read_bytes()


def test_gray_keeps_its_range(folder):
    Path("level.yml").write_text(LEVEL)
    write_video("in.mkv", [0], codec="ffv1", pixels="gray")
    command("dewarp", "in.mkv", "--camera", "level.yml", "-o", "out.mkv", "--crf", "1")
    before, after = (read_video(name)["frames"][0].to_ndarray(format="gray") for name in ("in.mkv", "out.mkv"))
    assert np.abs(before.astype(int) - after).max() <= 4  # to the ends of the range, where it was cut off


@pytest.mark.parametrize(
    "pixels",
    ["bgr0", "yuv444p", *(pytest.param(p, marks=pytest.mark.slow) for p in ("gray", "yuv422p", "yuv420p10le"))],
)
def test_pixels(folder, pixels):
    Path("level.yml").write_text(LEVEL)
    write_video("in.mkv", [0, 1], codec="ffv1", pixels=pixels)
    command("dewarp", "in.mkv", "--camera", "level.yml", "-o", "out.mkv", "--codec", "ffv1")
    before, after = read_video("in.mkv"), read_video("out.mkv")
    assert after["pixels"] == {"bgr0": "yuv420p"}.get(pixels, pixels)
    expected = before["frames"][1]
    if pixels == "bgr0":
        expected = expected.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="MPEG")
        assert after["matrix"] == (1, 1)
    assert np.abs(expected.to_ndarray().astype(int) - after["frames"][1].to_ndarray()).max() <= 1


def test_what_is_no_video(folder, capsys):
    write_video("in.mkv", range(30), codec="mpeg4")
    whole = Path("in.mkv").read_bytes()
    Path("in").mkdir()
    Path("in/whole.mkv").write_bytes(whole)
    Path("in/cut.mkv").write_bytes(whole[: len(whole) // 2])
    Path("in/nothing.mp4").touch()
    Path("in/words.mp4").write_text("no video")
    Path("in/list.mp4").write_text(f"ffconcat version 1.0\nfile '{folder}/in.mkv'\n")
    Path("in/list.ts").write_text(f"#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:1,\n{folder}/in.mkv\n#EXT-X-ENDLIST\n")
    write_video("in/small.avi", [0, 1], size=(32, 48))
    command("dewarp", "in", "--camera", "camera.yml", "-o", "out", "--jobs", 1, expect=1)
    told = capsys.readouterr()
    lines = dict(line.removeprefix("camtorch: error: ").split(": ", 1) for line in told.err.splitlines())
    assert list(lines) == [
        f"in/{name}" for name in ("cut.mkv", "list.mp4", "list.ts", "nothing.mp4", "small.avi", "words.mp4")
    ]
    for name in ("list.ts", "nothing.mp4", "words.mp4"):
        assert lines[f"in/{name}"] == "Invalid data found when processing input"
    assert "of 1.0 seconds; it is cut off or damaged" in lines["in/cut.mkv"]
    assert "is 48x32, but the camera in camera.yml is for 96x64" in lines["in/small.avi"]
    assert outputs().keys() == {"whole.mkv"}
    assert "1 of 7 files made" in told.out


def test_a_folder_goes_on(folder, capsys):
    Path("in").mkdir()
    write_video("in/a.mp4", range(5), sound="aac")
    write_video("in/b.mkv", range(5))
    Image.fromarray(np.zeros((64, 96), np.uint8)).save("in/c.png")
    words = ["dewarp", "in", "--camera", "camera.yml", "-o", "out/", "--jobs", 1]
    command(*words)
    before = outputs()
    assert before.keys() == {"a.mp4", "b.mkv", "c.png"}
    Path("out/b.mkv").write_bytes(before["b.mkv"][:100])
    command(*words, "--resume")
    assert outputs() == before
    assert "1 of 3 files made" in capsys.readouterr().out
    command(*words[:-3], "other", "--jobs", 1, "--suffix", ".avi")
    assert outputs("other").keys() == {"a.avi", "b.avi", "c.png"}


REFUSED = [
    ([*WORDS, "--codec", "nothing"], "--codec nothing: there is no such encoder; there are libx264"),
    ([*WORDS, "--codec", "aac"], "--codec aac: an encoder of audio, not of video"),
    ([*WORDS, "--codec", "ffv1", "--crf", "3"], "--crf: ffv1 has no such option"),
    ([*WORDS, "--size", "95x64"], "out.mkv: 95x64, but libx264 wants even numbers"),
    ([*WORDS[:-1], "out.webm"], "in.mkv: its audio, mp3float, cannot be kept in .webm; .mkv takes nearly all"),
    ([*WORDS[:-1], "out.webm", "--codec", "libx264"], "does not support 'libx264' codec; --codec names another"),
    ([*WORDS[:-1], "out.png"], "out.png: .png: no video can be written as that; try .avi, .m4v"),
    ([*WORDS[:-1], "in.mkv", "--force"], "in.mkv: would overwrite in.mkv, which is read"),
    (["dewarp", "none.mkv", *WORDS[2:]], "none.mkv: No such file or directory"),
]


def test_errors_are_one_line_and_leave_nothing(folder, capsys):
    write_video("in.mkv", range(3), sound="libmp3lame")
    before = sorted(Path().iterdir())
    for words, text in REFUSED:
        assert text in refused(capsys, *words)
        assert sorted(Path().iterdir()) == before


def test_quality(folder):
    write_video("in.mp4", range(10))
    sizes = []
    for words in ([], ["--crf", 40], ["--codec", "mpeg4"]):
        command("dewarp", "in.mp4", "--camera", "camera.yml", "-o", "out.mp4", "--force", *words)
        sizes.append(Path("out.mp4").stat().st_size)
        assert len(read_video("out.mp4")["frames"]) == 10
    assert sizes[1] < 0.6 * sizes[0]
