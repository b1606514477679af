"""Finds faces in a photograph, their landmarks and head poses, and draws them next to their normalised crops.

python examples/detect_faces.py examples/photographs/astronaut.jpg --fov 20 -o faces.png
python examples/detect_faces.py driver.jpg --camera camera.yml --detector dlib -o faces.png

Behind a lens of more than 100 degrees, faces are searched in a ring of views, and landmarks in crops that look at them.
Needs `pip install mediapipe==0.10.21`, whose wheel has the weights and wants numpy < 2; or dlib, `setuptools<81` and
face_recognition_models, whose weights were trained on data that excludes commercial use.
"""

import argparse
import importlib
from collections.abc import Callable
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import torch
from PIL import Image
from torch import Tensor

import camtorch as ct

Sample = dict[str, Any]
Finder = Callable[[Tensor], Sample]
VIEWS: dict[str, Any] = {"count": 5, "fov": 75, "size": 1000}  # large: dlib misses faces below 80 pixels


class Study(NamedTuple):
    """Heads of the faces of an image."""

    poses: Tensor
    """(F, 4, 4), camera from head, metres."""
    angles: Tensor
    """(F, 3): pitch, yaw and roll in degrees."""
    rms: Tensor
    """(F,): how far the generic face lies from the landmarks, as a part of the width of the face's box."""
    normalised: Sample
    """A sample of F images (F, 3, 224, 224), each a face from the front, with its landmarks."""


def mediapipe(image: Tensor) -> Sample:
    """Return the landmarks of an image (3, H, W) by MediaPipe."""
    options = {"static_image_mode": True, "max_num_faces": 10, "refine_landmarks": True}
    with importlib.import_module("mediapipe").solutions.face_mesh.FaceMesh(**options) as mesh:
        return ct.data.from_mediapipe(mesh.process(image.permute(1, 2, 0).contiguous().numpy()), image.shape[-2:])


def dlib(image: Tensor) -> Sample:
    """Return the landmarks of an image (3, H, W) by dlib."""
    library, array = importlib.import_module("dlib"), image.permute(1, 2, 0).contiguous().numpy()
    weights = importlib.import_module("face_recognition_models").pose_predictor_model_location()
    predictor, detector = library.shape_predictor(weights), library.get_frontal_face_detector()
    return ct.data.from_dlib([predictor(array, box) for box in detector(array, 1)])


DETECTORS = {"mediapipe": (mediapipe, "mediapipe478"), "dlib": (dlib, "ibug68")}
"""Name -> what finds the landmarks of an image, and the name of their order."""


@torch.no_grad()
def detect(image: Tensor, find: Finder, camera: ct.Camera) -> Sample:
    """Return the landmarks of an image (3, H, W) of any lens."""
    if float(camera.fov[0]) < 100:
        return find(image)
    views, faces = ct.views.ring(camera, **VIEWS), list[Tensor]()
    for view, warp in zip(views(image), views, strict=True):
        boxes, valid = warp.inverse().transform_boxes(find(view)["boxes"])
        for box in boxes[valid]:
            crop = ct.views.look_at(camera, box, (256, 256), margin=0.5)
            for face in crop.inverse().transform_points(find(crop(image))["keypoints"])[0]:
                # neighbouring views show the same face
                if all((face - other).norm(dim=1).mean() > 0.2 * (box[2] - box[0]) for other in faces):
                    faces.append(face)
    keypoints = torch.stack(faces) if faces else torch.zeros(0, 0, 2)
    boxes = torch.cat((keypoints.amin(1), keypoints.amax(1)), -1) if faces else torch.zeros(0, 4)
    return {"keypoints": keypoints, "boxes": boxes}


@torch.no_grad()
def study(image: Tensor, fields: Sample, landmarks: str, camera: ct.Camera) -> Study:
    """Find the heads of the faces of an image (3, H, W), and normalise their images."""
    face, keypoints = ct.augment.face_points(landmarks), fields["keypoints"]
    weights = torch.ones(len(face))
    weights[: {"ibug68": 17}.get(landmarks, 0)] = 0.1  # the jaw's outline is no fixed line of the head
    pose = ct.solve_pnp(camera, face, keypoints, weights=weights)
    width = fields["boxes"][:, 2] - fields["boxes"][:, 0]
    normalizer = ct.augment.FaceNormalizer(focal=640, distance=0.6, axis=(112, 80), camera=camera)
    heads = pose.extrinsics.matrix().float()
    normalised = normalizer(image=image.expand(len(heads), -1, -1, -1), keypoints=keypoints, head_pose=heads)
    return Study(heads, torch.rad2deg(ct.head_angles(pose)), pose.rms / width, normalised)


def draw(image: Tensor, fields: Sample, found: Study, out: str) -> None:
    """Draw the landmarks on the image, and the faces from the front."""
    images, keypoints, valid = (found.normalised[name] for name in ("image", "keypoints", "keypoints_valid"))
    crops = [(i, k[v], a) for i, k, v, a in zip(images, keypoints, valid, found.angles.tolist(), strict=True)]
    figure, axes = plt.subplots(1, 1 + len(found.poses), figsize=(4 + 4 * len(found.poses), 4), layout="constrained")
    panels = [(image, fields["keypoints"].flatten(0, 1), None), *crops]
    for axis, (picture, points, angles) in zip(np.atleast_1d(axes), panels, strict=True):
        axis.imshow(picture.permute(1, 2, 0).numpy())
        axis.plot(*points.T.numpy(), ".", color="#22d3ee", markersize=1)
        axis.set_title("pitch {:.0f}, yaw {:.0f}, roll {:.0f} degrees".format(*angles) if angles else "found")
        axis.axis("off")
    figure.savefig(out, dpi=100)
    plt.close(figure)


def main(photo: str, out: str, detector: str = "mediapipe", camera: str | None = None, fov: float = 60) -> Study:
    """Find, print and draw."""
    image = torch.from_numpy(np.array(Image.open(photo).convert("RGB"))).permute(2, 0, 1)
    size = (image.shape[1], image.shape[2])
    lens = ct.load(camera).camera if camera else ct.Pinhole.from_fov(fov, image_size=size)
    find, landmarks = DETECTORS[detector]
    fields = detect(image, find, lens)
    if not fields["keypoints"].numel():
        raise SystemExit(f"{detector} finds no face in {photo}. Try the other --detector")
    found = study(image, fields, landmarks, lens)
    for pose, angles, rms in zip(found.poses, found.angles.tolist(), found.rms.tolist(), strict=True):
        words = "pitch {:.0f}, yaw {:.0f}, roll {:.0f} degrees".format(*angles)
        print(
            f"a face {100 * pose[:3, 3].norm():.0f} cm away: {words}; landmarks within {100 * rms:.1f} % of its width"
        )
    draw(image, fields, found, out)
    return found


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photo")
    parser.add_argument("-o", "--out", default="faces.png")
    parser.add_argument("--detector", choices=DETECTORS, default="mediapipe")
    parser.add_argument("--camera", help="a calibration file of the photograph's camera")
    parser.add_argument("--fov", type=float, default=60, help="degrees across the image, if there is no calibration")
    main(**vars(parser.parse_args()))
