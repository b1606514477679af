"""Images of cameras: what they show is what the cameras say."""

import re

import numpy as np
import pytest
import torch
from boards import opencv_left
from cameras import DISTINCT, GOLDEN, golden_camera, one, slow_unless

import camtorch as ct

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")

from matplotlib.figure import Figure  # noqa: E402

from camtorch import plot  # noqa: E402
from camtorch.analysis.numbers import summarise  # noqa: E402
from camtorch.rays.lattices import ideal, ray_fan  # noqa: E402

SIZE = (480, 640)
ON_AXES = plot.distortion_field, plot.radius_curve, lambda camera, ax: plot.difference(camera, camera, ax)


def fisheye(**changes):
    values = {"intrinsics": [300.0, 300, 320, 240], "distortion": [-0.02, -0.01, 0.003, -0.001], "image_size": SIZE}
    return ct.KannalaBrandt(**(values | changes)).double()


def axes():
    return Figure(layout="constrained").add_subplot()


@pytest.mark.parametrize("key", slow_unless("fisheye624".__eq__, sorted(DISTINCT)))
def test_every_model_has_a_portrait(key):
    camera = one(key)
    figure = plot.portrait(camera, camera.convert("kannala_brandt", count=4).camera)
    figure.set_dpi(30)
    figure.canvas.draw()
    assert len([ax for ax in figure.axes if ax.get_title()]) == 3


def test_each_function_draws_on_the_axes_it_gets():
    for draw in ON_AXES:
        ax = axes()
        assert draw(fisheye(), ax) is ax
        ax.figure.canvas.draw()
    assert plot.difference(fisheye(), fisheye()).figure is matplotlib.pyplot.gcf()


def test_the_field_goes_from_the_ideal_pixel_to_the_actual_one():
    camera = fisheye(distortion=[-0.2, 0.0, 0.0, 0.0])
    ax = plot.distortion_field(camera, axes())
    (arrows,) = (c for c in ax.collections if hasattr(c, "U"))
    start, along = np.stack([arrows.X, arrows.Y], -1), np.stack([arrows.U, arrows.V], -1)
    assert "as long" not in ax.get_title()
    rays, valid = camera.unproject(torch.from_numpy(start + along))
    assert bool(valid.all())
    np.testing.assert_allclose(ideal(camera).project(rays)[0].detach(), start, atol=1e-6)
    mild = plot.distortion_field(fisheye(distortion=[-0.001, 0.0, 0.0, 0.0]), axes())
    assert "times as long" in mild.get_title()


def test_the_curve_is_the_radius_and_ends_where_rays_do():
    camera = golden_camera(GOLDEN["mpmath__fisheye624__aria_slam_left_online"])
    ax = plot.radius_curve([camera, fisheye()], axes(), labels=["aria", "mine"])
    assert [text.get_text() for text in ax.get_legend().get_texts()] == ["aria", "ideal", "mine"]
    curve = ax.lines[0]
    angles = torch.from_numpy(np.radians(curve.get_xdata()))
    assert float(angles[-1]) == pytest.approx(summarise(camera).valid_angle[1], abs=0.01)
    pixels, _ = camera.project(ray_fan(angles[100:101], 256)[0])
    radius = (pixels - camera.intrinsics[2:]).norm(dim=-1).detach()
    assert float(radius.min()) <= curve.get_ydata()[100] <= float(radius.max())


def test_a_difference_is_that_of_pixels():
    a, b = fisheye(), fisheye(intrinsics=[300.0, 300, 323, 244])
    ax = plot.difference(a, b, axes())
    assert "rms 5 px, at most 5 px" in ax.get_title()
    values = ax.images[0].get_array()
    np.testing.assert_allclose(values.compressed(), 5.0, atol=1e-9)
    same = plot.difference(a, a, axes())
    assert "the same to rounding" in same.get_title()
    assert same.images[0].get_clim() == (0, 1e-6)  # rounding is no image


def test_a_common_rotation_is_removed_only_if_asked():
    a = ct.Equirectangular([300.0, 300, 320, 240], image_size=SIZE).double()
    b = ct.Equirectangular([300.0, 300, 350, 240], image_size=SIZE).double()  # a turn by a tenth around the vertical
    assert "rms 30 px" in plot.difference(a, b, axes()).get_title()
    turned = plot.difference(a, b, axes(), remove_rotation=True)
    assert float(turned.images[0].get_array().max()) < 1e-6
    assert "turned by 5.73 degrees" in turned.get_title()


