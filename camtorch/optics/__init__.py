"""The parts of a camera model: a chart from rays to a plane, and a lens of stages on that plane."""

from camtorch.optics.backprojection import Inverted
from camtorch.optics.charts import (
    Chart,
    CylinderChart,
    Equidistant,
    EquidistantUpTo,
    Equisolid,
    Fov,
    OneDivision,
    Perspective,
    SphereChart,
    Transverse,
)
from camtorch.optics.lens import Homography, Lens, Planar, Shear, Stage, Tilt
from camtorch.optics.radial import AnglePerRadius, Polynomial, RadialFactor, RadiusPolynomial, RadiusTable, Rational
from camtorch.optics.surface import Surface
from camtorch.optics.unified import Unified

__all__ = [
    "AnglePerRadius",
    "Chart",
    "CylinderChart",
    "Equidistant",
    "EquidistantUpTo",
    "Equisolid",
    "Fov",
    "Homography",
    "Inverted",
    "Lens",
    "OneDivision",
    "Perspective",
    "Planar",
    "Polynomial",
    "RadialFactor",
    "RadiusPolynomial",
    "RadiusTable",
    "Rational",
    "Shear",
    "SphereChart",
    "Stage",
    "Surface",
    "Tilt",
    "Transverse",
    "Unified",
]
