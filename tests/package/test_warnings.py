"""Warnings show the line that called the package, however deep they come from."""

from pathlib import Path

import pytest
import torch

import camtorch as ct

NARROW = ct.Pinhole([2000.0, 2000.0, 319.5, 239.5], image_size=(480, 640))


def unusable():
    camera = ct.Pinhole([300.0, 300.0, 319.5, 239.5], image_size=(480, 640))
    with torch.no_grad():
        camera.intrinsics[0] = -3.0
    return camera


CALLS = {
    "is .height, width.": lambda: ct.Pinhole([300.0, 300.0, 319.5, 239.5], image_size=(640, 480)),
    "seem to be": lambda: ct.Pinhole([600.0, 320.0, 600.0, 240.0], image_size=(480, 640)),
    "is stretched to that": lambda: NARROW.resize(640, 480),
    "will show nothing": lambda: ct.augment.RandomCamera(fov=(120, 130), camera=NARROW)(image=torch.zeros(1, 480, 640)),
    "became unusable": lambda: unusable().project(torch.tensor([0.0, 0.0, 1.0])),
}


@pytest.mark.parametrize("says", CALLS)
def test_warnings_show_the_callers_line(says):
    with pytest.warns(UserWarning, match=says) as caught:
        CALLS[says]()
    assert {warning.filename for warning in caught} == {__file__}


def test_there_is_one_way_to_warn():
    folder = Path(ct.__file__).parent
    calls = {
        path.relative_to(folder).as_posix() for path in folder.rglob("*.py") if "warnings.warn(" in path.read_text()
    }
    # the library is loaded at its first use, wherever that is
    assert calls == {"values/arguments.py", "native/library.py"}
