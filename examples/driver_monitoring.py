"""From images of drivers with boxes to landmarks, head pose and gaze (ten to twenty minutes): what a plain crop costs.

Drivers sit all over the image of a camera of 130 degrees. Two equal networks learn from crops of their faces: plain
ones, the square around the box, and those of `ct.augment.BoxCrop`, a camera that looks at the face, and that turns its
labels along. What they find is compared in the camera's frame, by how far from the axis the face was.

    python examples/driver_monitoring.py -o driver_monitoring.png
    python examples/driver_monitoring.py --labels annotations.json  # landmarks of a data set that ct.data.read reads
"""

import argparse
import math
import time
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from scenes import cabin, faces
from torch import Tensor, nn

import camtorch as ct

SIDE, MARGIN = 64, 0.15
SIZE = (240, 320)
MOUNT = (50.0, 28.0, 10.0)  # degrees of yaw, pitch and roll by which the camera looks past the driver
CROPS = {"plain": "plain crops", "look_at": "crops that look at the face"}
BANDS = (0, 15, 30, 45, 60)  # degrees from the axis
Sample = dict[str, Any]


# -- data


def rendered(count: int, camera: ct.Camera, generator: torch.Generator) -> Sample:
    """Drivers anywhere in the image, with boxes of their faces, landmarks, gaze and head poses."""
    parts: list[Sample] = []
    while sum(len(part["gaze"]) for part in parts) < count:
        drivers = cabin.random_drivers(25, generator)
        turns = ((2 * torch.rand(25, 3, generator=generator) - 1) * torch.tensor(MOUNT)).double()
        mount = ct.augment.mount_rotation(*turns.unbind(-1))
        points, outline = (p @ mount.mT for p in (faces.points_of(drivers), drivers.face_box_points()))
        (pixels, valid), (rim, _) = camera.project(points), camera.project(outline)
        whole = (valid & camera.contains(pixels)).all(-1)
        image = cabin.render(camera, drivers, mount[:, None].expand(-1, camera.height, 3, 3), samples=1)
        pose = torch.eye(4).repeat(25, 1, 1).double()
        pose[:, :3] = mount @ drivers.pose[:, :3]
        part = {
            "image": (255 * image).round().byte(),
            "boxes": torch.cat((rim.amin(1), rim.amax(1)), -1)[:, None].float(),
            "keypoints": pixels[:, : len(faces.NAMES)].float(),
            "gaze": (mount @ drivers.gaze[..., None])[..., 0].float(),
            "head_pose": pose.float(),
        }
        parts.append({name: value[whole] for name, value in part.items()})
    return {name: torch.cat([part[name] for part in parts])[:count] for name in parts[0]}


def read(path: str) -> list[Sample]:
    """Samples of a file of labels with one face each: `image`, `boxes` and `keypoints`, of any sizes."""
    found = []
    for sample in ct.data.read(path):
        if "boxes" not in sample:  # the box of the landmarks
            points = sample["keypoints"]
            sample["boxes"] = torch.cat((points.amin(-2), points.amax(-2)), -1).reshape(1, 4)
        sample["image"] = sample["image"].expand(3, -1, -1)  # grey ones have one channel
        found.append(sample)
    return found


# -- crops


def look_at(batch: Sample, jitter: float = 1.0) -> Sample:
    """Crops of a camera that looks at each face, and the labels as that camera has them."""
    ranges: dict[str, Any] = {
        name: jitter * degrees for name, degrees in (("yaw", 2.0), ("pitch", 2.0), ("roll", 10.0))
    }
    crop = ct.augment.BoxCrop((SIDE, SIDE), margin=MARGIN, zoom=0.1 * jitter, **ranges)
    out: Sample = crop(batch)
    return out


def plain(batch: Sample, jitter: float = 1.0) -> Sample:
    """The square around each box, scaled; directions stay those of the camera before the crop."""
    camera, boxes = batch["camera"], batch["boxes"][:, 0]
    low, high = boxes.split(2, -1)
    chance = jitter * (2 * torch.rand(len(boxes), 3) - 1)
    side = (1 + 2 * MARGIN) * (high - low).amax(-1, keepdim=True) * (1 + 0.1 * chance[:, :1])
    middle = (low + high) / 2 + 0.06 * side * chance[:, 1:]
    focal, centre = camera.intrinsics.expand(len(boxes), 4).split(2, -1)
    numbers = torch.cat((focal * SIDE / side, (centre - middle) * SIDE / side + (SIDE - 1) / 2), -1)
    near = camera.expand(len(boxes)).replace(numbers, image_size=(SIDE, SIDE))
    warp = ct.Warp(camera, near)
    keypoints = near.project(camera.unproject(batch["keypoints"])[0])[0]
    return {**batch, "image": warp(batch["image"]), "keypoints": keypoints, "rotation": torch.eye(3)}


