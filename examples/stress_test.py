"""Measures what your own network loses away from the axis of a wide lens, and what crops as cameras give back.

    python examples/stress_test.py predict.py --images photographs --camera camera.yml -o stress.png
    python examples/stress_test.py predict.py --images photographs --camera "GoPro HERO11 Black Wide" --fov 30

It needs no labels. Photographs show a thing in their middle, or in the boxes of `--boxes`, a JSON file {name of the
photograph: [x1, y1, x2, y2]}, and are --fov degrees wide, which may be a guess. Exact rotations move each to places up
to 60 degrees from the axis of the lens. There the thing is cropped in two ways: plainly, as a square around its box,
and by `ct.views.look_at`, as a camera that looks at it (`ct.augment.BoxCrop` makes the same crops). The network's
answer to the photograph itself, turned by the same rotation, is the truth.

`predict.py` is yours. Its `predict(images)` takes crops, uint8 (B, 3, 512, 512), and returns one or more of

    rotation   (B, 3, 3)  from the thing's frame to that of a camera that looks at the middle of the crop:
                          x right, y down, z forward
    gaze       (B, 3)     a direction in that camera's frame
    landmarks  (B, N, 2)  pixels x, y of the crop; the centre of the first is (0, 0)
    boxes      (B, 4)     pixels x1, y1, x2, y2 of the crop

as tensors or arrays, NaN where it finds nothing. For MediaPipe, `pip install mediapipe` and Google's
face_landmarker.task, it is

    import mediapipe, numpy, torch
    import camtorch as ct

    vision = mediapipe.tasks.vision
    base = mediapipe.tasks.BaseOptions(model_asset_path="face_landmarker.task")
    options = vision.FaceLandmarkerOptions(base_options=base, output_facial_transformation_matrixes=True)
    landmarker, flip = vision.FaceLandmarker.create_from_options(options), numpy.diag([1.0, -1.0, -1.0])

    def predict(images):
        rotation, landmarks = torch.full((len(images), 3, 3), torch.nan), torch.full((len(images), 478, 2), torch.nan)
        for i, image in enumerate(images.permute(0, 2, 3, 1).contiguous().numpy()):
            found = landmarker.detect(mediapipe.Image(image_format=mediapipe.ImageFormat.SRGB, data=image))
            if found.face_landmarks:
                landmarks[i] = ct.data.from_mediapipe(found, image.shape[:2])["keypoints"][0]
                u, _, v = numpy.linalg.svd(found.facial_transformation_matrixes[0][:3, :3])
                rotation[i] = torch.from_numpy(flip @ u @ v @ flip)  # from y up, z back
        return {"rotation": rotation, "landmarks": landmarks}

In the table, "repeated" are crops on the axis by boxes that are 4 % off: what the network itself repeats. "With the
ray" turns the answer to a plain crop by `camera.local_pinhole` of its middle, without another image. Landmarks and
boxes are compared in the photograph, to which the lens moves them exactly; "shape" compares landmarks as they lie in
the crop, after the best shift, turn and scale.
"""

import argparse
import json
import math
import runpy
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import matplotlib.pyplot as plt
import numpy as np
import torch
from PIL import Image
from torch import Tensor

import camtorch as ct

SIZE = (512, 512)
MARGIN = 0.15
FINE: dict[str, Any] = {"mode": "bicubic", "tolerance": 1e-3}  # options of warps of photographs
LARGEST = 768  # pixels, of a photograph
ANGLES = (0, 15, 30, 45, 60)  # degrees from the axis
AZIMUTHS = (0, 90, 180, 270)  # degrees in the image, from right to down
WIDE = 10  # times what the network itself repeats: errors up to there have an axis from 0
NUDGE, REPEATED = 0.04, -1  # shift of a box as a part of its width, and the angle that stands for it
WAYS = {"plain": "plain crop", "ray": "with the ray", "look_at": "look_at"}
FOUND = "found"
LEAST = 1e-3  # degrees or %: less is drawn as this
SHAPES = {"rotation": (3, 3), "gaze": (3,), "landmarks": (0, 2), "boxes": (4,)}  # of an answer; 0: any number
SUFFIXES = (".jpg", ".jpeg", ".png", ".bmp", ".webp")
Answers = dict[str, Tensor]
Predict = Callable[[Tensor], Mapping[str, Any]]
Errors = dict[tuple[str, str], float]
Results = dict[tuple[str, int, str], list[float]]
"""(kind, angle, way) -> errors; of the kind FOUND, whether the thing is found."""
STILL = torch.eye(3, dtype=torch.float64)


