"""The demo `camtorch demo`: a room seen through five lenses, dewarped, and measured against what it should be."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from PIL import Image
from torch import Tensor

from camtorch._drawing import GREY, INK, MARGIN, MIDDLE, PAPER, POINT, Colour, Marks, Sheet, shown
from camtorch.camera import Camera
from camtorch.demo import room
from camtorch.models import BrownConrady, Fisheye62, Fisheye624, KannalaBrandt, Pinhole
from camtorch.warp.dewarp import Dewarp


@dataclass
class Study:
    """What one lens sees, what a `Dewarp` makes of it, and what it should have made; images are (3, H, W)."""

    title: str
    warp: Dewarp
    source: Tensor
    dewarped: Tensor
    direct: Tensor
    valid: Tensor
    """(H, W) bool: the source saw this pixel."""
    psnr: float
    """dB of `dewarped` against `direct`, over valid pixels."""
    bend_before: float
    bend_after: float
    """Rms distance in px of edges, found in the image, from straight lines; `lines` is their number."""
    lines: int
    shift: float
    """Distance in px by which `dewarped` lies beside `direct`, found in the images."""
    keypoints: tuple[Tensor, Tensor]
    """Corners of the room in the source, and where the warp moves them: (N, 2) each."""
    keypoint_error: float
    """The largest distance in px between a corner moved by the warp and the corner's true place."""


@dataclass
class DemoCamera:
    """A camera to demonstrate, and how its image is dewarped."""

    title: str
    camera: Camera
    degrees: float
    """Horizontal field of view of the target."""
    size: tuple[int, int]
    """(height, width) of the target."""
    pitch: float = 0.0
    roll: float = 0.0
    """How the camera hangs in the room, in degrees; the target is level."""


def lenses(height: int = 640) -> list[DemoCamera]:
    """The five lenses, with images of about that height in pixels."""

    def camera(
        model: type[Camera],
        size: tuple[int, int],
        intrinsics: list[float],
        *distortion: list[float],
        rows: int = height,
    ) -> Camera:
        values = [torch.tensor(v, dtype=torch.float64) for v in (intrinsics, *distortion)]
        whole = model(*values, image_size=size)
        return whole.requires_grad_(False).resize(rows, round(rows * size[1] / size[0]))

    # Brown-Conrady: the middle of a car's front camera, rational. Kannala-Brandt: a surround-view camera, 190 degrees
    # wide. The fisheyes are Project Aria's left SLAM camera, as calibrated in the factory's test and online.
    front = [0.5321, 0.0347, 0.00031, -0.00022, 0.00051, 0.8874, 0.1378, 0.00612, 0.00083, -0.00011, -0.00062, 9e-05]
    middle = [1109.62, 1111.07, 953.41, 707.88]
    surround = [-0.0237, 0.0041, -0.0029, 0.0006]
    aria = [-0.02689165420917155, 0.1019919163316408, -0.07180862612716554, 0.01245898233008245, 0.001242086400994195]
    aria += [-0.0004149914187376608, 0.0005499786009926172, 0.0005819661606400815]
    online = [-0.025480309501290002, 0.09820848703384401, -0.06668509542942, 0.009074256755411, 0.002338790334761]
    online += [-0.000557322637178, 0.000256432715104, -7.223937245e-06]
    online += [-0.000471561448648, -5.8604848163e-05, -0.000441436044638, -0.000137118462589]
    size = round(height * 33 / 64), round(height * 44 / 64)
    rows = round(height * 0.75)
    return [
        DemoCamera(
            "Pinhole, tilted", camera(Pinhole, (480, 640), [331.0, 331.0, 319.5, 239.5]), 70, size, pitch=-9, roll=7
        ),
        DemoCamera("Brown-Conrady", camera(BrownConrady, (1424, 1900), middle, front, rows=rows), 88, size),
        DemoCamera(
            "Kannala-Brandt", camera(KannalaBrandt, (1280, 1920), [561.8, 562.4, 957.3, 644.6], surround), 100, size
        ),
        DemoCamera(
            "Fisheye62", camera(Fisheye62, (480, 640), [242.0503, 242.0503, 319.8053, 240.9679], aria), 90, size
        ),
        DemoCamera(
            "Fisheye624", camera(Fisheye624, (480, 640), [241.3653, 241.3653, 319.0837, 239.8876], online), 95, size
        ),
    ]


