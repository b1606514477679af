"""Calls on a pretended device without float64, as Apple's `mps` is: it refuses such tensors as that does."""

import sys
from pathlib import Path

import torch

sys.path.insert(0, str(Path(__file__).parents[1]))

import pretended

import camtorch as ct
from camtorch.optics import radial_inverse
from camtorch.warp import affine

make = pretended.Pretended.__new__


def refuse(cls, on_host):
    if on_host.dtype == torch.float64:
        raise TypeError("Cannot convert a MPS Tensor to float64 dtype as the MPS framework doesn't support float64.")
    return make(cls, on_host)


pretended.Pretended.__new__ = staticmethod(refuse)
radial_inverse.WITHOUT_FLOAT64 = affine.WITHOUT_FLOAT64 = (pretended.NAME,)
library = pretended.install()
device = torch.device(pretended.NAME, 0)
points = (torch.rand(2, 5, 3) + torch.tensor([-0.5, -0.5, 1.0])).to(device)
images, pixels = torch.rand(2, 3, 48, 64).to(device), points[..., :2] * 40 + 20
for model in ct.MODELS.values():
    lens = model.from_fov(100, image_size=(48, 64)).requires_grad_(False).to(device)
    lens.unproject(lens.project(points)[0])
    assert lens.fov.isfinite().all(), model
camera = ct.KannalaBrandt.from_fov(100, image_size=(48, 64)).requires_grad_(False).to(device)
straight = ct.Dewarp(camera)
straight(images)
straight.transform_points(pixels)
camera.backproject(images[0, 0])
few = {"min_filled": 0}
kinds = [ct.augment.RandomCamera("dms130", yaw=5, **few), ct.augment.RandomLens("dms130", **few)]
for kind in (*kinds, ct.augment.RandomMount(yaw=5), ct.augment.HorizontalFlip(p=1.0), ct.augment.Resize((24, 32))):
    kind(image=images, keypoints=pixels, gaze=points[:, 0], camera=camera)
