"""The demo `camtorch demo training`: pinhole images teach a network that is to work behind a fisheye elsewhere.

Four networks start from the same weights and take as many steps on as many images. They find landmarks of drivers'
faces in the image, and where these are in space. What they learn from differs: see `TRAINING_SETS`.
"""

from __future__ import annotations

import copy
import math
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from PIL import Image
from torch import Tensor, nn

from camtorch._drawing import GREY, MARGIN, MIDDLE, POINT, Marks, Sheet, shown
from camtorch.demo import cabin
from camtorch.demo.training_data import MOUNT, NAMES, TRAINING_SETS, Augment, Samples, augmentation, cameras, photograph

_METRE = 40.0  # what a metre of error costs in the loss, where a pixel costs 1


@dataclass
class Result:
    """What a network learned, and what it then finds in the test images."""

    training_set: str
    training_images: Samples
    """A few of the images that it learned from."""
    test: Samples
    keypoints: Tensor
    """(B, N, 2), as found."""
    losses: list[float]
    pixels: Tensor
    """(B, N), how far keypoints are off."""
    share: Tensor
    """(B, N), the same as a part of the distance between the eyes."""
    metres: Tensor
    """(B, N), how far points are off."""

    def numbers(self) -> str:
        """The columns of the table."""
        found = f"{self.pixels.median():9.2f} px{self.pixels.mean():8.2f} px{100 * self.share.median():9.0f} %"
        return f"{found}{100 * self.metres.median():12.1f} cm"


