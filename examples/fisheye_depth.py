"""A depth network made for pinhole images, on a fisheye of 190 degrees: a view at a time, joined in one map.

python examples/fisheye_depth.py -o depth.png # a stand-in for the network knows the room that is rendered
"""

import argparse
from collections.abc import Callable
from typing import NamedTuple

import matplotlib.pyplot as plt
import torch
from scenes import room
from torch import Tensor
from torch.nn.functional import max_pool2d

import camtorch as ct

CAMERA = ct.KannalaBrandt.from_fov(190, image_size=(480, 480), distortion=[0.01, -0.004, 0.0, 0.0]).requires_grad_(
    False
)
MOUNT = ct.Extrinsics([0.0, 0.3, 0.0], [-0.1, 0.0, 0.2]).requires_grad_(False)
"""Camera from rig."""
EDGE = 0.03
"""By which part the inverse distance may bend from pixel to pixel on one surface."""


def distances(network: Callable[[Tensor], Tensor], views: ct.views.Views, images: Tensor) -> tuple[Tensor, Tensor]:
    """Return distances along rays (B, 1, H, W) of wide images (B, C, H, W), and where some view knows one.

    The network takes pinhole images (N, C, S, S) to depths along z (N, 1, S, S); not all views may see something.
    """
    pinhole = views(images)  # (B, N, C, S, S)
    z = network(pinhole.flatten(0, 1)).unflatten(0, pinhole.shape[:2])
    # inverse distances are nearly straight on planes, and zero is no surface at all
    inverse, valid = views.back(views.view.rays()[0][..., 2] / z)
    return 1 / inverse, valid & (inverse > 0)


def stand_in(views: ct.views.Views, place: tuple[float, float, float]) -> Callable[[Tensor], Tensor]:
    """Return a network whose answer for the views of one image of the room is right."""
    rays = views.view.rays()[0]
    z = torch.stack([room.distances(rays @ rotation, place) for rotation in views.rotations]) * rays[..., 2]
    return lambda images: z[:, None].expand(len(images), -1, -1, -1)


class Study(NamedTuple):
    """What the fisheye sees, and what came of it."""

    image: Tensor
    """(3, H, W)."""
    distance: Tensor
    """(H, W) metres along rays, joined."""
    truth: Tensor
    off: Tensor
    """(N,) by which parts of the distance pixels are off, without those at edges between two surfaces."""
    share: float
    """Of the pixels that see the room, those in `off`."""
    points: Tensor
    """(M, 3) of the room, in the rig's frame; none at edges."""


@torch.no_grad()
def study(views: ct.views.Views, samples: int = 4, place: tuple[float, float, float] = (0.4, 0.1, 0.6)) -> Study:
    """Render the room, and compare the joined distances with the true ones."""
    camera = views.camera
    image = room.render(camera, place=place, samples=samples)
    distance, valid = (found[0, 0] for found in distances(stand_in(views, place), views, image[None]))
    rays, has_ray = camera.rays()
    truth = torch.where(has_ray, room.distances(rays, place), torch.nan)
    near = 1 / truth
    bends = torch.stack([(near.roll(1, axis) + near.roll(-1, axis) - 2 * near).abs() / near for axis in (0, 1)])
    smooth = max_pool2d(bends, 3, 1, 1).amax(0) < EDGE  # False next to what has no distance
    off = ((distance - truth).abs() / truth)[valid & smooth]
    points, known = camera.backproject(distance, kind="distance")
    share = len(off) / int((has_ray & truth.isfinite()).sum())
    return Study(image, distance, truth, off, share, MOUNT.inverse()(points[known & valid & smooth]))


def draw(s: Study, output: str) -> None:
    """Draw the image, the joined distances, and the points from above."""
    figure, axes = plt.subplots(1, 3, figsize=(13, 4.2), layout="constrained")
    axes[0].imshow(s.image.movedim(0, -1).clamp(0, 1).numpy())
    shown = axes[1].imshow(s.distance.numpy(), vmin=0, vmax=5)
    figure.colorbar(shown, ax=axes[1], label="metres along the ray")
    axes[2].plot(*s.points[::7, [0, 2]].T.numpy(), ",", color="#1b6f73")
    axes[2].set(aspect="equal", xlabel="metres to the rig's right", ylabel="metres ahead")
    for axis in axes[:2]:
        axis.set_axis_off()
    figure.savefig(output, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="depth.png")
    output, found = parser.parse_args().output, study(ct.views.cube(CAMERA))
    most = float(found.off.quantile(0.999))
    print(f"off by {found.off.median():.2%} in the middle and {most:.2%} at most, away from edges ({found.share:.0%})")
    draw(found, output)
