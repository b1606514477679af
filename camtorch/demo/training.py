"""The demo `camtorch demo training`: images of one camera teach networks that are to work behind others.

Networks start from the same weights and take as many steps on as many images. They find landmarks in the image of a
driver's face, and which way the eyes look. What they learn from differs: see `TRAINING_SETS`.
"""

from __future__ import annotations

import copy
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from PIL import Image
from torch import Tensor, nn

from camtorch._drawing import GAZE, GREY, MARGIN, MIDDLE, POINT, Marks, Sheet, shown
from camtorch.demo import cabin
from camtorch.demo.training_data import (
    NAMES,
    SIDE,
    TESTS,
    TRAINING_SETS,
    Augment,
    Samples,
    augmentation,
    faces_of,
    photograph,
)

_RADIAN = 40.0  # what a radian of error in gaze costs in the loss, where a pixel costs 1
_LOOKS = 50  # steps between two looks at the tests


@dataclass
class Errors:
    """Of a network in a test."""

    share: Tensor
    """(B, N), how far landmarks are off as a part of the distance between the eyes."""
    degrees: Tensor
    """(B,), how far gaze is off."""

    def medians(self) -> tuple[float, float]:
        """Of landmarks, and of gaze."""
        return float(self.share.median()), float(self.degrees.median())


@dataclass
class Result:
    """What a network learned, and what it then finds."""

    training_set: str
    examples: Samples
    """A few of the images that it learned from."""
    errors: dict[str, Errors]
    """By the test."""
    test: Samples
    """The last test."""
    found: tuple[Tensor, Tensor]
    """Keypoints and gaze in it."""
    curves: dict[str, list[tuple[int, float, float]]] = field(default_factory=dict)
    """By the test: a step, and what `Errors.medians` was after it."""

    def numbers(self) -> str:
        """The columns of the table."""
        columns = [errors.medians() for errors in self.errors.values()]
        return "".join(f"{100 * share:12.1f} %{degrees:7.1f} deg" for share, degrees in columns)


