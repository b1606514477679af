"""Measures on real faces how true moved landmarks are: detect, augment with the landmarks, detect again.

python examples/real_faces.py -o faces.png
python examples/real_faces.py windows/*.jpg -o faces.png

Takes square photographs with a face in the middle, by default those of examples/photographs. Needs
`pip install mediapipe==0.10.21`, which wants numpy < 2 and brings OpenCV. A detector finds slightly other landmarks in
every image, so the same is measured in the image that the nearest similarity makes (`cv2.warpAffine`), and in the one
that OpenCV makes by the same draw.
"""

import argparse
import importlib
import itertools
import json
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
import torch
from PIL import Image
from torch import Tensor

import camtorch as ct

Sample = dict[str, Any]
Results = dict[str, dict[str, list[Any]]]
PHOTOGRAPHS = Path(__file__).with_name("photographs")
NUMBERS = PHOTOGRAPHS / "real_faces.json"
SIZE, FOV, LANDMARKS = (512, 512), 60, "mediapipe478"
MIRRORED = list(ct.augment.LANDMARKS[LANDMARKS])
OUTER_EYES = [33, 263]
CAMERA = ct.Pinhole.from_fov(FOV, image_size=SIZE).requires_grad_(False)  # assumed: nobody calibrated these cameras
FISHEYE = ct.KannalaBrandt.from_fov(150, image_size=(1024, 1024)).requires_grad_(False)
MOUNT = ct.augment.RandomMount(yaw=8, pitch=8, roll=30, p=1.0, min_filled=0)
TO_FISHEYE = ct.augment.RandomCamera(
    FISHEYE, yaw=(20, 20), pitch=(-10, -10), roll=(15, 15), focal=None, centre=None, distortion=None, crop=None,
    image_size=FISHEYE.image_size, p=1.0, min_filled=0,
)  # fmt: skip
NORMALISE = ct.augment.FaceNormalizer(focal=640, distance=0.6, axis=(112, 80))
MOVES: dict[str, tuple[Any, ...]] = {
    "mount": (MOUNT,),
    "lens": (ct.augment.RandomLens("dms130", fov="source", p=1.0),),
    "real lens": (ct.augment.RandomLens("real", fov=(45, 75), p=1.0, min_filled=0),),
    "mirror": (ct.augment.HorizontalFlip(p=1.0, landmarks=LANDMARKS),),
    "fisheye": (TO_FISHEYE,),
    "fisheye and back": (TO_FISHEYE, TO_FISHEYE.inverse),
    "normalised": (NORMALISE,),
    "mount, then normalised": (MOUNT, NORMALISE),
}
"""Name -> the steps of a move."""


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


def head(camera: ct.Camera, landmarks: Tensor) -> Tensor:
    """Return the head pose (4, 4) of landmarks, by camtorch."""
    return ct.solve_pnp(camera, ct.augment.face_points(LANDMARKS), landmarks).extrinsics.matrix().detach().float()


def windows(paths: list[str], find: Any) -> list[Sample]:
    """Return samples of 512 x 512 pixels with landmarks and head pose, of photographs in which a face is found."""
    samples = list[Sample]()
    for path in paths:
        array = np.array(Image.open(path).convert("RGB").resize(SIZE[::-1], Image.Resampling.BICUBIC))
        image = torch.from_numpy(array).permute(2, 0, 1).contiguous()
        if (landmarks := find(image)) is not None:
            labels = {"keypoints": landmarks, "head_pose": head(CAMERA, landmarks)}
            samples.append({"image": image, **labels, "camera": CAMERA, "rotation": torch.eye(3)})
    return samples


def move(sample: Sample, steps: tuple[Any, ...]) -> list[Sample]:
    """Return the sample before the move, and after each of its steps."""
    return list(itertools.accumulate(steps, lambda before, step: step(before), initial=sample))


def is_mirrored(moved: Sample) -> bool:
    """Whether a sample is the mirror image of the photograph."""
    return bool(torch.linalg.det(moved["rotation"]) < 0)


def similar(sample: Sample, moved: Sample) -> tuple[Tensor, Tensor]:
    """Return the image and the landmarks by the similarity nearest to a move."""
    cv2 = importlib.import_module("cv2")
    flip = np.diag([-1.0 if is_mirrored(moved) else 1.0, 1.0, 1.0])
    order = MIRRORED if is_mirrored(moved) else slice(None)
    before = np.c_[sample["keypoints"][order].double().numpy(), np.ones(478)]
    pairs = (np.ascontiguousarray(points[:, :2]) for points in (before @ flip, moved["keypoints"].double().numpy()))
    matrix = cv2.estimateAffinePartial2D(*pairs, method=cv2.LMEDS)[0] @ flip
    height, width = moved["image"].shape[-2:]
    image = cv2.warpAffine(sample["image"].permute(1, 2, 0).numpy(), matrix, (width, height))
    return torch.from_numpy(image).permute(2, 0, 1), torch.from_numpy(before @ matrix.T).float()


