"""Broken and hostile files: one error with file, place and reason, quickly, and nothing else."""

import io
import json
import math
import os
import pickle
import re
import struct
import subprocess
import sys
import zipfile

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from rigs import FAULTS, FILES, SAMPLES, written

import camtorch as ct

pytestmark = pytest.mark.filterwarnings("ignore:.*4 coefficients and no fisheye_model")
CAMERA = "1 PINHOLE 640 480 500 500 320 240\n"
BINARY = struct.pack("<QIiQQ4d", 1, 1, 1, 4, 4, 1, 1, 1, 1)
GIGANTIC = struct.pack("<Q", 1 << 60)


def loads_or_says_why(path):
    """Any content gives a rig of finite numbers, or the one error in one line that names the file."""
    try:
        rig = ct.load(path)
    except ct.CameraFileError as error:
        text = str(error)
        assert text.startswith(str(path.parent))  # an images file beside it is another file
        assert text.isprintable(), text
        assert len(text) < 1000
        return False
    for camera in rig.cameras.values():
        assert torch.isfinite(camera.intrinsics).all()
        assert torch.isfinite(camera.distortion).all()
    for pose in rig.extrinsics.values():
        assert torch.isfinite(pose.matrix()).all()
    return True


@pytest.mark.parametrize("name", [*SAMPLES, "nuscenes/calibrated_sensor.json"])
def test_truncated_anywhere(name, tmp_path):
    given = FILES / name
    whole = given.read_bytes()
    for length in {*range(0, len(whole), 37), *range(max(0, len(whole) - 5), len(whole))}:
        loads_or_says_why(written(tmp_path / given.name, whole[:length]))


@settings(max_examples=60)
@given(
    name=st.sampled_from(SAMPLES),
    position=st.floats(0, 1),
    content=st.binary(min_size=1, max_size=8)
    | st.sampled_from([b"NaN", b"1e400", b"-", b"{", b"]", b"&a *a", b"null"]),
    cut=st.integers(0, 12),
)
def test_damaged_bytes(tmp_path_factory, name, position, content, cut):
    whole = (FILES / name).read_bytes()
    start = int(position * len(whole))
    loads_or_says_why(written(tmp_path_factory.getbasetemp() / name, whole[:start] + content + whole[start + cut :]))


junk = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5) | st.sampled_from(["1e400", "NaN"]),
    lambda inner: st.lists(inner, max_size=6) | st.dictionaries(st.sampled_from(["rows", "data", "cam0"]), inner),
    max_leaves=8,
)
STRUCTURED = [name for name in SAMPLES if name.endswith(".json")]


@settings(max_examples=10)
@given(data=st.data(), name=st.sampled_from(STRUCTURED))
def test_wrong_values(tmp_path_factory, data, name):
    """One value of a good file, anywhere in it, becomes something else, or goes."""
    whole = json.loads((FILES / name).read_text())
    inside = whole
    while True:
        keys = list(inside) if isinstance(inside, dict) else list(range(len(inside)))
        if not keys:
            break
        key = data.draw(st.sampled_from(keys))
        if isinstance(inside[key], (dict, list)) and data.draw(st.integers(0, 4)):
            inside = inside[key]
            continue
        if data.draw(st.booleans()):
            inside[key] = data.draw(junk)
        else:
            del inside[key]
        break
    loads_or_says_why(written(tmp_path_factory.getbasetemp() / name, json.dumps(whole)))


@pytest.mark.parametrize("name", [name for name in SAMPLES if name.endswith(".xml")])
def test_stray_text_in_any_element(name, tmp_path):
    whole = (FILES / name).read_text()
    places = [tag.end() for tag in re.finditer(r"<\w[^>]*[^/>]>", whole)]
    for place in places:
        loads_or_says_why(written(tmp_path / name, whole[:place] + "stray" + whole[place:]))
    assert len(places) > 5


# -- what someone would do on purpose

K = "[500, 0, 320, 0, 500, 240, 0, 0, 1]"
CAM = "{camera_model: pinhole, distortion_model: none, intrinsics: [1, 1, 0, 0], resolution: [4, 4]}"
LAUGHS = "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 12))
XML = "<opencv_storage>{}</opencv_storage>"
OWN = """{"camtorch": 1, "extrinsics": {}, "cameras": {"a":
    {"model": "kannala_brandt", "intrinsics": %s, "distortion": %s, "distortion_names": ["k1"]}}}"""