WAYS = {"plain": plain, "look_at": look_at}


# -- the car: its frame is ISO 8855's in metres, x ahead, y to the left, z up, from midway between the driver's eyes

Point = tuple[float, float, float]
MOUNTS: dict[str, tuple[Point, float]] = {
    "steering_column": ((0.55, 0.0, -0.33), 60.0),
    "cluster": ((0.78, 0.0, -0.22), 50.0),
    "centre_stack": ((0.72, -0.38, -0.22), 130.0),
    "mirror": ((0.5, -0.38, 0.14), 140.0),
    "a_pillar": ((0.6, 0.5, 0.02), 60.0),
}
"""Position and degrees across of a usual lens: estimates for a car of middle size, with the wheel on the left."""
REGIONS: dict[str, tuple[Point, ...]] = {
    "windscreen": ((0.9, 0.55, -0.12), (0.9, -1.1, -0.12), (0.6, -1.05, 0.25), (0.6, 0.5, 0.25)),
    "cluster": ((0.72, 0.18, -0.28), (0.72, -0.18, -0.28), (0.72, -0.18, -0.15), (0.72, 0.18, -0.15)),
    "centre_stack": ((0.72, -0.25, -0.45), (0.72, -0.52, -0.45), (0.72, -0.52, -0.15), (0.72, -0.25, -0.15)),
    "mirror": ((0.5, -0.28, 0.1), (0.5, -0.52, 0.1), (0.5, -0.52, 0.18), (0.5, -0.28, 0.18)),
    "left_mirror": ((0.75, 0.85, -0.15), (0.75, 0.6, -0.15), (0.75, 0.6, 0.02), (0.75, 0.85, 0.02)),
    "right_mirror": ((0.85, -1.42, -0.15), (0.85, -1.7, -0.15), (0.85, -1.7, 0.02), (0.85, -1.42, 0.02)),
    "left_window": ((0.6, 0.65, -0.15), (-0.4, 0.65, -0.15), (-0.4, 0.65, 0.3), (0.6, 0.65, 0.3)),
    "passenger": ((-0.2, -0.6, -0.7), (0.4, -0.6, -0.7), (0.4, -0.6, -0.1), (-0.2, -0.6, -0.1)),
    "lap": ((0.05, 0.25, -0.6), (0.45, 0.25, -0.6), (0.45, -0.25, -0.6), (0.05, -0.25, -0.6)),
}
"""The corners of what drivers look at."""


def camera_from_car(position: Sequence[float]) -> ct.Extrinsics:
    """Return the pose of an upright camera that looks at the driver's eyes."""
    at = torch.tensor(position, dtype=torch.float64)
    ahead = F.normalize(-at, dim=0)
    right = F.normalize(torch.linalg.cross(ahead, at.new_tensor([0, 0, 1])), dim=0)
    rotation = torch.stack((right, torch.linalg.cross(ahead, right), ahead))
    return ct.Extrinsics.from_matrix(rotation, -rotation @ at).requires_grad_(False)


def in_car(rays: Tensor, pose: Tensor | None) -> Tensor:
    """Turn rays (..., 3) of the camera's frame into the car's; pose (..., 4, 4) is camera from car."""
    return rays.double() if pose is None else (pose[..., :3, :3].double().mT @ rays.double()[..., None])[..., 0]


class Regions:
    """Convex plane polygons in the car's frame, by name; the last of `names` is "elsewhere"."""

    def __init__(self, polygons: Mapping[str, Sequence[Sequence[float]]] = REGIONS) -> None:
        self.names = (*polygons, "elsewhere")
        self.corners = [torch.tensor(corners, dtype=torch.float64) for corners in polygons.values()]

    def region_of(self, gaze: Tensor, eye: Tensor, pose: Tensor | None = None) -> Tensor:
        """Return the number (...) in `names` of the nearest region that rays (..., 3) from eyes (..., 3) meet, or -1.

        Both are in the frame of a camera with pose (..., 4, 4), camera from car, or in the car's without one.
        """
        start = in_car(eye if pose is None else eye - pose[..., :3, 3], pose)
        ray, start = torch.broadcast_tensors(in_car(gaze, pose), start)
        nearest = torch.full(ray.shape[:-1], math.inf, dtype=torch.float64)
        found = torch.full(ray.shape[:-1], -1)
        for number, corners in enumerate(self.corners):
            edges = corners.roll(-1, 0) - corners
            normal = torch.linalg.cross(edges[0], edges[1])
            distance = (corners[0] - start) @ normal / (ray @ normal)
            hit = start + distance[..., None] * ray
            sides = torch.linalg.cross(edges.expand(*hit.shape[:-1], -1, -1), hit[..., None, :] - corners) @ normal
            here = (sides > 0).all(-1) & (distance > 0) & (distance < nearest)
            nearest, found = torch.where(here, distance, nearest), torch.where(here, number, found)
        return found


