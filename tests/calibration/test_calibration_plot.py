"""The figure of a calibration: what it shows is what the calibration says."""

import re

import numpy as np
import pytest
import torch
from boards import opencv_left

import camtorch as ct

matplotlib = pytest.importorskip("matplotlib")
matplotlib.use("Agg")

pytestmark = pytest.mark.slow
OUTLIERS = 7


@pytest.fixture(autouse=True)
def _close():
    yield
    matplotlib.pyplot.close("all")


def test_residuals_and_uncertainty_are_those_of_the_calibration():
    """Eight views, of which the third is empty; gross outliers in the second."""
    corners, _ = opencv_left()
    pixels = corners.image_points[:8].clone()
    pixels[1, 10 : 10 + OUTLIERS] += torch.tensor([9.0, -12.0])
    pixels[2] = torch.nan
    options = {"image_size": corners.image_size, "loss": "cauchy", "loss_scale": 0.3}
    with pytest.warns(UserWarning, match="nothing was seen in view 2"):
        found = ct.calibrate("brown_conrady", corners.object_points, pixels, **options)
    figure = ct.plot.calibration(found)
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
