"""Sees a car park from above by a car's four fisheyes: a `ct.BirdsEye` each, blended where they overlap.

python examples/surround_view.py -o above.png # rendering the four images takes some minutes
"""

import argparse
from functools import partial
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import torch
from matplotlib.patches import FancyBboxPatch
from scenes import car_park
from torch import Tensor
from torch.nn.functional import avg_pool2d

import camtorch as ct

X, Y = (-7.8, 7.8), (-10.2, 10.2)
"""Metres to the right of the car's middle, and ahead."""
FADE = 1.0  # metres over which a camera fades out before its view ends


def surround(rig: ct.Rig, resolution: float) -> tuple[list[ct.BirdsEye], Tensor]:
    """Return a warp per camera and weights (N, 1, H, W), which add up to 1 in each pixel that a camera sees."""
    make = partial(ct.BirdsEye, x=X, y=Y, resolution=resolution, padding_mode="border")
    eyes = [make(camera, rig.extrinsics[name]) for name, camera in rig.items()]
    weights, reach = torch.cat([eye.valid_mask() for eye in eyes]).float(), round(FADE / resolution)
    for _ in range(2):  # the mean around a pixel is one half at a straight edge: 0 there, 1 far inside
        mean = avg_pool2d(weights, 2 * reach + 1, stride=1, padding=reach, count_include_pad=False)
        weights = weights * (2 * mean - 1).clamp(min=1e-6)
    return eyes, weights / weights.sum(0).clamp(min=1e-30)


class Study(NamedTuple):
    """What the cameras see, and the ground: images (3, H, W), and valid (H, W), where some camera sees it."""

    images: dict[str, Tensor]
    above: Tensor
    valid: Tensor
    truth: Tensor
    error: float
    """Grey levels of 255, rms, within two metres of the car."""


@torch.no_grad()
def study(size: tuple[int, int] = (800, 1280), resolution: float = 0.02, samples: int = 4) -> Study:
    """Render what the four cameras see, and blend it from above, at `resolution` metres a pixel."""
    rig = car_park.rig(size)
    images = {name: car_park.render(rig[name], rig.extrinsics[name], samples=samples) for name in rig}
    eyes, weights = surround(rig, resolution)
    above = sum(eye(image[None])[0] * weight for eye, image, weight in zip(eyes, images.values(), weights, strict=True))
    x, y = eyes[0].grid_points.float().unbind(-1)
    truth = car_park.screen(car_park.ground(x.flatten(), y.flatten())).view(3, *x.shape)
    valid = weights.sum((0, 1)) > 0
    near = valid & (x.abs() < car_park.WIDTH / 2 + 2) & (y.abs() < car_park.LENGTH / 2 + 2)
    error = 255 * float((above - truth)[:, near].square().mean().sqrt())
    return Study(images, above, valid, truth, error)


def draw(s: Study, output: str) -> None:
    """Draw what the four cameras see, and the ground with the car on it."""
    layout: Any = [["front", "right", "above"], ["rear", "left", "above"]]
    figure, axes = plt.subplot_mosaic(layout, width_ratios=[1.6, 1.6, 1.53], figsize=(14.2, 6.1), layout="constrained")
    for name, image in {**s.images, "above": s.above}.items():
        axes[name].imshow(image.permute(1, 2, 0).clamp(0, 1).numpy(), extent=(*X, *Y) if name == "above" else None)
        axes[name].set(title=name, xticks=[], yticks=[])
    for width, length, colour in ((car_park.WIDTH, car_park.LENGTH, "#c4573a"), (1.3, 2.3, "#2b2a2e")):
        style = f"round,pad=0,rounding_size={width / 4}"
        axes["above"].add_patch(FancyBboxPatch((-width / 2, -length / 2), width, length, style, color=colour))
    figure.savefig(output, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="above.png")
    output, found = parser.parse_args().output, study()
    print(f"around the car off the ground by {found.error:.1f} of 255, rms")
    draw(found, output)
