"""The demo `camtorch demo stereo`: a room seen by two fisheyes, rectified, matched, and measured against the room."""

from __future__ import annotations

import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch
from PIL import Image
from torch import Tensor

from camtorch._drawing import GREY, INK, MARGIN, MIDDLE, PAPER, RIM, Colour, Marks, Sheet, shown
from camtorch.camera import Camera
from camtorch.demo import room
from camtorch.extrinsics import Extrinsics
from camtorch.models import KannalaBrandt, Pinhole
from camtorch.rotations import rotation_matrix
from camtorch.stereo.matching import match
from camtorch.stereo.rectification import Projection, Rectification, rectify

DEGREES, BASELINE = 170, 0.25
_TURNS = ([-0.04, 0.05, 0.02], [0.03, -0.06, -0.03])  # of the two cameras, which nobody mounts straight
_NEAREST = 0.45  # metres from the baseline, what is looked for
_CREAM = (246, 237, 221)
_MARK = (196, 87, 58, 190)
_NEAR_TO_FAR = (INK, (140, 47, 42), (196, 87, 58), (224, 163, 58), _CREAM, (47, 127, 131), (31, 85, 96))


@dataclass
class Pair:
    """What two fisheyes see; images are (3, H, W) uint8."""

    camera: Camera
    """Of both."""
    extrinsics: Extrinsics
    """Right from left."""
    images: tuple[Tensor, Tensor]
    place: room.Place
    """Of the left camera, in the room."""
    rotation: Tensor
    """(3, 3), left camera from room."""


@dataclass
class Study:
    """A pair rectified to one projection, its distances, and the true ones, in metres from the left camera."""

    rectification: Rectification
    images: tuple[Tensor, Tensor]
    points: Tensor
    """(H, W, 3) in the frame of the room, where `known`."""
    known: Tensor
    """(H, W) bool: a disparity was found, in the room."""
    truth: Tensor
    """(H, W) metres, infinite out of the window."""
    error: Tensor
    """(H, W), the part of the distance by which it is off."""
    visible: Tensor
    """(H, W) bool: the left camera sees the room there."""

    @property
    def median(self) -> float:
        """Of the errors, where known."""
        return float(self.error[self.known].median())

    @property
    def share(self) -> float:
        """Of what the left camera sees of the room, that is known."""
        return float(self.known.sum() / self.visible.sum())


def pair(size: int = 960, samples: int = 5) -> Pair:
    """Render both images, of size x size pixels."""
    focal, middle = size / math.radians(DEGREES), (size - 1) / 2
    camera = KannalaBrandt(
        torch.tensor([focal, focal, middle, middle], dtype=torch.float64),
        torch.tensor([0.02, -0.01, 0.003, -0.001], dtype=torch.float64),
        image_size=(size, size),
    ).requires_grad_(False)
    rotations = [rotation_matrix(torch.tensor(turn, dtype=torch.float64)) for turn in _TURNS]
    places = [(side * BASELINE / 2, 0.0, 0.0) for side in (-1.0, 1.0)]
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(2) as pool:
            images = pool.map(
                lambda r, p: room.render(camera, r, place=p, samples=samples, rough=True), rotations, places
            )
            left, right = ((255 * image).round().byte() for image in images)
    finally:
        torch.set_num_threads(threads)
    turn = rotations[1] @ rotations[0].T
    shift = -rotations[1] @ torch.tensor([BASELINE, 0.0, 0.0], dtype=torch.float64)
    extrinsics = Extrinsics.from_matrix(turn, shift).requires_grad_(False)
    return Pair(camera, extrinsics, (left, right), places[0], rotations[0])


@torch.no_grad()
def study(
    seen: Pair, projection: Projection, fov: tuple[float, float], image_size: tuple[int, int] | None = None
) -> Study:
    """Rectify, match by OpenCV, and measure.

    Args:
        seen: the pair.
        projection: as `rectify` takes it.
        fov: (horizontal, vertical) degrees.
        image_size: of the rectified images.
    """
    found = rectify(seen.camera, seen.camera, seen.extrinsics, projection=projection, fov=fov, image_size=image_size)
    left, right = (image[0] for image in found(*(image[None] for image in seen.images)))
    least, most = found.disparity_range(_NEAREST)
    disparity, known = match(found, left, right, least, most)
    points, good = found.disparity_to_points(disparity.double(), known)
    to_room = seen.rotation.T @ found.rotation_left.T
    rays, has_ray = found.camera_left.unproject(found.camera_left.pixel_grid())
    truth = room.distances(rays @ to_room.T, seen.place).double()
    visible = found.left.valid_mask()[0, 0] & has_ray & truth.isfinite()
    error = (points.norm(dim=-1) / truth - 1).abs()
    in_room = points @ to_room.T + torch.tensor(seen.place, dtype=torch.float64)
    return Study(found, (left, right), in_room, good & visible, truth, error, visible)


def run(report: Callable[[str], None] = print, *, size: int = 960, samples: int = 5) -> tuple[Pair, list[Study]]:
    """Study the pair as panoramas about the baseline and as pinhole images, and report a line about each.

    Args:
        report: gets the lines of the table.
        size: of the fisheye images, in pixels.
        samples: rays per pixel.
    """
    seen = pair(size, samples)
    report(f"{'':<24}{'pixels':>12}{'known':>10}{'off by, median':>18}")
    studies = []
    wide: tuple[Projection, tuple[float, float]] = ("latlon", (150.0, 160.0))
    for projection, fov in (wide, ("perspective", (110.0, 100.0))):
        s = study(seen, projection, fov)
        height, width = s.truth.shape
        title = f"{projection}, {fov[0]:.0f} x {fov[1]:.0f} deg"
        report(f"{title:<24}{f'{width}x{height}':>12}{100 * s.share:8.0f} %{100 * s.median:16.2f} %")
        studies.append(s)
    return seen, studies


