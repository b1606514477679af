"""OCamCalib against its published formulas, evaluated here by themselves, and its text file."""

import math
import time

import numpy as np
import pytest
from cameras import pixel_lattice
from rigs import assert_same, float64

import camtorch as ct

SS = (-206.517, 0.0, 2.207161e-03, -4.879622e-06, 1.865656e-08)
# the toolbox's own polynomial of the other direction
INVERSE = (294.182260, 152.289570, -12.191217, 27.959546, 8.241525, -1.970397)
INVERSE += (10.689256, 1.871609, -6.437684, 0.430037, 3.215544, 0.921484)
CENTRE, AFFINE, SIZE = (241.800066, 394.552874), (1.000330, 0.000219, 0.000257), (480, 752)


def text(ss=SS, inverse=INVERSE, centre=CENTRE, affine=AFFINE, size=SIZE, more=""):
    rows = (len(ss), *ss), (len(inverse), *inverse), centre, affine, size
    return "\n\n".join(f"#a comment\n\n{' '.join(map(str, row))} " for row in rows) + f"\n\n{more}"


def seen(row, column, ss=SS, centre=CENTRE, affine=AFFINE):
    """cam2world: the direction of a pixel with the toolbox's axes, x down the rows, y along the columns."""
    c, d, e = affine
    x, y = np.linalg.solve([[c, d], [e, 1.0]], [row - centre[0], column - centre[1]])
    rho = math.sqrt(x * x + y * y)
    z = sum(a * rho**i for i, a in enumerate(ss))
    return np.array([x, y, z]) / math.sqrt(x * x + y * y + z * z)


def test_rays_are_those_of_the_toolbox():
    camera = ct.OCamCalib.from_ocamcalib(*map(float64, (SS, CENTRE, AFFINE)), image_size=SIZE)
    pixels = pixel_lattice(camera, 9, 11)
    rays, valid = camera.unproject(pixels)
    assert valid.all()
    for (u, v), ray in zip(pixels.tolist(), rays.tolist(), strict=True):
        down, right, backwards = seen(v, u)
        np.testing.assert_allclose(ray, [right, down, -backwards], atol=1e-14)


def test_a_file_is_the_camera_of_its_numbers_which_look_along_z_or_against_it(tmp_path):
    path = tmp_path / "calib_results.txt"
    path.write_text(text(more="#camera Intrinsics\n\n300 0 1 0 300 2 0 0 1\n"))
    rig = ct.load(path)
    assert rig.format == "ocamcalib"
    for polynomial in (SS, [-a for a in SS]):
        expected = ct.OCamCalib.from_ocamcalib(*map(float64, (polynomial, CENTRE, AFFINE)), image_size=SIZE)
        assert_same(rig, ct.Rig({"camera": expected}))


BAD = {
    "no size": (text().rsplit("#", 1)[0], "image size: must be given"),
    "a count that is wrong": (text().replace("5 -206", "6 -206"), "polynomial"),
    "a word": (text().replace("0.000219", "x"), "affine.*must be a finite number"),
    "nan": (text().replace("-206.517", "nan"), "polynomial.*must be a finite number"),
    "no focal length": (text(ss=(0.0, 0.0, 1e-3)), "must not be zero"),
    "mirrored": (text(affine=(-1.0, 0.0, 0.0)), "c must be positive"),
    "half a pixel": (text(size=(480.5, 752)), "number of pixels"),
    "three sides": (text(size=(480, 752, 3)), "must be a height and a width"),
    "too many": (text(ss=(-200.0, *[0.0] * 80)), "number of coefficients up to 64"),
    "overflow": (text(ss=(-1e300, 0.0, 1e300)), "finite"),
    "no affine": (text(affine=(1.0, 0.0)), "must have 3 numbers; got 2"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_files_say_what_is_wrong(name, tmp_path):
    content, message = BAD[name]
    path = tmp_path / "calib_results.txt"
    path.write_text(content)
    with pytest.raises(ct.CameraFileError, match=message):
        ct.load(path, format="ocamcalib")


def test_large_files_are_refused_at_once(tmp_path):
    path = tmp_path / "calib_results.txt"
    for filling in ("# a comment\n", "0 ", "\n"):
        path.write_text(text(more=filling * ((10 << 20) // len(filling))))
        start = time.process_time()
        with pytest.raises(ct.CameraFileError, match=r"at most 65536 bytes; got 10"):
            ct.load(path)
        assert time.process_time() - start < 1
