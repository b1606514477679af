"""Exported programs run elsewhere: in ONNX Runtime, and in a process without camtorch, with the same results."""

import importlib.util
import io
import logging
import os
import subprocess
import sys

import pytest
import torch
from cameras import fisheye, one
from torch import nn

import camtorch as ct

onnxruntime = pytest.importorskip("onnxruntime")

pytestmark = [
    pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning"),  # torch's own, in torch.onnx.export
    pytest.mark.skipif(importlib.util.find_spec("onnxscript") is None, reason="onnxscript is not installed"),
]
logging.getLogger("torch.onnx").setLevel(logging.ERROR)  # which operators of torchvision are not installed


def to_onnx(module, *inputs, **options):
    """The program, and what ONNX Runtime makes of it: a function of tensors."""
    program = torch.onnx.export(module.eval(), inputs, dynamo=True, verbose=False, **options)
    settings = onnxruntime.SessionOptions()
    settings.intra_op_num_threads = 1
    session = onnxruntime.InferenceSession(program.model_proto.SerializeToString(), settings)
    names = [node.name for node in session.get_inputs()]

    def run(*values):
        given = {name: value.numpy() for name, value in zip(names, values, strict=True)}
        return tuple(torch.from_numpy(result) for result in session.run(None, given))

    return program.model, run


def camera():
    return fisheye((96, 128)).requires_grad_()


def smooth(batch=1):
    torch.manual_seed(0)
    return nn.functional.interpolate(torch.rand(batch, 3, 12, 16), (96, 128), mode="bicubic").clamp(0, 1)


def kinds(model):
    return [node.op_type for node in model.graph]


BICUBIC = {"mode": "bicubic", "padding_mode": "border", "fill": (0.1, 0.2, 0.3)}


@pytest.mark.parametrize("options", [{}, BICUBIC, {"antialias": True, "image_size": (24, 32)}])
@pytest.mark.slow
def test_a_dewarp_with_options_and_one_without_is_a_plain_gridsample(options):
    images = smooth(2 if options else 1)
    # the program's positions are exact
    warp = ct.Dewarp(camera().double(), **options, tolerance=0.0)
    model, run = to_onnx(warp, images, opset_version=None if options else 16)
    torch.testing.assert_close(run(images)[0], warp(images).detach(), atol=1e-5, rtol=0)
    if not options:
        assert kinds(model) == ["GridSample"]
        assert model.opset_imports[""] == 16
        (grid,) = model.graph.initializers.values()
        assert grid.const_value.nbytes == warp.grid().numel() * 4


@pytest.mark.slow
def test_a_dewarp_takes_any_batch_and_bytes():
    warp, images = ct.Dewarp(camera()), (255 * smooth()).to(torch.uint8)
    model, run = to_onnx(warp, images, dynamic_shapes={"images": {0: "batch"}})
    assert kinds(model).count("GridSample") == 1
    many = images.expand(3, -1, -1, -1).contiguous()
    (result,), expected = run(many), warp(many)
    assert result.dtype == expected.dtype == torch.uint8
    # what lies within rounding of one half may become the next integer: positions of the warp are good to its
    # tolerance of 0.001 px, and values move by some a pixel
    off = (result.double() - expected).abs()
    assert off.max() <= 1
    assert (off > 0).double().mean() < 3e-3


class Both(nn.Module):
    """Pixels of points, and rays of pixels."""

    def __init__(self, camera):
        super().__init__()
        self.camera = camera

    def forward(self, points, pixels):
        return *self.camera.project(points), *self.camera.unproject(pixels)


def inputs_of(camera, count=600):
    """Points all around, and pixels on the image and beside it, with some that are none."""
    generator = torch.Generator().manual_seed(5)
    points = torch.randn(count, 3, generator=generator, dtype=torch.float64)
    points[::2, 2] = points[::2, 2].abs() + 0.3
    strange = [torch.nan, 0, 1], [0, torch.inf, 1], [3e8, 1e8, 5e8]
    points[:7] = torch.tensor([[0, 0, 0], [0, 0, -1], [0, 0, 1], [1e-8, 0, 1], *strange])
    sides = torch.tensor((camera.image_size or (480, 640))[::-1], dtype=torch.float64)
    pixels = (torch.rand(count, 2, generator=generator, dtype=torch.float64) * 1.4 - 0.2) * sides
    pixels[0], pixels[1] = camera.intrinsics[2:].detach(), torch.nan
    pixels[2, 0], pixels[3] = torch.inf, 1e9
    return points.float(), pixels.float()


