"""The unified camera (UCM): (x, y) / (alpha d + (1 - alpha) z), d the distance."""

from collections.abc import Sequence

from torch import Tensor

from camtorch.cameras.camera import Camera
from camtorch.optics import Chart, Lens, Unified


class UCM(Camera):
    """The unified camera model, in the form with alpha; for catadioptric and for fisheye cameras.

        (a, b) = (x, y) / (alpha d + (1 - alpha) z),  d = sqrt(x^2 + y^2 + z^2)
        (u, v) = f (a, b) + c

    A ray is valid before the pole or the fold of r: for z > -w d with w = alpha / (1 - alpha) up to alpha = 1/2, where
    the camera sees all directions but the exact backward one, and (1 - alpha) / alpha from there on. alpha = 0 is a
    pinhole camera, 1 an orthographic fisheye. All values of alpha are allowed.

    Distortion: alpha. The same as Basalt `ucm`. With xi = alpha / (1 - alpha) and f (1 + xi) for f it is the model
    of Mei and Rives without its lens: `Mei`. Source: Geyer and Daniilidis, "A unifying theory for central panoramic
    systems", ECCV 2000, in the form of Usenko, Demmel and Cremers, "The double sphere camera model", 3DV 2018,
    equation (10). See `Camera` for shapes, conventions and errors.
    """

    key = "ucm"
    distortion_names: tuple[str, ...] = ("alpha",)
    default_count = 1
    special_cases = (("pinhole", ()),)
    fit_starts = ({"alpha": 0.1}, {"alpha": 0.5}, {"alpha": 0.7})

    @staticmethod
    def optics(k: Sequence[Tensor]) -> tuple[Chart, Lens]:
        return Unified(alpha=k[0]), Lens()
