"""A camera of Blender as the Python script that makes it; written only.

Panoramas are EQUIRECTANGULAR; lenses other than pinhole are Cycles' FISHEYE_LENS_POLYNOMIAL, whose angle is
-(k0 + k1 r + ... + k4 r^4) of the distance r in millimetres on the sensor (`kernel/camera/projection.h`). The shifts of
perspective cameras count in widths of the image, those of the others in its width and height.
"""

from __future__ import annotations

import math

from camtorch.io import poses
from camtorch.io.protocol import Names
from camtorch.io.writing import Lossy
from camtorch.rig import Rig

NAMES = Names("blender", "Blender", (".py",))

_SENSOR = 36.0  # millimetres
_LENSES = (1.0, 5000.0)  # millimetres, beyond which Blender takes the nearest


def render(rig: Rig, path: str) -> str:
    """A script that adds one camera to the scene, and sets what the scene says of the image."""
    lossy = Lossy(path, NAMES.title)
    name, camera = lossy.only_camera(rig)
    extrinsics = lossy.all_posed(rig)[name]
    height, width = lossy.size(name, camera)
    whole = camera.key == "equirectangular"
    models: dict[str, int | None] = {"equirectangular": None} if whole else {"pinhole": None, "f_theta_backward": 3}
    result, fit = lossy.closest(name, camera, models)
    fx, fy, cx, cy = result.camera.intrinsics.tolist()
    right, up = ((width - 1) / 2 - cx) / width, (cy - (height - 1) / 2) / height
    lens = [
        f"data.shift_x, data.shift_y = {right!r}, {up!r}",
        'scene.render.engine, data.type = "CYCLES", "PANO"',
        'lens = data if hasattr(data, "fisheye_fov") else data.cycles  # before Blender 5',
    ]
    if result.camera.key == "pinhole":
        length = fx * _SENSOR / width
        if not _LENSES[0] <= length <= _LENSES[1]:
            lossy.fail(name, f"a focal length of {fx / width:g} widths of the image, which Blender has not")
        up *= height * fx / (fy * width)
        lens = [f"data.shift_x, data.shift_y = {right!r}, {up!r}", f"data.lens = {length!r}"]
    elif whole:
        across, down = width / (2 * fx), height / (2 * fy)
        if max(across, 2 * down) > math.pi * (1 + 1e-6):
            lossy.fail(name, "more than 360 x 180 degrees, which Blender has not")
        lens += [
            'lens.panorama_type = "EQUIRECTANGULAR"',
            f"lens.longitude_min, lens.longitude_max = {-across!r}, {across!r}",
            f"lens.latitude_min, lens.latitude_max = {-down!r}, {down!r}",
        ]
    else:
        unit = width / (_SENSOR * fx)
        polynomial = [0.0, *(-value * unit**i for i, value in enumerate([1.0, *result.camera.distortion.tolist()], 1))]
        lens += [
            'lens.panorama_type = "FISHEYE_LENS_POLYNOMIAL"',
            f"lens.fisheye_fov = {2 * float(result.max_angle)!r}",
            *(f"lens.fisheye_polynomial_k{i} = {value!r}" for i, value in enumerate(polynomial)),
        ]
    rows = (poses.matrices(extrinsics, undo=True).numpy() * poses.UPRIGHT + 0.0).tolist()
    text = f'''"""Adds a camera to the scene of Blender: {fit}. Written by camtorch."""

import bpy
import mathutils

scene = bpy.context.scene
data = bpy.data.cameras.new({name!a})
camera = bpy.data.objects.new({name!a}, data)
scene.collection.objects.link(camera)
scene.camera = camera
camera.matrix_world = mathutils.Matrix({rows})
scene.render.resolution_x, scene.render.resolution_y, scene.render.resolution_percentage = {width}, {height}, 100
scene.render.pixel_aspect_x, scene.render.pixel_aspect_y = {max(fy / fx, 1.0)!r}, {max(fx / fy, 1.0)!r}
data.sensor_fit, data.sensor_width = "HORIZONTAL", {_SENSOR}
'''
    return text + "\n".join(lens) + "\n"
