"""Plots of calibrations: what they show is what the calibrations say."""

import math
import re

import numpy as np
import pytest
import torch
from boards import opencv_left

import camtorch as ct

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")

from matplotlib.collections import PolyCollection  # noqa: E402
from matplotlib.figure import Figure  # noqa: E402
from matplotlib.patches import PathPatch  # noqa: E402

from camtorch import plot  # noqa: E402
from camtorch.plot import calibrations  # noqa: E402

pytestmark = pytest.mark.slow

ALL = (plot.coverage, plot.residuals, plot.residual_histogram, plot.views, plot.uncertainty)
ALL += (plot.calibrated_radius, plot.boards)
OUTLIERS = 7


@pytest.fixture(scope="module")
def calibration():
    """Eight views, of which the third is empty; gross outliers in the second."""
    corners, _ = opencv_left()
    pixels = corners.image_points[:8].clone()
    pixels[1, 10 : 10 + OUTLIERS] += torch.tensor([9.0, -12.0])
    pixels[2] = torch.nan
    options = {"image_size": corners.image_size, "loss": "cauchy", "loss_scale": 0.3}
    with pytest.warns(UserWarning, match="nothing was seen in view 2"):
        return ct.calibrate("brown_conrady", corners.object_points, pixels, **options)


def axes():
    return Figure(layout="constrained").add_subplot()


def strokes(ax):
    """(K, 2, 2) ends of lines, dots without a length among them, and the colours of as many."""
    found = [patch for patch in ax.patches if isinstance(patch, PathPatch)]
    ends = [patch.get_path().vertices.reshape(-1, 2, 2) for patch in found]
    return np.concatenate(ends), np.repeat([patch.get_edgecolor() for patch in found], list(map(len, ends)), 0)


def magnified(ax):
    return int(re.search(r"(\d+) times as long", ax.get_title())[1])


@pytest.mark.parametrize("draw", ALL, ids=lambda draw: draw.__name__)
def test_each_draws_on_the_axes_it_gets(draw, calibration):
    ax = axes()
    assert draw(calibration, ax) is ax
    assert ax.get_title()
    ax.figure.canvas.draw()
    figure = draw(calibration).figure  # or on new ones
    matplotlib.pyplot.close(figure)


def test_the_corners_are_where_they_were_seen(calibration):
    ax = plot.coverage(calibration, axes())
    ends, _ = strokes(ax)
    use = torch.isfinite(calibration.residuals).all(-1) & calibration.inliers
    np.testing.assert_array_equal(np.sort(ends[:, 0], 0), np.sort(calibration.image_points[use].numpy(), 0))
    (crosses,) = (line for line in ax.lines if line.get_marker() == "x")
    assert len(crosses.get_xdata()) == OUTLIERS
    assert ax.get_legend().get_texts()[0].get_text() == f"{OUTLIERS} outliers"
    assert ax.get_title().startswith(f"{7 * 54 - OUTLIERS} corners in ")


def test_residuals_are_as_long_as_the_title_says(calibration):
    ax = plot.residuals(calibration, axes())
    ends, _ = strokes(ax)
    along = ends[:, 1] - ends[:, 0]
    along = along[np.abs(along).sum(-1) > 0]
    expected = calibration.residuals[calibration.inliers].numpy() * magnified(ax)
    np.testing.assert_allclose(np.sort(along, 0), np.sort(expected, 0), atol=1e-9)


def test_of_many_residuals_an_even_choice_is_drawn(calibration, monkeypatch):
    monkeypatch.setattr(calibrations, "_ARROWS", 60)
    ax = plot.residuals(calibration, axes())
    assert f"60 of {7 * 54 - OUTLIERS}" in ax.get_title()
    ends, _ = strokes(ax)
    lengths = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1)
    assert (lengths > 0).sum() == 60
    most = float(calibration.residuals[calibration.inliers].norm(dim=-1).max())
    assert lengths.max() == pytest.approx(most * magnified(ax))


def test_the_bars_are_the_rms_of_the_inliers(calibration):
    ax = plot.views(calibration, axes(), names=[f"${i}" for i in range(8)])
    labels = [text.get_text() for text in ax.get_xticklabels()]
    assert labels == [f"${i}" for i in (0, 1, 3, 4, 5, 6, 7)]
    for bar, number in zip(ax.patches, (0, 1, 3, 4, 5, 6, 7), strict=True):
        left = calibration.residuals[number][calibration.inliers[number]]
        assert bar.get_height() == pytest.approx(float(left.square().sum(-1).mean().sqrt()))
    ax.figure.canvas.draw()  # a dollar sign is no formula


