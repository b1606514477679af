"""Measures on real faces how true moved landmarks are: detect, augment with the landmarks, detect again.

python examples/real_faces.py examples/photographs/astronaut.jpg more/*.jpg -o faces.png

Needs `pip install mediapipe==0.10.21 opencv-python`, which want numpy < 2. A detector finds slightly other landmarks in
every image, so the same is measured in the image that the nearest similarity makes (`cv2.warpAffine`), and in the one
that OpenCV makes by the same draw.
"""

import argparse
import importlib
import json
import statistics
from collections import defaultdict
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from PIL import Image
from torch import Tensor

import camtorch as ct

Sample = dict[str, Any]
SIZE, FOV, LANDMARKS = (512, 512), 60, "mediapipe478"
OUTER_EYES = [33, 263]
CAMERA = ct.Pinhole.from_fov(FOV, image_size=SIZE).requires_grad_(False)  # assumed: it is nobody's, and all know it
FISHEYE = ct.KannalaBrandt.from_fov(150, image_size=(1024, 1024)).requires_grad_(False)
TURN = ct.augment.mount_rotation(*torch.tensor([20.0, -10.0, 15.0]))
MOVES: dict[str, Any] = {
    "mount": ct.augment.RandomMount(yaw=8, pitch=8, roll=30, p=1.0, camera=CAMERA),
    "lens": ct.augment.RandomLens("dms90", p=1.0, fov="source", image_size=SIZE, camera=CAMERA),
    "mirror": ct.augment.HorizontalFlip(p=1.0, landmarks=LANDMARKS, camera=CAMERA),
    "fisheye": (ct.Warp(CAMERA, FISHEYE, TURN),),
    "fisheye and back": (ct.Warp(CAMERA, FISHEYE, TURN), ct.Warp(FISHEYE, CAMERA, TURN.mT)),
    "normalised": ct.augment.FaceNormalizer(focal=640, distance=0.6, axis=(112, 80), camera=CAMERA),
}
"""Name -> an augmentation, or warps one after the other."""


class Mesh:
    """MediaPipe's mesh of the face in an image."""

    def __init__(self) -> None:
        options = {"static_image_mode": True, "refine_landmarks": True, "min_detection_confidence": 0.3}
        self.mesh = importlib.import_module("mediapipe").solutions.face_mesh.FaceMesh(**options)

    def __call__(self, image: Tensor) -> Tensor | None:
        """Return landmarks (478, 2) of an image (3, H, W), or None."""
        array = image.permute(1, 2, 0).contiguous().numpy()
        found = ct.data.from_mediapipe(self.mesh.process(array), image.shape[-2:])["keypoints"]
        return found[0] if len(found) else None


def windows(paths: list[str], find: Any) -> list[Sample]:
    """Return the faces of photographs, each in the middle of an image of its own, with landmarks and head pose."""
    cv2, samples = importlib.import_module("cv2"), list[Sample]()
    frontal = cv2.CascadeClassifier(cv2.data.haarcascades + "haarcascade_frontalface_default.xml")
    for path in paths:
        array = np.array(Image.open(path).convert("RGB"))
        for x, y, w, h in frontal.detectMultiScale(cv2.cvtColor(array, cv2.COLOR_RGB2GRAY), 1.1, 8, minSize=(60, 60)):
            corners = np.array([x - w / 2, y - h / 2, x + 1.5 * w, y + 1.5 * h])
            part = array[max(0, int(corners[1])) : int(corners[3]), max(0, int(corners[0])) : int(corners[2])]
            image = torch.from_numpy(np.array(Image.fromarray(part).resize(SIZE[::-1], Image.Resampling.BICUBIC)))
            image = image.permute(2, 0, 1).contiguous()
            if (landmarks := find(image)) is not None:
                pose = ct.solve_pnp(CAMERA, ct.augment.face_points(LANDMARKS), landmarks)
                head = pose.extrinsics.matrix().detach().float()
                samples.append({"image": image, "keypoints": landmarks, "head_pose": head})
    return samples


def move(sample: Sample, how: Any) -> Sample:
    """Return the sample as moved by an augmentation, or by warps one after the other."""
    if not isinstance(how, tuple):
        moved: Sample = how(sample)
        return moved
    image, points = sample["image"], sample["keypoints"]
    for warp in how:
        image, (points, _) = warp(image[None])[0], warp.transform_points(points)
    return {"image": image, "keypoints": points}


