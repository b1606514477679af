"""NVIDIA's ncore: JSON of one camera, as `encode_camera_model_parameters` of nvidia-ncore gives it."""

from typing import Any

import numpy as np

from camtorch.cameras.camera import Camera
from camtorch.cameras.rig import Rig
from camtorch.io.record import Names, Record, one_of
from camtorch.models import FTheta, FThetaBackward
from camtorch.values.arguments import LEFT

NAMES = Names("ncore", "ncore")

_POLYNOMIALS = {
    "ANGLE_TO_PIXELDIST": ("angle_to_pixeldist_poly", FTheta),
    "PIXELDIST_TO_ANGLE": ("pixeldist_to_angle_poly", FThetaBackward),
}
_PINHOLES = ("opencv-pinhole", "pinhole", "ideal-pinhole")


def matches(keys: dict[str, Any]) -> bool:
    """Whether the keys are those of an ncore file."""
    return "camera_model_type" in keys and "camera_model_parameters" in keys


def parse(record: Record) -> Rig:
    """Return the camera without its shutter; of the two polynomials of an f-theta camera only the reference is read."""
    kind = one_of(record["camera_model_type"], ("ftheta", *_PINHOLES, "opencv-fisheye"))
    values = record["camera_model_parameters"]
    camera = _f_theta(values) if kind == "ftheta" else _of_opencv(values, kind)
    shield = values.get("external_distortion_parameters")
    if shield is not None and shield.value is not None:
        shield.fail(f"must be null, as no model here has a windshield; got one. {LEFT}")
    return Rig({"camera": camera})


def _f_theta(values: Record) -> Camera:
    """Return an f-theta camera, whose pixel centres are integers; ncore's other models have them at 0.5."""
    polynomial, kind = _POLYNOMIALS[one_of(values["reference_poly"], _POLYNOMIALS)]
    coefficients = values[polynomial]
    constant, *rest = coefficients.numbers() or [0.0]
    if constant:
        coefficients.fail(f"the constant must be 0, as no model here has one; got {constant:g}")
    linear = values["linear_cde"].numbers(3) if "linear_cde" in values else [0.0]
    while len(rest) > 2 and not rest[-1]:  # files are padded with zeros
        rest.pop()
    centre, size = np.array(values["principal_point"].numbers(2)), values["resolution"].size()
    linear = linear if any(linear) else [1.0, 0.0, 0.0]  # ncore reads zeros as the identity
    try:
        camera = kind.from_polynomial(centre, np.array(rest), linear_cde=linear)
    except ValueError as error:
        coefficients.fail(error)
    camera.image_size = size
    return camera


def _of_opencv(values: Record, kind: str) -> Camera:
    (fx, fy), (cx, cy) = values["focal_length"].numbers(2), values["principal_point"].numbers(2)
    key, distortion = "pinhole", list[float]()
    if kind == "opencv-fisheye":
        key, distortion = "kannala_brandt", values["radial_coeffs"].numbers(4)
    elif kind != "ideal-pinhole":
        counts = (("radial_coeffs", 6), ("tangential_coeffs", 2), ("thin_prism_coeffs", 4))
        radial, tangential, prism = (values[name].numbers(count) for name, count in counts)
        key, distortion = "brown_conrady", [*radial[:2], *tangential, *radial[2:], *prism]
    return values.camera(key, [fx, fy, cx - 0.5, cy - 0.5], distortion, values["resolution"].size())
