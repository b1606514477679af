import pytest
from boards import opencv_calibration


@pytest.fixture
def left():
    return opencv_calibration()