def archive(**files):
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as file:
        for name, data in files.items():
            file.writestr(name.replace("__", "."), data)
    return content.getvalue()


def array(shape, data=b"", descr="<f8"):
    content = io.BytesIO()
    np.lib.format.write_array_header_1_0(content, {"descr": descr, "fortran_order": False, "shape": shape})
    return content.getvalue() + data


def spelled(content):
    """The content of a row of faults.txt."""
    return content.replace("$CAM", CAM).replace("$K", K).replace(r"\n", "\n")


@pytest.mark.parametrize(
    ("name", "content", "reason"),
    [
        *((name, spelled(text), told) for name, rows in FAULTS if name != "camera.yml" for text, told in rows),
        ("a.yaml", "a0: &a0 [1, 2]\n" + LAUGHS, "must have at most 131072 values"),
        ("a.yaml", "[" * 200, "nested too deeply"),
        ("a.yaml", "[" * 100_000, "nest|deep"),  # newer parsers count levels themselves
        ("a.yaml", "a: " * 300, "line 1"),
        ("a.yaml", f"K: {K[:-2]}{'9' * 1_000_000}]", "must be a finite number"),
        ("a.json", '{"a":' * 10_000, "deep|Expecting value"),  # Python 3.14 reads as deep as it likes
        ("a.json", '[{"sensor_token": ' + "[" * 100_000, "RecursionError"),
        ("a.json", OWN % ([[[1, 1, 1, 1]]] * 3000, [[[0.0]] * 3000]), "batch dims must be equal"),
        ("a.json", '{"\\n\\u0000": {"K": 1}}', "must be those of a known format"),
        ("a.xml", XML.format("<a>" * 100_000), "must have fewer elements"),
        ("a.xml", "<calibration>" + '<a b="1"/>' * 20_000 + "</calibration>", "must have fewer elements"),
        ("a.cameramodel", "{'lensmodel': " + "[" * 30_000, "nest|deep"),
        ("a.npz", archive(data__pkl=b"x"), "content: keys must be those of a known format; got 'data.pkl'"),
        ("a.npz", archive(K__npy=b"x"), "K: must be an OpenCV matrix or a list of numbers"),
        ("a.npz", archive(K__npy=array((1 << 40,))), "K: must be an OpenCV"),
        ("a.npz", archive(K__npy=array((3, 3), bytes(8))), "K: must be an OpenCV"),
        ("a.npz", archive(K__npy=array((9,), b"." * 72, "|O")), "K: must be an OpenCV"),
        ("a.npz", archive(K__npy=array((1 << 20,), bytes(8 << 20))), "K: must be an OpenCV"),
        ("a.npz", archive(K__npy=array((3, 3), bytes(72)))[:-30], "content: must be an archive of numpy"),
        ("a.npz", archive(**{f"a{i}__npy": array((1,), bytes(8)) for i in range(1001)}), "at most 1000 arrays"),
        ("a.p", b"", "content: must not be empty"),
        ("a.p", pickle.dumps({"K": [1]}), r"byte 0: must be text, or an archive as of numpy\.savez.* got other bytes"),
        ("cameras.bin", GIGANTIC, "byte 0: must have as many cameras as .* got 1152921504606846976"),
        ("cameras.bin", struct.pack("<QIiQQ", 1, 1, 99, 4, 4), "byte 8: the model must be one of .* got 99"),
        ("cameras.bin", struct.pack("<QIiQQ4d", 1, 1, 1, 4, 4, 1, 1, math.nan, 1), "must be a finite number"),
        ("cameras.bin", struct.pack("<QIiQQ4d", 1, 1, 1, 1 << 60, 4, 1, 1, 1, 1), "must be a number of pixels"),
        ("cameras.bin", BINARY + b"x", "must end after the last camera"),
        ("images.txt", b"\xff\xfe\n", "line 1: must be text"),
        ("images.bin", GIGANTIC, "as the file has room for"),
        ("images.bin", struct.pack("<QI7dI", 1, 1, 1, *[0] * 6, 1) + b"a\0" + GIGANTIC, "as the file has room for"),
    ],
)
def test_faults(name, content, reason, tmp_path):
    """Of images beside a camera that is right."""
    path = written(tmp_path / name, content)
    if path.stem == "images":
        path = written(path.with_stem("cameras"), CAMERA if path.suffix == ".txt" else BINARY)
    with pytest.raises(ct.CameraFileError, match=rf"{re.escape(name)}: .*{reason}"):
        ct.load(path)
    assert not loads_or_says_why(path)


