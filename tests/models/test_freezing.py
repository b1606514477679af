"""Parameters that stay, by name: in gradients, under any optimizer, in copies and states, and in fits."""

import copy
import io
import pickle

import pytest
import torch
from cameras import each_kind, spread

import camtorch as ct
from camtorch.networks.parametrize import PositiveFocal


def names_of(camera):
    return ["fx", "cy", *camera.distortion_names[-1:]]


def numbers(camera):
    return torch.cat((camera.intrinsics, camera.distortion), -1).detach()


def is_frozen(camera):
    names = ("fx", "fy", "cx", "cy", *camera.distortion_names)
    return torch.tensor([name in names_of(camera) for name in names])


def loss(camera, seed=0):
    generator = torch.Generator().manual_seed(seed)
    rays = torch.randn(64, 3, generator=generator, dtype=camera.intrinsics.dtype) * 0.3 + torch.tensor([0.0, 0, 1])
    pixels, valid = camera.project(rays)
    return ((pixels - 100) ** 2)[valid].mean()


@each_kind
def test_what_is_frozen_has_no_gradient_and_the_rest_has_its_own(key):
    plain, camera = spread(key), spread(key)
    held = camera.intrinsics
    assert camera.freeze(*names_of(camera)) is camera
    assert camera.intrinsics is held  # the Parameter, of which an optimizer may hold
    for one in (plain, camera):
        loss(one).backward()
    want, found = (torch.cat([p.grad for p in one.parameters()]) for one in (plain, camera))
    learns = ~is_frozen(camera)[: len(found)]
    assert (found[~learns] == 0).all()
    torch.testing.assert_close(found[learns], want[learns])


@each_kind
@pytest.mark.parametrize("make", [torch.optim.Adam, torch.optim.AdamW, torch.optim.SGD])
def test_no_optimizer_moves_it(key, make):
    camera = spread(key)
    before = numbers(camera)
    options = {"momentum": 0.9} if make is torch.optim.SGD else {}
    optimizer = make(camera.parameters(), lr=1e-4, weight_decay=0.1, **options)
    loss(camera).backward()  # momentum from before it was frozen
    optimizer.step()
    camera.freeze(*names_of(camera))
    held = numbers(camera)
    for _ in range(3):
        optimizer.zero_grad()
        loss(camera).backward()
        optimizer.step()
    frozen, now = is_frozen(camera), numbers(camera)
    assert torch.equal(now[frozen], held[frozen])
    assert (now != before)[:4][~frozen[:4]].all()
    camera.unfreeze()
    assert torch.equal(numbers(camera), now)


def test_what_is_frozen_later_or_less_has_the_gradient_that_it_should():
    camera = spread("kannala_brandt").freeze("fx")
    loss(camera).backward()
    camera.freeze("k1").unfreeze("fx")
    camera.zero_grad()
    loss(camera).backward()
    assert camera.intrinsics.grad[0] != 0
    assert camera.distortion.grad.tolist()[0] == 0
    camera.unfreeze()
    camera.zero_grad()
    loss(camera).backward()
    assert (camera.distortion.grad != 0).all()
    for again in (copy.deepcopy(camera.freeze("k2")), pickle.loads(pickle.dumps(camera))):
        again.zero_grad()
        loss(again).backward()
        assert again.distortion.grad[1] == 0
        assert again.distortion.grad[0] != 0


def test_compiled_and_functional_calls_hold_it():
    camera = spread("kannala_brandt").freeze("fx", "k3")
    points = torch.randn(9, 3, dtype=torch.float64) * 0.2 + torch.tensor([0.0, 0, 1])
    want = camera.project(points)[0]
    other = {"intrinsics": camera.intrinsics.detach() * 2}
    moved = torch.func.functional_call(camera, other, (points,))[0]
    middle = camera.cx.detach(), 2 * camera.cx.detach()
    torch.testing.assert_close(moved[:, 0] - middle[1], want.detach()[:, 0] - middle[0])  # fx stays, cx does not
    call = torch.func.functional_call
    slope = torch.func.grad(lambda values: call(camera, {"intrinsics": values}, (points,))[0].sum())
    assert slope(camera.intrinsics.detach())[0] == 0


def test_copies_pickles_and_states_keep_it():
    camera = spread("kannala_brandt", torch.float32).freeze("fx", "k2")
    with torch.no_grad():
        camera._parameters["intrinsics"].mul_(1.1)  # as weight decay does
    held = numbers(camera)
    state = io.BytesIO()
    torch.save(camera.state_dict(), state)
    state.seek(0)
    other = ct.KannalaBrandt([1.0, 1, 1, 1])
    other.load_state_dict(torch.load(state))
    for made in (copy.deepcopy(camera), pickle.loads(pickle.dumps(camera)), other):
        assert torch.equal(numbers(made), held)
        assert "frozen=(fx, k2)" in repr(made)
    assert "frozen=(fx, k2)" in repr(copy.deepcopy(camera).to(torch.float64))
    assert "frozen" not in repr(camera.resize(24, 32))
    assert ", float32, learns, frozen=(fx, k2)" in repr(camera)
    assert ", float32, frozen, frozen=(fx, fy, " in repr(copy.deepcopy(camera).freeze())
    assert "frozen=(k2)" in repr(copy.deepcopy(camera).unfreeze("fx"))
    # a state of one that was not frozen leaves it to the module
    camera.load_state_dict(ct.KannalaBrandt([5.0, 6, 7, 8]).state_dict())
    assert camera.fx == 5
    assert "frozen=(fx, k2)" in repr(camera)
    tied = spread("kannala_brandt")
    torch.nn.utils.parametrize.register_parametrization(tied, "intrinsics", PositiveFocal())
    assert "frozen=(k1)" in repr(tied.freeze("k1"))


def test_fits_hold_what_is_fixed_and_what_is_frozen():
    truth = ct.KannalaBrandt([200.0, 210, 320, 240], [0.01, -0.002, 0.001, 0.0003], image_size=(480, 640)).double()
    pixels = truth.pixel_grid()[::40, ::40].reshape(-1, 2).double()
    rays = truth.unproject(pixels)[0].detach()
    found = ct.fit("kannala_brandt", pixels, rays, image_size=(480, 640), fixed=("cx", "cy", "k3")).camera
    assert (found.cx, found.cy, found.distortion[2]) == (319.5, 239.5, 0)
    start = ct.KannalaBrandt([200.0, 205, 318, 240], [0.01, -0.002, 0.0, 0.0003], image_size=(480, 640)).double()
    result = ct.fit(start.freeze("fx", "k1"), pixels, rays)
    assert result.camera.fx == 200
    assert result.camera.distortion[0] == start.distortion[0]
    assert result.rms < 1e-9
    assert result.camera.image_size == (480, 640)
    with pytest.raises(ValueError, match="image_size"):
        ct.fit("kannala_brandt", pixels, rays, fixed="cx")