def similar(sample: Sample, moved: Sample) -> tuple[Tensor, Tensor]:
    """Return the image and the landmarks by the similarity nearest to a move."""
    cv2 = importlib.import_module("cv2")
    mirrored = "rotation" in moved and bool(torch.linalg.det(moved["rotation"]) < 0)
    flip = np.diag([-1.0 if mirrored else 1.0, 1.0, 1.0])
    order = list(ct.augment.LANDMARKS[LANDMARKS]) if mirrored else slice(None)
    before = np.c_[sample["keypoints"][order].double().numpy(), np.ones(478)]
    pairs = (np.ascontiguousarray(points[:, :2]) for points in (before @ flip, moved["keypoints"].double().numpy()))
    matrix = cv2.estimateAffinePartial2D(*pairs, method=cv2.LMEDS)[0] @ flip
    height, width = moved["image"].shape[-2:]
    image = cv2.warpAffine(sample["image"].permute(1, 2, 0).numpy(), matrix, (width, height))
    return torch.from_numpy(image).permute(2, 0, 1), torch.from_numpy(before @ matrix.T).float()


def by_opencv(sample: Sample, moved: Sample) -> Tensor:
    """Return the image of a move between pinhole cameras, by OpenCV's homography."""
    cv2, target = importlib.import_module("cv2"), moved["camera"]
    homography = target.K.double() @ moved["rotation"].double() @ CAMERA.K.double().inverse()
    array = sample["image"].permute(1, 2, 0).numpy()
    return torch.from_numpy(cv2.warpPerspective(array, homography.numpy(), target.image_size[::-1])).permute(2, 0, 1)


@torch.no_grad()
def measure(samples: list[Sample], find: Any, draws: int = 3) -> dict[str, dict[str, list[float]]]:
    """Return for each move how far found landmarks lie from moved ones, as parts of the distance between the eyes.

    Also by how many degrees the head that they give is off the moved one.
    """
    results: dict[str, dict[str, list[float]]] = defaultdict(lambda: defaultdict(list))
    for (name, how), sample in ((item, sample) for item in MOVES.items() for sample in samples):
        for _ in range(draws if name in ("mount", "lens") else 1):
            moved = move(sample, how)
            images = {"camtorch": (moved["image"], moved["keypoints"]), "similarity": similar(sample, moved)}
            if name in ("mount", "normalised"):
                images["OpenCV"] = by_opencv(sample, moved), moved["keypoints"]
            inside = (moved["keypoints"] > 0).all() and (moved["keypoints"] < moved["image"].shape[-1] - 1).all()
            for source, (image, truth) in images.items() if inside else ():
                if (found := find(image)) is None:
                    results[name][f"{source}, missed"].append(1.0)
                    continue
                if source != "similarity" and "head_pose" in moved:
                    pose = ct.solve_pnp(moved["camera"], ct.augment.face_points(LANDMARKS), found).extrinsics.matrix()
                    turn = pose[:3, :3].mT.float() @ moved["head_pose"][:3, :3]
                    degrees = torch.rad2deg(((turn.trace() - 1) / 2).clamp(-1, 1).acos())
                    results[name][f"{source}, head"].append(float(degrees))
                eyes = float((truth[OUTER_EYES[0]] - truth[OUTER_EYES[1]]).norm())
                results[name][source].append(float((found - truth).norm(dim=1).mean()) / eyes)
    return results


def draw(samples: list[Sample], find: Any, out: str) -> None:
    """Draw each move of the first face, with moved landmarks and those that are found there."""
    figure, axes = plt.subplots(1, len(MOVES), figsize=(3 * len(MOVES), 3.3), layout="constrained")
    for axis, (name, how) in zip(axes, MOVES.items(), strict=True):
        moved = move(samples[0], how)
        axis.imshow(moved["image"].permute(1, 2, 0).numpy())
        found = find(moved["image"])
        for points, colour in ((moved["keypoints"], "#22d3ee"), (found, "#e21d48")):
            if points is not None:
                axis.plot(*points[::4].T.numpy(), ".", color=colour, markersize=2.5)
        axis.set(title=name, xlim=(0, moved["image"].shape[2]), ylim=(moved["image"].shape[1], 0))
        axis.axis("off")
    figure.savefig(out, dpi=100)
    plt.close(figure)


def main(photos: list[str], out: str, numbers: str | None = None) -> None:
    """Measure, print and draw."""
    torch.manual_seed(0)
    find = Mesh()
    samples = windows(photos, find)
    results = measure(samples, find)
    print(f"{len(samples)} faces; medians as parts of the distance between the eyes")
    for name, by_source in results.items():
        print(name, {source: round(statistics.median(values), 4) for source, values in by_source.items()})
    draw(samples, find, out)
    if numbers:
        Path(numbers).write_text(json.dumps(results))


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="+")
    parser.add_argument("-o", "--out", default="faces.png")
    parser.add_argument("--numbers", help="a JSON file for all numbers")
    main(**vars(parser.parse_args()))
