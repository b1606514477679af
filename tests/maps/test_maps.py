"""Maps of warps for other runtimes: each format read by a decoder of the tests, which measures its error as well."""

import functools
import json
import math
import os
import struct
from pathlib import Path

import cv2
import numpy as np
import onnxruntime
import pytest
import torch

import camtorch as ct
from camtorch.cli.main import main
from camtorch.maps.formats import FORMATS
from camtorch.warp.options import MODES, PADDINGS

NOTES = [356.0, 356.0, 647.3, 404.8], [-0.0514, -0.0002, -0.0026, 0.0002]


def fisheye(scale=1.0):
    """A real lens, of 1280x800 at full scale."""
    fx, fy, cx, cy = NOTES[0]
    intrinsics = [fx * scale, fy * scale, (cx + 0.5) * scale - 0.5, (cy + 0.5) * scale - 0.5]
    size = (round(800 * scale), round(1280 * scale))
    return ct.KannalaBrandt(intrinsics, NOTES[1], image_size=size).double().requires_grad_(False)


def small():
    """All of its target shows the image, whose sides are no multiples of 16."""
    return ct.Dewarp(fisheye(0.25), image_size=(184, 312))


def partial():
    """A lens whose rays end within the image, on a wide target."""
    lens = ct.KannalaBrandt([60.0, 60, 127.5, 87.5], [-0.1, -0.1, -0.05, -0.02], image_size=(176, 256))
    return ct.Dewarp(lens.double().requires_grad_(False), projection="equirectangular", fov=286, image_size=(160, 320))


def positions(warp):
    """(H', W', 2) in pixels of the source, and which pixels show it, by the warp's own grid."""
    height, width = warp.source.image_size
    grid = warp.grid()[0].double()
    return ((grid + 1) * grid.new_tensor([width, height]) - 1) / 2, warp.valid_mask()[0, 0]


def off(found, warp):
    """Distances at the pixels that show the image, edges repeated."""
    wanted, shown = positions(warp)
    limit = torch.tensor(warp.source.image_size[::-1]) - 1.0
    pair = [torch.minimum(p.clamp(min=0), limit) for p in (torch.as_tensor(found, dtype=torch.float64), wanted)]
    return (pair[0] - pair[1]).norm(dim=-1)[shown]


def between(nodes, step, size):
    """Bilinear, of nodes (n, m, 2), by torch."""
    n, m = nodes.shape[:2]
    planes = torch.as_tensor(np.ascontiguousarray(nodes), dtype=torch.float64).movedim(-1, 0)[None]
    fine = ((n - 1) * step + 1, (m - 1) * step + 1)
    fine = torch.nn.functional.interpolate(planes, fine, mode="bilinear", align_corners=True)
    return fine[0, :, : size[0], : size[1]].movedim(0, -1)


# -- decoders that know nothing of ours


def with_opencv(path, **_):
    if path.endswith(".npz"):
        arrays = np.load(path)
        maps = arrays["map1"], arrays["map2"]
    else:
        storage = cv2.FileStorage(path, cv2.FILE_STORAGE_READ)
        maps = storage.getNode("map1").mat(), storage.getNode("map2").mat()
    if maps[0].ndim == 3:
        assert (maps[0].dtype, maps[1].dtype) == (np.int16, np.uint16)
        maps = cv2.convertMaps(*maps, cv2.CV_32FC1)
    assert maps[0].dtype == np.float32
    return np.stack(maps[:2], -1)


def with_dw100(path, warp, **_):
    height, width = warp.target.image_size
    words = np.fromfile(path, "<u4").reshape(math.ceil(height / 16) + 1, math.ceil(width / 16) + 1)
    return between(np.stack((words & 0xFFFF, words >> 16), -1) / 16, 16, (height, width))


def with_ti(path, warp, step=8, **_):
    height, width = warp.target.image_size
    n, m = math.ceil(height / step) + 1, math.ceil(width / step) + 1
    pitch = (4 * m + 15) // 16 * 16
    raw = Path(path).read_bytes()
    assert len(raw) == n * pitch
    nodes = np.empty((n, m, 2))
    for i in range(n):
        for j in range(m):
            dx, dy = struct.unpack_from("<hh", raw, i * pitch + 4 * j)
            nodes[i, j] = step * j + dx / 8, step * i + dy / 8
    return between(nodes, step, (height, width))