@torch.no_grad()
def study(lens: DemoCamera, samples: int = 6) -> Study:
    """Render, dewarp and measure one lens: `samples` rays per pixel of the source, twice as many of the truth."""
    to_camera = _rotation(lens.pitch, lens.roll)
    warp = Dewarp(lens.camera, fov=lens.degrees, image_size=lens.size, rotation=to_camera.T)
    source = room.render(warp.source, to_camera, samples=samples)
    direct = room.render(warp.target, samples=2 * samples)
    dewarped = warp(source[None])[0]
    valid = warp.valid_mask()[0, 0]
    valid = valid & _away_from_rim(valid)
    error = (dewarped - direct)[:, valid].square().mean()
    edges = _edges(room.lines(), (source, warp.source, to_camera), (dewarped, warp.target, torch.eye(3).double()))
    points = room.keypoints()
    points = points[room.visible(points)]
    pixels, seen = warp.source.project(points @ to_camera.T)
    truth, _ = warp.target.project(points)
    moved, mapped = warp.transform_points(pixels)
    use = seen & mapped & warp.source.contains(pixels)
    return Study(
        lens.title,
        warp,
        source,
        dewarped,
        direct,
        valid,
        psnr=-10 * math.log10(float(error)),
        bend_before=_bend(edges[0]),
        bend_after=_bend(edges[1]),
        lines=len(edges[1]),
        shift=_shift(dewarped, direct, valid),
        keypoints=(pixels[use], moved[use]),
        keypoint_error=float((moved - truth)[use].norm(dim=-1).max()),
    )


def run(report: Callable[[str], None] = print, *, height: int = 640, samples: int = 6) -> list[Study]:
    """Study the five lenses, and report a line about each as it is done.

    Args:
        report: gets the lines of the table.
        height: of the sources, in pixels.
        samples: rays per pixel of the sources; see `study`.
    """
    report(
        f"{'':<20}{'PSNR':>10}{'edges bent by':>16}{'after dewarping':>17}{'shifted by':>13}{'keypoints off by':>18}"
    )
    # A thread for each lens keeps the cores busier than many threads on one chunk of rays
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        with ThreadPoolExecutor(min(os.cpu_count() or 1, 5)) as pool:
            studies = []
            for s in pool.map(lambda lens: study(lens, samples), lenses(height)):
                studies.append(s)
                numbers = f"{s.psnr:7.1f} dB{s.bend_before:13.2f} px{s.bend_after:14.2f} px{s.shift:10.3f} px"
                report(f"{s.title:<20}{numbers}{s.keypoint_error:15.0e} px")
    finally:
        torch.set_num_threads(threads)
    return studies