def test_a_view_has_its_corners_on_its_photograph(calibration):
    ax = plot.view(calibration, 1, axes(), image=np.zeros((480, 640), np.uint8))
    (rings,) = (line for line in ax.lines if line.get_marker() == "o")
    expected = calibration.image_points[1][calibration.inliers[1]].numpy()
    np.testing.assert_array_equal(np.stack(rings.get_data(), -1), expected)
    assert len(ax.images) == 1
    (crosses,) = (line for line in ax.lines if line.get_marker() == "x")
    assert len(crosses.get_xdata()) == OUTLIERS


@pytest.mark.parametrize("distance", [math.inf, 0.5])
def test_the_map_is_the_uncertainty(distance, calibration):
    ax = plot.uncertainty(calibration, axes(), distance=distance)
    height, width = calibration.image_size
    v, u = torch.meshgrid(torch.linspace(-0.5, height - 0.5, 73), torch.linspace(-0.5, width - 0.5, 97), indexing="ij")
    values = calibration.uncertainty(torch.stack((u, v), -1).double(), distance)
    median = float(re.search(r"median ([\d.]+) px", ax.get_title())[1])
    assert median == pytest.approx(float(values[values.isfinite()].quantile(0.5)), rel=0.05)
    assert ("at infinity" in ax.get_title()) == math.isinf(distance)


def test_the_curve_is_that_of_the_camera_and_ends_with_the_image(calibration):
    ax = plot.calibrated_radius(calibration, axes())
    curve = ax.lines[0]
    angle, radius = math.radians(curve.get_xdata()[10]), curve.get_ydata()[10]
    ray = torch.tensor([math.sin(angle) * math.sqrt(0.5), math.sin(angle) * math.sqrt(0.5), math.cos(angle)])
    pixel = calibration.camera.project(ray.double())[0].detach()
    assert radius == pytest.approx(float((pixel - calibration.camera.intrinsics[2:].detach()).norm()), rel=0.01)
    across = float(calibration.camera.field_of_view[2]) / 2
    assert curve.get_xdata()[-1] == pytest.approx(math.degrees(across), abs=3)


def test_boards_stand_before_the_camera(calibration):
    ax = plot.boards(calibration, axes())
    faces, rims = (found for found in ax.collections if isinstance(found, PolyCollection))
    assert len(faces.get_paths()) == len(rims.get_paths()) == 7
    # in the oblique view what is in front of the camera lies to its right
    assert all(path.vertices[:, 0].min() > 0 for path in faces.get_paths())


def test_cameras_of_a_rig_are_where_they_are():
    camera = ct.Pinhole([300.0, 300, 320, 240], image_size=(480, 640))
    poses = {"$left\udc80": ct.Extrinsics([0.0] * 3, [0.0] * 3)}
    poses["right"] = ct.Extrinsics([0.0, 0.2, 0.0], [-0.1, 0.0, 0.02])
    rig = ct.Rig(dict.fromkeys(poses, camera), poses)
    ax = plot.rig(rig, axes())
    ax.figure.canvas.draw()
    dots = [(line.get_xdata()[0], line.get_ydata()[0]) for line in ax.lines if line.get_marker() == "o"]
    expected = [rig.extrinsics[name].position[[0, 2]].tolist() for name in poses]
    np.testing.assert_allclose(dots, expected, atol=1e-7)
    assert [text.get_text() for text in ax.texts] == ["$left\N{REPLACEMENT CHARACTER}", "right"]
    stacked = {"a": poses["$left\udc80"], "b": ct.Extrinsics([0.0] * 3, [0.0, 0.3, 0.0])}
    above = ct.Rig(dict.fromkeys("ab", camera), stacked)
    assert "from the right" in plot.rig(above, axes()).get_title()
    with pytest.raises(ValueError, match="the cameras of a rig need extrinsics; got a rig of"):
        plot.rig(ct.Rig({"a": camera}), axes())


def test_the_door(calibration):
    with pytest.raises(ValueError, match="8 views, and names for 2"):
        plot.views(calibration, axes(), names=["a", "b"])
    for number in (2, 8, -1):  # the first of which has no corner
        with pytest.raises(ValueError, match=f"no view {number} with corners; of 8 7 have"):
            plot.view(calibration, number, axes())
    with pytest.raises(ValueError, match="image_size"):
        plot.view(calibration, 0, axes(), image=np.zeros((10, 10)))