CASES = [
    ("map.yml", "opencv", {}, with_opencv, 2e-5),
    ("map.npz", "opencv", {}, with_opencv, 2e-5),
    ("map.yml", "opencv_fixed", {}, with_opencv, 0.0222),
    ("map.npz", "opencv_fixed", {}, with_opencv, 0.0222),
    ("map.bin", "dw100", {}, with_dw100, 0.5),
    ("map.bin", "ti_ldc", {}, with_ti, 0.2),
    ("map.bin", "ti_ldc", {"step": 16}, with_ti, 0.5),
]


@pytest.mark.parametrize(("name", "format", "options", "decode", "most"), CASES)
def test_what_another_decoder_reads_is_as_far_off_as_the_report_says(name, format, options, decode, most, tmp_path):
    warp, path = small(), str(tmp_path / name)
    report = ct.save_map(warp, path, format, **options)
    found = off(decode(path, warp=warp, **options), warp)
    measured = float(found.max()), float(found.square().mean().sqrt())
    assert measured == pytest.approx((report.max_error, report.rms_error), abs=1e-6)
    assert report.max_error < most
    assert (report.format, report.shown, report.stray) == (format, warp.target.image_size[0] * 312, 0)
    again = ct.load_map(path)
    assert again.format == format
    assert float(again.error(warp).max()) == report.max_error
    assert (again.source_size, again.target_size) == ((200, 320), (184, 312))


@pytest.mark.parametrize(("format", "most"), [("ti_ldc", 0.09), ("dw100", 0.15)])
def test_meshes_of_a_fisheye_are_as_near_as_their_fractions_allow(format, most, tmp_path):
    """The panorama of 170 degrees, the hardest: an eighth of a pixel alone is off by 0.0884."""
    warp = ct.Dewarp(fisheye(), projection="cylindrical", fov=170)
    assert ct.save_map(warp, tmp_path / "map.bin", format).max_error <= most


@pytest.mark.parametrize(
    ("mode", "padding", "fill", "dtype"),
    [
        ("bilinear", "zeros", 0.0, "float32"),
        ("bilinear", "zeros", (0.1, 0.2, 0.9), "float32"),
        ("bilinear", "border", 0.5, "float32"),
        ("nearest", "reflection", 7, "uint8"),
        ("bicubic", "zeros", 200, "uint8"),
    ],
)
def test_onnx_runtime_makes_the_same_images(mode, padding, fill, dtype, tmp_path):
    lens = partial().source.float()
    warp = ct.Dewarp(lens, fov=149, image_size=(90, 160), mode=mode, padding_mode=padding, fill=fill, tolerance=0)
    report = ct.save_map(warp, tmp_path / "warp.onnx", dtype=None if dtype == "float32" else dtype)
    session = onnxruntime.InferenceSession(tmp_path / "warp.onnx", providers=["CPUExecutionProvider"])
    for batch in (1, 3):
        images = torch.rand(batch, 3, 176, 256, generator=torch.Generator().manual_seed(batch))
        images = images if dtype == "float32" else (255 * images).byte()
        (result,) = session.run(None, {"images": images.numpy()})
        difference = (torch.from_numpy(result).double() - warp(images).double()).abs()
        assert result.dtype == dtype
        if dtype == "float32":
            assert difference.max() < 1e-5
        else:  # where a value lies half-way between two
            assert difference.max() <= 1
            assert difference.mean() < 1e-4
    assert report.max_error < 1e-3
    assert ct.load_map(tmp_path / "warp.onnx").valid_mask().equal(warp.valid_mask())


@pytest.mark.parametrize("name", ["map.npz", "map.onnx"])
def test_pixels_without_a_ray_are_marked(name, tmp_path):
    warp = partial()
    report = ct.save_map(warp, tmp_path / name)
    read = ct.load_map(tmp_path / name)
    assert 0.1 < report.shown / warp.valid_mask().numel() < 0.6
    assert report.shown == int(warp.valid_mask().sum())
    assert report.stray == 0
    assert read.valid_mask().equal(warp.valid_mask())
    image = torch.rand(1, 2, 176, 256, dtype=torch.float64)
    assert (read(image) - warp(image)).abs().max() < 1e-4
    assert (read.grid()[0] == -9).all(-1).equal((warp.grid()[0] == -9).all(-1))


@pytest.mark.parametrize("format", ["dw100", "ti_ldc"])
def test_meshes_go_on_where_rays_end(format, tmp_path):
    camera = partial().source
    warp = ct.Warp(camera, ct.KannalaBrandt([55.0, 55, 130, 80], image_size=(160, 256)).double(), tolerance=0)
    report = ct.save_map(warp, tmp_path / "map.bin", format)
    assert report.stray > 0
    assert report.rms_error < (0.25 if format == "ti_ldc" else 1.0)  # lens and steps are of the same size
    assert report.max_error < 7
    moved = ct.load_map(tmp_path / "map.bin").positions
    # hardware reads small blocks of the source, also outside
    assert max(float(moved.diff(dim=dim).abs().max()) for dim in (0, 1)) < 20