class Network(nn.Module):
    """Samples of faces to keypoints (B, N, 2) and unit gazes (B, 3).

    Args:
        with_rays: whether it is told where faces are.
        width: channels of the first layer.
    """

    def __init__(self, with_rays: bool, width: int = 16):
        super().__init__()

        def block(inputs: int, outputs: int, stride: int = 1) -> list[nn.Module]:
            return [nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.GroupNorm(4, outputs), nn.ReLU()]

        a, b, c, d = width, 2 * width, 3 * width, 4 * width
        see = [*block(3, a, 2), *block(a, b, 2), *block(b, b), *block(b, c, 2), *block(c, d), *block(d, d, 2)]
        self.see = nn.Sequential(*see, nn.Flatten(), nn.Linear(d * (SIDE // 16) ** 2, 128), nn.ReLU())
        self.keypoints = nn.Linear(128, 2 * len(NAMES))
        self.gaze = nn.Sequential(nn.Linear(128 + 12, 64), nn.ReLU(), nn.Linear(64, 3))
        self.with_rays = with_rays

    def forward(self, samples: Samples) -> tuple[Tensor, Tensor]:
        """Keypoints and gaze."""
        seen = self.see((samples.image - 0.5).contiguous(memory_format=torch.channels_last))
        keypoints = 20 * self.keypoints(seen).unflatten(1, (len(NAMES), 2)) + (SIDE - 1) / 2
        where = samples.rays.flatten(1) * self.with_rays
        gaze = self.gaze(torch.cat((seen, where), 1))
        return keypoints, F.normalize(gaze - gaze.new_tensor([0.0, 0.0, 1.0]), dim=-1)


def loss_of(found: tuple[Tensor, Tensor], p: Samples) -> Tensor:
    """How far off landmarks and gaze are found, on average."""
    keypoints, gaze = found
    off = F.smooth_l1_loss(keypoints, p.keypoints, reduction="none", beta=2.0).sum(-1).mean(-1)
    off = off + _RADIAN * (gaze - p.gaze).norm(dim=-1)
    mean: Tensor = (off * p.weight).sum() / p.weight.sum().clamp(min=1)
    return mean


def train(
    network: Network,
    count: int,
    augment: Augment,
    steps: int,
    batch: int = 32,
    *,
    seed: int = 0,
    report: Callable[[int, float], None] = lambda step, loss: None,
) -> list[float]:
    """Train a network on batches of `count` photographs, augmented on the fly; the losses of all steps."""
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 5e-3, total_steps=steps, pct_start=0.2)
    losses = []
    for step in range(1, steps + 1):
        seen = augment(torch.randint(count, (batch,), generator=generator), generator)
        loss = loss_of(network(seen), seen)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        losses.append(loss.item())
        report(step, sum(losses[-_LOOKS:]) / len(losses[-_LOOKS:]))
    return losses


@torch.no_grad()
def evaluate(network: Network, test: Samples) -> tuple[Errors, tuple[Tensor, Tensor]]:
    """Have a network find what it has not seen: the errors, and keypoints and gaze."""
    keypoints, gaze = network(test)
    eyes = (test.keypoints[:, :2].mean(1) - test.keypoints[:, 2:4].mean(1)).norm(dim=-1, keepdim=True)
    share = (keypoints - test.keypoints).norm(dim=-1) / eyes
    degrees = torch.rad2deg(2 * torch.asin((gaze - test.gaze).norm(dim=-1).clamp(max=2) / 2))
    return Errors(share, degrees), (keypoints, gaze)


def run(
    report: Callable[[str], None] = print,
    *,
    images: int = 400,
    tests: int = 150,
    steps: int = 1500,
    seed: int = 0,
) -> list[Result]:
    """Render, train and evaluate.

    Args:
        report: gets lines on the progress, and those of the table.
        images: how many to learn from.
        tests: how many faces, of other drivers, in each test.
        steps: of 32 faces each.
        seed: of everything drawn.

    Returns:
        A result for each of `TRAINING_SETS`.
    """
    begin, workers = time.monotonic(), min(os.cpu_count() or 1, len(TRAINING_SETS))

    def say(text: str) -> None:
        report(f"{time.monotonic() - begin:4.0f} s  {text}")

    generator = torch.Generator().manual_seed(seed)
    drivers, others = (cabin.random_drivers(count, generator) for count in (images, tests))
    # A thread for each network keeps the cores busier than many threads on one small image
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with torch.random.fork_rng(devices=[]), ThreadPoolExecutor(workers) as pool:
            torch.manual_seed(seed)
            say(f"rendering {images} images to learn from and {tests} for each of {len(TESTS)} tests")
            seen = photograph(drivers, workers)
            held_out = {test: faces_of(others, test, generator, workers) for test in TESTS}
            first = Network(with_rays=False)

            def study(name: str) -> Result:
                # torch's own generator is RandomAffine's alone from here on
                network = copy.deepcopy(first)
                network.with_rays = name.endswith("rays")
                augment = augmentation(name, seen)
                curves: dict[str, list[tuple[int, float, float]]] = {test: [] for test in TESTS}

                def look(step: int, loss: float) -> None:
                    if step % _LOOKS and step != steps:
                        return
                    for test, samples in held_out.items():
                        curves[test].append((step, *evaluate(network, samples)[0].medians()))
                    if step % (6 * _LOOKS) == 0 or step == steps:
                        say(f"{TRAINING_SETS[name]:<26} step {step} of {steps}, loss {loss:.2f}")

                train(network, images, augment, steps, seed=seed, report=look)
                examples = augment(torch.arange(min(12, images)), torch.Generator().manual_seed(seed))
                examples = examples[examples.weight > 0][:2]
                errors, found = zip(*(evaluate(network, samples) for samples in held_out.values()), strict=True)
                return Result(
                    name, examples, dict(zip(TESTS, errors, strict=True)), held_out["shutter"], found[-1], curves
                )

            # the slowest first
            studies = {name: pool.submit(study, name) for name in reversed(TRAINING_SETS)}
            results = [studies[name].result() for name in TRAINING_SETS]
    finally:
        torch.set_num_threads(threads)
    report(f"\n{'learned from':<26}" + "".join(f"{title:>25}" for title in TESTS.values()))
    for result in results:
        report(f"{TRAINING_SETS[result.training_set]:<26}{result.numbers()}")
    return results


def drawing(results: list[Result], tests: int = 6) -> Image.Image:
    """One image: for each network two images that it learned from, and what it finds in the same test images."""
    band, head, scale = 44, 100, 3.0
    side = round(scale * SIDE)
    left = 2 * (side + MARGIN) + 2 * MARGIN
    size = left + tests * (side + MARGIN), head + len(results) * (side + band + MARGIN)
    sheet = Sheet(*size, "One network, five training sets")
    sheet.text((MARGIN, 66), "what it learned from", colour=GREY)
    sheet.text((left, 66), "other lenses and mounts: rings and blue are true, dots and red are found", colour=GREY)
    for row, result in enumerate(results):
        top = head + row * (side + band + MARGIN)
        sheet.text((MARGIN, top + 10), TRAINING_SETS[result.training_set], size=MIDDLE)
        share, degrees = result.errors["shutter"].medians()
        off = f"{100 * share:.1f} % of the distance between the eyes, gaze by {degrees:.1f} degrees"
        sheet.text((left, top + 13), f"landmarks off by {off} (medians of {len(result.test)} faces)")
        some = torch.arange(tests) * (len(result.test) // tests)
        tiles = [(MARGIN + i * (side + MARGIN), result.examples, i, False) for i in range(len(result.examples))]
        tiles += [(left + n * (side + MARGIN), result.test, int(i), True) for n, i in enumerate(some)]
        for x, faces, i, is_test in tiles:
            image, marks = shown(faces.image[i], side, side), Marks(side, side, scale)
            for at in faces.keypoints[i]:
                marks.circle(at, 10 / 3, outline=(255, 255, 255), width=4 / 3)
            _look(marks, faces.keypoints[i], faces.gaze[i], GAZE)
            if is_test:
                for at in result.found[0][i]:
                    marks.circle(at, 8 / 3, fill=POINT, outline=(255, 255, 255), width=1 / 3)
                _look(marks, faces.keypoints[i], result.found[1][i], POINT)
            marks.over(image)
            sheet.put(image, (x, top + band))
    return sheet.image


def _look(marks: Marks, keypoints: Tensor, gaze: Tensor, colour: tuple[int, ...]) -> None:
    """A line from between the eyes towards where they look."""
    start = keypoints[:4].mean(0)
    marks.line(start, start + 0.45 * SIDE * gaze[:2], 2.5, colour)