def test_what_shows_nothing_is_left_out():
    wide, ahead = fisheye(distortion=[0.0] * 4), ct.Pinhole([300.0, 300, 320, 240]).double()
    ax = plot.difference(wide.pad(400, 400, 400, 400), ahead, axes())
    assert ax.images[0].get_array().mask.mean() > 0.3
    folded, nothing = (ct.BrownConrady([300.0, 300, cx, 240], [-0.5, 0, 0, 0], image_size=SIZE) for cx in (320, 9e5))
    for draw in ON_AXES:
        draw(folded, axes()).figure.canvas.draw()
        draw(nothing, axes()).figure.canvas.draw()


def test_cameras_of_a_rig_are_where_they_are():
    camera = ct.Pinhole([300.0, 300, 320, 240], image_size=SIZE)
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
    assert "from the right" in plot.rig(ct.Rig(dict.fromkeys("ab", camera), stacked), axes()).get_title()
    with pytest.raises(ValueError, match="rig must have extrinsics; got "):
        plot.rig(ct.Rig({"a": camera}), axes())


def test_the_door():
    batch = ct.Pinhole(torch.ones(2, 4), image_size=SIZE)
    for error, match, *calls in (
        (ValueError, r"must be (a )?single", *(lambda draw=draw: draw(batch, None) for draw in ON_AXES)),
        (ValueError, "image_size must be", lambda: plot.distortion_field(ct.Pinhole([1.0, 1, 0, 0]))),
        (ValueError, "must be of one size", lambda: plot.difference(fisheye(), fisheye(image_size=(482, 640)))),
        (ValueError, "as many as cameras, 1; got 2", lambda: plot.radius_curve(fisheye(), labels=["a", "b"])),
        (TypeError, "Axes.*; got KannalaBrandt. Pass several cameras", lambda: plot.radius_curve(fisheye(), fisheye())),
    ):
        for call in calls:
            with pytest.raises(error, match=match):
                call()
    matplotlib.pyplot.close("all")


OUTLIERS = 7


@pytest.mark.slow
def test_residuals_and_uncertainty_are_those_of_the_calibration():
    """Eight views, of which the third is empty; gross outliers in the second."""
    corners, _ = opencv_left()
    pixels = corners.image_points[:8].clone()
    pixels[1, 10 : 10 + OUTLIERS] += torch.tensor([9.0, -12.0])
    pixels[2] = torch.nan
    options = {"image_size": corners.image_size, "loss": "cauchy", "loss_scale": 0.3}
    with pytest.warns(UserWarning, match="view 2 left out, because nothing was seen"):
        found = ct.calibrate("brown_conrady", corners.object_points, pixels, **options)
    figure = plot.calibration(found)
    figure.canvas.draw()
    left, right = figure.axes[:2]
    longer = int(re.search(r"(\d+) times as long", left.get_title())[1])
    (arrows,) = (one for one in left.collections if hasattr(one, "U"))
    use = found.inliers & torch.isfinite(found.residuals).all(-1)
    assert f"residuals of {7 * 54 - OUTLIERS} corners" in left.get_title()
    ends = np.stack((arrows.X, arrows.Y, arrows.U / longer, arrows.V / longer), -1)
    expected = torch.cat((pixels[use], found.residuals[use]), -1).numpy()
    np.testing.assert_allclose(ends[np.lexsort(ends.T)], expected[np.lexsort(expected.T)], atol=1e-6)
    (crosses,) = (line for line in left.lines if line.get_marker() == "x")
    assert len(crosses.get_xdata()) == OUTLIERS
    assert left.get_legend().get_texts()[0].get_text() == f"{OUTLIERS} outliers"
    values = found.uncertainty(found.camera.pixel_grid(8).double())
    median = float(re.search(r"median ([\d.]+) px", right.get_title())[1])
    assert median == pytest.approx(float(values[values.isfinite()].quantile(0.5)), rel=0.1)
    matplotlib.pyplot.close("all")