def turned(*signs):
    camera = ct.Pinhole.from_fov(60, image_size=(160, 208)).double().requires_grad_(False)
    return ct.Warp(camera, camera, torch.diag(torch.tensor(signs)).double())


upside_down, behind = (functools.partial(turned, *signs) for signs in ((-1.0, -1.0, 1.0), (-1.0, 1.0, -1.0)))


def between_pinholes(source, target):
    return ct.Warp(*(ct.Pinhole.from_fov(60, image_size=size).double() for size in (source, target)))


def across_the_seam():
    panorama = ct.Equirectangular([256 / math.tau, 256 / math.tau, 127.5, 63.5], image_size=(128, 256)).double()
    view = ct.Pinhole.from_fov(60, image_size=(160, 200)).double()
    return ct.Warp(panorama, view, torch.diag(torch.tensor([-1.0, 1, -1])).double())


def far_off():
    wide = ct.Pinhole([2000.0, 2000, 6000, 119.5], image_size=(240, 8000)).double()
    return ct.Warp(wide, ct.Pinhole([2000.0, 2000, 160, 119.5], image_size=(240, 320)).double())


def batch():
    camera = fisheye(0.25)
    return ct.Dewarp(type(camera)(camera.intrinsics.expand(2, 4), camera.distortion, image_size=camera.image_size))


REFUSED = [
    (upside_down, "dw100", {}, r"vertices: must fit in dw100; got x -1.0 .*clip=True"),
    (far_off, "ti_ldc", {}, "must fit in ti_ldc"),
    (across_the_seam, "dw100", {}, "positions must not leap"),
    (lambda: between_pinholes((144, 160), (144, 176)), "dw100", {}, "source size: .*; got 160x144"),
    (lambda: between_pinholes((144, 176), (3080, 176)), "dw100", {}, "target size: .*; got 176x3080"),
    (lambda: between_pinholes((17, 8200), (17, 17)), "ti_ldc", {}, "8192"),
    (lambda: between_pinholes((9, 32767), (17, 17)), "opencv", {}, "got 32767"),
    (behind, "opencv", {}, "the target must show a part"),
    (batch, "opencv", {}, "a batch of 2"),
    (lambda: ct.Dewarp(fisheye(0.25), mode="bicubic", padding_mode="border"), "onnx", {}, "bicubic"),
    (lambda: ct.Dewarp(fisheye(0.25), antialias=True), "onnx", {}, "antialias"),
    (small, "onnx", {"dtype": "float16"}, "float16"),
    (small, "opencv", {"step": 8}, "options of opencv must be none; got step"),
    (small, "opencv", {"v": "up"}, "options of opencv must be none; got v"),
    (small, "dw100", {"step": 8}, "options of dw100 must be among clip; got step"),
    (small, "ti_ldc", {"step": 8.0}, r"step must be a whole number; got 8.0"),
    (small, "ti_ldc", {"step": 12}, "step must be one of"),
]


@pytest.mark.parametrize(("make", "format", "options", "match"), REFUSED)
def test_what_a_format_cannot_hold_is_an_error(make, format, options, match, tmp_path):
    with pytest.raises((ct.CameraFileError, ValueError, TypeError), match=match):
        ct.save_map(make(), tmp_path / ("a.onnx" if format == "onnx" else "a.npz"), format, **options)
    assert not os.listdir(tmp_path)


def test_what_clipping_costs_is_told_and_other_formats_need_none(tmp_path):
    path = tmp_path / "map.bin"
    report = ct.save_map(upside_down(), path, "dw100", clip=True)
    assert 0.5 < report.max_error < 2
    assert float(off(with_dw100(path, upside_down()), upside_down()).max()) == pytest.approx(report.max_error, abs=1e-6)
    assert ct.save_map(upside_down(), path, "ti_ldc").max_error < 1e-9
    assert ct.save_map(across_the_seam(), tmp_path / "map.npz").max_error < 1e-4


def up_to_the_pole():
    upwards = ct.augment.mount_rotation(*torch.tensor([0.0, 90.0, 0.0], dtype=torch.float64))
    return ct.Warp(fisheye(0.25), ct.Equirectangular.from_fov(360, image_size=(80, 160)).double(), upwards)


