"""The presets' lenses, and those drawn around them, see with every pixel that the lens can see with."""

import pytest
import torch

import camtorch as ct
from camtorch.augment import PRESETS, RandomCamera, RandomLens
from camtorch.warp.boxes import along_edges

WHOLE = [name for name in PRESETS if name != "aria"]
"""Of Aria's, the calibrated polynomial folds before the corners: they lie beyond what the lens lights."""


def rim(size):
    """(N, 2): the outer edges of an image, a point on every pixel edge."""
    height, width = size
    corners = torch.tensor([[[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]]])
    return along_edges(corners, max(size))[0]


def source(size):
    return ct.Pinhole([400.0, 400.0, (size[1] - 1) / 2, (size[0] - 1) / 2], image_size=size).requires_grad_(False)


@pytest.mark.parametrize("size", [(480, 640), (400, 640)])
@pytest.mark.parametrize("name", WHOLE)
def test_every_draw_around_a_preset_has_a_ray_for_every_point_of_its_image(name, size):
    for augmentation in (RandomCamera(name, camera=source(size)), RandomLens(name, camera=source(size))):
        target = augmentation.change(None, augmentation.draw(64, torch.Generator().manual_seed(0))).target
        edge = rim(size)
        assert target.unproject(edge.expand(64, -1, -1))[1].all()


@pytest.mark.slow
def test_a_drawn_lens_loses_no_pixel_that_its_like_has():
    """Where a calibrated lens itself ends within the image, too."""
    size, none = (240, 320), {"focal": (1, 1), "centre": (0, 0)}
    for name in PRESETS:
        still, drawn = (RandomLens(name, camera=source(size), distortion=d, **none) for d in (None, 0.2))
        draw = drawn.draw(16, torch.Generator().manual_seed(0))
        before, after = (a.change(None, draw).target.rays()[1] for a in (still, drawn))
        lost = (before & ~after).flatten(1).sum(1)
        assert lost.max() <= 1e-4 * after[0].numel(), name  # a line of them may be hit by less than a tenth of a pixel
        lenses = drawn.change(None, draw).target.distortion
        assert (lenses != lenses[:1]).any(-1).sum() > 12, name
