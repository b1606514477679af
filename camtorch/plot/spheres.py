"""Images on the sphere of their rays, for viewers of scenes: rerun and viser have pinhole cameras alone."""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import torch

from camtorch._arguments import as_number, as_whole
from camtorch._photographs import as_photograph
from camtorch.plot.axes import size_of

if TYPE_CHECKING:
    from camtorch.camera import Camera

_MOST_SIDE = 4096  # pixels of a texture, which all graphics cards take


class _Sphere(NamedTuple):
    """A mesh of the camera frame: x right, y down, z forward."""

    vertices: np.ndarray
    """(V, 3) float32."""
    triangles: np.ndarray
    """(T, 3) uint32, whose front faces the camera."""
    texture: np.ndarray
    """(V, 2) float32: parts of the image's width and height, from its top left."""


def to_rerun(
    camera: Camera, image: Any, entity: str, *, radius: float = 1.0, step: int = 16, recording: Any = None
) -> None:
    """Log an image to rerun as a textured mesh on the sphere of its rays, of any lens and any angle.

    The mesh is of the camera frame: where the camera stands says an `rr.Transform3D` at the entity or above it. Pixels
    without a ray are left out, by squares of `step` pixels.

        rr.init("cabin", spawn=True)
        rr.log("driver", rr.Transform3D(translation=t, mat3x3=R))  # world from camera
        ct.plot.to_rerun(camera, "driver.png", "driver/image")

    Args:
        camera: one camera with an image size.
        image: of that size: a path, an array (H, W, 3) or (H, W), or a tensor (C, H, W); red, green, blue.
        entity: its path in rerun.
        radius: of the sphere, in the unit of the scene.
        step: pixels between the nodes of the mesh.
        recording: an `rr.RecordingStream`; by default the current one.

    Raises:
        ImportError: rerun is not there; the text says how to install it. ValueError: a batch of cameras, no image_size,
            an image of another size, a step below 1. OSError: the image cannot be read.
    """
    rr = _required("rerun", "rerun-sdk", "to_rerun")
    sphere, pixels = _sphere(camera, image, radius, step, "to_rerun")
    mesh = rr.Mesh3D(
        vertex_positions=sphere.vertices,
        triangle_indices=sphere.triangles,
        vertex_texcoords=sphere.texture,
        albedo_texture=np.asarray(pixels),
    )
    rr.log(entity, mesh, recording=recording)


def to_viser(camera: Camera, image: Any, server: Any, name: str, *, radius: float = 1.0, step: int = 16) -> Any:
    """Add an image to the scene of a `viser.ViserServer` as `to_rerun` does; what comes back is viser's handle, whose
    `wxyz` and `position` say where the camera stands.
    """
    trimesh = _required("trimesh", "viser trimesh", "to_viser")
    sphere, pixels = _sphere(camera, image, radius, step, "to_viser")
    across, down = sphere.texture.T
    paint = trimesh.visual.material.PBRMaterial(
        baseColorTexture=pixels, baseColorFactor=[255] * 4, metallicFactor=0.0, roughnessFactor=1.0, doubleSided=True
    )
    look = trimesh.visual.TextureVisuals(uv=np.stack((across, 1 - down), -1), material=paint)
    mesh = trimesh.Trimesh(sphere.vertices, sphere.triangles, visual=look, process=False)
    return server.scene.add_mesh_trimesh(name, mesh)


def _required(module: str, packages: str, owner: str) -> Any:
    try:
        return import_module(module)
    except ImportError:
        raise ImportError(f"{owner} needs {module}: pip install {packages}") from None


@torch.no_grad()
def _sphere(camera: Camera, image: Any, radius: float, step: int, owner: str) -> tuple[_Sphere, Any]:
    """The mesh, and its image."""
    height, width = size_of(camera)
    radius, step = as_number(radius, "radius", owner), as_whole(step, "step", owner, least=1)
    name = os.fsdecode(image) if isinstance(image, (str, bytes, os.PathLike)) else "image"
    pixels = as_photograph(image, (height, width), name, owner, _MOST_SIDE).convert("RGB")
    rows, columns = -(-height // step) + 1, -(-width // step) + 1
    v, u = np.meshgrid(np.linspace(0, height, rows), np.linspace(0, width, columns), indexing="ij")
    # nodes at the outer edges of the image, half a pixel beyond the centres
    rays, valid = camera.unproject(np.stack((u - 0.5, v - 0.5), -1))
    known, number = valid.numpy(force=True), np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = number[:-1, :-1], number[:-1, 1:], number[1:, :-1], number[1:, 1:]
    whole = known[:-1, :-1] & known[:-1, 1:] & known[1:, :-1] & known[1:, 1:]
    triangles = np.concatenate([np.stack(three, -1)[whole] for three in ((a, c, b), (b, c, d))])
    texture = np.stack((u / width, v / height), -1).reshape(-1, 2)
    vertices = radius * rays.numpy(force=True).reshape(-1, 3)
    return _Sphere(vertices.astype(np.float32), triangles.astype(np.uint32), texture.astype(np.float32)), pixels
