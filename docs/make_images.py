"""The images of the documentation, rendered: `python docs/make_images.py`."""

from pathlib import Path

import torch
from PIL import Image, ImageDraw, ImageFont

import camtorch as ct
from camtorch.cli.labelled_image import LabelledImage, rendered
from camtorch.cli.labels import Labels
from camtorch.cli.main import main
from camtorch.cli.sheet import marked
from camtorch.demo.example import driver

SEED = 4
HERE = Path(__file__).parent / "images"
INK, GREY, RIM, PAPER = (43, 42, 46), (122, 112, 100), (214, 202, 182), (250, 245, 235)


def moved(before: LabelledImage, warp: ct.Warp) -> LabelledImage:
    """An image with its labels, warped."""
    labels = before.labels
    keypoints, keypoints_valid = warp.transform_points(labels.keypoints)
    boxes, boxes_valid = warp.transform_boxes(labels.boxes)
    new = Labels(keypoints, boxes, warp.transform_rays(labels.eyes), warp.transform_rays(labels.gaze))
    return LabelledImage(warp(before.image[None])[0], warp.target, new, [], keypoints_valid, boxes_valid)


def overview() -> Image.Image:
    """A fisheye image, dewarped, and as other cameras would have seen it."""
    lens = ct.KannalaBrandt.from_fov(170, image_size=(480, 640), distortion=[0.02, -0.01, 0.003, -0.001])
    fisheye = rendered(driver(lens.double().requires_grad_(False)))
    straight = moved(fisheye, ct.Dewarp(fisheye.camera, fov=1.75, image_size=(480, 640)))
    mount = {"yaw": 12, "pitch": 8, "roll": 20}
    new = ct.augment.RandomCamera("dms90", **mount, fov="source", min_filled=0.98, image_size=(480, 640))
    sample = {"keypoints": fisheye.labels.keypoints.expand(2, -1, -1), "camera": fisheye.camera}
    sample = new(sample, draw=new.draw(2, torch.Generator().manual_seed(SEED)))
    warps = [ct.Warp(fisheye.camera, c, r) for c, r in zip(sample["camera"], sample["rotation"], strict=True)]
    others = [moved(fisheye, warp) for warp in warps]
    panels = [
        (fisheye, "a fisheye of 170 degrees"),
        (straight, "dewarped"),
        *((other, "another lens and mount") for other in others),
    ]
    height, width, gap, band = 300, 400, 16, 34
    sheet = Image.new("RGB", (len(panels) * (width + gap) + gap, height + band + 2 * gap), PAPER)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=18)
    for i, (view, title) in enumerate(panels):
        left = gap + i * (width + gap)
        tile = marked(view, height, width)
        sheet.paste(tile, (left, gap + band))
        draw.rectangle((left - 1, gap + band - 1, left + tile.width, gap + band + tile.height), outline=RIM)
        draw.text((left, gap), title, INK, font)
    return sheet


if __name__ == "__main__":
    overview().save(HERE / "overview.jpg", quality=88)
    full = ["--preset", "dms130", "--fov", "source", "--min-filled", "0.95", "-n", "5"]
    for words in (["augment", *full], ["demo"], ["demo", "stereo"], ["demo", "surround"]):
        path = HERE / f"{words[1] if words[0] == 'demo' and words[1:] else words[0]}.jpg"
        main([*words, "-o", str(path), "--force"])
        Image.open(path).save(path, quality=85)
