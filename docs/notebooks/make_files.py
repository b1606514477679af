"""Makes the files that lie beside the notebooks: a driver with labels, and a room to all sides, both rendered.

Run it from the root of the repository: python docs/notebooks/make_files.py
"""

import json
import sys
from pathlib import Path

import torch
from PIL import Image

sys.path.append(str(Path(__file__).parents[2] / "examples"))  # rendered scenes

from scenes import cabin, portrait, room

import camtorch as ct

HERE = Path(__file__).parent


def driver() -> None:
    """A driver as a wide camera on the steering column sees him, with all that is known of him."""
    camera = ct.KannalaBrandt.from_fov(165, image_size=(600, 800), distortion=[0.01, -0.004, 0.001, -0.0002])
    camera = camera.double().requires_grad_(False)
    found = portrait.driver(camera, yaw=16, place=(0.03, -0.05, 0.42), gaze=(-0.6, 0.25, -1.0))
    labels = {
        "names": list(cabin.LANDMARKS),
        "keypoints": found.keypoints.round(decimals=3).tolist(),
        "points": found.drivers.landmarks()[0].round(decimals=6).tolist(),
        "boxes": found.boxes.round(decimals=3).tolist(),
        "gaze": found.gaze[0].tolist(),
        "head_pose": found.drivers.pose[0].tolist(),
        "camera": {"intrinsics": camera.intrinsics.tolist(), "distortion": camera.distortion.tolist()},
    }
    Image.fromarray(found.image.permute(1, 2, 0).numpy()).save(HERE / "driver.jpg", quality=88)
    (HERE / "driver.json").write_text(json.dumps(labels) + "\n")


def panorama() -> None:
    """The room to all sides, 360 by 180 degrees."""
    side = 1024
    focal = side / torch.pi
    camera = ct.Equirectangular([focal, focal, side - 0.5, side / 2 - 0.5], image_size=(side, 2 * side))
    image = room.render(camera.requires_grad_(False), rough=True)
    Image.fromarray((255 * image).round().byte().permute(1, 2, 0).numpy()).save(HERE / "room.jpg", quality=75)


if __name__ == "__main__":
    driver()
    panorama()
