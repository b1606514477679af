"""Measures what detectors that others trained lose on faces away from the axis, and what crops as cameras give back.

    python examples/off_axis_faces.py --detector mediapipe --model face_landmarker.task -o mediapipe.png
    python examples/off_axis_faces.py --detector dlib --model shape_predictor_68_face_landmarks.dat -o dlib.png

The 20 faces of examples/photographs are brought to places up to 60 degrees from the axis of three real lenses, at two
distances; this takes about ten minutes. `stress_test.py` does the same with a network of yours, and explains how.
Besides its columns this measures head poses that `ct.solve_pnp` finds by the camera from the landmarks of both crops,
and what the detector finds in the whole image, to the right of its middle.

MediaPipe: `pip install mediapipe`, and
https://storage.googleapis.com/mediapipe-models/face_landmarker/face_landmarker/float16/1/face_landmarker.task
dlib: `pip install dlib-bin`, and http://dlib.net/files/shape_predictor_68_face_landmarks.dat.bz2, unpacked; the data
that it was trained on excludes commercial use. MediaPipe finds rotations itself, and takes the camera for one of 63
degrees; dlib's come from its landmarks by `ct.solve_pnp`, as if the image were 25 degrees wide.
"""

import argparse
import importlib
import itertools
import json
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import stress_test
import torch
from stress_test import Answer, Errors, Photograph, Place, Predict, Results, Seen
from torch import Tensor

import camtorch as ct

PHOTOGRAPHS = Path(__file__).with_name("photographs")
LENSES = {
    "GoPro HERO11, 121 degrees": "GoPro HERO11 Black Wide 2464x2156",
    "Insta360 Go, 150 degrees": "Insta360 Go fisheye automatic",
    "RunCam ThumbPro, 173 degrees": "RunCam ThumbPro Foxeer 1.7mm 2704x1520",
}
"""Name -> words for `ct.lenses.find`; of square pixels, or plain crops are squeezed on the axis too."""
WINDOWS = (15, 30)  # degrees across a photograph: a face about 110 and 55 cm away
BOX = (55.75, 44.5, 231.25, 241.5)  # of the face, in the 288 pixels of a photograph
WAYS = {**stress_test.WAYS, "whole": "whole image"}
SOLVED = "pose by solve_pnp"


class Detector(NamedTuple):
    """A detector of faces."""

    make: Callable[[str], Predict]
    """From the path of its model."""
    landmarks: str
    """Order of its landmarks."""
    eyes: tuple[int, int]
    """Landmarks at the outer corners of the eyes."""
    package: str
    model: str
    """Name of the file of its weights."""


def solved(camera: ct.Camera, landmarks: str, pixels: Tensor) -> Tensor:
    """Return the rotation (3, 3) of a head by its landmarks (N, 2)."""
    points = ct.augment.face_points(landmarks)
    weights = torch.ones(len(points))
    weights[: {"ibug68": 17}.get(landmarks, 0)] = 0.1  # the jaw's outline is no fixed line of the head
    return ct.solve_pnp(camera, points, pixels, weights=weights).extrinsics.matrix()[:3, :3].double()


def mediapipe(model: str) -> Predict:
    """Return MediaPipe's face landmarker."""
    library = importlib.import_module("mediapipe")
    vision, base = library.tasks.vision, library.tasks.BaseOptions(model_asset_path=model)
    options = vision.FaceLandmarkerOptions(
        base_options=base, output_facial_transformation_matrixes=True, min_face_detection_confidence=0.3
    )
    landmarker, flip = vision.FaceLandmarker.create_from_options(options), np.diag([1.0, -1.0, -1.0])

    def predict(images: Tensor) -> dict[str, Tensor]:
        rotation, landmarks = torch.full((len(images), 3, 3), torch.nan), torch.full((len(images), 478, 2), torch.nan)
        for i, image in enumerate(images.permute(0, 2, 3, 1).contiguous().numpy()):
            found = landmarker.detect(library.Image(image_format=library.ImageFormat.SRGB, data=image))
            if found.face_landmarks:
                landmarks[i] = ct.data.from_mediapipe(found, image.shape[:2])["keypoints"][0]
                u, _, v = np.linalg.svd(np.asarray(found.facial_transformation_matrixes[0])[:3, :3])
                rotation[i] = torch.from_numpy(flip @ u @ v @ flip)  # from y up, z back
        return {"rotation": rotation, "landmarks": landmarks}

    return predict


def dlib(model: str) -> Predict:
    """Return dlib's detector of faces from the front and its 68 landmarks."""
    library = importlib.import_module("dlib")
    detector, predictor = library.get_frontal_face_detector(), library.shape_predictor(model)

    def predict(images: Tensor) -> dict[str, Tensor]:
        rotation, landmarks = torch.full((len(images), 3, 3), torch.nan), torch.full((len(images), 68, 2), torch.nan)
        guess = ct.Pinhole.from_fov(25, image_size=images.shape[2:])
        for i, image in enumerate(images.permute(0, 2, 3, 1).contiguous().numpy()):
            if boxes := detector(image, 0):
                largest = max(boxes, key=lambda box: box.area())
                landmarks[i] = ct.data.from_dlib([predictor(image, largest)])["keypoints"][0]
                rotation[i] = solved(guess, "ibug68", landmarks[i])
        return {"rotation": rotation, "landmarks": landmarks}

    return predict


DETECTORS = {
    "mediapipe": Detector(mediapipe, "mediapipe478", (33, 263), "mediapipe", "face_landmarker.task"),
    "dlib": Detector(dlib, "ibug68", (36, 45), "dlib-bin", "shape_predictor_68_face_landmarks.dat"),
}