def assert_agrees(camera, results, points, pixels):
    """Pixels to 1e-5 of the image or of themselves, rays to 1e-5, and valid but where rounding may decide."""
    extent = max(camera.image_size or (640,))
    both = (camera.project, points, *results[:2]), (camera.unproject, pixels, *results[2:])
    for method, values, found, valid in both:
        expected, is_valid = method(values)
        assert torch.equal(valid[:7], is_valid[:7])
        assert (valid != is_valid).double().mean() < 0.02
        assert found.isfinite().all()
        assert found.dtype == expected.dtype
        both = valid & is_valid
        assert both.any()
        size = expected[both].abs().amax(-1).clamp(min=extent if values is points else 1)
        assert ((found[both] - expected[both]).abs().amax(-1) / size).max() < 1e-5
        assert torch.equal(found[~valid & ~is_valid], expected[~valid & ~is_valid])


COUNT = {"points": {0: "count"}, "pixels": {0: "pixel_count"}}


@pytest.mark.slow
def test_a_camera_is_a_constant():
    camera = one("kannala_brandt").float().requires_grad_(False)  # others take a minute
    points, pixels = inputs_of(camera)
    model, run = to_onnx(Both(camera), points, pixels, dynamic_shapes=COUNT)
    assert not any(node.domain for node in model.graph)
    assert_agrees(camera, run(points, pixels), points, pixels)
    assert [len(result) for result in run(points[:50], pixels[:1])] == [50, 50, 1, 1]


@pytest.mark.slow
def test_a_camera_that_is_made_of_inputs_is_a_program_with_operators_of_camtorch():
    class Rays(nn.Module):
        def forward(self, pixels, intrinsics):
            return ct.KannalaBrandt(intrinsics, intrinsics[:2] / 1e4).unproject(pixels)

    module, given = Rays().eval(), (80 * torch.rand(5, 2), torch.tensor([60.0, 60.0, 63.5, 47.5]))
    program, other = torch.export.export(module, given).module(), torch.tensor([40.0, 50.0, 30.0, 20.0])
    torch.testing.assert_close(program(given[0], other), module(given[0], other))
    with pytest.raises(RuntimeError, match=r"No ONNX function found for .*camtorch\.tables"):
        torch.onnx.export(module, given, dynamo=True, verbose=False)


def legacy_onnx(module, inputs):
    torch.onnx.export(module, inputs, io.BytesIO(), dynamo=False)


@pytest.mark.filterwarnings("ignore")  # both are deprecated, and say which sizes become constants
def test_a_recorded_run_holds_the_map_of_a_frozen_warp_and_no_camera():
    warp = ct.Dewarp(camera())
    network, images = nn.Sequential(warp, nn.ReLU()), smooth()
    for record in (legacy_onnx, torch.jit.trace):
        with pytest.raises(RuntimeError, match=r"Warp: cameras must not learn in.*\(dynamo=True\)"):
            record(network, (images,))
    warp.requires_grad_(False)
    file = io.BytesIO()
    torch.jit.save(torch.jit.trace(network, (images,)), file)
    found = torch.jit.load(io.BytesIO(file.getvalue()))(1 - images)
    torch.testing.assert_close(found, network(1 - images), atol=1e-5, rtol=0)
    for lens in (camera(), ct.Pinhole([60.0, 60, 31.5, 23.5])):
        with pytest.raises(RuntimeError, match=r"must not project in torch\.jit\.trace; got .*torch\.export\.export"):
            torch.jit.trace(lens, (torch.rand(5, 3),))


@pytest.mark.parametrize("method", ["project", "unproject", "rays"])
@pytest.mark.filterwarnings("ignore")
def test_the_exporter_of_recorded_runs_takes_no_camera(method):
    class Network(nn.Module):
        def forward(self, values):
            lens = camera()
            return lens.rays()[0] * values.sum() if method == "rays" else getattr(lens, method)(values)

    with pytest.raises(RuntimeError, match=r"KannalaBrandt: dynamo must be True in torch.onnx.export.*; got False"):
        legacy_onnx(Network(), (torch.rand(5, 2 + (method == "project")),))


ELSEWHERE = """
import sys, torch
program = torch.export.load(sys.argv[1]).module()
given, expected = torch.load(sys.argv[2])
for result, known in zip(program(*given), expected, strict=True):
    torch.testing.assert_close(result, known, rtol=1e-5, atol=1e-3)
assert "camtorch" not in sys.modules
"""


@pytest.mark.slow
def test_a_saved_program_runs_without_camtorch(tmp_path):
    camera = one("kannala_brandt").float().requires_grad_(False)
    given, module = inputs_of(camera), Both(camera)
    count = tuple({0: torch.export.Dim(name, min=2)} for name in ("count", "pixel_count"))
    program = torch.export.export(module, given, dynamic_shapes=count)
    torch.export.save(program, tmp_path / "camera.pt2")
    torch.save((given, module(*given)), tmp_path / "values.pt")
    # not from the folder of the sources
    arguments = [sys.executable, "-c", ELSEWHERE, tmp_path / "camera.pt2", tmp_path / "values.pt"]
    subprocess.run(arguments, check=True, cwd=tmp_path, timeout=120, env={**os.environ, "PYTHONPATH": ""})
