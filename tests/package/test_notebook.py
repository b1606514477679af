"""What notebooks show of a camera."""

import html
import re
import xml.etree.ElementTree as ElementTree

import pytest
import torch
from cameras import every_model

import camtorch as ct

SIZE = 160, 200
NUMBERS = 100.0, 100.0, 99.5, 79.5


def shown(camera):
    form = r"<pre[^>]*>(.*?)</pre>(?:(<svg.*</svg>)<div>.*</div>)?"
    text, svg = re.fullmatch(form, camera._repr_html_(), re.S).groups()
    return html.unescape(text), svg and [path.get("d") for path in ElementTree.fromstring(svg).iter("path")]


@every_model
def test_a_camera_shows_its_numbers_and_circles(key):
    camera = ct.MODELS[key](torch.tensor(NUMBERS, dtype=torch.float64), image_size=SIZE)
    text, (_, *circles) = shown(camera)
    assert text == repr(camera)
    assert len(circles) > 1
    # on a circle every point is as far from the axis
    points = [[float(w) for w in p.split()] for p in re.split("[ML]", circles[0])[1:]]
    points = torch.tensor(points, dtype=torch.float64)
    rays, valid = camera.unproject(points - 0.5)
    assert valid.all()
    angles = rays[:, 2].acos().rad2deg()
    assert (angles - angles.mean().round()).abs().max() < 0.1


def test_pixels_without_rays_are_grey():
    camera = ct.OrthographicFisheye([50.0, 50.0, *NUMBERS[2:]], image_size=SIZE)
    cells = shown(camera)[1][0].count("M")
    assert cells * (200 / 48) ** 2 == pytest.approx(160 * 200 - torch.pi * 50**2, rel=0.03)


@pytest.mark.parametrize(
    "camera",
    [
        lambda: ct.Pinhole(NUMBERS),
        lambda: ct.Pinhole(torch.tensor([NUMBERS]), image_size=SIZE),
        lambda: ct.cat([ct.UCM(NUMBERS, image_size=SIZE), ct.FOV(NUMBERS, image_size=SIZE)]),
    ],
)
def test_batches_and_cameras_without_a_size_are_text(camera):
    assert shown(camera())[1] is None
