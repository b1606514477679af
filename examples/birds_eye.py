"""Sees a car park from above by a car's four fisheyes, and compares with the ground that was painted.

python examples/birds_eye.py -o above.png
"""

import argparse
from typing import NamedTuple

import matplotlib.pyplot as plt
import torch
from matplotlib.patches import FancyBboxPatch
from scenes import car_park
from torch import Tensor

import camtorch as ct

X, Y = (-7.8, 7.8), (-10.2, 10.2)
"""Metres to the right of the car's middle, and ahead."""


class Study(NamedTuple):
    """What the cameras see, and the ground; images are (3, H, W)."""

    images: dict[str, Tensor]
    above: Tensor
    valid: Tensor
    """(H, W) bool: where some camera sees the ground."""
    truth: Tensor
    error: float
    """Grey levels of 255, rms, within two metres of the car."""


@torch.no_grad()
def study(size: tuple[int, int] = (800, 1280), resolution: float = 0.02, samples: int = 4) -> Study:
    """Render what the four cameras see, and blend it from above, at `resolution` metres a pixel."""
    rig = car_park.rig(size)
    images = {name: car_park.render(rig[name], rig.extrinsics[name], samples=samples) for name in rig}
    surround = ct.surround(rig, x=X, y=Y, resolution=resolution)
    above, valid = (values[0] for values in surround({name: image[None] for name, image in images.items()}))

    rows, columns = above.shape[1:]
    x = X[0] + resolution * (torch.arange(columns) + 0.5)
    y = Y[1] - resolution * (torch.arange(rows)[:, None] + 0.5)
    x, y = torch.broadcast_tensors(x, y)
    truth = car_park.screen(car_park.ground(x.flatten(), y.flatten())).view(3, rows, columns)
    near = valid[0] & (x.abs() < car_park.WIDTH / 2 + 2) & (y.abs() < car_park.LENGTH / 2 + 2)
    error = 255 * float((above - truth)[:, near].square().mean().sqrt())
    return Study(images, above, valid[0], truth, error)


def draw(s: Study, output: str) -> None:
    """One figure: what the four cameras see, and the ground with the car on it."""
    figure, axes = plt.subplot_mosaic(
        [["front", "right", "above"], ["rear", "left", "above"]],
        width_ratios=[1.6, 1.6, 1.53],
        figsize=(14.2, 6.1),
        layout="constrained",
    )
    for name, image in {**s.images, "above": s.above}.items():
        axes[name].imshow(image.permute(1, 2, 0).clamp(0, 1).numpy(), extent=(*X, *Y) if name == "above" else None)
        axes[name].set_title(name)
        axes[name].set_axis_off()
    half, end = car_park.WIDTH / 2, car_park.LENGTH / 2
    for x, low, high, colour in ((half, -end, end, "#c4573a"), (half - 0.2, -1.6, 1.1, "#2b2a2e")):
        style = f"round,pad=0,rounding_size={0.4 * x}"
        axes["above"].add_patch(FancyBboxPatch((-x, low), 2 * x, high - low, boxstyle=style, color=colour))
    roof = FancyBboxPatch((-0.62, -1.25), 1.24, 1.8, boxstyle="round,pad=0,rounding_size=0.2", color="#cf7259")
    axes["above"].add_patch(roof)
    figure.savefig(output, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="above.png")
    found = study()
    print(f"around the car off the ground by {found.error:.1f} of 255, rms")
    draw(found, parser.parse_args().output)
