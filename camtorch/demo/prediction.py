"""The demo `camtorch demo camera`: a small network learns to tell focal length and distortion from single images.

It learns from views of a room through lenses that are drawn at random, warped from panoramas while it learns, and is
tried on other lenses in other places. The lenses are unified cameras; what is predicted is another model, because
nobody knows that of a camera: rays are what is compared.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import torch
from PIL import Image
from torch import Tensor, nn

from camtorch._drawing import GREY, MARGIN, MIDDLE, POINT, Marks, Sheet, shown
from camtorch.camera import Camera
from camtorch.demo import room
from camtorch.models import UCM, Equirectangular, KannalaBrandt
from camtorch.networks import losses
from camtorch.networks.head import CameraHead
from camtorch.rotations import mount_rotation
from camtorch.warp.dewarp import Dewarp
from camtorch.warp.warp import Warp

SIZE = (48, 64)
_FOV, _ALPHA = (55.0, 125.0), (0.0, 0.7)  # horizontally, in degrees; from perspective to more than equidistant
_MOUNT = 180.0, 15.0, 10.0  # degrees: looking anywhere, held nearly level
_SIDES = (-1.6, 1.6), (-0.5, 0.3), (-1.6, 1.2)  # of the part of the room where cameras are, in metres


def places(count: int, generator: torch.Generator) -> list[room.Place]:
    """Where panoramas are taken."""
    low, high = torch.tensor(_SIDES).unbind(-1)
    return [(x, y, z) for x, y, z in (low + (high - low) * torch.rand(count, 3, generator=generator)).tolist()]


def panoramas(where: list[room.Place], height: int = 160) -> tuple[Camera, Tensor]:
    """A camera that sees all around, and its images (N, 3, height, 2 height) of the room."""
    # whose outer edges have rays still
    per_radian = 1.00001 * height / math.pi
    camera = Equirectangular([per_radian, per_radian, height - 0.5, height / 2 - 0.5], image_size=(height, 2 * height))
    camera = camera.requires_grad_(False)
    return camera, torch.stack([room.render(camera, place=place, samples=2) for place in where])


def lenses(count: int, generator: torch.Generator) -> UCM:
    """A batch of cameras to be found: unified lenses, with the axis in the middle of the image."""
    drawn = torch.rand(count, 2, generator=generator, dtype=torch.float64)
    half = torch.deg2rad(_FOV[0] + (_FOV[1] - _FOV[0]) * drawn[:, 0]) / 2
    alpha = _ALPHA[0] + (_ALPHA[1] - _ALPHA[0]) * drawn[:, 1]
    focal = SIZE[1] / 2 * (alpha + (1 - alpha) * half.cos()) / half.sin()
    middle = focal.new_tensor([(SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2]).expand(count, 2)
    intrinsics = torch.cat((focal[:, None].expand(-1, 2), middle), -1)
    return UCM(intrinsics.float(), alpha[:, None].float(), image_size=SIZE).requires_grad_(False)


def photographs(panorama: Camera, images: Tensor, cameras: UCM, generator: torch.Generator) -> Tensor:
    """(B, 3, H, W): what each camera sees of one of the panoramas, turned at random."""
    chosen = torch.randint(len(images), (len(cameras),), generator=generator)
    yaw, pitch, roll = torch.tensor(_MOUNT)[:, None] * (2 * torch.rand(3, len(cameras), generator=generator) - 1)
    rotation = mount_rotation(yaw, pitch, roll)
    return Warp(panorama, cameras, rotation, padding_mode="border")(images[chosen])


class Network(nn.Module):
    """Images (B, 3, H, W) to cameras (B)."""

    def __init__(self, width: int = 16):
        super().__init__()

        def block(inputs: int, outputs: int, stride: int) -> list[nn.Module]:
            return [nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.GroupNorm(4, outputs), nn.ReLU()]

        a, b, c, d = width, 2 * width, 3 * width, 4 * width
        see = [*block(5, a, 2), *block(a, b, 2), *block(b, c, 1), *block(c, d, 2), *block(d, d, 1)]
        cells = math.prod(-(-side // 8) for side in SIZE)
        self.layers = nn.Sequential(*see, nn.Conv2d(d, 16, 1), nn.Flatten(), nn.Linear(16 * cells, 128), nn.ReLU())
        self.head = CameraHead(128, KannalaBrandt, image_size=SIZE, fov=(45, 150), count=2, fixed=("cx", "cy"))
        v, u = torch.meshgrid(*(torch.linspace(-1, 1, side) for side in SIZE), indexing="ij")
        self.register_buffer("places", torch.stack((u, v)), persistent=False)

    def forward(self, images: Tensor) -> Camera:
        """The cameras that took the images."""
        places = self.get_buffer("places").expand(len(images), -1, -1, -1)
        seen = torch.cat((2 * images - 1, places), 1).contiguous(memory_format=torch.channels_last)
        return self.head(self.layers(seen))


@dataclass
class Result:
    """What a network finds of cameras that it has not seen, and what it began with."""

    images: Tensor
    """(B, 3, H, W), of unseen lenses in unseen places."""
    truth: UCM
    """The cameras (B) that took them."""
    found: Camera
    """As predicted (B)."""
    prior: Camera
    """What is predicted before anything is learned, the same for all."""
    losses: list[float]
    """Of all steps, radians."""

    def focal(self, found: Camera) -> Tensor:
        """(B,): by what part the focal length is off; both models have as many pixels per radian at the axis."""
        return (found.fx / self.truth.fx - 1).abs()

    def corners(self, found: Camera) -> Tensor:
        """(B,) degrees, by which the rays of the image's corners are off, on average."""
        height, width = SIZE
        ends = torch.tensor([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]]) - 0.5
        off, _ = losses.rays(found, self.truth, pixels=ends.expand(len(self.truth), -1, -1), reduction="none")
        return off.mean(-1).rad2deg()


