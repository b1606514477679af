"""Groups of a camera's parameters for an optimizer, and training with them: the loss is good only if the camera is."""

import copy

import pytest
import torch
from cameras import every_model, pixel_lattice, slow_unless, spread
from torch.nn.utils import parametrize

import camtorch as ct
from camtorch.networks.parametrize import PositiveFocal

FISHEYE = [310.0, 312, 322, 238, 0.02, -0.01, 0.003, -0.001, 3e-4, -1e-4, 0.001, -5e-4, 0.001, 3e-4, -0.001, -2e-4]
LENSES = {"kannala_brandt": FISHEYE[:8], "fisheye62": FISHEYE[:12], "fisheye624": FISHEYE}
LENSES |= {"brown_conrady": [420.0, 421, 323, 237, -0.1, 0.02, 0.001, -5e-4, 0], "ucm": [350.0, 351, 323, 237, 0.4]}
OPTIMIZERS = {name: getattr(torch.optim, name) for name in ("Adam", "AdamW", "RMSprop", "SGD")}
OPTIMIZERS["momentum"] = lambda groups: torch.optim.SGD(groups, momentum=0.9)
# each optimizer with the lens that most people have, and each lens with one that adapts its steps and one that does not
CASES = [("kannala_brandt", name) for name in OPTIMIZERS]
CASES += [(key, name) for key in LENSES if key != "kannala_brandt" for name in ("AdamW", "momentum")]
QUICK = {("kannala_brandt", "AdamW"), ("brown_conrady", "momentum")}.__contains__


def pixels_moved_at_most(camera, lr, count=None):
    rays, seen = camera.unproject(pixel_lattice(camera, 13, 17))
    steps = lr * torch.eye(len(camera.distortion), dtype=torch.float64)[:count]
    after, valid = camera.replace(distortion=camera.distortion + steps).project(rays.expand(len(steps), -1, 3))
    return (after - camera.project(rays)[0]).norm(dim=-1)[valid & seen].max().item()


@every_model
def test_a_step_moves_the_image_by_lr_pixels(key):
    near, camera = rows = spread(key), spread(key)
    near.intrinsics.data[:2] *= 0.8
    for made, parts in ((camera, [camera]), (copy.deepcopy(ct.cat(rows)), rows)):  # a copy has leaves of its own
        groups = made.parameter_groups(lr=0.01)
        assert [id(*group["params"]) for group in groups] == [id(t) for t in made.tensors if t.requires_grad]
        assert [groups[0]["lr"], *(group["weight_decay"] for group in groups)] == [0.01, *[0] * len(groups)]
        for group in groups[1:]:  # a lens that ends on the image is measured a little inside
            assert max(pixels_moved_at_most(part, group["lr"]) for part in parts) == pytest.approx(0.01, rel=0.25)


def test_groups_of_what_learns_of_several_cameras():
    lens, focal, fixed = spread("kannala_brandt"), spread("pinhole"), spread("ucm").requires_grad_(False)
    parametrize.register_parametrization(focal, "intrinsics", PositiveFocal())
    shared = lens.replace(intrinsics=[300.0, 300.0, 320.0, 240.0]).freeze("k3", "k4")
    groups = ct.Mixed([lens.freeze("k3", "k4"), focal, fixed, shared]).parameter_groups(lr=0.01)
    held = [*lens.parameters(), focal.parametrizations.intrinsics.original, shared.intrinsics]
    assert [id(*group["params"]) for group in groups] == [id(t) for t in held]
    assert pixels_moved_at_most(lens, groups[1]["lr"], 2) == pytest.approx(0.01, rel=0.25)
    assert groups[2]["lr"] == pytest.approx(0.01 / focal.fy.item())


@pytest.mark.parametrize(("key", "name"), slow_unless(QUICK, CASES))
@pytest.mark.filterwarnings("ignore:.* became unusable")  # SGD may do that
def test_the_loss_is_good_only_if_the_camera_is(key, name):
    truth = ct.MODELS[key](LENSES[key][:4], LENSES[key][4:], image_size=(480, 640)).requires_grad_(False)
    seen = torch.rand(500, 2, generator=torch.Generator().manual_seed(0)) * torch.tensor([639.0, 479.0])
    points, _ = truth.unproject(seen)
    camera = type(truth).from_fov(float(truth.fov[0]), image_size=(480, 640))
    optimizer = OPTIMIZERS[name](camera.parameter_groups(lr=0.5))
    for _ in range(300):
        optimizer.zero_grad()
        ct.losses.reprojection(camera, seen, points, penalty=800).backward()
        optimizer.step()
    loss, (pixels, valid) = ct.losses.reprojection(camera, seen, points, penalty=800), camera.project(points)
    off, lost = (pixels - seen).square().sum(-1).mean().sqrt(), 1 - valid.float().mean()
    assert (off < 1 and lost == 0) or (name in ("SGD", "momentum") and loss > max(1, 799 * lost))


def test_what_cameras_share_has_the_step_of_the_most_sensitive_one():
    wide = spread("kannala_brandt").freeze("fx", "fy", "cx", "cy")
    near = wide.replace(intrinsics=wide.intrinsics.detach() * 0.5)
    near._parameters["distortion"] = wide._parameters["distortion"]
    steps = [camera.parameter_groups(lr=0.01)[-1]["lr"] for camera in (wide, near)]
    assert ct.Mixed([near, wide]).parameter_groups(lr=0.01)[-1]["lr"] == min(steps) < max(steps)


def test_a_number_without_an_effect_moves_little():
    lens = ct.FOV([300.0, 300.0, 320.0, 240.0], [0.0], image_size=(480, 640))
    assert lens.parameter_groups(lr=0.01)[1]["lr"] == pytest.approx(1e-5)
