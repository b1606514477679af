"""Teaches networks by images of one camera to read faces behind others, with and without augmentation (some minutes).

They start from the same weights and take as many steps on as many images. They find landmarks in the image
of a driver's face, and which way the eyes look; those with rays are told beside each face where its corners look. The
last two learn from images of the other cameras themselves: what augmentation can come near to, and hardly pass.

    python examples/train_faces.py -o faces.png
"""

import argparse
import copy
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple

import matplotlib.pyplot as plt
import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from kornia.augmentation import RandomAffine
from scenes import cabin, faces
from scenes.faces import NAMES, SIDE, Photographs, Samples
from torch import Tensor, nn

import camtorch as ct

TRAINING_SETS = {
    "plain": "one camera's images",
    "plain_rays": "... and rays",
    "affine": "... with RandomAffine",
    "camtorch": "... with camtorch",
    "camtorch_rays": "... with camtorch and rays",
    "own": "the other cameras' own images",
    "own_rays": "... and rays",
}
TESTS = {"seen": "the same camera", "mounts": "other lenses and mounts", "shutter": "... and rolling shutters"}
YAW, PITCH, ROLL = 35.0, 20.0, 25.0  # degrees, wider than those of the tests: nobody knows the mounts to come
LOOKS = 50  # steps between two looks at the tests
Augment = Callable[[Photographs, Tensor, torch.Generator], Samples]


# -- what is learned from: faces of the photographs that a tensor numbers


def plain(seen: Photographs, index: Tensor, generator: torch.Generator) -> Samples:
    """Faces cut out somewhat larger or smaller, and beside."""
    pixels, valid = seen.camera.project(seen.points[index])
    near, whole = faces.cut(seen.camera, pixels, valid, 2 * torch.rand(len(index), 3, generator=generator) - 1)
    return warped(seen, index, ct.Warp(seen.camera, near, padding_mode="border"), whole)


def by_camera(seen: Photographs, index: Tensor, generator: torch.Generator) -> Samples:
    """Real lenses, mounted anywhere and turning, of whose images the faces are cut: one warp from the first to the cut.

    What it needs beyond `RandomCamera` is that the cut follows the face.
    """
    augment = ct.augment.RandomCamera("real", fov=(60, 160), yaw=YAW, pitch=PITCH, roll=ROLL, crop=None, min_filled=0)
    change = augment.change(seen.camera, augment.draw(len(index), generator))
    assert isinstance(change.target, ct.Camera)
    return cut_out(seen, index, change.target, change.rotation, generator)


def as_taken(seen: Photographs, index: Tensor, generator: torch.Generator) -> Samples:
    """Faces of the images as they are, cut out, and a rolling shutter."""
    turn = torch.eye(3, dtype=torch.float64).expand(len(index), 3, 3)
    return cut_out(seen, index, seen.camera, turn, generator)


def cut_out(seen: Photographs, index: Tensor, camera: ct.Camera, turn: Tensor, generator: torch.Generator) -> Samples:
    """Faces as `camera`, one or one of each, sees them when it is turned and its shutter rolls, cut out at random."""
    jitter, rates = (2 * torch.rand(2, len(index), 3, generator=generator) - 1).unbind()
    near, whole = faces.cut(camera, *camera.project(seen.points[index].to(turn) @ turn.mT), jitter)
    readout = SIDE * faces.READOUT / faces.SIZE[0] * camera.fx / near.fx
    shutter = ct.RollingShutter(readout, faces.RATE * rates)
    warp = ct.ShutterWarp(seen.camera, near, turn, target_shutter=shutter, padding_mode="border")
    return warped(seen, index, warp, whole)


def by_affine(seen: Photographs, index: Tensor, generator: torch.Generator) -> Samples:
    """Turns cut faces by as much as `by_camera` rolls, and scales, shears and shifts them."""
    augment = RandomAffine(ROLL, (0.05, 0.05), (0.85, 1.15), (-8.0, 8.0), p=1.0, padding_mode="border")
    cut = plain(seen, index, generator)
    image = augment(cut.image)
    matrix = torch.as_tensor(augment.transform_matrix)
    linear, step = matrix[:, :2, :2], matrix[:, None, :2, 2]
    u, _, v = torch.linalg.svd(linear)  # what in it is a turn, gaze turns by
    gaze = torch.cat(((u @ v @ cut.gaze[:, :2, None])[..., 0], cut.gaze[:, 2:]), -1)
    return cut._replace(image=image, keypoints=cut.keypoints @ linear.mT + step, gaze=gaze)