@pytest.mark.parametrize(("make", "size"), [(small, None), (up_to_the_pole, (32, 32))])
def test_blocks_with_their_padding_hold_what_they_need(make, size, tmp_path):
    warp = make()
    facts = ct.save_map(warp, tmp_path / "map.bin", "ti_ldc").facts
    (height, width), padding = facts["block_size"], facts["pixel_padding"]
    assert size in (None, (height, width))
    found = ct.load_map(tmp_path / "map.bin").positions.numpy().clip(0, (319, 199))
    needed, largest = 0, np.zeros(2)
    for top in range(0, len(found), height):
        for left in range(0, found.shape[1], width):
            part = found[top : top + height, left : left + width]
            corners = np.stack((part[0, 0], part[0, -1], part[-1, 0], part[-1, -1]))
            first, last = np.floor(corners.min(0)), np.ceil(corners.max(0))
            for position in part.reshape(-1, 2):  # a bicubic filter reads one pixel before and two after
                reads = np.floor(position) - 1, np.floor(position) + 2
                needed = max(needed, *(first - reads[0]), *(reads[1] - last))
            largest = np.maximum(largest, last - first + 1)
    assert padding == needed
    assert facts["source_block"] == tuple((largest[::-1] + 2 * padding).astype(int))


def test_the_name_says_the_format_or_the_error_lists_them(tmp_path):
    warp = between_pinholes((9, 9), (9, 9))
    for name, format in (("a.yaml", "opencv"), ("a.NPZ", "opencv"), ("a.onnx", "onnx")):
        assert ct.save_map(warp, tmp_path / name).format == format
    for name, format, match in (
        ("map.bin", None, "to determine the format"),
        ("map.exr", None, "to determine the format"),
        ("map.yml", "stmap", "format must be a known format of maps; got 'stmap'"),
    ):
        with pytest.raises(ValueError, match=match) as raised:
            ct.save_map(warp, tmp_path / name, format)
        assert all(word in str(raised.value) for word in (*FORMATS, "docs/leaving-0.3.md"))
    with pytest.raises(ValueError, match=r"suffix must be one of \.yml"):
        ct.save_map(warp, tmp_path / "map.png", "opencv")


def test_one_warp_is_saved_whether_it_learns_or_not(tmp_path):
    camera = fisheye(0.25)
    learning = ct.Warp(ct.KannalaBrandt(camera.intrinsics.tolist(), image_size=(200, 320)), small().target)
    assert learning.source.intrinsics.requires_grad
    pose = ct.Extrinsics([math.radians(125), 0.0, 0.0], [0.0, 1.0, 0.5]).double().requires_grad_(False)
    above = ct.BirdsEye(camera, pose, x=(-1, 1), y=(1, 2.5), resolution=0.02)
    for warp in (learning, above, ct.Dewarp(fisheye(0.25).float())):  # measured in float64
        assert ct.save_map(warp, tmp_path / "map.npz").max_error < 2e-5
    single = ct.KannalaBrandt(camera.intrinsics[None], camera.distortion[None], image_size=(200, 320))
    assert ct.save_map(ct.Dewarp(single), tmp_path / "map.npz").max_error < 1e-4


def test_what_stood_there_stays_where_saving_fails(tmp_path):
    path = tmp_path / "map.bin"
    ct.save_map(small(), path, "dw100")
    before = {name: (tmp_path / name).read_bytes() for name in sorted(os.listdir(tmp_path))}
    assert list(before) == ["map.bin", "map.bin.json"]
    with pytest.raises(ct.CameraFileError):
        ct.save_map(upside_down(), path, "dw100")
    (tmp_path / "other.bin.json").mkdir()  # the map has a place, its description none
    with pytest.raises(OSError, match="no ordinary file"):
        ct.save_map(small(), tmp_path / "other.bin", "ti_ldc")
    (tmp_path / "other.bin.json").rmdir()
    assert {name: (tmp_path / name).read_bytes() for name in sorted(os.listdir(tmp_path))} == before


# -- files that are described, cut short, or spoiled


def test_bare_tables_have_a_description(tmp_path):
    report = ct.save_map(small(), tmp_path / "map.bin", "ti_ldc", step=16)
    described = json.loads((tmp_path / "map.bin.json").read_text())
    assert described["format"] == "ti_ldc"
    assert described["block_size"] == list(report.facts["block_size"])
    assert report.files == (str(tmp_path / "map.bin"), str(tmp_path / "map.bin.json"))
    with pytest.raises(ct.CameraFileError, match="must be dw100; got 'ti_ldc'"):
        ct.load_map(tmp_path / "map.bin", "dw100")
    with pytest.raises(ValueError, match="map and warp must have the same sizes"):
        ct.load_map(tmp_path / "map.bin").error(ct.Dewarp(fisheye(0.25)))
    (tmp_path / "map.bin").write_bytes((tmp_path / "map.bin").read_bytes()[:-4])
    with pytest.raises(ct.CameraFileError, match="bytes"):
        ct.load_map(tmp_path / "map.bin")
    (tmp_path / "map.bin.json").unlink()
    for format in (None, "ti_ldc"):
        with pytest.raises(ct.CameraFileError, match=r"a known map, or have .*map\.bin\.json|must be a map of ti_ldc"):
            ct.load_map(tmp_path / "map.bin", format)