class Network(nn.Module):
    """Samples (B, 3, H, W) of one size to keypoints (B, N, 2) and points (B, N, 3)."""

    def __init__(self, size: tuple[int, int], width: int = 16):
        super().__init__()

        def block(inputs: int, outputs: int, stride: int = 1) -> list[nn.Module]:
            return [nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.GroupNorm(4, outputs), nn.ReLU()]

        a, b, c, d = width, 2 * width, 3 * width, 4 * width
        see = [*block(3, a, 2), *block(a, b, 2), *block(b, b), *block(b, c, 2), *block(c, d), *block(d, d, 2)]
        cells = math.prod(-(-side // 16) for side in size)
        self.layers = nn.Sequential(*see, nn.Flatten(), nn.Linear(d * cells, 128), nn.ReLU(), nn.Linear(128, 40))
        self.middle = (size[1] / 2, size[0] / 2)

    def forward(self, images: Tensor) -> tuple[Tensor, Tensor]:
        """Keypoints and points."""
        found = self.layers((images - 0.5).contiguous(memory_format=torch.channels_last)).unflatten(1, (len(NAMES), 5))
        keypoints = 20 * found[..., :2] + found.new_tensor(self.middle)
        return keypoints, 0.2 * found[..., 2:] + found.new_tensor([0, 0, 0.6])


def loss_of(found: tuple[Tensor, Tensor], p: Samples) -> Tensor:
    """How far off the landmarks that are seen are found, on average."""
    keypoints, points = found
    off = F.smooth_l1_loss(keypoints, p.keypoints, reduction="none", beta=2.0).sum(-1)
    off = off + _METRE * (points - p.points).norm(dim=-1)
    return (off * p.seen).sum() / p.seen.sum().clamp(min=1)


def train(
    network: Network,
    images: Samples,
    augment: Augment,
    steps: int,
    batch: int = 24,
    *,
    seed: int = 0,
    report: Callable[[int, float], None] = lambda step, loss: None,
) -> list[float]:
    """Train a network on batches that are augmented on the fly; the losses of all steps."""
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 5e-3, total_steps=steps, pct_start=0.2)
    losses = []
    for step in range(1, steps + 1):
        chosen = torch.randint(len(images), (batch,), generator=generator)
        seen = augment(images[chosen], generator)
        loss = loss_of(network(seen.image), seen)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
        if step % 100 == 0 or step == steps:
            report(step, sum(losses[-50:]) / len(losses[-50:]))
    return losses


@torch.no_grad()
def evaluate(name: str, network: Network, training_images: Samples, test: Samples, losses: list[float]) -> Result:
    """Have a network find what it has not seen."""
    keypoints, points = (torch.cat(part) for part in zip(*map(network, test.image.split(50)), strict=True))
    pixels = (keypoints - test.keypoints).norm(dim=-1)
    eyes = (test.keypoints[:, :2].mean(1) - test.keypoints[:, 2:4].mean(1)).norm(dim=-1, keepdim=True)
    metres = (points - test.points).norm(dim=-1)
    return Result(name, training_images, test, keypoints, losses, pixels, pixels / eyes, metres)


def run(
    report: Callable[[str], None] = print,
    *,
    images: int = 400,
    tests: int = 150,
    steps: int = 500,
    seed: int = 0,
) -> list[Result]:
    """Render, train and evaluate.

    Args:
        report: gets lines on the progress, and those of the table.
        images: how many to learn from; of pinhole and fisheye alike.
        tests: how many fisheye images of other drivers to be tested on.
        steps: of 24 images each.
        seed: of everything drawn.

    Returns:
        A result for each of `TRAINING_SETS`.
    """
    begin, workers = time.monotonic(), min(os.cpu_count() or 1, len(TRAINING_SETS))

    def say(text: str) -> None:
        report(f"{time.monotonic() - begin:4.0f} s  {text}")

    camera, like = cameras()
    generator = torch.Generator().manual_seed(seed)
    drivers, others = (cabin.random_drivers(count, generator) for count in (images, tests))
    # A thread for each network keeps the cores busier than many threads on one small image
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng(devices=[]), ThreadPoolExecutor(workers) as pool:
            torch.manual_seed(seed)
            say(f"rendering {2 * images} images to learn from and {tests} to be tested on")
            seen = photograph(camera, drivers, workers=workers)
            test, bound = (photograph(like, d, MOUNT, workers) for d in (others, drivers))
            first = Network((camera.height, camera.width))

            def study(name: str) -> Result:
                # torch's own generator is RandomAffine's alone from here on
                network = copy.deepcopy(first)
                source = bound if name == "fisheye" else seen
                augment = augmentation(name, camera, like)

                def tell(step: int, loss: float) -> None:
                    say(f"{TRAINING_SETS[name]:<24} step {step} of {steps}, loss {loss:.2f}")

                losses = train(network, source, augment, steps, seed=seed, report=tell)
                examples = augment(source[:2], torch.Generator().manual_seed(seed))
                return evaluate(name, network, examples, test, losses)

            # the slowest first
            studies = {name: pool.submit(study, name) for name in ("camtorch", "affine", "pinhole", "fisheye")}
            results = [studies[name].result() for name in TRAINING_SETS]
    finally:
        torch.set_num_threads(threads)
    report(f"\n{'learned from':<24}{'landmarks off by':>16}{'mean':>7}{'of eye distance':>16}{'in space':>10}")
    for result in results:
        report(f"{TRAINING_SETS[result.training_set]:<24}{result.numbers()}")
    return results


def drawing(results: list[Result], tests: int = 5) -> Image.Image:
    """One image: for each network two images that it learned from, and what it finds in the same test images."""
    band, head, scale = 44, 100, 2.5
    height, width = (round(scale * side) for side in results[0].test.image.shape[-2:])
    left = 2 * (width + MARGIN) + 2 * MARGIN
    size = left + tests * (width + MARGIN), head + len(results) * (height + band + MARGIN)
    sheet = Sheet(*size, "One network, four training sets")
    sheet.text((MARGIN, 66), "what it learned from", colour=GREY)
    sheet.text((left, 66), "behind a fisheye mounted elsewhere: rings are true, dots are found", colour=GREY)
    for row, result in enumerate(results):
        top = head + row * (height + band + MARGIN)
        sheet.text((MARGIN, top + 10), TRAINING_SETS[result.training_set], size=MIDDLE)
        off = f"{result.pixels.median():.1f} px in the image, {100 * result.metres.median():.0f} cm in space"
        sheet.text((left, top + 13), f"off by {off} (medians of {len(result.test)} drivers)")
        tiles = [(MARGIN + i * (width + MARGIN), result.training_images, i, False) for i in range(2)]
        tiles += [(left + i * (width + MARGIN), result.test, i, True) for i in range(tests)]
        for x, images, i, tested in tiles:
            image = shown(images.image[i], height, width)
            marks = Marks(width, height, scale)
            for at in images.keypoints[i]:
                marks.circle(at, 11 / 3, outline=(255, 255, 255), width=4 / 3)
            for at in result.keypoints[i] if tested else ():
                marks.circle(at, 8 / 3, fill=POINT, outline=(255, 255, 255), width=1 / 3)
            marks.over(image)
            sheet.put(image, (x, top + band))
    return sheet.image
