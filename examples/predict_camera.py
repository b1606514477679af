"""Teaches a small network to tell focal length and distortion from single images of rooms (a minute).

It learns from views through unified lenses, warped from panoramas while it learns, and is tried on other lenses in
other places. What it predicts is another model, because nobody knows that of a camera: rays are what is compared.

    python examples/predict_camera.py -o camera.png
"""

import argparse
import math
from typing import NamedTuple

import matplotlib.pyplot as plt
import torch
from scenes import room
from torch import Tensor, nn

import camtorch as ct
from camtorch.poses.rotations import mount_rotation

SIZE = (48, 64)
FOV, ALPHA = (55.0, 125.0), (0.0, 0.7)  # horizontally, in degrees; from perspective to more than equidistant
MOUNT = torch.tensor([180.0, 15.0, 10.0])  # degrees of yaw, pitch and roll: looking anywhere, held nearly level
SIDES = torch.tensor([[-1.6, 1.6], [-0.5, 0.3], [-1.6, 1.2]])  # metres, of the part of the room where cameras are


def panoramas(count: int, generator: torch.Generator, height: int = 160) -> tuple[ct.Camera, Tensor]:
    """A camera that sees all around, and its images (N, 3, height, 2 height) from places in the room."""
    focal = 1.00001 * height / math.pi  # so that its outer edges have rays
    camera = ct.Equirectangular([focal, focal, height - 0.5, height / 2 - 0.5], image_size=(height, 2 * height))
    low, high = SIDES.unbind(-1)
    places = (low + (high - low) * torch.rand(count, 3, generator=generator)).tolist()
    return camera.requires_grad_(False), torch.stack([room.render(camera, place=(*p,), samples=2) for p in places])


def lenses(count: int, generator: torch.Generator) -> ct.UCM:
    """A batch of cameras to be found: unified lenses, with the axis in the middle of the image."""
    drawn = torch.rand(count, 2, generator=generator, dtype=torch.float64)
    half = torch.deg2rad(FOV[0] + (FOV[1] - FOV[0]) * drawn[:, 0]) / 2
    alpha = ALPHA[0] + (ALPHA[1] - ALPHA[0]) * drawn[:, 1]
    focal = SIZE[1] / 2 * (alpha + (1 - alpha) * half.cos()) / half.sin()
    middle = focal.new_tensor([(SIZE[1] - 1) / 2, (SIZE[0] - 1) / 2]).expand(count, 2)
    intrinsics = torch.cat((focal[:, None].expand(-1, 2), middle), -1)
    return ct.UCM(intrinsics.float(), alpha[:, None].float(), image_size=SIZE).requires_grad_(False)


def photographs(panorama: ct.Camera, images: Tensor, cameras: ct.UCM, generator: torch.Generator) -> Tensor:
    """(B, 3, H, W): what each camera sees of one of the panoramas, turned at random."""
    chosen = torch.randint(len(images), (len(cameras),), generator=generator)
    mount = MOUNT[:, None] * (2 * torch.rand(3, len(cameras), generator=generator) - 1)
    return ct.Warp(panorama, cameras, mount_rotation(*mount), padding_mode="border")(images[chosen])


class Network(nn.Module):
    """Images (B, 3, H, W) to cameras (B)."""

    def __init__(self) -> None:
        super().__init__()
        layers, channels = [], (5, 16, 32, 48, 64, 64)  # of an image, and of the places of its pixels
        for inputs, outputs, stride in zip(channels, channels[1:], (2, 2, 1, 2, 1), strict=False):
            layers += [nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.GroupNorm(4, outputs), nn.ReLU()]
        layers += [nn.Conv2d(64, 16, 1), nn.Flatten(), nn.Linear(16 * 6 * 8, 128), nn.ReLU()]
        self.layers = nn.Sequential(*layers)
        self.head = ct.CameraHead(128, "kannala_brandt", image_size=SIZE, fov=(45, 150), count=2, fixed=("cx", "cy"))

    def forward(self, images: Tensor) -> ct.Camera:
        """The cameras that took the images."""
        v, u = torch.meshgrid(*(torch.linspace(-1, 1, side) for side in SIZE), indexing="ij")
        places = torch.stack((u, v)).expand(len(images), -1, -1, -1)
        cameras: ct.Camera = self.head(self.layers(torch.cat((2 * images - 1, places), 1)))
        return cameras