class Photograph(NamedTuple):
    """A photograph of a thing."""

    image: Tensor
    """uint8 (3, H, W)."""
    camera: ct.Camera
    box: Tensor
    """(4,): where the thing is."""


class Place(NamedTuple):
    """Where in the lens's image a thing is brought, degrees."""

    angle: int
    """From the axis, or REPEATED."""
    azimuth: int

    @property
    def direction(self) -> tuple[float, float]:
        """The azimuth's direction x, y in the image."""
        return math.cos(math.radians(self.azimuth)), math.sin(math.radians(self.azimuth))

    @property
    def turn(self) -> Tensor:
        """(3, 3): the least rotation that brings the axis there."""
        x, y = self.direction
        across = torch.tensor([[0.0, 0, x], [0, 0, y], [-x, -y, 0]], dtype=torch.float64)
        return torch.matrix_exp(math.radians(max(self.angle, 0)) * across)


class Seen(NamedTuple):
    """An image that the network is given."""

    image: Tensor
    """uint8 (3, H, W)."""
    camera: ct.Camera
    """Its camera."""
    rotation: Tensor
    """(3, 3): from that camera's frame to the lens's."""
    ray: Tensor
    """(3, 3): from the frame of a camera that looks at the middle of the image to the lens's."""


class Answer(NamedTuple):
    """What the network finds in an image, and in the reference: the photograph's crop, in which the thing is ahead."""

    place: Place
    way: str
    seen: Seen
    found: Answers
    reference: ct.Camera
    expected: Answers
    width: float
    """Of the thing's box in the reference."""

    @property
    def is_found(self) -> bool:
        """Whether the network finds the thing."""
        return whole(self.found)


PLACES = [Place(0, 0)] + [Place(angle, azimuth) for angle in (REPEATED, *ANGLES[1:]) for azimuth in AZIMUTHS]
See = Callable[[Photograph, ct.Camera, Place, Tensor], dict[str, Seen]]


# -- images


def photographs(paths: Sequence[Path], fov: float, boxes: Mapping[str, Sequence[float]] | None) -> list[Photograph]:
    """Return photographs, which are `fov` degrees wide; without boxes, things fill six tenths of each side."""
    found = list[Photograph]()
    for path in paths:
        with Image.open(path) as opened:
            wide = opened.width
            opened.thumbnail((LARGEST, LARGEST))  # a lens has fewer pixels for a degree, and warps do not average
            image = torch.from_numpy(np.array(opened.convert("RGB"))).permute(2, 0, 1).contiguous()
        height, width = image.shape[1:]
        if boxes is None:
            box = torch.tensor([0.2 * width, 0.2 * height, 0.8 * width, 0.8 * height], dtype=torch.float64) - 0.5
        elif path.name in boxes:
            box = (torch.tensor(boxes[path.name], dtype=torch.float64) + 0.5) * width / wide - 0.5
        else:
            raise ValueError(f"stress_test: boxes must have one of each photograph; got none of {path.name!r}")
        camera = ct.Pinhole.from_fov(fov, image_size=(height, width)).double().requires_grad_(False)
        found.append(Photograph(image, camera, box))
    return found


def look(photograph: Photograph) -> ct.Warp:
    """Return the warp to the reference: the camera of the photograph that looks at the thing."""
    found = ct.views.look_at(photograph.camera, photograph.box, SIZE, margin=MARGIN)
    return ct.Warp(found.source, found.target, found.rotation, **FINE)


def box_in(lens: ct.Camera, photograph: Photograph, turn: Tensor) -> Tensor | None:
    """Return the thing's box (4,) in the lens's image, or None if it is not all there."""
    warp = ct.Warp(photograph.camera, lens, turn)
    share = torch.linspace(0, 1, 17, dtype=torch.float64)
    x, y = photograph.box.view(2, 2).T
    across, down = x[0] + share * (x[1] - x[0]), y[0] + share * (y[1] - y[0])
    sides = [torch.cartesian_prod(*pair) for pair in ((across, y), (x, down))]
    pixels, valid = warp.transform_points(torch.cat(sides))
    return warp.transform_boxes(photograph.box)[0] if bool((valid & lens.contains(pixels)).all()) else None