def spoiled(content, random):
    """What a disk, a network or somebody mean makes of a file."""
    kind = random.integers(4)
    at = int(random.integers(len(content)))
    if kind == 0:
        return content[:at]
    if kind == 1:
        return content[:at] + bytes(random.integers(0, 256, 20, np.uint8)) + content[at + 20 :]
    if kind == 2:  # where what is said of the data stands
        at = int(random.integers(min(300, len(content))))
        return content[:at] + bytes([random.integers(256)]) + content[at + 1 :]
    return content + b"9" * 40


@pytest.mark.parametrize("suffix", ["yml", "npz", "bin", "onnx"])
@pytest.mark.filterwarnings("ignore")
def test_spoiled_maps_are_one_kind_of_error(suffix, tmp_path):
    view = ct.Pinhole.from_fov(60, image_size=(40, 50)).double().requires_grad_(False)
    path = tmp_path / f"map.{suffix}"
    ct.save_map(ct.Warp(view, view), path, "ti_ldc" if suffix == "bin" else None)
    content, random = path.read_bytes(), np.random.default_rng(0)
    for _ in range(10):
        path.write_bytes(spoiled(content, random))
        try:
            read = ct.load_map(path)
        except ct.CameraFileError:
            continue
        assert read.positions.shape[-1] == 2


@pytest.mark.parametrize("content", ["", "[]", '{"format": 3}', '{"format": "dw100", "source_height": -1}', "{" * 9999])
def test_spoiled_descriptions_are_one_kind_of_error(content, tmp_path):
    ct.save_map(small(), tmp_path / "map.bin", "dw100")
    (tmp_path / "map.bin.json").write_text(content)
    with pytest.raises(ct.CameraFileError):
        ct.load_map(tmp_path / "map.bin")


def test_the_command_writes_a_map_and_measures_one(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    ct.save(fisheye(0.25), "camera.json")
    assert main(["map", "camera.json", "-o", "maps/ti.bin", "--format", "ti_ldc"]) == 0
    told = capsys.readouterr().out
    assert told.startswith("maps/ti.bin: ti_ldc, 320x200 from 320x200, off by at most 0.")
    assert "block size 64x64; pixel padding " in told
    assert main(["map", "camera.json", "--check", "maps/ti.bin"]) == 0
    assert capsys.readouterr().out.split(";")[0] == told.split(";")[0]
    assert main(["map", "camera.json", "--fov", "60", "--check", "maps/ti.bin"]) == 0
    assert "off by at most 0." not in capsys.readouterr().out
    ct.save(ct.Pinhole.from_fov(50, image_size=(60, 80)), "view.json")
    assert main(["map", "camera.json", "--target", "view.json", "-o", "a.npz"]) == 0
    assert "80x60 from 320x200" in capsys.readouterr().out


@pytest.mark.parametrize("mode", MODES)
@pytest.mark.parametrize("padding_mode", PADDINGS)
def test_positions_beyond_every_float32_are_finite(mode, padding_mode):
    far = torch.tensor([1e300, -1e300, 1e30, -1e39, 3e9, torch.inf, -torch.inf, torch.nan], dtype=torch.float64)
    places = torch.stack(torch.meshgrid(far, torch.cat((far, torch.arange(9).double())), indexing="xy"), -1)
    found = ct.LookupMap(places, (8, 9), "test", {})
    near = torch.tensor([[[-0.5, 3.0], [8.5, 3.0], [4.0, -0.5], [4.0, 7.5], [-0.6, 3], [8.6, 3], [4, -0.6], [4, 7.6]]])
    assert ct.LookupMap(near.double(), (8, 9), "test", {}).valid_mask().tolist() == [[[[True] * 4 + [False] * 4]]]
    for images in (torch.rand(1, 2, 8, 9), torch.rand(1, 2, 8, 9).double(), torch.ones(1, 2, 8, 9, dtype=torch.uint16)):
        result = found(images, mode, padding_mode)
        assert result.double().isfinite().all()
        assert padding_mode != "zeros" or not result[~found.valid_mask().expand_as(result)].any()