def by_opencv(states: list[Sample]) -> tuple[Tensor, Tensor]:
    """Return the image and the landmarks of a move by OpenCV's flip, homography and fisheye, step by step."""
    cv2 = importlib.import_module("cv2")
    image, points = states[0]["image"].permute(1, 2, 0).numpy(), states[0]["keypoints"].double().numpy()
    for before, after in itertools.pairwise(states):
        source, target, size = before["camera"], after["camera"], after["camera"].image_size[::-1]
        turn = (after["rotation"].double() @ before["rotation"].double().mT).numpy()
        old, new = source.K.double().numpy(), target.K.double().numpy()
        if is_mirrored(after):
            image, points = cv2.flip(image, 1), np.abs([size[0] - 1, 0] - points)[MIRRORED]
        elif target.distortion.numel():  # from a pinhole camera to a fisheye
            pixels = np.stack(np.meshgrid(*map(np.arange, size)), -1).reshape(-1, 1, 2).astype(float)
            lens = target.distortion.double().numpy()
            positions = cv2.fisheye.undistortPoints(pixels, new, lens, R=turn.T, P=old).astype(np.float32)
            image = cv2.remap(image, positions.reshape(*size[::-1], 2), None, cv2.INTER_LINEAR)
            rays = np.c_[points, np.ones(478)] @ np.linalg.inv(old).T
            points = cv2.fisheye.projectPoints(rays[:, None], cv2.Rodrigues(turn)[0], np.zeros(3), new, lens)[0][:, 0]
        elif source.distortion.numel():  # and back
            lens = source.distortion.double().numpy()
            maps = cv2.fisheye.initUndistortRectifyMap(old, lens, turn, new, size, cv2.CV_32FC1)
            image = cv2.remap(image, *maps, cv2.INTER_LINEAR)
            points = cv2.fisheye.undistortPoints(points[:, None], old, lens, R=turn, P=new)[:, 0]
        else:
            homography = new @ turn @ np.linalg.inv(old)
            image = cv2.warpPerspective(image, homography, size)
            points = cv2.perspectiveTransform(points[:, None], homography)[:, 0]
    return torch.from_numpy(image).permute(2, 0, 1), torch.from_numpy(points).float()


def head_by_opencv(camera: ct.Camera, landmarks: Tensor) -> Tensor:
    """Return the head's rotation (3, 3), by OpenCV."""
    cv2, points, matrix = importlib.import_module("cv2"), landmarks[:, None].double().numpy(), camera.K.double().numpy()
    if camera.distortion.numel():
        points = cv2.fisheye.undistortPoints(points, matrix, camera.distortion.double().numpy(), P=matrix)
    face = ct.augment.face_points(LANDMARKS).double().numpy()
    pose = cv2.solvePnP(face, points, matrix, None, flags=cv2.SOLVEPNP_SQPNP)[1:]
    return torch.from_numpy(cv2.Rodrigues(cv2.solvePnPRefineLM(face, points, matrix, None, *pose)[0])[0]).float()


def degrees(head: Tensor, other: Tensor) -> float:
    """Return the angle between two rotations."""
    return float(torch.rad2deg(((torch.trace(head[:3, :3].mT @ other[:3, :3]) - 1) / 2).clamp(-1, 1).acos()))