def crops(photograph: Photograph, lens: ct.Camera, place: Place, turn: Tensor) -> dict[str, Seen]:
    """Return the plain crop of a thing, and that of a camera that looks at it; nothing if the lens doesn't see it."""
    if (box := box_in(lens, photograph, turn)) is None:
        return {}
    if place.angle == REPEATED:
        box = box + NUDGE * (box[2] - box[0]) * box.new_tensor(2 * place.direction)
    low, high = box.split(2)
    longer = float((high - low).max())
    # the part of the lens's image that holds both crops
    left, top = (max(0, round(v)) for v in (low - longer).tolist())
    right, bottom = (min(n, round(v)) for v, n in zip((high + longer).tolist(), (lens.width, lens.height), strict=True))
    part = lens.crop(top, left, bottom - top, right - left)
    image = ct.Warp(photograph.camera, part, turn, **FINE)(photograph.image)

    side = round((1 + 2 * MARGIN) * longer)
    left, top = (round(v) for v in ((low + high - side + 1) / 2).tolist())
    plain = lens.crop(top, left, side, side).resize(*SIZE)
    ray = plain.local_pinhole(box.new_tensor([(n - 1) / 2 for n in SIZE]))[0].mT
    view = ct.views.look_at(lens, box, SIZE, margin=MARGIN)
    turned = view.transform_rays(STILL)  # rows: the axes of the lens, in the crop
    return {
        "plain": Seen(ct.Warp(part, plain, tolerance=1e-3)(image), plain, STILL, ray),
        "look_at": Seen(ct.Warp(part, view.target, turned.mT, tolerance=1e-3)(image), view.target, turned, turned),
    }


# -- answers


def ask(predict: Predict, images: Sequence[Tensor]) -> list[Answers]:
    """Return what the network finds in images (3, H, W) of one size."""
    found = {key: torch.as_tensor(value).double().cpu() for key, value in predict(torch.stack(list(images))).items()}
    if not found or not found.keys() <= SHAPES.keys():
        raise ValueError(f"predict: its answer must have some of {', '.join(SHAPES)}; got {', '.join(found) or 'none'}")
    for key, value in found.items():
        wanted = (len(images), *SHAPES[key])
        if value.ndim != len(wanted) or any(n not in (m, 0) for n, m in zip(wanted, value.shape, strict=True)):
            raise ValueError(f"predict: {key} must be {str(wanted).replace(' 0', ' N')}; got {tuple(value.shape)}")
    return [{key: value[i] for key, value in found.items()} for i in range(len(images))]


def whole(found: Answers) -> bool:
    """Whether the network finds something."""
    return all(bool(torch.isfinite(value).all()) for value in found.values())


@torch.no_grad()
def answers(predict: Predict, things: Sequence[Photograph], lens: ct.Camera, see: See = crops) -> Iterator[Answer]:
    """Yield the network's answers to all images of the things that it finds in the photographs themselves."""
    for thing in things:
        warp = look(thing)
        (expected,) = ask(predict, [warp(thing.image)])
        if not whole(expected):
            continue
        ahead = warp.transform_rays(STILL).mT
        low, _, high, _ = warp.transform_boxes(thing.box)[0].tolist()
        images = [(p, *pair) for p in PLACES for pair in see(thing, lens, p, p.turn @ ahead).items()]
        for size in dict.fromkeys(seen.image.shape for _, _, seen in images):
            same = [one for one in images if one[2].image.shape == size]
            found = ask(predict, [seen.image for _, _, seen in same])
            for one, values in zip(same, found, strict=True):
                yield Answer(*one, values, warp.target, expected, high - low)


def degrees(rotation: Tensor, other: Tensor) -> float:
    """Return the angle between two rotations."""
    return math.degrees(2 * math.asin(min(1.0, float((rotation - other).norm()) / math.sqrt(8))))


def off_shape(points: Tensor, others: Tensor) -> Tensor:
    """Return how far points (N, 2) lie from others after the best shift, turn and scale."""
    a, b = (torch.view_as_complex((p - p.mean(0)).contiguous()) for p in (points, others))
    return ((a.conj() @ b) / (a.conj() @ a) * a - b).abs()


