import pytest
from boards import opencv_left

import camtorch as ct


@pytest.fixture(scope="session")
def left():
    """The calibration of OpenCV's thirteen real views, which several files look at."""
    corners, _ = opencv_left()
    return ct.calibrate("brown_conrady", corners.object_points, corners.image_points, image_size=corners.image_size)
