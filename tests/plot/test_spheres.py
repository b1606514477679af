"""Images on the sphere of their rays, in viewers of scenes."""

import numpy as np
import pytest
import torch
from cameras import one

import camtorch as ct

SIZE = (96, 128)


def camera_of(key):
    camera = ct.KannalaBrandt.from_fov(220, image_size=SIZE, distortion=[0.02, -0.01, 0.0, 0.0])
    return camera if key == "kannala_brandt" else one(key).requires_grad_(False).resize(*SIZE)


def image_of(camera):
    v, u = np.mgrid[: SIZE[0], : SIZE[1]]
    return np.stack((2 * u, 2 * v, 0 * u), -1).astype(np.uint8)


def check(camera, vertices, triangles, texture, radius):
    """Each vertex is where the camera sees its place in the image, and triangles face the camera."""
    np.testing.assert_allclose(np.linalg.norm(vertices[triangles], axis=-1), radius, rtol=1e-5)
    used = np.unique(triangles)
    pixels, valid = camera.double().project(vertices[used].astype(np.float64))
    assert valid.all()
    expected = texture[used] * SIZE[::-1] - 0.5
    np.testing.assert_allclose(pixels.detach(), expected, atol=1e-3)
    a, b, c = vertices[triangles].transpose(1, 0, 2)
    assert (np.einsum("ij,ij->i", np.cross(b - a, c - a), a + b + c) < 0).all()


@pytest.mark.parametrize("key", ["kannala_brandt", "brown_conrady", "fisheye624"])
def test_rerun_gets_the_rays_of_the_image(key, tmp_path):
    rr = pytest.importorskip("rerun")
    camera = camera_of(key)
    chunk = pytest.importorskip("rerun.chunk")
    image, path = image_of(camera), str(tmp_path / "sphere.rrd")
    recording = rr.RecordingStream("test")
    recording.save(path)
    ct.plot.to_rerun(camera, image, "driver/image", radius=2.0, step=8, recording=recording)
    recording.disconnect()
    (logged,) = (c for c in chunk.RrdReader(path).stream().to_chunks() if c.entity_path == "/driver/image")
    batch = logged.to_record_batch()
    names = ("vertex_positions", "triangle_indices", "vertex_texcoords", "albedo_texture_buffer")
    vertices, triangles, texture, pixels = (np.array(batch.column(f"Mesh3D:{name}").to_pylist()[0]) for name in names)
    check(camera, vertices, triangles, texture, 2.0)
    assert (pixels.reshape(image.shape) == image).all()


@pytest.mark.parametrize("key", ["kannala_brandt", "brown_conrady"])
def test_viser_gets_the_rays_of_the_image(key):
    pytest.importorskip("trimesh")
    camera, added = camera_of(key), {}

    class Scene:
        def add_mesh_trimesh(self, name, mesh):
            added[name] = mesh
            return "handle"

    class Server:
        scene = Scene()

    image = image_of(camera)
    assert ct.plot.to_viser(camera, image, Server(), "driver", step=8) == "handle"
    mesh = added["driver"]
    upright = mesh.visual.uv * [1, -1] + [0, 1]
    check(camera, mesh.vertices, mesh.faces, upright, 1.0)
    assert (np.asarray(mesh.visual.material.baseColorTexture) == image).all()


def test_what_cannot_be_shown():
    pytest.importorskip("trimesh")
    camera = camera_of("kannala_brandt")
    with pytest.raises(ValueError, match="to_viser: the image 'image' has 3 x 4 pixels, and those of the camera"):
        ct.plot.to_viser(camera, torch.zeros(3, 4, 3), None, "driver")
    with pytest.raises(ValueError, match="the camera must be a single one"):
        ct.plot.to_viser(camera.expand(2), image_of(camera), None, "driver")