def warped(seen: Photographs, index: Tensor, warp: ct.Warp, whole: Tensor) -> Samples:
    """What becomes of photographs by a warp."""
    pixels = seen.camera.project(seen.points[index, : len(NAMES)])[0]
    keypoints = warp.transform_points(pixels)[0].float()
    gaze = warp.transform_rays(seen.gaze[index][:, None])[:, 0].float()
    return Samples(warp(seen.image[index]), keypoints, gaze, faces.corner_rays(warp.target), whole.float())


AUGMENTATIONS: dict[str, Augment] = {"plain": plain, "affine": by_affine, "camtorch": by_camera, "own": as_taken}


# -- learning


class Network(nn.Module):
    """Samples of faces to keypoints (B, N, 2) and unit gazes (B, 3); perhaps it is told where faces are."""

    def __init__(self, with_rays: bool = False) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = (3, 16, 32, 32, 48, 64, 64)
        for inputs, outputs, stride in zip(channels, channels[1:], (2, 2, 1, 2, 1, 2), strict=False):
            layers += [nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.GroupNorm(4, outputs), nn.ReLU()]
        self.see = nn.Sequential(*layers, nn.Flatten(), nn.Linear(64 * (SIDE // 16) ** 2, 128), nn.ReLU())
        self.keypoints = nn.Linear(128, 2 * len(NAMES))
        self.gaze = nn.Sequential(nn.Linear(128 + 12, 64), nn.ReLU(), nn.Linear(64, 3))
        self.with_rays = with_rays

    def forward(self, samples: Samples) -> tuple[Tensor, Tensor]:
        """Keypoints and gaze."""
        seen = self.see((samples.image - 0.5).contiguous(memory_format=torch.channels_last))
        keypoints = 20 * self.keypoints(seen).unflatten(1, (len(NAMES), 2)) + (SIDE - 1) / 2
        gaze = self.gaze(torch.cat((seen, samples.rays.flatten(1) * self.with_rays), 1))
        return keypoints, F.normalize(gaze - gaze.new_tensor([0.0, 0.0, 1.0]), dim=-1)


def loss_of(found: tuple[Tensor, Tensor], samples: Samples) -> Tensor:
    """How far off keypoints and gaze are found: a radian costs as much as 40 pixels."""
    keypoints, gaze = found
    off = F.smooth_l1_loss(keypoints, samples.keypoints, reduction="none", beta=2.0).sum(-1).mean(-1)
    off = off + 40 * (gaze - samples.gaze).norm(dim=-1)
    mean: Tensor = (off * samples.weight).sum() / samples.weight.sum().clamp(min=1)
    return mean


@torch.no_grad()
def medians(network: Network, test: Samples) -> tuple[float, float]:
    """How far keypoints are off, as a part of the distance between the eyes, and gaze, in degrees."""
    keypoints, gaze = network(test)
    eyes = (test.keypoints[:, :2].mean(1) - test.keypoints[:, 2:4].mean(1)).norm(dim=-1, keepdim=True)
    share = (keypoints - test.keypoints).norm(dim=-1) / eyes
    degrees = torch.rad2deg(2 * torch.asin((gaze - test.gaze).norm(dim=-1).clamp(max=2) / 2))
    return float(share.median()), float(degrees.median())


class Result(NamedTuple):
    """What a network learned from, and what it then finds."""

    examples: Samples
    """Two of the images that it learned from."""
    found: tuple[Tensor, Tensor]
    """Keypoints and gaze in the last test."""
    curves: dict[str, list[tuple[int, float, float]]]
    """By the test: a step, and what `medians` was after it."""


def train(
    name: str, network: Network, seen: list[Photographs], tests: dict[str, Samples], steps: int, seed: int
) -> Result:
    """Train a network on batches of 32 photographs, of one camera after the other, and look how it does."""
    generator = torch.Generator().manual_seed(seed)
    augment = AUGMENTATIONS[name.removesuffix("_rays")]
    network.with_rays = name.endswith("_rays")
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 5e-3, total_steps=steps, pct_start=0.2)
    curves: dict[str, list[tuple[int, float, float]]] = {test: [] for test in tests}
    for step in range(1, steps + 1):
        taken = seen[step % len(seen)]
        samples = augment(taken, torch.randint(len(taken.image), (32,), generator=generator), generator)
        loss = loss_of(network(samples), samples)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % LOOKS == 0 or step == steps:
            for test, held_out in tests.items():
                curves[test].append((step, *medians(network, held_out)))
        if step % (6 * LOOKS) == 0 or step == steps:
            print(f"{TRAINING_SETS[name]:<26} step {step} of {steps}, loss {loss.item():.2f}", flush=True)
    examples = augment(seen[0], torch.arange(min(12, len(seen[0].image))), torch.Generator().manual_seed(seed))
    with torch.no_grad():
        found = network(tests["shutter"])
    return Result(Samples(*(values[examples.weight > 0][:2] for values in examples)), found, curves)


def run(images: int = 400, count: int = 150, steps: int = 1500, seed: int = 0) -> tuple[dict[str, Result], Samples]:
    """Render, train and evaluate; `count` other faces are in each test.

    Returns:
        a result for each of `TRAINING_SETS`, and the last test.
    """
    print(f"rendering twice {images} images to learn from, {count} for each of {len(TESTS)} tests", flush=True)
    generator = torch.Generator().manual_seed(seed)
    drivers, others = (cabin.random_drivers(n, generator) for n in (images, count))
    seen = [faces.photograph(drivers)]
    mounts, shutter = (faces.by_others(others, generator, rolling=rolling) for rolling in (False, True))
    tests = {"seen": faces.by_teacher(others), "mounts": mounts, "shutter": shutter}
    own = [
        faces.photograph_mounted(drivers[rows], faces.lens(name), generator)
        for name, rows in zip(faces.LENSES, torch.arange(images).tensor_split(len(faces.LENSES)), strict=True)
    ]
    learned = {name: own if name.startswith("own") else seen for name in TRAINING_SETS}
    torch.manual_seed(seed)
    first = Network()
    # A thread for each network keeps cores busier than many threads on one small image
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(os.cpu_count() or 1) as pool:
            jobs = [pool.submit(train, n, copy.deepcopy(first), learned[n], tests, steps, seed) for n in TRAINING_SETS]
            results = dict(zip(TRAINING_SETS, (job.result() for job in jobs), strict=True))
    finally:
        torch.set_num_threads(threads)
    print(f"\n{'learned from':<26}" + "".join(f"{title:>25}" for title in TESTS.values()))
    for name, result in results.items():
        last = [result.curves[test][-1] for test in TESTS]
        columns = [f"{100 * share:12.1f} %{degrees:7.1f} deg" for _, share, degrees in last]
        print(f"{TRAINING_SETS[name]:<26}" + "".join(columns))
    return results, shutter


def draw(results: dict[str, Result], test: Samples, output: str, count: int = 6) -> None:
    """One figure: two images that each network learned from, and what it finds in the same test images."""
    figure, axes = plt.subplots(len(results), 2 + count, figsize=(13, 1.8 * len(results) + 0.5), layout="constrained")
    figure.suptitle("left: what was learned from; right: other cameras, blue is true and red is found")
    some = torch.arange(count) * (len(test.image) // count)
    for row, (name, result) in zip(axes, results.items(), strict=True):
        row[0].set_title(TRAINING_SETS[name], fontsize="medium", loc="left")
        for axis, samples, i in zip(row, [result.examples] * 2 + [test] * count, [0, 1, *some.tolist()], strict=True):
            axis.set_axis_off()
            if i >= len(samples.image):
                continue
            axis.imshow(samples.image[i].permute(1, 2, 0).numpy())
            looks = [(samples.keypoints[i], samples.gaze[i], "#1e64f0")]
            if samples is test:
                looks.append((result.found[0][i], result.found[1][i], "#e21d48"))
            for keypoints, gaze, colour in looks:
                start = samples.keypoints[i, :4].mean(0)
                axis.plot(*keypoints.T.numpy(), ".", color=colour, markersize=4)
                axis.plot(*torch.stack((start, start + 0.45 * SIDE * gaze[:2])).T.numpy(), color=colour)
    figure.savefig(output, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="faces.png")
    draw(*run(), parser.parse_args().output)
