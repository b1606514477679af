"""The command line called in this process, and a small image with its camera."""

from pathlib import Path

import numpy as np
from PIL import Image, ImageCms

import camtorch as ct
from camtorch.cli.main import main

FILES = Path(__file__).parents[1] / "files"
FISHEYE = "%YAML:1.0\n---\nimage_width: 96\nimage_height: 64\nfisheye_model: 1\n"
MATRIX = "K: [28, 0, 47, 0, 28, 32, 0, 0, 1]\nD: [-0.02, 0.004, -0.003, 0.0006]\n"
PROFILE = ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
LEVEL = "K: [80, 0, 47.5, 0, 80, 31.5, 0, 0, 1]"
"""A pinhole whose dewarped image is the image."""


def camera():
    return ct.KannalaBrandt([28.0, 28, 47, 32], [-0.02, 0.004, -0.003, 0.0006], image_size=(64, 96)).double()


def write_photograph(folder):
    (folder / "camera.yml").write_text(FISHEYE + MATRIX)
    colours = np.random.default_rng(0).integers(0, 256, (64, 96, 3), dtype=np.uint8)
    Image.fromarray(colours).save(folder / "in.png")


def command(*words, expect=0):
    assert main([str(word) for word in words]) == expect


def refused(capsys, *words):
    """The one line of the error."""
    capsys.readouterr()
    command(*words, expect=2)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.startswith("camtorch: error: ")
    assert captured.err.count("\n") == 1
    return captured.err


def opened(path):
    with Image.open(path) as image:
        image.load()
        return image


def pixels(path):
    return np.array(opened(path))
