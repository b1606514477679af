"""Modules are made of shapes alone, on the meta device or in a FakeTensorMode, and filled from a state_dict."""

import copy

import pytest
import torch
from cameras import fan, slow_unless
from torch._subclasses.fake_tensor import FakeTensorMode

import camtorch as ct

some_models = pytest.mark.parametrize("key", slow_unless("kannala_brandt".__eq__, ["double_sphere", "kannala_brandt"]))
POINTS = fan(40, 4, 3).float()


def build(key):
    """A layer of every kind of module, as a training script makes it: of lists and constants."""
    camera = ct.MODELS[key]([300.0, 310.0, 31.5, 23.5], image_size=(48, 64))
    pose = ct.Extrinsics([0.1, 0.2, 0.3], [1.0, 2.0, 3.0])
    return torch.nn.ModuleDict(
        {
            "camera": camera,
            "batch": ct.MODELS[key](torch.tensor([[300.0, 310.0, 31.5, 23.5]] * 3), image_size=(48, 64)),
            "pose": pose,
            "rig": ct.Rig({"a.b": camera}, {"a.b": pose}),
            "warp": ct.Warp(camera, camera, torch.eye(3)),
            "dewarp": ct.Dewarp(camera, image_size=(20, 30)),
        }
    )


def results(layer):
    images = torch.arange(2.0 * 3 * 48 * 64).view(2, 3, 48, 64) / 18432
    points = torch.ones(4, 3, 3) * torch.tensor([[0.1], [0.2], [-0.3]])
    return (
        *layer["camera"].project(points),
        *layer["batch"].unproject(torch.full((3, 5, 2), 20.0)),
        layer["pose"](points),
        layer["rig"].extrinsics["a.b"].matrix(),
        layer["warp"](images),
        layer["dewarp"](images),
    )


def varied(layer):
    with torch.no_grad():
        for i, p in enumerate(layer.parameters()):
            p.mul_(1 + 0.01 * i)
    return layer


@some_models
@pytest.mark.parametrize("fill", ["to_empty", "assign"])
def test_deferred_initialisation(key, fill):
    reference = varied(build(key))
    with torch.device("meta"):
        layer = build(key)
    names = [name for name, _ in reference.named_parameters()]
    assert [name for name, p in layer.named_parameters() if p.is_meta] == names
    assert [p.requires_grad for p in layer.parameters()] == [p.requires_grad for p in reference.parameters()]
    state = copy.deepcopy(reference.state_dict())
    if fill == "to_empty":
        layer.to_empty(device="cpu")
    layer.load_state_dict(state, assign=fill == "assign")
    assert not any(t.is_meta for t in (*layer.parameters(), *layer.buffers()))
    for mine, expected in zip(results(layer), results(reference), strict=True):
        assert torch.equal(mine, expected)
    layer["camera"].project(POINTS)[0].sum().backward()
    assert layer["camera"].intrinsics.grad.any()


@pytest.mark.parametrize("mode", [pytest.param(FakeTensorMode, marks=pytest.mark.slow), lambda: torch.device("meta")])
def test_shapes_without_values(mode):
    expected = results(build("kannala_brandt"))
    with mode():
        layer = build("kannala_brandt")
        found = results(layer)
        assert [(t.shape, t.dtype) for t in found] == [(t.shape, t.dtype) for t in expected]
        camera = layer["camera"]
        assert camera.crop(1, 2, 20, 30).hflip().rays()[0].shape == (20, 30, 3)
        assert camera.field_of_view.shape == (3,)
        assert layer["batch"][1:].intrinsics.shape == (2, 4)
        assert type(camera).from_fov(90.0, image_size=(48, 64)).intrinsics.shape == (4,)
        assert camera.K.shape == (3, 3)
        assert layer["warp"].transform_points(torch.ones(5, 2))[0].shape == (5, 2)
        assert layer["warp"](torch.zeros(1, 3, 48, 64, dtype=torch.uint8), mode="nearest").dtype == torch.uint8
        assert layer["pose"].inverse().compose(layer["pose"]).matrix().shape == (4, 4)
        assert ct.Extrinsics(torch.eye(3), torch.zeros(3)).batch_shape == ()
        assert repr(layer)


def test_a_camera_with_values_among_tensors_without():
    camera = ct.KannalaBrandt([300.0, 310.0, 31.5, 23.5], image_size=(48, 64))
    with FakeTensorMode(allow_non_fake_inputs=True):
        assert camera.project(torch.ones(5, 3))[0].shape == (5, 2)
        assert camera.unproject(torch.ones(5, 2))[0].shape == (5, 3)
    assert camera.project(POINTS)[1].all()