def drawing(seen: Pair, studies: list[Study]) -> Image.Image:
    """One image: what the fisheyes see, both rectified pairs with rows, distances, errors, and the points."""
    head, band, height = 96, 40, 420
    latlon, perspective = studies
    wide, tall = (round(height * s.truth.shape[1] / s.truth.shape[0]) for s in (perspective, latlon))
    across = 2 * (height + tall) + 3 * MARGIN
    lower = (across - 3 * MARGIN) // 4
    sheet = Sheet(
        across + 2 * MARGIN,
        head + 3 * (band + MARGIN) + 2 * height + round(height * lower / wide),
        "One room, two fisheyes",
    )
    caption = f"{DEGREES} degrees each, {100 * BASELINE:.0f} cm apart, neither mounted straight"
    sheet.text((MARGIN, 62), caption, colour=GREY)

    def put(image: Tensor, x: int, y: int, w: int, h: int, title: str, rows: int = 0) -> int:
        tile = shown(image, h, w)
        if rows:
            marks = Marks(w, h)
            for i in range(1, rows):
                marks.line((0, h * i / rows), (w, h * i / rows), 1.2, _MARK)
            marks.over(tile)
        sheet.text((x, y), title, size=MIDDLE)
        sheet.put(tile, (x, y + band - 10))
        return x + w + MARGIN

    top = head
    x = put(seen.images[0], MARGIN, top, height, height, "left camera")
    x = put(seen.images[1], x, top, height, height, "right camera")
    x = put(latlon.images[0], x, top, tall, height, "rectified, a panorama about the baseline", 12)
    put(latlon.images[1], x, top, tall, height, "", 12)
    top += height + band + MARGIN
    x = put(_distances(latlon), MARGIN, top, tall, height, f"distance, {100 * latlon.share:.0f} % known")
    x = put(_errors(latlon), x, top, tall, height, f"off the truth: {100 * latlon.median:.2f} %, the median")
    rest = sheet.image.width - MARGIN - x
    put(_cloud(latlon, rest, height), x, top, rest, height, "the points, from above and behind the cameras")
    top += height + band + MARGIN
    h = round(height * lower / wide)
    x = put(perspective.images[0], MARGIN, top, lower, h, "rectified, perspective", 9)
    x = put(perspective.images[1], x, top, lower, h, "", 9)
    x = put(_distances(perspective), x, top, lower, h, f"distance, {100 * perspective.share:.0f} % known")
    put(_errors(perspective), x, top, lower, h, f"off the truth: {100 * perspective.median:.2f} %, the median")
    return sheet.image


def _flat(colour: Colour) -> Tensor:
    return torch.tensor(colour[:3])[:, None, None] / 255


def _distances(s: Study) -> Tensor:
    """(3, H, W): near is dark red, far is petrol."""
    away = s.points - torch.tensor([-BASELINE / 2, 0.0, 0.0], dtype=torch.float64)
    place = ((away.norm(dim=-1) - 0.8) / 4.2).clamp(0, 1).float() * (len(_NEAR_TO_FAR) - 1)
    palette = torch.tensor(_NEAR_TO_FAR) / 255
    index = place.long().clamp(max=len(palette) - 2)
    colours = torch.lerp(palette[index], palette[index + 1], (place - index)[..., None]).permute(2, 0, 1)
    return torch.where(s.known, colours, _flat(PAPER))


def _errors(s: Study) -> Tensor:
    """(3, H, W): black is off by 5 % or more."""
    off = (s.error / 0.05).clamp(0, 1).float()
    return torch.where(s.known, torch.lerp(_flat(_CREAM), _flat(INK), off), _flat(RIM))


def _cloud(s: Study, width: int, height: int) -> Tensor:
    """(3, H, W): the points as spots, each with its colour, the ceiling taken off."""
    sharp, reach = 2, 2
    view = Pinhole.from_fov(58, image_size=(sharp * height, sharp * width)).double()
    turn = rotation_matrix(torch.tensor([0.62, 0.0, 0.0], dtype=torch.float64))
    turn = turn @ rotation_matrix(torch.tensor([0.0, 0.18, 0.0], dtype=torch.float64))
    place = torch.tensor([1.15, -4.2, -3.6], dtype=torch.float64)
    use = s.known & (s.points[..., 1] > -1.0) & (s.points[..., 2] > 0.2)
    points = (s.points[use] - place) @ turn.T
    pixels, _ = view.project(points)
    order = points[:, 2].argsort(descending=True)
    colours = (s.images[0].permute(1, 2, 0)[use].float() / 255)[order]
    pixels, far = pixels[order], points[order, 2]
    image = _flat(PAPER).expand(3, sharp * height, sharp * width).clone()
    depth = torch.full((sharp * height, sharp * width), torch.inf, dtype=torch.float64)
    for dy in range(-reach, reach + 1):
        for dx in range(-reach, reach + 1):
            u, v = (pixels[:, 0] + dx).round().long(), (pixels[:, 1] + dy).round().long()
            inside = (u >= 0) & (u < sharp * width) & (v >= 0) & (v < sharp * height)
            at = v[inside] * sharp * width + u[inside]
            nearest = depth.view(-1).scatter_reduce(0, at, far[inside], "amin")
            mine = nearest[at] == far[inside]
            depth = nearest.view_as(depth)
            closer = at[mine]
            image.view(3, -1)[:, closer] = colours[inside][mine].T
    return torch.nn.functional.avg_pool2d(image, sharp)
