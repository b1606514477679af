"""Cameras by name: calibrated and typical ones, whose lenses augmentations use."""

from dataclasses import dataclass
from difflib import get_close_matches
from typing import Literal

import torch

from camtorch.cameras.camera import Camera
from camtorch.cameras.catalogue import ELSEWHERE
from camtorch.cameras.operators import fixed_camera
from camtorch.models import MODELS


@dataclass(frozen=True)
class Preset:
    """A calibrated camera by name."""

    model: str
    image_size: tuple[int, int]
    intrinsics: tuple[float, ...]
    distortion: tuple[float, ...]
    origin: str
    """The calibrated camera and the publication of its numbers; or that they are only typical."""

    def camera(self) -> Camera:
        """Return the camera, in float32, which does not learn."""
        numbers = torch.tensor(self.intrinsics), torch.tensor(self.distortion)
        return fixed_camera(MODELS[self.model], *numbers, self.image_size)


REAL = "real"  # instead of a name: a lens of `camtorch.lenses`, drawn for each sample
PresetName = Literal["webcam", "dms60", "dms90", "dms130", "surround190", "tumvi", "aria", "aria_rgb"]

PRESETS: dict[str, Preset] = {
    "webcam": Preset(
        "brown_conrady",
        (480, 640),
        (535.915734, 535.915734, 342.283155, 235.570829),
        (-0.266373, -0.038589, 0.001783, -0.000281, 0.238392),
        "a VGA camera, 67 degrees: OpenCV's sample data, left_intrinsics.yml",
    ),
    "dms60": Preset(
        "brown_conrady",
        (800, 1280),
        (1215.6, 1216.5, 641.7, 396.4),
        (-0.3021, 0.1254, 0.00021, -0.00017, -0.0289),
        "typical of an infrared driver camera of 60 degrees; not one calibrated camera",
    ),
    "dms90": Preset(
        "brown_conrady",
        (480, 752),
        (458.654, 457.296, 367.215, 248.375),
        (-0.28340811, 0.07395907, 0.00019359, 1.76187114e-05),
        "a monochrome global-shutter camera of the kind, 93 degrees: EuRoC MAV dataset, cam0 (Burri et al., 2016)",
    ),
    "dms130": Preset(
        "kannala_brandt",
        (800, 1280),
        (560.4, 559.9, 644.1, 398.3),
        (-0.0268, 0.0572, -0.0310, 0.0040),
        "typical of an infrared driver camera of 130 degrees: the median lens of 112 real cameras of 120 to 140 degrees"
        " (gyroflow/lens_profiles, CC0), continued without a fold; not one calibrated camera",
    ),
    "surround190": Preset(
        "kannala_brandt",
        (1280, 1750),
        (561.8, 562.4, 872.3, 644.6),
        (-0.0237, 0.0041, -0.0029, 0.0006),
        "typical of a car's surround-view camera of 190 degrees; not one calibrated camera",
    ),
    "tumvi": Preset(
        "kannala_brandt",
        (512, 512),
        (190.97847715128717, 190.9733070521226, 254.93170605935475, 256.8974428996504),
        (0.0034823894022493434, 0.0007150348452162257, -0.0020532361418706202, 0.00020293673591811182),
        "a fisheye of 195 degrees, 154 across the image: TUM-VI dataset, cam0, 512 pixels (Schubert et al., 2018)",
    ),
    "aria": Preset(
        "fisheye624",
        (480, 640),
        (241.36528, 241.36528, 319.08371, 239.88765),
        (
            *(-0.0254803095, 0.098208487, -0.0666850955, 0.00907425676, 0.00233879033, -0.000557322637),
            *(0.000256432715, -7.22393725e-06, -0.000471561449, -5.86048482e-05, -0.000441436045, -0.000137118463),
        ),
        "Project Aria glasses, left SLAM camera, 151 degrees: online calibration in the tests of projectaria_tools",
    ),
    "aria_rgb": Preset(
        "fisheye624",
        (2880, 2880),
        (1223.431009, 1223.431009, 1459.943865, 1449.616710),
        (
            *(0.398863079, -0.417100458966, -0.1090692405, 1.59137166, -2.02959744, 0.738166502),
            *(0.000688098579, -0.000494212153, -0.000368309363, 0.000122299997, 0.000733995781, -1.33127664e-05),
        ),
        "Project Aria glasses, RGB camera, 115 degrees: online calibration in the tests of projectaria_tools",
    ),
}


def as_like(like: Camera | str | None, owner: str) -> Camera | None:
    """Return a single camera, or that of a preset or a model; None stays None."""
    if like is None or isinstance(like, Camera):
        if like is not None and like.batch_shape:
            raise ValueError(f"{owner}: like must be a single camera; got batch dims {tuple(like.batch_shape)}")
        return like
    if isinstance(like, str) and like in (*PRESETS, *MODELS):
        return PRESETS[like].camera() if like in PRESETS else MODELS[like]([1.0, 1.0, 0.0, 0.0]).detach()
    close = get_close_matches(like, [REAL, *PRESETS, *MODELS, *ELSEWHERE], 1) if isinstance(like, str) else []
    raise ValueError(
        f"{owner}: like must be a Camera, 'real', a preset ({', '.join(PRESETS)}) or a model ({', '.join(MODELS)}); "
        f"got {like!r}" + (f". Did you mean {ELSEWHERE.get(close[0], close[0])!r}?" if close else "")
    )
