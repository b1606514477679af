"""Exported programs run elsewhere: in ONNX Runtime, and in a process without camtorch, with the same results."""

import logging

import pytest
import torch
from torch import nn

import camtorch as ct

onnxruntime = pytest.importorskip("onnxruntime")
pytest.importorskip("onnxscript")

pytestmark = pytest.mark.filterwarnings("ignore:.*LeafSpec:FutureWarning")  # torch's own, in torch.onnx.export
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


def fisheye(**options):
    values = [60.0, 60.0, 63.5, 47.5], [0.02, -0.01, 0.003, -0.001]
    return ct.KannalaBrandt(*values, image_size=(96, 128), **options)


def smooth(batch=1):
    torch.manual_seed(0)
    return nn.functional.interpolate(torch.rand(batch, 3, 12, 16), (96, 128), mode="bicubic").clamp(0, 1)


# -- warps whose map is a constant


def kinds(model):
    return [node.op_type for node in model.graph]


SLOW = pytest.mark.slow


@pytest.mark.parametrize("learns", [False, pytest.param(True, marks=SLOW)])
@pytest.mark.parametrize("dtype", [torch.float32, pytest.param(torch.float64, marks=SLOW)])
def test_a_dewarp_is_a_plain_gridsample(learns, dtype):
    warp = ct.Dewarp(fisheye().to(dtype)).requires_grad_(learns)
    images = smooth()
    model, run = to_onnx(warp, images, opset_version=16)
    assert kinds(model) == ["GridSample"]
    assert model.opset_imports[""] == 16
    (grid,) = model.graph.initializers.values()
    assert grid.const_value.nbytes == warp.grid().numel() * 4
    torch.testing.assert_close(run(images)[0], warp(images).detach(), atol=1e-5, rtol=0)


@pytest.mark.slow
def test_a_dewarp_takes_any_batch_and_bytes():
    warp = ct.Dewarp(fisheye())
    for images in (smooth(), (255 * smooth()).to(torch.uint8)):
        model, run = to_onnx(warp, images, dynamic_shapes={"images": {0: "batch"}})
        assert kinds(model).count("GridSample") == 1
        many = images.expand(3, -1, -1, -1).contiguous()
        (result,), expected = run(many), warp(many).detach()
        assert result.dtype == expected.dtype
        # what lies within rounding of one half may become the next integer
        off = (result.double() - expected).abs()
        assert off.max() <= (1 if images.dtype == torch.uint8 else 1e-5)
        assert (off > 1e-5).double().mean() < 1e-3


OPTIONS = [
    {"padding_mode": "border", "fill": (0.1, 0.2, 0.3)},
    {"padding_mode": "reflection", "mode": "nearest"},
    {"mode": "bicubic", "fill": 0.5},
    {"antialias": True, "image_size": (24, 32)},
    {"tolerance": 0.0, "projection": "cylindrical"},
]


@pytest.mark.parametrize("options", OPTIONS)
@pytest.mark.slow
def test_a_dewarp_with_options(options):
    warp, images = ct.Dewarp(fisheye(), **options), smooth(2)
    _, run = to_onnx(warp, images)
    torch.testing.assert_close(run(images)[0], warp(images).detach(), atol=1e-5, rtol=0)
