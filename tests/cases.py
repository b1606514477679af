"""Calls whose answers are the same everywhere: eager, compiled, exported, without the compiled library, on a device.

`python tests/cases.py FILE` writes the answers of all, eager and on the CPU, to a file.
"""

import copy
import functools
import sys

import torch
from pretended import tensors_of
from torch import nn
from torch.utils import _pytree as pytree

import camtorch as ct
from camtorch import augment as A  # noqa: N812
from camtorch import losses, views
from camtorch.poses.rotations import rotation_matrix
from camtorch.warp.options import MODES, PADDINGS

SIZE = (48, 64)


def rand(*shape, low=0.0, high=1.0):
    return low + (high - low) * torch.rand(*shape, generator=torch.Generator().manual_seed(0))


FISHEYE = ct.KannalaBrandt([22.0, 22.5, 31.3, 23.8], [0.02, -0.01, 0.004, -0.001], image_size=SIZE)
BROWN = ct.BrownConrady([40.0, 41, 31, 24], [-0.2, 0.05, 1e-3, -5e-4], image_size=SIZE)
PINHOLE = ct.Pinhole([30.0, 30, 35.5, 19.5], image_size=(40, 72))
BATCH = ct.Pinhole([[31.0, 30, 31, 23], [24, 25, 33, 24]], image_size=SIZE)
PANORAMA = ct.Equirectangular([128 / 6.283185307, 64 / 3.141592653, 63.5, 31.5], image_size=(64, 128))
TURN = rotation_matrix(torch.tensor([0.12, -0.23, 0.31]))
POSE = ct.Extrinsics([0.02, -0.05, 0.03], [-0.2, 0.02, 0.05])
ABOVE = ct.Extrinsics([2.0, 0, 0], [0, 0.5, 1.5])
SHUTTER = ct.RollingShutter(0.03, [0.8, 2.5, 1.6])
IMAGES = rand(2, 3, *SIZE, high=255.99).to(torch.uint8)
PIXELS = rand(2, 5, 2, low=4, high=44)
BOXES = torch.tensor([[[9.2, 10.1, 30.3, 29.4], [25.7, 12.6, 60.1, 44.3]]]).repeat(2, 1, 1)
POINTS = rand(2, 5, 3, low=-1) + torch.tensor([0, 0, 2.0])
DEPTH = rand(2, 1, *SIZE, low=1, high=1.3)
RAMP = 1 + (torch.arange(48.0)[:, None] / 4000 + torch.arange(64.0) / 3000).repeat(2, 1, 1, 1)
MASK = (torch.arange(48)[:, None] // 8 + torch.arange(64) // 8).repeat(2, 1, 1)
POSES = ct.Extrinsics(rand(2, 3, low=-0.3, high=0.3), rand(2, 3, high=0.1) + torch.tensor([0, 0, 1.0]))
POSES = POSES.matrix().detach()
FIELDS = {"image": IMAGES, "mask": MASK, "keypoints": PIXELS, "boxes": BOXES, "gaze": POINTS[:, 0], "head_pose": POSES}


HEAD = ct.CameraHead(6, "kannala_brandt", image_size=SIZE)
PAIR = nn.ModuleList([FISHEYE, BROWN])


class Case(nn.Module):
    """A call of a module with inputs; both go to a device, but for a draw, which stays where it was made."""

    def __init__(self, module, call, *inputs, draw=None):
        super().__init__()
        self.module, self.call, self.inputs, self.draw = copy.deepcopy(module).requires_grad_(False), call, inputs, draw

    def forward(self, *inputs):
        # positions far outside are wherever rounding takes them
        made = self.call(self.module, *inputs)
        return pytree.tree_map(lambda t: t.clamp(-99, 199) if t.is_floating_point() else t, made)

    def on(self, device):
        """Return a program on a device, and its inputs."""
        given = [value.to(device) for value in self.inputs]
        return Case(self.module, self.call).to(device), [*given, *([] if self.draw is None else [self.draw])]


def warp(made, images=IMAGES):
    """A case of images of three kinds, and of the mask of what is seen."""

    def call(made, images):
        return made(images), made(images / 255), made(images[:, :1], mode="nearest"), made.valid_mask()

    return Case(made, call, images)


def labels(made):
    """A case of points and boxes."""
    call = lambda made, pixels, boxes: (made.transform_points(pixels), made.transform_boxes(boxes))  # noqa: E731
    return Case(made, call, PIXELS, BOXES)


def plain(made, *inputs):
    """A case of the call alone."""
    return Case(made, lambda module, *given: module(*given), *inputs)


def moved(augmentation, *fields):
    """A case of a sample with these fields, or image, mask, keypoints and boxes; one draw is given."""
    given = {**FIELDS, "depth": RAMP}
    names = fields or tuple(FIELDS)[:4]

    def call(module, *values):
        drawn = {"draw": values[len(names)]} if len(values) > len(names) else {}
        out = dict(module(dict(zip(names, values, strict=False)), **drawn))
        cameras = {n: out.pop(n) for n in ("camera", "source_camera") if n in out}
        return {**out, **{n: (c.intrinsics, c.distortion.expand(*c.batch_shape, -1)) for n, c in cameras.items()}}

    draw = augmentation.draw(2, torch.Generator().manual_seed(3)) if isinstance(augmentation, A.Augmentation) else None
    return Case(augmentation, call, *(given[name] for name in names), draw=draw)


def chain(*parts, **options):
    return moved(A.Compose(parts, camera=FISHEYE, **options))


PROGRAMS = {
    f"Warp, {mode}, {padding}": warp(ct.Warp(FISHEYE, PINHOLE, TURN, mode=mode, padding_mode=padding, fill=9.0))
    for mode in MODES
    for padding in PADDINGS
}
PROGRAMS |= {
    "Warp, antialias": warp(ct.Warp(FISHEYE, PINHOLE.detach().resize(12, 20), TURN, antialias=True)),
    "Warp, tolerance=0": warp(ct.Warp(FISHEYE, BROWN, tolerance=0)),
    "Warp, float64": warp(copy.deepcopy(ct.Warp(FISHEYE, BROWN, TURN)).double()),
    "Warp, batch": warp(ct.Warp(BATCH, BROWN, TURN)),
    "Warp, panorama": plain(ct.Warp(PANORAMA, PINHOLE, TURN), rand(2, 3, 64, 128, high=255).byte()),
    "Warp, mixed": plain(ct.Warp(ct.Mixed([FISHEYE, BROWN]), PINHOLE), IMAGES),
    "Warp, channels last": plain(ct.Warp(FISHEYE, BROWN), IMAGES.contiguous(memory_format=torch.channels_last)),
    "Warp, uint16": plain(ct.Warp(FISHEYE, BROWN), IMAGES.to(torch.uint16)),
    "labels: Warp": labels(ct.Warp(FISHEYE, PINHOLE, TURN)),
    "labels: PlaneWarp": labels(ct.PlaneWarp(BROWN, BROWN, POSE, [0, 0.2, 1], 2.0)),
    "labels: ShutterWarp": labels(ct.ShutterWarp(FISHEYE, PINHOLE, TURN, shutter=SHUTTER)),
    "Reproject, z": plain(ct.Reproject(FISHEYE, BROWN, POSE), IMAGES, DEPTH),
    "Reproject, sweep": plain(ct.Reproject(FISHEYE, BROWN, POSE), IMAGES, torch.cat((DEPTH, DEPTH + 1), 1)),
    "PlaneWarp": plain(ct.PlaneWarp(BROWN, BROWN, POSE, [0, 0.2, 1], 2.0), IMAGES),
    "BirdsEye": plain(ct.BirdsEye(BROWN, ABOVE, x=(-1, 1), y=(1, 3), resolution=0.05), IMAGES),
    "ShutterWarp": plain(ct.ShutterWarp(FISHEYE, PINHOLE, TURN, shutter=SHUTTER), IMAGES),
    "ShutterWarp, target": plain(ct.ShutterWarp(FISHEYE, BROWN, target_shutter=SHUTTER), IMAGES),
    "views.cube": plain(views.cube(FISHEYE, 16), IMAGES),
    "views.ring": plain(views.ring(FISHEYE, 3, size=16), IMAGES),
    "views.look_at": plain(views.look_at(FISHEYE, BOXES[0, :1].repeat(2, 1), (24, 24)), IMAGES),
    "rectify": plain(ct.rectify(BROWN, BROWN, ct.Extrinsics([0, 0.02, 0], [-0.3, 0, 0])).left.detach(), IMAGES),
    "Resize": moved(A.Resize(13)),
    "Resize, larger": moved(A.Resize((77, 100))),
    "Resize, a little": moved(A.Resize((36, 50))),
    "Resize, antialias": moved(A.Resize((36, 50), antialias=True)),
    "Resize, bicubic": moved(A.Resize(20, mode="bicubic")),
    "Resize, no antialias": moved(A.Resize(20, antialias=False, padding_mode="border")),
    "RandomResizedCrop": moved(A.RandomResizedCrop(15)),
    "RandomResizedCrop, antialias": moved(A.RandomResizedCrop(40, antialias=True)),
    "RandomResizedCrop, bicubic": moved(A.RandomResizedCrop((15, 20), mode="bicubic", padding_mode="reflection")),
    "RandomCrop": moved(A.RandomCrop(30)),
    "CenterCrop": moved(A.CenterCrop((40, 80), fill=(1.0, 2.0, 3.6))),
    "Pad": moved(A.Pad((3, 4), padding_mode="reflection")),
    "HorizontalFlip": moved(A.HorizontalFlip(), *FIELDS),
    "VerticalFlip": moved(A.VerticalFlip(1.0, camera=FISHEYE), *FIELDS),
    "Rotate90": moved(A.Rotate90((0, 2), step=2)),
    "Rotate90, upright": moved(A.Rotate90(1)),
    "Compose: size, flip": chain(A.Resize(21), A.HorizontalFlip()),
    "Compose: crop, flip": chain(A.RandomResizedCrop(20), A.HorizontalFlip()),
    "Compose: crop, crop": chain(A.RandomResizedCrop(31), A.RandomResizedCrop(13)),
    "Compose: crop, crop, antialias": chain(A.RandomResizedCrop(31), A.RandomResizedCrop(13), antialias=True),
    "Compose: crop, turn, size": chain(A.CenterCrop(40), A.Rotate90(), A.Resize(11)),
    "Compose: mount, crop, antialias": chain(A.RandomMount(yaw=10), A.RandomResizedCrop(15), antialias=True),
    "Compose: crop, mount": chain(A.RandomResizedCrop(20), A.RandomMount(yaw=5)),
    "Compose: flip, lens": chain(A.HorizontalFlip(), A.RandomLens("dms60", fov="source")),
    "Compose: size, shutter": chain(A.Resize(14), A.RandomShutter(readout=0.03, rates=(0.5, 1.0))),
    "RandomMount": moved(A.RandomMount(camera=FISHEYE, min_filled=0.9, valid_mask=True), *FIELDS),
    "RandomMount, shift": moved(A.RandomMount(camera=BROWN, shift=(0.1, 0.1, 0.1)), "image", "keypoints", "depth"),
    "RandomLens": moved(A.RandomLens("dms130", camera=FISHEYE, fov="source", vignetting=0.5, chromatic=0.01)),
    "RandomCamera": moved(A.RandomCamera(camera=FISHEYE, like="dms60", image_size=(20, 30), min_filled=0)),
    "RandomShutter": moved(A.RandomShutter(readout=0.03, rates=(0.5, 1.0), camera=FISHEYE), "image", "keypoints"),
    "BoxCrop": moved(A.BoxCrop((16, 16), yaw=3, camera=FISHEYE), "image", "keypoints", "boxes"),
    "FaceNormalizer": moved(A.FaceNormalizer(image_size=(16, 16), distance=1, focal=40, camera=FISHEYE), *FIELDS),
    "CanonicalCamera, depth": moved(ct.CanonicalCamera(focal=30, camera=FISHEYE), "image", "depth"),
    "CanonicalCamera, image": moved(ct.CanonicalCamera(focal=9, scales="image", image_size=SIZE, camera=FISHEYE)),
    "CameraHead": Case(HEAD, lambda head, features, points: head(features).project(points), rand(2, 6), POINTS),
    "losses.angles": Case(nn.Identity(), lambda _, a, b: losses.angles(a, b), POINTS, POINTS.flip(0)),
    "losses.rays": Case(PAIR, lambda pair: losses.rays(pair[0], pair[1])),
    "losses.reprojection": Case(PAIR, lambda pair: losses.reprojection(pair[0], pair[1], penalty=50)),
    "project": Case(FISHEYE, lambda c, points, pixels: (c.project(points), c.unproject(pixels)), POINTS, PIXELS),
}


def answer(name, device="cpu"):
    """Return the tensors that a case gives eagerly."""
    program, inputs = PROGRAMS[name].on(device)
    with torch.no_grad():
        return list(tensors_of(program(*inputs)))


CASES = {name: functools.partial(answer, name) for name in PROGRAMS}

if __name__ == "__main__":
    torch.save({name: case() for name, case in CASES.items()}, sys.argv[1])
