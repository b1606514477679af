"""Images of the guides, rendered: `python docs/guide_images.py`, or those named: `... dewarp learn`."""

import sys

from make_images import HERE, tiles
from PIL import Image

import camtorch as ct
from camtorch.demo import room


def dewarp() -> Image.Image:
    """A fisheye image of a room, and what `ct.Dewarp` makes of it."""
    lens = ct.KannalaBrandt.from_fov(190, image_size=(600, 800), distortion=[0.02, -0.01, 0.003, -0.001])
    lens = lens.requires_grad_(False)
    image = room.render(lens, samples=4)[None]
    size = (300, 400)
    options = {"image_size": size, "antialias": True}
    warps = {
        "a fisheye of 190 degrees": ct.Warp(lens, lens.resize(*size), antialias=True),
        "perspective, 100 degrees": ct.Dewarp(lens, fov=1.75, **options),
        "cylindrical, 180 degrees": ct.Dewarp(lens, projection="cylindrical", fov=3.14, **options),
        "equirectangular": ct.Dewarp(lens, projection="equirectangular", **options),
    }
    return tiles([(warp(image)[0], title) for title, warp in warps.items()], 2)


IMAGES = {"dewarp": dewarp}

if __name__ == "__main__":
    for name in sys.argv[1:] or IMAGES:
        IMAGES[name]().save(HERE / f"{name}.jpg", quality=82)