def drawing(studies: list[Study]) -> Image.Image:
    """One image: each study's source, dewarped image, and tenfold difference from the truth."""
    band, head = 44, 96
    height, width = studies[0].dewarped.shape[-2:]
    widest = max(round(height * s.source.shape[-1] / s.source.shape[-2]) for s in studies)
    columns = MARGIN, 2 * MARGIN + widest, 3 * MARGIN + widest + width
    whole = head + len(studies) * (height + band + MARGIN) + MARGIN // 2
    sheet = Sheet(widest + 2 * width + 4 * MARGIN, whole, "One room, five lenses")
    captions = "what the lens sees", "dewarped, dots moved by the same warp", "off the true view, tenfold"
    for x, text in zip(columns, captions, strict=True):
        sheet.text((x, 66), text, colour=GREY)
    for row, s in enumerate(studies):
        top = head + row * (height + band + MARGIN)
        sheet.text((columns[0], top + 10), s.title, size=MIDDLE)
        numbers = f"PSNR {s.psnr:.1f} dB     edges bent by {s.bend_before:.2f} px, now by {s.bend_after:.2f} px"
        sheet.text((columns[1], top + 13), numbers)
        off = (10 * (s.dewarped - s.direct).abs().mean(0) * s.valid).clamp(max=1)
        difference = torch.lerp(_flat(PAPER), _flat(INK), off)
        marked = (s.source, s.keypoints[0]), (s.dewarped, s.keypoints[1]), (difference, s.keypoints[0][:0])
        for x, (content, points) in zip(columns, marked, strict=True):
            scale = height / content.shape[-2]
            image = shown(content, height, round(content.shape[-1] * scale))
            marks = Marks(image.width, height, scale)
            for at in points.tolist():
                marks.circle(at, 1.5, fill=POINT)
            marks.over(image)
            sheet.put(image, (x + (widest - image.width) // 2 * (x == columns[0]), top + band))
    return sheet.image


def _flat(colour: Colour) -> Tensor:
    return torch.tensor(colour)[:, None, None] / 255


def _rotation(pitch: float, roll: float) -> Tensor:
    """(3, 3) camera from room, of a camera that looks up by `pitch` and leans right by `roll` degrees."""
    a, b = math.radians(pitch), math.radians(roll)
    up = torch.tensor([[1, 0, 0], [0, math.cos(a), math.sin(a)], [0, -math.sin(a), math.cos(a)]], dtype=torch.float64)
    lean = torch.tensor([[math.cos(b), math.sin(b), 0], [-math.sin(b), math.cos(b), 0], [0, 0, 1]], dtype=torch.float64)
    return lean @ up


def _away_from_rim(valid: Tensor) -> Tensor:
    """Not beside an invalid pixel: there the interpolation mixes in the black around the image."""
    near = F.max_pool2d((~valid)[None, None].float(), 3, stride=1, padding=1)
    return near[0, 0] == 0


# -- measuring in images


def _look(image: Tensor, pixels: Tensor) -> Tensor:
    """(..., 3) colours of an image (3, H, W) at pixels (..., 2), bilinear."""
    height, width = image.shape[-2:]
    grid = (2 * pixels + 1) / pixels.new_tensor([width, height]) - 1
    colours = F.grid_sample(
        image[None].to(pixels.dtype), grid.reshape(1, 1, -1, 2), padding_mode="border", align_corners=False
    )
    return colours[0, :, 0].T.reshape(*pixels.shape[:-1], 3)


_REACH = 3.0  # px to either side in which an edge is sought
_STEPS = torch.linspace(-_REACH, _REACH, 49, dtype=torch.float64)


def _across(image: Tensor, pixels: Tensor, normal: Tensor) -> tuple[Tensor, Tensor]:
    """Where on the normal (N, 2) through each pixel (N, 2) the colour changes, in px, and whether it does at all."""
    offset = pixels.new_zeros(len(pixels))
    for _ in range(4):
        at = pixels + offset[:, None] * normal
        colours = _look(image, at[:, None] + _STEPS[:, None] * normal[:, None])
        change = colours[:, -1] - colours[:, 0]
        contrast = change.norm(dim=-1)
        step = ((colours[:, 1:] - colours[:, :-1]) @ (change / contrast.clamp(min=1e-6)[:, None])[..., None])[..., 0]
        step = step.clamp(min=0)
        middle = (_STEPS[1:] + _STEPS[:-1]) / 2
        offset = offset + (step * middle).sum(-1) / step.sum(-1).clamp(min=1e-6)
    flat = step[:, (middle.abs() > 2)].sum(-1) < 0.1 * contrast
    return offset, (contrast > 0.12) & flat & (offset.abs() < 2)


def _edges(lines: Tensor, *views: tuple[Tensor, Camera, Tensor]) -> list[list[Tensor]]:
    """For every view, the points (N, 2) found on each line; all views use the same places in the room."""
    share = torch.linspace(0.02, 0.98, 160, dtype=torch.float64)[:, None]
    found: list[list[Tensor]] = [[] for _ in views]
    for start, end in lines:
        points = start + share * (end - start)
        use = room.visible(points)
        places = []
        for image, camera, rotation in views:
            pixels, valid = camera.project(points @ rotation.T)
            ahead, _ = camera.project((points + 1e-3 * (end - start)) @ rotation.T)
            along = F.normalize(ahead - pixels, dim=-1)
            normal = torch.stack((-along[:, 1], along[:, 0]), -1)
            inner = camera.crop(8, 8, camera.height - 16, camera.width - 16).contains(pixels - 8)
            offset, clear = _across(image, pixels, normal)
            use = use & valid & inner & clear
            places.append(pixels + offset[:, None] * normal)
        length = (places[-1][use].amax(0) - places[-1][use].amin(0)).norm() if use.any() else 0
        if use.sum() >= 20 and length > 60:
            for kept, place in zip(found, places, strict=True):
                kept.append(place[use])
    return found


def _bend(lines: list[Tensor]) -> float:
    """Rms distance in px of points from the straight line that fits those of their line best."""
    squares = [torch.linalg.svdvals(points - points.mean(0))[1] ** 2 for points in lines]
    return math.sqrt(float(sum(squares)) / sum(map(len, lines)))


def _shift(image: Tensor, truth: Tensor, valid: Tensor) -> float:
    """The length in px of the shift that explains best how an image differs from the truth, to first order."""
    along = [(truth.roll(-1, axis) - truth.roll(1, axis)) / 2 for axis in (2, 1)]
    inner = valid.clone()
    inner[[0, -1]], inner[:, [0, -1]] = False, False
    slopes = torch.stack([slope[:, inner].flatten() for slope in along], -1)
    difference = (truth - image)[:, inner].flatten()
    return float(torch.linalg.solve(slopes.T @ slopes, slopes.T @ difference).norm())