def head_share(gaze: Tensor, head: Tensor, pose: Tensor | None = None) -> Tensor:
    """Return which part (...) of a glance away from straight ahead the head makes: an "owl" 1, a "lizard" 0.

    The words are Euro NCAP's. Gaze (..., 3) and head (..., 3, 3) or (..., 4, 4), whose nose points along -z, are in the
    frame of a camera with pose (..., 4, 4), camera from car, or in the car's without one.
    """

    def from_ahead(rays: Tensor) -> Tensor:  # angles to the left and up
        x, side = rays[..., :1], rays[..., 1:]
        size = side.norm(dim=-1, keepdim=True)
        angles: Tensor = side * (torch.atan2(size, x) / size.clamp(min=1e-30))
        return angles

    eyes, nose = (from_ahead(in_car(rays, pose)) for rays in (gaze, -head[..., :3, 2]))
    square = eyes.square().sum(-1)
    share: Tensor = torch.where(square > 1e-12, (eyes * nose).sum(-1) / square.clamp(min=1e-12), 0.0)
    return share


# -- learning


class Network(nn.Module):
    """Crops (B, 3, SIDE, SIDE) to keypoints (B, N, 2) and to unit vectors of gaze and of the nose (B, 3)."""

    def __init__(self, count: int) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = (3, 16, 32, 32, 48, 64, 64)
        for inputs, outputs, stride in zip(channels, channels[1:], (2, 2, 1, 2, 1, 2), strict=False):
            layers += [nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.GroupNorm(4, outputs), nn.ReLU()]
        self.see = nn.Sequential(*layers, nn.Flatten(), nn.Linear(64 * (SIDE // 16) ** 2, 128), nn.ReLU())
        self.keypoints, self.looks = nn.Linear(128, 2 * count), nn.Linear(128, 6)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Keypoints, gaze, nose."""
        seen = self.see((images.float() / 255 - 0.5).contiguous(memory_format=torch.channels_last))
        keypoints = 20 * self.keypoints(seen).unflatten(1, (-1, 2)) + (SIDE - 1) / 2
        ahead = torch.tensor([0.0, 0.0, 1.0])
        gaze, nose = (F.normalize(v - ahead, dim=-1) for v in self.looks(seen).split(3, -1))
        return keypoints, gaze, nose


def nose_of(sample: Sample) -> Tensor:
    """(B, 3): where noses point."""
    pose: Tensor = sample["head_pose"]
    return -pose[:, :3, 2]


def train(way: str, data: Sample, camera: ct.Camera, steps: int) -> Network:
    """A network that learns from crops of one kind."""
    torch.manual_seed(0)
    network = Network(data["keypoints"].shape[1])
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 5e-3, total_steps=steps, pct_start=0.2)
    for step in range(1, steps + 1):
        index = torch.randint(len(data["image"]), (32,))
        batch = WAYS[way]({**{name: value[index] for name, value in data.items()}, "camera": camera})
        keypoints, gaze, nose = network(batch["image"])
        loss = F.smooth_l1_loss(keypoints, batch["keypoints"], beta=2.0)
        if "gaze" in batch:
            loss = loss + 20 * ((gaze - batch["gaze"]).norm(dim=-1) + (nose - nose_of(batch)).norm(dim=-1)).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % 100 == 0 or step == steps:
            print(f"{CROPS[way]:<28} step {step} of {steps}, loss {loss.item():.2f}", flush=True)
    return network


@torch.no_grad()
def errors(way: str, network: Network, data: Sample, camera: ct.Camera) -> dict[str, Tensor]:
    """Degrees that gaze and nose are off, and landmarks in parts of the eyes' distance, all of them (B,)."""
    batch = WAYS[way]({**data, "camera": camera}, jitter=0.0)
    keypoints, gaze, nose = network(batch["image"])
    off = (keypoints - batch["keypoints"]).norm(dim=-1).mean(-1)
    eyes = (batch["keypoints"][:, :2].mean(1) - batch["keypoints"][:, 2:4].mean(1)).norm(dim=-1)
    found = {"landmarks": off / eyes}
    if "gaze" in data:
        for name, one, true in (("gaze", gaze, data["gaze"]), ("head", nose, nose_of(data))):
            back = (batch["rotation"].mT @ one[..., None])[..., 0]  # into the camera's own frame
            found[name] = torch.rad2deg(2 * torch.asin(((back - true).norm(dim=-1) / 2).clamp(max=1)))
    return found


def by_angle(values: Tensor, data: Sample, camera: ct.Camera) -> list[float]:
    """Medians by how far from the axis faces are, in `BANDS`."""
    rays = camera.unproject(data["boxes"][:, 0].unflatten(-1, (2, 2)).mean(1))[0]
    angle = torch.rad2deg(torch.acos(rays[:, 2].clamp(-1, 1)))
    return [float(values[(angle >= low) & (angle < high)].median()) for low, high in pairwise(BANDS)]


def run(images: int = 500, count: int = 240, steps: int = 1500) -> dict[str, dict[str, list[float]]]:
    """Render, train both, and measure: error -> way of cropping -> median in each band."""
    start, generator = time.time(), torch.Generator().manual_seed(0)
    camera = ct.KannalaBrandt.from_fov(130, image_size=SIZE).requires_grad_(False)
    print(f"rendering {images} images to learn from and {count} to test", flush=True)
    data, test = (rendered(n, camera, generator) for n in (images, count))
    found: dict[str, dict[str, list[float]]] = {}
    for way in CROPS:
        for name, values in errors(way, train(way, data, camera, steps), test, camera).items():
            found.setdefault(name, {})[way] = by_angle(values, test, camera)
    print(f"\n{'median by degrees from the axis':<40}" + "".join(f"{f'{a} to {b}':>10}" for a, b in pairwise(BANDS)))
    for name, ways in found.items():
        for way, row in ways.items():
            scale, unit = (100, "%") if name == "landmarks" else (1, "deg")
            print(f"{f'{name}, {CROPS[way]}':<40}" + "".join(f"{f'{scale * v:.1f} {unit}':>10}" for v in row))
    print(f"{time.time() - start:.0f} seconds")
    return found


def learn_landmarks(path: str, steps: int = 600) -> Network:
    """Landmarks of a file of labels, by crops that look at each face; of an unknown camera 60 degrees are a guess."""
    crops = []
    for sample in read(path):
        height, width = sample["image"].shape[-2:]
        camera = sample.get("camera") or ct.Pinhole.from_fov(60, image_size=(height, width))
        kept = {name: sample[name] for name in ("image", "boxes", "keypoints")}
        crops.append(ct.augment.BoxCrop((2 * SIDE, 2 * SIDE), margin=2 * MARGIN, camera=camera)(kept))
    data = {name: torch.stack([crop[name] for crop in crops]) for name in ("image", "keypoints")}
    data["boxes"] = torch.stack([crop["boxes"][:1] for crop in crops])
    near = ct.Pinhole.from_fov(20, image_size=(2 * SIDE, 2 * SIDE)).requires_grad_(False)  # crops look at the middle
    print(f"{len(crops)} samples of {path}, {data['keypoints'].shape[1]} landmarks", flush=True)
    return train("look_at", data, near, steps)


def draw(found: dict[str, dict[str, list[float]]], output: str) -> None:
    """Error over angle, for both."""
    names = [name for name in ("head", "gaze", "landmarks") if name in found]
    figure, axes = plt.subplots(1, len(names), figsize=(4 * len(names), 3.2), layout="constrained")
    middles = [(low + high) / 2 for low, high in pairwise(BANDS)]
    for axis, name in zip(axes, names, strict=True):
        for way, colour in (("plain", "#8a8f98"), ("look_at", "#1e64f0")):
            axis.plot(middles, found[name][way], "o-", color=colour, label=CROPS[way])
        axis.set(title=name, xlabel="degrees from the axis", ylim=(0, None))
        axis.set_ylabel("parts of the eyes' distance" if name == "landmarks" else "degrees, median")
    axes[0].legend(frameon=False)
    figure.savefig(output, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="driver_monitoring.png")
    parser.add_argument("--labels", help="a file that ct.data.read reads: learn landmarks from it instead, into a .pt")
    arguments = parser.parse_args()
    if arguments.labels:
        weights = Path(arguments.output).with_suffix(".pt")
        torch.save(learn_landmarks(arguments.labels).state_dict(), weights)
        print(f"{weights}: the network's state_dict")
    else:
        draw(run(), arguments.output)
