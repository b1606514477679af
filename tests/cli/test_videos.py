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
from camtorch.cli import videos

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
    assert (after["codec"], after["pixels"]) == ("ffv1", "yuv420p")
    same = ("times", "packets", "languages", "rate", "rotation", "matrix")
    assert {name: before[name] for name in same} == {name: after[name] for name in same}
    assert {kind for kind, *_ in after["packets"]} == {"audio", "subtitle"}
    assert (after["rotation"], after["matrix"], after["languages"]) == (90, (1, 2), ["fin"])
    # brightness goes through the warp as an image does, to the bit; colours are where they are in RGB, whose rounding
    # to and fro is within a few levels
    warp = ct.Dewarp(camera(), tolerance=0.001)
    for old, new in zip(before["frames"], after["frames"], strict=True):
        old = old.reformat(format="yuv420p")  # two names for one, as the range is full
        expected = warp(torch.from_numpy(planes(old)[0].astype(np.uint8).reshape(1, 1, 64, 96)))
        assert np.array_equal(expected.numpy().ravel(), planes(new)[0])
        rgb = torch.from_numpy(old.to_ndarray(format="rgb24")).permute(2, 0, 1)[None]
        expected = av.VideoFrame.from_ndarray(warp(rgb)[0].permute(1, 2, 0).numpy())
        expected = expected.reformat(format="yuv420p", dst_colorspace="ITU709", dst_color_range="JPEG")
        for number, (got, wanted) in enumerate(zip(planes(new)[1:], planes(expected)[1:], strict=True)):
            assert np.abs(got - wanted).mean() < 2, number


@pytest.mark.parametrize("pixels", ["yuv420p", "gray", "yuv444p", "yuv422p10le", "bgr0"])
def test_formats_of_pixels_become_one_in_which_nothing_is_black(folder, pixels):
    Path("level.yml").write_text(LEVEL)  # the camera of an image without distortion
    write_video("in.mkv", [0], codec="ffv1", pixels=pixels, matrix=1, full=1)
    command("dewarp", "in.mkv", "--camera", "level.yml", "-o", "level.mkv", "--codec", "ffv1")
    before, after = (read_video(name)["frames"][0] for name in ("in.mkv", "level.mkv"))
    expected = before.reformat(format="yuv420p")
    for old, new in zip(planes(expected), planes(after), strict=True):  # colours of half the resolution, too
        assert np.abs(old - new).max() <= 1
    command(*WORDS, "--codec", "ffv1", "--projection", "equirectangular", "--fov", 360)
    made = read_video("out.mkv")
    assert made["pixels"] == "yuv420p"
    assert made["frames"][0].reformat(format="rgb24").to_ndarray()[0, 0].tolist() == [0, 0, 0]


@pytest.mark.parametrize(
    ("suffix", "codec", "sound"),
    [(".mp4", "libx264", "aac"), *(pytest.param(*case, marks=pytest.mark.slow) for case in (
        (".mov", "mpeg4", "aac"), (".avi", "mpeg4", "libmp3lame"), (".ts", "libx264", "aac"),
        (".webm", "libvpx-vp9", "libopus"),
    ))],
)  # fmt: skip
def test_formats_of_files(folder, suffix, codec, sound):
    write_video(f"in{suffix}", range(8), codec=codec, sound=sound)
    made = suffix if suffix not in (".avi", ".ts") else ".mkv"
    for place in ("out/", "again/"):
        command("dewarp", f"in{suffix}", "--camera", "camera.yml", "-o", place)
    before, after = read_video(f"in{suffix}"), read_video(f"out/in{made}")
    assert after["codec"] == ("vp9" if suffix == ".webm" else "h264")
    assert len(after["frames"]) == 8
    for (*_, old), (*_, new) in zip(before["packets"], after["packets"], strict=True):
        assert old.endswith(new)  # whose headers .ts repeats in each
    assert np.allclose(np.diff(after["times"]), 1 / 30, atol=2e-3)
    assert Path(f"again/in{made}").read_bytes() == Path(f"out/in{made}").read_bytes()


def test_a_recording_may_begin_late(folder):
    write_video("in.mkv", range(108000, 108010))
    assert np.allclose([seconds for seconds, _ in videos.frames(Path("in.mkv"))], np.arange(10) / 30, atol=1e-3)
    command(*WORDS)
    assert np.allclose(read_video("in.mkv")["times"], read_video("out.mkv")["times"], atol=1e-3)


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
    assert " ".join(lines) == "in/cut.mkv in/list.mp4 in/list.ts in/nothing.mp4 in/small.avi in/words.mp4"
    for name in ("list.ts", "nothing.mp4", "words.mp4"):
        assert lines[f"in/{name}"] == "Invalid data found when processing input"
    assert "It is cut off or damaged" in lines["in/cut.mkv"]
    assert "must be 96x64, as the camera in camera.yml; got 48x32" in lines["in/small.avi"]
    assert outputs().keys() == {"whole.mkv"}
    assert "1 of 7 files made" in told.out


def test_a_folder_goes_on(folder, capsys):
    Path("in").mkdir()
    write_video("in/a.mp4", range(5), sound="aac")
    write_video("in/b.avi", range(5))
    Image.fromarray(np.zeros((64, 96), np.uint8)).save("in/c.png")
    words = ["dewarp", "in", "--camera", "camera.yml", "-o", "out/", "--jobs", 1]
    command(*words)
    before = outputs()
    assert before.keys() == {"a.mp4", "b.mkv", "c.png"}
    Path("out/b.mkv").unlink()
    command(*words, "--resume")
    assert outputs() == before
    assert "1 of 3 files made" in capsys.readouterr().out
    command(*words[:-3], "other", "--jobs", 1, "--suffix", ".mov")
    assert outputs("other").keys() == {"a.mov", "b.mov", "c.png"}


REFUSED = [
    ([*WORDS, "--codec", "nothing"], "--codec: invalid choice: 'nothing'"),
    ([*WORDS, "--size", "95x64"], "out.mkv: size must be even for libx264; got 95x64"),
    ([*WORDS[:-1], "out.webm"], "in.mkv: streams must fit in .webm; got audio, mp3float. .mkv takes nearly all"),
    ([*WORDS[:-1], "out.webm", "--codec", "libx264"], "'libx264' codec. Choose another encoder with --codec"),
    ([*WORDS[:-1], "out.png"], "out.png: the suffix of the video must be one of .mp4, .m4v"),
    ([*WORDS[:-1], "in.mkv", "--force"], "in.mkv: would overwrite in.mkv, which is read"),
    (["dewarp", "none.mkv", *WORDS[2:]], "none.mkv: No such file"),
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
    for words in ([], ["--crf", 40]):
        command("dewarp", "in.mp4", "--camera", "camera.yml", "-o", "out.mp4", "--force", *words)
        sizes.append(Path("out.mp4").stat().st_size)
    assert sizes[1] < 0.6 * sizes[0]
