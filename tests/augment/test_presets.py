"""The presets' lenses, and those drawn around them, see with every pixel that the lens can see with."""

import pytest
import torch

import camtorch as ct
from camtorch.augment import PRESETS, RandomCamera, RandomLens
from camtorch.warp.boxes import along_edges


def rim(size):
    """(N, 2): the outer edges of an image, a point on every pixel edge."""
    height, width = size
    corners = torch.tensor([[[-0.5, -0.5], [width - 0.5, -0.5], [width - 0.5, height - 0.5], [-0.5, height - 0.5]]])
    return along_edges(corners, max(size))[0]


def source(size):
    return ct.Pinhole([400.0, 400.0, (size[1] - 1) / 2, (size[0] - 1) / 2], image_size=size).requires_grad_(False)


@pytest.mark.parametrize("size", [(480, 640), (400, 640)])
@pytest.mark.parametrize("name", PRESETS)
def test_every_draw_around_a_preset_has_a_ray_for_every_point_of_its_image(name, size):
    """Or, of Aria's, which folds before the corners, for every point for which the preset itself has one."""
    none, edge = dict.fromkeys(("focal", "centre")), rim(size)
    still = RandomLens(name, camera=source(size), distortion=None, **none)
    seen = still.change(None, still.draw(1)).target.unproject(edge[None])[1]
    assert seen.all() or name == "aria"
    more = [kind(name, camera=source(size)) for kind in (RandomLens, RandomCamera) if name != "aria"]
    for augmentation in (RandomLens(name, camera=source(size), **none), *more):
        target = augmentation.change(None, augmentation.draw(64, torch.Generator().manual_seed(0))).target
        assert (target.unproject(edge.expand(64, -1, -1))[1] | ~seen).all()
        assert len(target.distortion.unique(dim=0)) > 48