def overlap(box: Tensor, other: Tensor) -> Tensor:
    """Return the area that boxes share as a part of the area that they cover."""
    sides = torch.minimum(box[2:], other[2:]) - torch.maximum(box[:2], other[:2])
    shared, *areas = (s.clamp(min=0).prod() for s in (sides, box[2:] - box[:2], other[2:] - other[:2]))
    return shared / (sum(areas) - shared)


def errors(answer: Answer, unit: tuple[int, int] | None = None) -> Errors:
    """Return {(kind, way): error} of an answer.

    Landmarks are off in percent of the width of the thing's box, or of the distance between the landmarks `unit`.
    """
    place, way, seen, found, reference, expected, width = answer
    turn, off = place.turn, Errors()
    if not answer.is_found:
        return off
    back = ct.Warp(seen.camera, reference, turn.mT @ seen.rotation)
    frames = {"plain": STILL, "ray": seen.ray} if way == "plain" else {way: seen.ray}
    for name, frame in frames.items():
        if "rotation" in found:
            off["rotation", name] = degrees(frame @ found["rotation"], turn @ expected["rotation"])
        if "gaze" in found:
            a, b = (g / g.norm() for g in (frame @ found["gaze"], turn @ expected["gaze"]))
            off["gaze", name] = math.degrees(2 * math.asin(min(1.0, float((a - b).norm()) / 2)))
    if "landmarks" in found:
        there = expected["landmarks"]
        scale = float((there[unit[0]] - there[unit[1]]).norm()) if unit else width
        moved = (back.transform_points(found["landmarks"])[0] - there).norm(dim=-1)
        off["landmarks", way] = 100 * float(moved.mean()) / scale
        if len(there) > 2:
            off["shape", way] = 100 * float(off_shape(found["landmarks"], there).mean()) / scale
    if "boxes" in found:
        (x1, y1, x2, y2), half = found["boxes"], found["boxes"].view(2, 2).mean(0)
        middles = torch.stack((x1, half[1], half[0], y1, x2, half[1], half[0], y2)).view(4, 2)  # of the sides
        box = back.transform_points(middles)[0].flatten()[[0, 3, 4, 7]]
        off["boxes", way] = 100 * float(1 - overlap(box, expected["boxes"]))
    return off


# -- results


def add(results: Results, answer: Answer, off: Errors) -> None:
    """Add an answer, and its errors if the thing is found."""
    angle = answer.place.angle
    results[FOUND, angle, answer.way].append(answer.is_found)
    for (kind, way), value in off.items():
        results[kind, angle, way].append(value)


def kinds(results: Results) -> list[str]:
    """Return what is measured."""
    return [kind for kind in dict.fromkeys(kind for kind, _, _ in results) if kind != FOUND]


def unit(kind: str) -> str:
    """Return the unit of an error."""
    return {"landmarks": "%", "shape": "%", "boxes": "% of their area"}.get(kind, "degrees")


def median(results: Results, kind: str, angle: int, way: str, quantile: float = 0.5) -> float:
    """Return a median, or another quantile; NaN of nothing."""
    values = results.get((kind, angle, way))
    return float(np.quantile(values, quantile)) if values else math.nan


def cell(results: Results, kind: str, angle: int, way: str) -> str:
    """Return a cell of a table: median (90 %), or how many are found."""
    if not (values := results.get((kind, angle, way))):
        return ""
    if kind == FOUND:
        return f"{sum(values):.0f} of {len(values)}"
    return "{:.2f} ({:.2f})".format(*(median(results, kind, angle, way, quantile) for quantile in (0.5, 0.9)))


def table(results: Results, ways: Mapping[str, str] = WAYS) -> Iterator[str]:
    """Yield the rows of tables, one for each kind: medians and, in brackets, 90 %."""
    for kind in (*kinds(results), FOUND):
        shown = {way: title for way, title in ways.items() if any((kind, way) == (k, w) for k, _, w in results)}
        yield f"| {kind if kind == FOUND else f'{kind}, {unit(kind)}'} | {' | '.join(shown.values())} |"
        yield "|---" * (1 + len(shown)) + "|"
        for angle in sorted({angle for k, angle, _ in results if k == kind}):
            name = "repeated" if angle == REPEATED else angle
            yield f"| {name} | {' | '.join(cell(results, kind, angle, way) for way in shown)} |"
        yield ""