MB = 1 << 20


def filled(unit, size=6 * MB, start=b"", end=b""):
    return start + unit * (size // len(unit)) + end


def many(pattern, size, start=b"", end=b""):
    """The same of pieces that count."""
    return start + b"".join(pattern % i for i in range(size // len(pattern % 100_000))) + end


def large():
    """Files as large as they are read, by their names."""
    return {
        "blank.txt": filled(b"\n"),
        "numbers.txt": filled(b" 1", start=b"1 PINHOLE 640 480"),
        "lists.cameramodel": filled(b"[],", MB - 99, start=b"{'lensmodel': [", end=b"]}"),
        "keys.yaml": many(b"k%d: 1\n", MB - 99),
        "anchors.yaml": filled(b"&a [], *a,", MB - 99, b"a: [", b"]"),
        "documents.yaml": filled(b"---\n", MB - 99),
        "cameras.json": many(b'"K%d":[5,0,3,0,5,2,0,0,1],', 6 * MB, b"{", b'"":1}'),
        "nested.json": filled(b'{"a":'),
        "digits.json": filled(b"9", start=b'{"fl_x": ', end=b"}"),
        "patterns.json": filled(b"coef", start=b'{"K": [5], "', end=b'\\n": [1]}'),
        "words.xml": filled(b"1 ", MB - 99, start=b"<opencv_storage><K>", end=b"</K></opencv_storage>"),
        "attributes.xml": many(b'a%d="" ', MB - 99, b"<opencv_storage ", b"/>"),
        "entries.npz": b"PK\3\4" + filled(b"PK\1\2"),
    }


COSTS = """
import sys, time, warnings
import yaml, torch, camtorch as ct
warnings.simplefilter("ignore")
def peak():
    with open("/proc/self/status") as file:
        return 1024 * int(next(line for line in file if line.startswith("VmHWM")).split()[1])
for path in sys.argv[1:]:
    with open("/proc/self/clear_refs", "w") as file:
        file.write("5")
    before, start = peak(), time.process_time()
    loaded = True
    try:
        ct.load(path)
    except ct.CameraFileError:
        loaded = False
    print(time.process_time() - start, peak() - before, int(loaded))
"""


def costs(*paths):
    """Of each file the seconds and bytes that it takes, in a process of its own, and whether it loads."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    command = [sys.executable, "-c", COSTS, *map(str, paths)]
    out = subprocess.run(command, capture_output=True, text=True, check=True, env=environment).stdout
    return [tuple(map(float, line.split())) for line in out.splitlines()]


@pytest.mark.slow
@pytest.mark.skipif(not os.path.exists("/proc/self/clear_refs"), reason="no peak memory that can be reset")
def test_large_files_cost_little(tmp_path):
    """Ten times the file, and the 32 MB that small files may take besides; and no more time than grows with the size.

    A machine that is busy takes a multiple of the second for 10 MB that it takes alone, and what grows with the square
    of the size takes minutes.
    """
    paths = [written(tmp_path / name, content) for name, content in large().items()]
    for path, (seconds, memory, loaded) in zip(paths, costs(*paths), strict=True):
        size = path.stat().st_size
        assert seconds < 5 + size / 1e6, path.name
        assert memory < 32 * MB + 10 * size, path.name
        assert not loaded, path.name


@pytest.mark.skipif(not hasattr(os, "mkfifo"), reason="no named pipes")
@pytest.mark.parametrize("suffix", ["txt", "bin"])
def test_pipes_are_neither_waited_for_nor_replaced(suffix, tmp_path):
    camera = ct.Pinhole([500.0, 500, 320, 240], image_size=(480, 640))
    ct.save(camera, tmp_path / f"cameras.{suffix}", "colmap")
    os.mkfifo(tmp_path / f"images.{suffix}")
    with pytest.raises(ct.CameraFileError, match="must be an ordinary file"):
        ct.load(tmp_path / f"cameras.{suffix}")
    os.mkfifo(tmp_path / "pipe.yml")
    with pytest.raises(OSError, match="no ordinary file"):
        ct.save(camera, tmp_path / "pipe.yml", "opencv")
