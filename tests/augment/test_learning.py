"""A camera given to an augmentation is copied and does not learn; that of a sample learns, except in a worker."""

import importlib
import inspect

import pytest
import torch
from torch import nn
from torch.utils.data import DataLoader
from torchvision_stand_in import torchvision_of

import camtorch as ct
from camtorch import augment
from camtorch.augment import kornia as adapter
from camtorch.augment.sample import SampleTransform
from camtorch.lenses import drawing

SIZE, MOUNT = (48, 64), augment.RandomMount()
GIVEN = {"Compose": ([MOUNT],), "RandomShutter": (0.02, 30), "Pad": (2,), "Rotate90": (1,), "BoxCrop": ((32, 32),)}
GIVEN |= dict.fromkeys(("CenterCrop", "RandomCrop", "Resize", "RandomResizedCrop"), (32,)) | {"CanonicalCamera": (60,)}
CLASSES = [one for one in vars(augment).values() if inspect.isclass(one) and issubclass(one, SampleTransform)]
BATCHES = {
    one.__name__: lambda lens, one=one: one(*GIVEN.get(one.__name__, ()), camera=lens)
    for one in (*CLASSES, ct.CanonicalCamera)
    if one not in (augment.Augmentation, augment.Edit)
}
BATCHES |= {"set later": lambda lens: setattr(one := augment.RandomMount(), "camera", lens) or one}
BATCHES |= {"part": lambda lens: augment.Compose([augment.RandomMount(camera=lens)])}
SINGLE = {
    "like": lambda lens: augment.RandomCamera(lens, camera=lens),
    "kornia": lambda lens: adapter.RandomLens(lens, lens),
    "kornia's part": lambda lens: adapter.CameraAugmentation(augment.RandomMount(camera=lens)),
    "kornia, set later": lambda lens: setattr(one := adapter.RandomMount(lens_of()), "camera", lens) or one,
    "torchvision": lambda lens: importlib.import_module("camtorch.augment.torchvision").Transform(MOUNT, lens),
}


class Own(ct.Pinhole):
    """A model of somebody's own."""


def lens_of(kind="plain"):
    lens = (Own if kind == "subclass" else ct.Pinhole)([40.0, 40.0, 31.5, 23.5], image_size=SIZE)
    if kind == "parametrized":
        nn.utils.parametrize.register_parametrization(lens, "intrinsics", nn.Softplus())
    return {"predicted": lens.replace(intrinsics=2 * lens.intrinsics), "mixed": ct.Mixed([lens, lens])}.get(kind, lens)


def moved(held, weight=1.0, **more):
    """What comes out of a batch of two samples."""
    pose = torch.eye(4).index_put((torch.tensor(2), torch.tensor(3)), torch.tensor(600.0))
    fields = {"image": weight * torch.ones(1, *SIZE), "boxes": torch.tensor([[5.0, 5, 40, 40]]), "head_pose": pose}
    fields = {name: value.expand(2, *value.shape) for name, value in fields.items()} | more
    return held(fields) if isinstance(held, SampleTransform) else {"image": held(fields["image"])}


@pytest.mark.parametrize("kind", ["plain", "subclass", "parametrized", "predicted", "mixed"])
@pytest.mark.parametrize("name", BATCHES | SINGLE)
def test_a_given_camera_is_copied_and_does_not_learn(name, kind, monkeypatch):
    if kind == "mixed" and name in SINGLE:
        return
    lens, weight = lens_of(kind), nn.Parameter(torch.ones(()))
    with torchvision_of("stand-in", monkeypatch):
        held = (BATCHES | SINGLE)[name](lens)
        cameras = [part for part in held.modules() if type(part) is type(lens)]
        before = [camera.intrinsics.clone() for camera in cameras]
        if kind != "parametrized":  # whose Parameters are those of torch's own modules
            held.requires_grad_(True)  # as a network that it is a part of
        optimizer = torch.optim.Adam([*nn.ModuleList([held]).parameters(), weight], lr=1.0)
        moved(held, weight)["image"].sum().backward()
        optimizer.step()
    for tensor in (*lens.parameters(), lens.intrinsics):
        tensor.data += 1.0
    assert {f"camera.{key}" for key in lens.state_dict()} <= held.state_dict().keys()
    assert weight.item() < 0.5
    assert not any(tensor.requires_grad for tensor in (*held.parameters(), *held.buffers()))
    assert cameras
    assert all(torch.equal(camera.intrinsics, was) for camera, was in zip(cameras, before, strict=True))


def test_a_warp_says_whether_it_learns():
    for warp in (ct.Dewarp(lens_of()), ct.Warp(lens_of().requires_grad_(False), lens_of())):
        assert ", learns\n" in repr(warp)
        assert ", fixed\n" in repr(warp.requires_grad_(False))
    assert ", learns\n" in repr(ct.Warp(warp.source, warp.target, torch.eye(3).requires_grad_()))


class Learning(dict):
    """Name -> the names of what learns among all that an augmentation makes of a sample whose camera learns."""

    def __getitem__(self, name):
        out = moved(super().__getitem__(name)(None), camera=lens_of())
        return {n for n, v in out.items() if any(t.requires_grad for t in getattr(v, "tensors", (v,)))}


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_a_sample_s_camera_learns_but_not_in_a_worker():
    samples, lens = Learning(BATCHES, still=lambda lens: augment.RandomMount(p=0.0)), lens_of()
    assert all(samples[name] for name in samples)
    if "fork" in torch.multiprocessing.get_all_start_methods():
        options = {"num_workers": 1, "multiprocessing_context": "fork"}
        assert all(batch == [set()] for batch in DataLoader(samples, sampler=list(samples), collate_fn=list, **options))
        sample = {"camera": lens, "image": ct.Dewarp(lens)(torch.ones(1, 1, *SIZE))[0]}
        (batch,) = DataLoader([sample], collate_fn=augment.collate, **options)
        assert not batch["image"].requires_grad
        assert not batch["camera"].intrinsics.requires_grad


TRANSFORMED = {
    "lens": lambda: augment.RandomLens(),
    "camera": lambda: augment.RandomCamera(),
    "formulas": lambda: augment.RandomLens("double_sphere", fov=(60, 70)),
    "real": lambda: augment.RandomLens("real", fov=(60, 70)),
}


@pytest.mark.parametrize("name", TRANSFORMED)
@pytest.mark.parametrize("transform", [torch.func.jacrev, torch.func.jacfwd])
def test_derivatives_pass_through_drawn_lenses(name, transform):
    lens, augmentation = lens_of().requires_grad_(False), TRANSFORMED[name]()
    draw, keypoints = augmentation.draw(1), 8 + 30 * torch.rand(3, 2)

    def by_keypoints(points):
        return augmentation(keypoints=points, draw=draw, camera=lens)["keypoints"]

    def by_camera(intrinsics):
        return augmentation(keypoints=keypoints, draw=draw, camera=lens.replace(intrinsics=intrinsics))["keypoints"]

    drawing._good.cache_clear()
    drawing.lenses_for.cache_clear()
    for function, value in ((by_keypoints, keypoints), (by_camera, lens.intrinsics)):
        found, expected = transform(function)(value), torch.autograd.functional.jacobian(function, value)
        torch.testing.assert_close(found, expected, rtol=1e-4, atol=1e-4)