def train(
    network: Network,
    panorama: Camera,
    images: Tensor,
    steps: int,
    batch: int = 32,
    *,
    seed: int = 0,
    report: Callable[[int, float], None] = lambda step, loss: None,
) -> list[float]:
    """Train a network on views that are warped from panoramas on the fly; the losses of all steps, in radians."""
    generator = torch.Generator().manual_seed(seed)
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 4e-3, total_steps=steps, pct_start=0.2)
    history = []
    for step in range(1, steps + 1):
        cameras = lenses(batch, generator)
        loss = losses.rays(network(photographs(panorama, images, cameras, generator)), cameras, samples=6)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        history.append(loss.item())
        if step % 200 == 0 or step == steps:
            report(step, sum(history[-50:]) / len(history[-50:]))
    return history


def run(
    report: Callable[[str], None] = print, *, steps: int = 700, tests: int = 300, around: int = 24, seed: int = 0
) -> Result:
    """Render, train and evaluate.

    Args:
        report: gets lines on the progress, and those of the table.
        steps: of 32 images each.
        tests: images to be tested on.
        around: panoramas to learn from; half as many, taken elsewhere, are to be tested on.
        seed: of everything drawn.
    """
    begin, generator = time.monotonic(), torch.Generator().manual_seed(seed)

    def say(text: str) -> None:
        report(f"{time.monotonic() - begin:4.0f} s  {text}")

    say(f"rendering {around} panoramas to learn from and {around // 2} to be tested on")
    panorama, images = panoramas(places(around, generator))
    _, others = panoramas(places(around // 2, generator))
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        network = Network()

    def tell(step: int, loss: float) -> None:
        say(f"step {step} of {steps}, rays off by {math.degrees(loss):.2f} degrees")

    history = train(network, panorama, images, steps, seed=seed, report=tell)
    truth = lenses(tests, generator)
    seen = photographs(panorama, others, truth, generator)
    with torch.no_grad():
        result = Result(seen, truth, network(seen), network.head.prior, history)
    report(f"\n{'medians of unseen lenses':<28}{'focal length off by':>20}{'corners off by':>18}")
    for title, found in (("before learning", result.prior), ("after", result.found)):
        focal, corners = result.focal(found).median(), result.corners(found).median()
        report(f"{title:<28}{100 * focal:>18.1f} %{corners:>14.1f} deg")
    return result


@torch.no_grad()
def drawing(result: Result, shows: int = 6) -> Image.Image:
    """One image: some of the test images, straightened by what was predicted and by the truth, and all predictions."""
    scale, band, side = 3, 36, 432
    height, width = (scale * n for n in SIZE)
    left = 150
    size = left + shows * (width + MARGIN) + side + 3 * MARGIN, 84 + 3 * (height + MARGIN) + band
    sheet = Sheet(*size, "Which lens took this image?")
    # from the widest focal length to the longest
    order = result.truth.fx.argsort()[torch.linspace(0, len(result.truth) - 1, shows + 2).long()[1:-1]].tolist()
    rows = ("as it was taken", "straightened by\nwhat was found", "by the truth")
    for row, title in enumerate(rows):
        top = 84 + row * (height + MARGIN)
        for line, text in enumerate(title.split("\n")):
            sheet.text((MARGIN, top + height // 2 - 12 + 20 * line), text)
        for column, i in enumerate(order):
            camera = (None, result.found, result.truth)[row]
            image = result.images[i]
            if camera is not None:
                image = Dewarp(camera[i], fov=69, image_size=SIZE)(image[None])[0]
            sheet.put(shown(image, height, width), (left + column * (width + MARGIN), top))
    at, top = left + shows * (width + MARGIN) + 2 * MARGIN, 84
    marks = Marks(side, side)
    low, high = math.log(12), math.log(75)
    marks.line((0, side), (side, 0), 1.5, GREY)
    for true, found in zip(result.truth.fx.log().tolist(), result.found.fx.log().tolist(), strict=True):
        marks.circle([side * (true - low) / (high - low), side * (high - found) / (high - low)], 3, fill=POINT)
    plot = Image.new("RGB", (side, side), (255, 255, 255))
    marks.over(plot)
    sheet.put(plot, (at, top))
    sheet.text((at, top + side + 8), "focal length: true across, found upwards; 12 to 75 pixels", colour=GREY)
    off = f"off by {100 * result.focal(result.found).median():.0f} %, corners by"
    off = f"{off} {result.corners(result.found).median():.1f} degrees (medians)"
    sheet.text((at, top + side + 32), off, size=MIDDLE)
    return sheet.image