@torch.no_grad()
def measure(samples: list[Sample], find: Any, draws: int = 3) -> Results:
    """Return for each move how far found landmarks lie from moved ones, as parts of the distance between the eyes.

    Also the mean of their differences (bias), by how many degrees the head that they give is off the moved one, and how
    many pixels moved landmarks are off OpenCV's.
    """
    results: Results = defaultdict(lambda: defaultdict(list))
    for (name, steps), sample in itertools.product(MOVES.items(), samples):
        turned = head_by_opencv(CAMERA, sample["keypoints"])
        for _ in range(draws if name in ("mount", "lens", "real lens", "mount, then normalised") else 1):
            states, numbers = move(sample, steps), results[name]
            moved, points = states[-1], states[-1]["keypoints"]
            if (points < 0).any() or (points > moved["image"].shape[-1] - 1).any():
                continue
            images = {"camtorch": (moved["image"], points), "similarity": similar(sample, moved)}
            images["OpenCV"] = by_opencv(states)
            numbers["labels"].append(float((points - images["OpenCV"][1]).norm(dim=1).max()))
            eyes = float((points[OUTER_EYES[0]] - points[OUTER_EYES[1]]).norm())
            for source, (image, truth) in images.items():
                if (found := find(image)) is None:
                    numbers[f"{source}, missed"].append(1)
                    continue
                numbers[source].append(float((found - truth).norm(dim=1).mean()) / eyes)
                numbers[f"{source}, bias"].append(((found - truth).mean(0) / eyes).tolist())
                if source == "OpenCV":
                    mirror = torch.diag(torch.tensor([-1.0 if is_mirrored(moved) else 1.0, 1.0, 1.0]))
                    after = moved["rotation"] @ turned @ mirror
                    numbers["OpenCV, head"].append(degrees(head_by_opencv(moved["camera"], found), after))
                elif source == "camtorch":
                    numbers["camtorch, head"].append(degrees(head(moved["camera"], found), moved["head_pose"]))
                    if is_mirrored(moved):
                        unordered = truth[MIRRORED]
                        numbers["in order"].append(int((found - truth).norm() < (found - unordered).norm()))
                    if len(steps) == 2 and NORMALISE in steps:
                        straight = NORMALISE(sample)
                        numbers["across mounts"].append(float((points - straight["keypoints"]).norm(dim=1).max()))
                        if (other := find(straight["image"])) is not None:
                            numbers["found across mounts"].append(float((found - other).norm(dim=1).mean()) / eyes)
    return results


def table(results: Results) -> Iterator[str]:
    """Yield the rows of the table, medians over faces and draws; the last column has the largest difference."""
    for name, numbers in results.items():
        sources = "camtorch", "similarity", "OpenCV"
        off = " / ".join(f"{100 * np.median(numbers[source]):.2f}" for source in sources)
        bias = (np.linalg.norm(np.median(numbers[f"{source}, bias"], axis=0)) for source in sources)
        heads = " / ".join(f"{np.median(numbers[f'{source}, head']):.1f}°" for source in ("camtorch", "OpenCV"))
        shift = " / ".join(f"{100 * part:.2f}" for part in bias)
        yield f"| {name} | {len(numbers['camtorch'])} | {off} | {shift} | {heads} | {max(numbers['labels']):.5f} |"


def draw(samples: list[Sample], find: Any, out: str) -> None:
    """Draw faces before and after each move, with moved landmarks and those that are found there."""
    moves, faces = {"before": (), **MOVES}, [samples[int(i)] for i in np.linspace(0, len(samples) - 1, 4)]
    figure, axes = plt.subplots(4, len(moves), figsize=(1.6 * len(moves), 6.7), layout="constrained")
    for (row, sample), (column, (name, steps)) in itertools.product(enumerate(faces), enumerate(moves.items())):
        moved, axis = move(sample, steps)[-1], axes[row, column]
        axis.imshow(moved["image"].permute(1, 2, 0).numpy())
        found = find(moved["image"])
        for points, colour in ((moved["keypoints"], "#22d3ee"), (found, "#e21d48")):
            if points is not None:
                axis.plot(*points[::4].T.numpy(), ".", color=colour, markersize=1)
        axis.set(xlim=(0, moved["image"].shape[2]), ylim=(moved["image"].shape[1], 0))
        axis.set_title("" if row else name, fontsize=8)
        axis.axis("off")
    figure.savefig(out, dpi=100)
    plt.close(figure)


def main(photos: list[str], out: str, numbers: str | None = None) -> None:
    """Measure, print and draw."""
    torch.manual_seed(0)
    find = Mesh()
    shipped = [PHOTOGRAPHS / "astronaut.jpg", *sorted(PHOTOGRAPHS.glob("faces/*.jpg"))]
    samples = windows(photos or list(map(str, shipped)), find)
    results = measure(samples, find)
    print(f"{len(samples)} faces; distance and bias in % of the distance between the eyes, labels in pixels")
    print("\n".join(table(results)))
    for name in ("in order", "across mounts", "found across mounts"):
        print(name, *(f"{key}: {np.median(r[name]):.5f} of {len(r[name])}" for key, r in results.items() if r[name]))
    draw(samples, find, out)
    if numbers:
        rounded = {move: {k: np.round(v, 5).tolist() for k, v in r.items() if v} for move, r in results.items()}
        Path(numbers).write_text(json.dumps(rounded, separators=(",", ":")) + "\n")


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("photos", nargs="*")
    parser.add_argument("-o", "--out", default="faces.png")
    parser.add_argument("--numbers", help="a JSON file for all numbers")
    main(**vars(parser.parse_args()))