def made(name: str, model: str | None) -> Predict:
    """Return the detector of a name, or say what it lacks."""
    detector = DETECTORS[name]
    path = model or detector.model
    if not Path(path).is_file():
        raise SystemExit(f"off_axis_faces: --model must be an existing {detector.model}; got {path!r}. See --help")
    try:
        return detector.make(path)
    except ImportError as error:
        lacking = f"off_axis_faces: --detector {name} needs `pip install {detector.package}`; {error}"
        raise SystemExit(lacking) from error


def see(photograph: Photograph, lens: ct.Camera, place: Place, turn: Tensor) -> dict[str, Seen]:
    """Return both crops of a face, and to the right of the middle the whole image."""
    views = stress_test.crops(photograph, lens, place, turn)
    if views and place.azimuth == 0 and place.angle != stress_test.REPEATED:
        image = ct.Warp(photograph.camera, lens, turn, **stress_test.FINE)(photograph.image)
        views["whole"] = Seen(image, lens, stress_test.STILL, stress_test.STILL)
    return views


def off(answer: Answer, detector: Detector) -> Errors:
    """Return the errors of an answer, and of the pose that `ct.solve_pnp` finds by the camera."""
    found, order = stress_test.errors(answer, detector.eyes), detector.landmarks
    if order == "ibug68":
        found.pop(("rotation", "whole"), None)  # nobody takes a whole image for 25 degrees wide
    if answer.is_found:
        expected = solved(answer.reference, order, answer.expected["landmarks"])
        pose = answer.seen.rotation @ solved(answer.seen.camera, order, answer.found["landmarks"])
        found[SOLVED, answer.way] = stress_test.degrees(pose, answer.place.turn @ expected)
    return found


def photographs(window: float) -> list[Photograph]:
    """Return the 20 faces."""
    paths = [PHOTOGRAPHS / "astronaut.jpg", *sorted(PHOTOGRAPHS.glob("faces/*.jpg"))]
    return stress_test.photographs(paths, window, dict.fromkeys((path.name for path in paths), BOX))


def study(predict: Predict, detector: Detector) -> dict[str, Results]:
    """Return the results of all lenses and windows together, and of each."""
    results: dict[str, Results] = defaultdict(lambda: defaultdict(list))
    for (name, words), window in itertools.product(LENSES.items(), WINDOWS):
        for answer in stress_test.answers(predict, photographs(window), ct.lenses.find(words), see):
            errors = off(answer, detector)
            for title in ("all", f"{name}, photographs of {window}"):
                stress_test.add(results[title], answer, errors)
    return results


def at_angle(results: Mapping[str, Results], angle: int = 45) -> Iterator[str]:
    """Yield the rows of a table for each kind, of each lens and window at one angle."""
    for kind in (*stress_test.kinds(results["all"]), stress_test.FOUND):
        shown = {way: title for way, title in WAYS.items() if (kind, angle, way) in results["all"]}
        yield f"| {kind} at {angle} degrees | {' | '.join(shown.values())} | repeated |"
        yield "|---" * (len(shown) + 2) + "|"
        for title, one in results.items():
            columns = [(angle, way) for way in shown] + [(stress_test.REPEATED, "look_at")]
            yield f"| {title} | {' | '.join(stress_test.cell(one, kind, *column) for column in columns)} |"
        yield ""


def draw(results: Results, title: str, out: str) -> None:
    """Draw crops of a face 45 degrees from the axis, and medians over the angle."""
    figure, axes = plt.subplots(2, 3, figsize=(12, 7.5), layout="constrained")
    thing, place = photographs(WINDOWS[-1])[1], Place(45, 0)
    crops = stress_test.crops(thing, ct.lenses.find(list(LENSES.values())[-1]), place, place.turn)
    images = {WAYS[way] + " at 45 degrees": seen.image for way, seen in crops.items()}
    images = {"on the axis": stress_test.look(thing)(thing.image), **images}
    for axis, (label, image) in zip(axes[0], images.items(), strict=True):
        axis.imshow(image.permute(1, 2, 0).numpy())
        axis.set_title(label, fontsize=10)
        axis.axis("off")
    for axis, kind in zip(axes[1], ("rotation", "landmarks", "shape"), strict=True):
        stress_test.plot(axis, results, kind)
    figure.suptitle(title, fontsize=10)
    figure.savefig(out, dpi=100)
    plt.close(figure)


def main(detector: str, out: str, model: str | None = None, numbers: str | None = None) -> dict[str, Results]:
    """Measure, print and draw."""
    predict, start = made(detector, model), time.perf_counter()
    results = study(predict, DETECTORS[detector])
    print("\n".join([*stress_test.table(results["all"], WAYS), *at_angle(results)]))
    print(f"{time.perf_counter() - start:.0f} s")
    draw(results["all"], f"{detector}, medians over {', '.join(LENSES)}", out)
    if numbers:
        rows = {
            title: {
                " ".join(map(str, key)): [round(float(value), 4) for value in values] for key, values in one.items()
            }
            for title, one in results.items()
            if title != "all"
        }
        Path(numbers).write_text(json.dumps(rows, separators=(",", ":")) + "\n")
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--detector", choices=DETECTORS, default="mediapipe")
    parser.add_argument("--model", help="the file of the detector's weights; default: by its name, here")
    parser.add_argument("-o", "--out", default="off_axis_faces.png")
    parser.add_argument("--json", dest="numbers", help="a JSON file for all numbers")
    main(**vars(parser.parse_args()))