def sentences(results: Results, most: int = 45) -> Iterator[str]:
    """Yield a sentence for each kind: how many times what the network repeats it is off at an angle up to `most`."""
    words = {"plain": "loses {} in plain crops", "ray": "{} with their ray", "look_at": "with BoxCrop {}"}
    for kind in kinds(results):
        own = median(results, kind, REPEATED, "look_at")
        if angle := max((a for k, a, way in results if (k, way) == (kind, "look_at") and a <= most), default=0):
            off = {way: median(results, kind, angle, way) for way in words if (kind, angle, way) in results}
            parts = (words[way].format(f"{value / max(own, LEAST):.3g} times") for way, value in off.items())
            values = " / ".join(f"{value:.2f}" for value in off.values())
            yield (
                f"{kind}: {', '.join(parts)} at {angle} degrees behind this lens ({values} {unit(kind)}; "
                f"the network itself repeats {own:.2f})"
            )


def plot(axis: Any, results: Results, kind: str) -> None:
    """Draw the medians of a kind over the angle."""
    for (way, label), colour in zip(WAYS.items(), ("#e21d48", "#f59e0b", "#0e7490"), strict=True):
        if angles := sorted(a for k, a, w in results if (k, w) == (kind, way) and a != REPEATED):
            values = [max(LEAST, median(results, kind, a, way)) for a in angles]
            axis.plot(angles, values, "o-", color=colour, label=label)
    own = max(LEAST, median(results, kind, REPEATED, "look_at"))
    axis.axhline(own, color="#64748b", linestyle=":", label="repeated")
    axis.set(xlabel="degrees from the axis", ylabel=f"{kind}, {unit(kind)}")
    if axis.get_ylim()[1] > WIDE * own:
        axis.set_yscale("log")
        axis.yaxis.set_major_formatter("{x:g}")
    else:
        axis.set_ylim(0)
    axis.grid(alpha=0.3)
    axis.legend()


def draw(results: Results, title: str, out: str) -> None:
    """Draw the error over the angle, a panel for each kind."""
    shown = kinds(results)
    figure, axes = plt.subplots(1, len(shown), figsize=(5 * len(shown), 4), layout="constrained", squeeze=False)
    for axis, kind in zip(axes[0], shown, strict=True):
        plot(axis, results, kind)
    figure.suptitle(title, fontsize=10)
    figure.savefig(out, dpi=100)
    plt.close(figure)


def study(predict: Predict, things: Sequence[Photograph], lens: ct.Camera) -> Results:
    """Measure a network behind a lens."""
    results: Results = defaultdict(list)
    for answer in answers(predict, things, lens):
        add(results, answer, errors(answer))
    if not kinds(results):
        raise ValueError("stress_test: predict must find a thing in a photograph, and in a crop; it finds none")
    return results


def loaded(path: str) -> Predict:
    """Return the function `predict` of a file."""
    if not Path(path).is_file():
        raise FileNotFoundError(f"stress_test: predict must be a Python file with a function predict; got {path!r}")
    predict: Predict | None = runpy.run_path(path).get("predict")
    if not callable(predict):
        raise ValueError(f"stress_test: {path} must have a function predict(images); it has none")
    return predict


def main(
    predict: str, images: str, camera: str, fov: float = 30, boxes: str | None = None, out: str | None = None
) -> Results:
    """Measure, print and draw."""
    paths = sorted(path for path in Path(images).glob("*") if path.suffix.lower() in SUFFIXES)
    if not paths:
        raise FileNotFoundError(f"stress_test: images must be a folder of photographs; got {images!r}")
    lens = ct.load(camera).camera if Path(camera).is_file() else ct.lenses.find(camera)
    things = photographs(paths, fov, json.loads(Path(boxes).read_bytes()) if boxes else None)
    results = study(loaded(predict), things, lens.double().requires_grad_(False))
    print("\n".join([*table(results), *sentences(results)]))
    if out:
        draw(results, f"{len(things)} photographs, {fov:g} degrees wide, behind {camera}", out)
    return results


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("predict", help="a Python file with predict(images)")
    parser.add_argument("--images", required=True, help="a folder of photographs")
    parser.add_argument("--camera", required=True, help="a calibration file, or the name of a lens for ct.lenses.find")
    parser.add_argument("--fov", type=float, default=30, help="degrees across a photograph")
    parser.add_argument("--boxes", help="a JSON file of boxes by names of photographs")
    parser.add_argument("-o", "--out", help="a file for the figure")
    main(**vars(parser.parse_args()))
