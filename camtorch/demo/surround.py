"""The demo `camtorch demo surround`: a car park seen by a car's four fisheyes, from above."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch
from PIL import Image, ImageDraw
from torch import Tensor

from camtorch._drawing import GREY, MARGIN, MIDDLE, Sheet, shown
from camtorch.demo import car_park
from camtorch.rig import Rig
from camtorch.warp.plane import BirdsEye
from camtorch.warp.surround import Surround, surround

X, Y, RESOLUTION = (-7.8, 7.8), (-10.2, 10.2), 0.02
_BODY, _GLASS, _SHADE = (196, 87, 58), (43, 42, 46), (43, 42, 46, 90)
_NEAR = 1.5, 2.0  # metres from the car, within which the image from above is compared with the ground


@dataclass
class Study:
    """What the cameras see, what became of it, and what lies there; images are (3, H, W)."""

    rig: Rig
    images: dict[str, Tensor]
    surround: Surround
    above: Tensor
    valid: Tensor
    """(H, W) bool."""
    truth: Tensor
    error: float
    """Grey levels, rms, between `above` and `truth` around the car."""


@torch.no_grad()
def run(
    report: Callable[[str], None] = print,
    *,
    size: tuple[int, int] = (800, 1280),
    resolution: float = RESOLUTION,
    samples: int = 4,
) -> Study:
    """Render what the four cameras see, and blend it from above.

    Args:
        report: gets a line about the result.
        size: (height, width) of the images, in pixels.
        resolution: metres of the ground per pixel.
        samples: rays per pixel.
    """
    rig = car_park.rig(size)
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(min(os.cpu_count() or 1, 4)) as pool:
            rendered = pool.map(lambda name: car_park.render(rig[name], rig.extrinsics[name], samples=samples), rig)
            images = dict(zip(rig, rendered, strict=True))
    finally:
        torch.set_num_threads(threads)
    whole = surround(rig, x=X, y=Y, resolution=resolution)
    above, valid = whole({name: image[None] for name, image in images.items()})
    front = whole.warp("front")
    assert isinstance(front, BirdsEye)
    x, y = front.grid_points.to(torch.float32).unbind(-1)
    truth = car_park.screen(car_park.ground(x.flatten(), y.flatten())).view(3, *x.shape)
    near = (x.abs() < car_park.WIDTH / 2 + _NEAR[0]) & (y.abs() < car_park.LENGTH / 2 + _NEAR[1]) & valid[0, 0]
    error = 255 * float((above[0] - truth)[:, near].square().mean().sqrt())
    report(f"{len(rig)} cameras of 190 degrees; around the car off the ground by {error:.1f} of 255, rms")
    return Study(rig, images, whole, above[0], valid[0, 0], truth, error)


def drawing(study: Study) -> Image.Image:
    """One image: the four cameras' images, and the one from above with the car in it."""
    head, band, width = 92, 40, 620
    height = round(width * study.images["front"].shape[1] / study.images["front"].shape[2])
    tall = 2 * height + band + MARGIN
    across = round(tall * study.above.shape[2] / study.above.shape[1])
    sheet = Sheet(2 * width + across + 4 * MARGIN, head + band + tall + MARGIN, "A car park from above")
    sheet.text((MARGIN, 62), "four fisheyes of 190 degrees, blended where they overlap", colour=GREY)
    for i, (name, image) in enumerate(study.images.items()):
        x, y = MARGIN + i % 2 * (width + MARGIN), head + i // 2 * (height + band + MARGIN)
        sheet.text((x, y), name, size=MIDDLE)
        sheet.put(shown(image, height, width), (x, y + band - 10))
    x = 2 * width + 3 * MARGIN
    sheet.text((x, head), f"what became of them: {X[1] - X[0]:.1f} x {Y[1] - Y[0]:.1f} m", size=MIDDLE)
    above = shown(study.above, tall, across)
    _draw_car(above, across / (X[1] - X[0]))
    sheet.put(above, (x, head + band - 10))
    return sheet.image


def _draw_car(image: Image.Image, scale: float) -> None:
    """The car in the middle of an image, in pixels per metre."""
    sharp = 4
    layer = Image.new("RGBA", (sharp * image.width, sharp * image.height))
    draw = ImageDraw.Draw(layer)

    def place(x: float, y: float) -> tuple[float, float]:
        return sharp * (image.width / 2 + x * scale), sharp * (image.height / 2 - y * scale)

    def rounded(x: float, low: float, high: float, radius: float, colour: tuple[int, ...], shift: float = 0.0) -> None:
        draw.rounded_rectangle((*place(shift - x, high), *place(shift + x, low)), sharp * scale * radius, colour)

    half, end = car_park.WIDTH / 2, car_park.LENGTH / 2
    rounded(half + 0.06, -end - 0.08, end + 0.02, 0.55, _SHADE, 0.05)
    for side in (-1, 1):
        rounded(0.11, 0.42, 0.62, 0.06, _BODY, side * (half + 0.08))
    rounded(half, -end, end, 0.5, _BODY)
    light = tuple(round(c + 0.16 * (255 - c)) for c in _BODY)
    rounded(half - 0.22, -1.25, 0.55, 0.2, light)
    for low, high, wide, narrow in ((0.55, 1.15, 0.78, 0.62), (-1.25, -1.75, 0.72, 0.6)):
        draw.polygon([place(-narrow, low), place(narrow, low), place(wide, high), place(-wide, high)], _GLASS)
    for side in (-1, 1):
        corners = [(half - 0.2, 0.5), (half - 0.06, 0.95), (half - 0.06, -1.5), (half - 0.2, -1.2)]
        draw.polygon([place(side * x, y) for x, y in corners], _GLASS)
        rounded(0.17, end - 0.26, end - 0.12, 0.06, (250, 245, 235), side * (half - 0.38))
        rounded(0.17, -end + 0.08, -end + 0.2, 0.05, (140, 47, 42), side * (half - 0.38))
    small = layer.reduce(sharp)
    image.paste(small, (0, 0), small)