class Result(NamedTuple):
    """Images of lenses that the network has not seen, the lenses, and what it found before and after it learned."""

    images: Tensor
    truth: ct.UCM
    prior: ct.Camera
    found: ct.Camera

    def focal(self, found: ct.Camera) -> Tensor:
        """(B,): by what part the focal length is off; both models have as many pixels per radian at the axis."""
        return (found.fx / self.truth.fx - 1).abs()

    def corners(self, found: ct.Camera) -> Tensor:
        """(B,) degrees, by which the rays of the image's corners are off, on average."""
        height, width = SIZE
        ends = torch.tensor([[0.0, 0.0], [width, 0.0], [0.0, height], [width, height]]) - 0.5
        off, _ = ct.losses.rays(found, self.truth, pixels=ends.expand(len(self.truth), -1, -1), reduction="none")
        return off.mean(-1).rad2deg()


def run(steps: int = 700, tests: int = 300, around: int = 24, seed: int = 0) -> Result:
    """Render panoramas, half as many to be tested on, train on batches of 32, evaluate, and print a table."""
    torch.manual_seed(seed)
    generator = torch.Generator().manual_seed(seed)
    panorama, images = panoramas(around, generator)
    _, others = panoramas(around // 2, generator)
    network = Network()
    optimizer = torch.optim.AdamW(network.parameters(), weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, 4e-3, total_steps=steps, pct_start=0.2)
    for step in range(1, steps + 1):
        cameras = lenses(32, generator)
        loss = ct.losses.rays(network(photographs(panorama, images, cameras, generator)), cameras, samples=6)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        schedule.step()
        if step % 100 == 0:
            print(f"step {step} of {steps}, rays off by {math.degrees(loss.item()):.1f} degrees", flush=True)

    truth = lenses(tests, generator)
    seen = photographs(panorama, others, truth, generator)
    with torch.no_grad():
        result = Result(seen, truth, network.head.prior, network(seen))
    print("medians of unseen lenses")
    for title, found in (("before learning", result.prior), ("after", result.found)):
        focal, corners = result.focal(found).median(), result.corners(found).median()
        print(f"{title:<16} focal length off by {100 * focal:.1f} %, corners by {corners:.1f} degrees")
    return result


@torch.no_grad()
def draw(result: Result, output: str) -> None:
    """One figure: some test images, straightened by what was predicted and by the truth, and all predictions."""
    names = [[f"{row}{column}" for column in range(6)] for row in range(3)]
    figure, axes = plt.subplot_mosaic([[*row, "all", "all"] for row in names], figsize=(15, 4.6), layout="constrained")
    order = result.truth.fx.argsort()[torch.linspace(0, len(result.truth) - 1, 8).long()[1:-1]].tolist()
    titles = ("as it was taken", "straightened by\nwhat was found", "by the truth")
    for title, row, cameras in zip(titles, names, (None, result.found, result.truth), strict=True):
        for name, i in zip(row, order, strict=True):
            image = result.images[i]
            if cameras is not None:
                image = ct.Dewarp(cameras[i], fov=69, image_size=SIZE)(image[None])[0]
            axes[name].imshow(image.permute(1, 2, 0).numpy())
            axes[name].set(xticks=[], yticks=[])
        axes[row[0]].set_ylabel(title)
    axes["all"].plot(result.truth.fx.numpy(), result.found.fx.numpy(), ".", color="#e21d48")
    axes["all"].axline((15, 15), (70, 70), color="grey", linewidth=1)
    axes["all"].set(title="focal length in pixels", xlabel="true", ylabel="found", aspect="equal")
    figure.savefig(output, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="camera.png")
    draw(run(), parser.parse_args().output)
