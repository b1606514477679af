"""An episode of a simulator's pinhole camera, as a robot's own fisheye on another mount would have seen it.

python examples/robot_cameras.py -o robot.png # renders a short episode of a room by both cameras, and compares
"""

import argparse
import json
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import torch
from scenes import room
from torch import Tensor

import camtorch as ct
from camtorch.augment import mount_rotation

WRIST = "observation.images.wrist"
FIELDS = {"*_is_pad": "keep", "observation.images.*": "image", "*": "keep"}
"""What moves in a sample of LeRobot, by its names: the first pattern that a name matches counts."""
SIMULATED = ct.Pinhole.from_fov(120, image_size=(240, 320)).requires_grad_(False)
ROBOT = ct.KannalaBrandt.from_fov(105, image_size=(240, 320), distortion=[0.02, -0.01, 0.0, 0.0]).requires_grad_(False)
MOUNT = {"yaw": 4.0, "pitch": -8.0, "roll": 10.0}
"""Degrees by which the robot's camera is turned from the simulator's."""


def save_cameras(root: Path, cameras: dict[str, ct.Camera]) -> None:
    """Write the cameras of a data set next to LeRobot's own meta/info.json, by the names of their images."""
    path = root / "meta" / "cameras.json"
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps({name: camera.to_dict() for name, camera in cameras.items()}, indent=1))


def load_cameras(root: Path) -> dict[str, ct.Camera]:
    """Return the cameras that `save_cameras` wrote."""
    stored = json.loads((root / "meta" / "cameras.json").read_text())
    return {name: ct.Camera.from_dict(camera) for name, camera in stored.items()}


def as_robot(simulated: ct.Camera, robot: ct.Camera, turn: float = 0.0) -> ct.data.Seeded:
    """Return an augmentation to images of the robot's camera, mounted up to `turn` degrees off in every direction."""
    options: dict[str, Any] = {name: (angle - turn, angle + turn) for name, angle in MOUNT.items()}
    options |= dict.fromkeys(("focal", "centre", "distortion"), "auto" if turn else None)
    options |= {"crop": None, "min_filled": 0, "image_size": robot.image_size, "fields": FIELDS}
    augment = ct.augment.RandomCamera(robot, camera=simulated, **options)
    return ct.data.Seeded(augment)


class Study(NamedTuple):
    """Episodes (T, 3, H, W), and how close the one that was made is to the one that was rendered."""

    simulated: Tensor
    seen: Tensor
    drawn: Tensor
    """By a mount that is drawn once for the episode."""
    truth: Tensor
    valid: Tensor
    """(H, W) bool: the simulator's camera saw it."""
    error: float
    """Grey levels of 255, rms, where valid."""


@torch.no_grad()
def study(simulated: ct.Camera = SIMULATED, robot: ct.Camera = ROBOT, frames: int = 3, samples: int = 4) -> Study:
    """Render an episode by both cameras, and make the second of the first."""
    rotation = mount_rotation(*map(torch.tensor, MOUNT.values()))
    places = [(0.15 * t - 0.15, -0.1 * t, 0.2 * t) for t in range(frames)]
    episode, truth = (
        torch.stack([room.render(camera, turn, place=place, samples=samples) for place in places])
        for camera, turn in ((simulated, None), (robot, rotation))
    )
    batch = {WRIST: episode[None], "action": torch.zeros(1, frames, 7), "episode_index": torch.tensor([17])}
    seen, drawn = (as_robot(simulated, robot, t)(batch, key=batch["episode_index"])[WRIST][0] for t in (0, 6))
    valid = ct.Warp(simulated, robot, rotation).valid_mask()[0, 0]
    error = 255 * float((seen - truth)[..., valid].square().mean().sqrt())
    return Study(episode, seen, drawn, truth, valid, error)


def draw(s: Study, output: str) -> None:
    """Draw the episodes: simulated, made, rendered, and made with a mount that is drawn."""
    rows = {"simulated": s.simulated, "as the robot sees": s.seen, "rendered": s.truth, "a drawn mount": s.drawn}
    figure, axes = plt.subplots(len(rows), len(s.seen), figsize=(3 * len(s.seen), 9.4), layout="constrained")
    for line, (name, images) in zip(axes, rows.items(), strict=True):
        for axis, image in zip(line, images, strict=True):
            axis.imshow(image.movedim(0, -1).clamp(0, 1).numpy())
            axis.set(xticks=[], yticks=[])
        line[0].set_ylabel(name)
    figure.savefig(output, dpi=100)
    plt.close(figure)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("-o", "--output", default="robot.png")
    output, found = parser.parse_args().output, study()
    print(f"off the rendered episode by {found.error:.1f} of 255, rms; {found.valid.float().mean():.0%} filled")
    draw(found, output)
