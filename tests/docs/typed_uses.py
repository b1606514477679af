"""What users write, and the types they get; test_types.py has it checked in a project that installed camtorch."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, assert_type

import numpy as np
import PIL.Image
import torch
from torch import Tensor, nn

import camtorch as ct
from camtorch.convert.result import Conversion

Pair = tuple[Tensor, Tensor]


def cameras() -> ct.KannalaBrandt:
    image = np.zeros((480, 640, 3), np.uint8)
    camera = ct.KannalaBrandt([300, 300.0, 320, 240], np.zeros(4), image_size=image.shape[:2])
    ct.Pinhole((300, 300, 320, 240), image_size=torch.rand(3, 480, 640).shape[-2:])
    ct.Pinhole(torch.tensor([300.0, 300, 320, 240]), image_size=[480, 640])
    ct.BrownConrady.from_matrix(np.eye(3, dtype=np.float32), np.zeros((1, 5)), image_size=(480, 640))
    assert_type(camera, ct.KannalaBrandt)
    assert_type(ct.Pinhole.from_fov(60, image_size=(480, 640)), ct.Pinhole)
    assert_type(camera.crop(0, 0, 100, 100).resize(50, 50).hflip().pad(1, 1, 1, 1), ct.KannalaBrandt)
    assert_type(camera.to("cpu"), ct.KannalaBrandt)
    assert_type(camera.to(torch.float64).float().requires_grad_(False).eval(), ct.KannalaBrandt)
    assert_type((camera.project(torch.rand(5, 3)), camera(torch.rand(5, 3)), camera.rays()), tuple[Pair, Pair, Pair])
    assert_type((camera.unproject([[320.0, 240.0]]), camera.unproject(np.zeros((5, 2)))), tuple[Pair, Pair])
    assert_type(camera.contains(torch.rand(5, 2)), Tensor)
    assert_type((camera.intrinsics, camera.distortion, camera.K, camera.fx), tuple[Tensor, Tensor, Tensor, Tensor])
    assert_type((camera.height, camera.width, camera.distortion_names), tuple[int, int, tuple[str, ...]])
    assert_type(ct.Mei.odd_in_x, frozenset[str])
    batch = ct.DoubleSphere(torch.tensor([[300.0, 300, 320, 240]]).repeat(4, 1), image_size=(480, 640))
    assert_type((batch[0], batch[1:]), tuple[ct.DoubleSphere, ct.DoubleSphere])
    assert_type([one.fx for one in batch], list[Tensor])
    assert_type(ct.MODELS["pinhole"], type[ct.Camera])
    assert_type(ct.MODELS["pinhole"].from_fov(60, image_size=(4, 4)), ct.Camera)
    assert_type(ct.Mixed([batch[0], camera]).project(torch.rand(2, 5, 3)), Pair)
    assert_type(camera.convert(ct.Fisheye624), Conversion[ct.Fisheye624])
    assert_type(camera.convert(ct.Fisheye624, max_angle=1.0).camera, ct.Fisheye624)
    assert_type(camera.convert("fisheye624").camera, ct.Camera)
    assert_type(camera.convert(ct.Pinhole).rms, Tensor)
    return camera


def files(folder: Path) -> None:
    camera = ct.Pinhole.from_fov(60, image_size=(480, 640))
    ct.save(camera, folder / "camera.json")
    rig = ct.load(str(folder / "camera.json"))
    assert_type(rig.camera, ct.Camera)
    assert_type(dict(rig.items()), dict[str, ct.Camera])
    poses = {name: ct.Extrinsics([0, 0, 0], [0.1, 0, 0]) for name in ("left", "right")}
    rig = ct.Rig({"left": camera, "right": camera}, poses)
    assert_type((rig.cameras["left"], rig.extrinsics["left"]), tuple[ct.Camera, ct.Extrinsics])
    assert_type(rig.between("left", "right"), ct.Extrinsics)
    assert_type(rig.requires_grad_(False), ct.Rig)


def warps(camera: ct.Camera) -> None:
    images = torch.rand(1, 3, 480, 640)
    dewarp = ct.Dewarp(camera, projection="cylindrical", image_size=images.shape[-2:])
    assert_type(dewarp(images), Tensor)
    assert_type(dewarp(PIL.Image.open("image.png").convert("RGB")), PIL.Image.Image)
    assert_type(ct.Warp(camera, camera, torch.eye(3)).inverse()(images, mode="nearest"), Tensor)
    assert_type(dewarp.transform_points(torch.rand(5, 2)), Pair)
    assert_type(dewarp.transform_boxes(torch.rand(5, 4).sort().values), Pair)
    assert_type((dewarp.target, dewarp.rotation), tuple[ct.Camera, Tensor | None])
    assert_type([part for _, part, _ in dewarp.strips(images)], list[Tensor])
    extrinsics = ct.Extrinsics(np.zeros((3, 1)), [0, 0, 2])
    assert_type(extrinsics(torch.rand(5, 3)), Tensor)
    assert_type(extrinsics.inverse().compose(extrinsics).position, Tensor)
    layer = nn.Sequential(extrinsics, camera)
    pixels, valid = layer(torch.rand(5, 3))
    pixels[valid].sum()
    reproject = ct.Reproject(camera, camera, extrinsics)
    assert_type(reproject(images, torch.ones(1, 1, 480, 640)), Pair)
    ground = ct.Extrinsics([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]], [0, 1.5, 0])
    assert_type(ct.BirdsEye(camera, ground, x=(-1, 1), y=(1, 3), resolution=0.1)(images), Tensor)
    pair = ct.rectify(camera, camera, ct.Extrinsics([0, 0, 0], [-0.1, 0, 0]))
    assert_type((pair(images, images), pair.left), tuple[Pair, ct.Warp])
    assert_type((ct.losses.rays(camera, camera), ct.losses.rays(camera, camera, reduction="none")), tuple[Tensor, Pair])
    assert_type(ct.losses.reprojection(camera, camera, torch.rand(5, 3), reduction="none", penalty=800), Pair)
    assert_type(camera.parameter_groups(lr=0.5), list[dict[str, Any]])
    assert_type(ct.solve_pnp(camera, np.random.rand(6, 3) + 2, np.random.rand(6, 2) * 400).rms, Tensor)


class Shifted(ct.augment.Augmentation):
    def __init__(self, shift: tuple[float, float] = (-5, 5), **options: Any):
        super().__init__({"shift": ct.augment.Range(*shift)}, **options)

    def new_camera(self, source: ct.Camera, values: Mapping[str, Tensor]) -> tuple[ct.Camera, Tensor | None]:
        zero = torch.zeros_like(values["shift"])
        moved = source.intrinsics + torch.stack((zero, zero, values["shift"], zero), -1)
        return source.replace(intrinsics=moved), None


def augmentations(camera: ct.Camera) -> None:
    camera = camera.requires_grad_(False)
    augment = ct.augment.RandomCamera("dms130", fov="source", yaw=5, pitch=(-5, 5), camera=camera)
    sample = {"image": torch.rand(2, 3, 480, 640), "keypoints": torch.rand(2, 5, 2) * 400}
    moved = augment(sample)
    assert_type(moved, dict[str, Any])
    augment(image=sample["image"], gaze=torch.randn(2, 3), file=["a.jpg", "b.jpg"])
    chain = ct.augment.Compose([augment, ct.augment.HorizontalFlip(), ct.augment.Resize((240, 320)), Shifted()])
    assert_type(chain(sample), dict[str, Any])
    assert_type(chain.to("cpu"), ct.augment.Compose)
    seeded = ct.data.Seeded(ct.augment.RandomMount(roll=5, camera=camera), seed=0)
    assert_type(seeded(image=torch.rand(3, 480, 640), key=3), dict[str, Any])
