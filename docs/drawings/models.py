"""One image for each camera model: a room, a cube of lines and the radius over the angle, through a calibration."""

import math

import matplotlib
import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from PIL import Image, ImageDraw, ImageFont
from scenes import room

import camtorch as ct
from camtorch.plot.figures import COLOURS, GREY, INK, NO_RAYS
from camtorch.rays.lattices import followed, image_lattice
from drawings.pages import IMAGES, code, sections
from drawings.sheets import GAP, WIDTH, drawn
from drawings.svg import PAPER, RIM

PANEL, STRIP = (348, 460), 300
"""Pixels: of the upper panels (height, width), of the lower one."""
CELLS = 8  # of a face of the cube, along each side
FACES = {2: (COLOURS[0], COLOURS[1]), 0: (COLOURS[2], COLOURS[2]), 1: (COLOURS[3], COLOURS[3])}
"""Axis: colours of the face at +1 and of that at -1."""
MOST = 180, 3.3  # degrees and focal lengths that a curve's panel shows


def cameras() -> dict[str, ct.Camera]:
    """Model -> the camera that the gallery makes of it, in the gallery's order."""
    made = {}
    for title, text in sections("models.md").items():
        names: dict = {}
        exec(code(text), names)
        made[title] = names["camera"].double().requires_grad_(False)
    return made


def fitted(camera: ct.Camera, height: int, width: int) -> ct.Camera:
    """The camera of the same image, as large as fits."""
    scale = min(height / camera.height, width / camera.width)
    return camera.resize(round(scale * camera.height), round(scale * camera.width))


@torch.no_grad()
def rendered(camera: ct.Camera, samples: int) -> tuple[torch.Tensor, torch.Tensor]:
    """The room (3, H, W) as a camera sees it, and (H, W) bool, where it has rays.

    The renderer leaves out pixels of which a corner has none, as at the ends of a panorama: those have one ray here.
    """
    image = room.render(camera, samples=samples)
    whole = camera.unproject(camera.crop(0, 0, camera.height + 1, camera.width + 1).pixel_grid() - 0.5)[1]
    rays, seen = camera.rays()
    rest = seen & ~(whole[1:, 1:] & whole[1:, :-1] & whole[:-1, 1:] & whole[:-1, :-1])
    image[:, rest] = room.radiance(rays[rest].float()).T
    return image, seen


@torch.no_grad()
def room_image(camera: ct.Camera, samples: int = 8) -> Image.Image:
    """The room as the camera sees it, paper where it has no rays."""
    image, seen = rendered(camera, samples)
    paper = torch.tensor([int(PAPER[i : i + 2], 16) / 255 for i in (1, 3, 5)])[:, None, None]
    image = torch.where(seen, image, paper)
    return Image.fromarray((image * 255).round().byte().permute(1, 2, 0).numpy())


@torch.no_grad()
def cube(ax: Axes, camera: ct.Camera) -> None:
    """Lines on the faces of a cube around the camera."""
    height, width = camera.height, camera.width
    along = torch.linspace(-1, 1, 401, dtype=torch.float64)
    steps = torch.linspace(-1, 1, CELLS + 1, dtype=torch.float64)
    valid = camera.unproject(image_lattice(camera, 300, 400))[1]
    shade = np.ma.masked_array(np.ones(valid.shape), valid.numpy())
    edges = (-0.5, width - 0.5, height - 0.5, -0.5)
    colour = matplotlib.colors.ListedColormap([NO_RAYS])
    ax.imshow(shade, extent=edges, cmap=colour, interpolation="nearest", aspect="auto")
    for axis in (2, 0, 1):
        first, second = (i for i in range(3) if i != axis)
        for side, hue in zip((1, -1), FACES[axis], strict=True):
            for moving, still in ((first, second), (second, first)):
                points = torch.empty(len(steps), len(along), 3, dtype=torch.float64)
                points[..., axis], points[..., moving], points[..., still] = side, along, steps[:, None]
                pixels, there = camera.project(points)
                # a line that leaves a panorama on one side comes back on the other
                jump = (pixels.diff(dim=1).norm(dim=-1, p=torch.inf) > 0.2 * max(height, width)).nonzero()
                pixels[~there] = torch.nan
                pixels[jump[:, 0], jump[:, 1]] = torch.nan
                for i, line in enumerate(pixels):
                    strong = i in (0, CELLS)
                    ax.plot(*line.T, color=hue, linewidth=1.6 if strong else 0.9, solid_capstyle="butt")
    ax.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5))


@torch.no_grad()
def curves(camera: ct.Camera) -> tuple[list[tuple[np.ndarray, np.ndarray, np.ndarray, str]], float]:
    """Radius over angle, and the largest angle that the image has: lists of angles, least, greatest radius and name.

    In focal lengths on the axis: every curve begins with the slope 1. Panoramas have one curve across and one down.
    """
    angles = torch.linspace(0, math.pi, 721, dtype=torch.float64)
    pixels, valid = followed(camera, angles, 32)
    slope = camera.project(torch.tensor([[1e-4, 0, 1], [0, 1e-4, 1]], dtype=torch.float64))[0] - camera.intrinsics[2:]
    focal = slope.abs().amax(0) / 1e-4
    radius = torch.linalg.vector_norm((pixels - camera.intrinsics[2:]) / focal, dim=-1)
    rays, seen = camera.unproject(image_lattice(camera, 129, 129))
    farthest = float(torch.atan2(rays[..., :2].norm(dim=-1), rays[..., 2])[seen].max().rad2deg())
    if type(camera) in (ct.Equirectangular, ct.LatLon, ct.Cylindrical, ct.TransverseCylindrical):
        found = []
        for i, name in ((0, "across"), (1, "down")):
            rays = torch.zeros(len(angles), 3, dtype=torch.float64)
            rays[:, i], rays[:, 2] = angles.sin(), angles.cos()
            pixels, valid = camera.project(rays)
            line = ((pixels - camera.intrinsics[2:]) / focal).norm(dim=-1)
            # past a pole the pixel is elsewhere
            some = valid & (line.diff(prepend=line[:1]).abs() < 1)
            some = some.long().cumprod(0).bool()
            line = line[some].numpy()
            found.append((angles[some].rad2deg().numpy(), line, line, name))
        return found, farthest
    some = valid.any(-1)
    low = torch.where(valid, radius, torch.inf).amin(-1)[some].numpy()
    high = torch.where(valid, radius, -torch.inf).amax(-1)[some].numpy()
    return [(angles[some].rad2deg().numpy(), low, high, "")], farthest


def curve(ax: Axes, camera: ct.Camera) -> None:
    """The radius over the angle, against a pinhole and an equidistant camera."""
    found, farthest = curves(camera)
    ax.axvspan(0, farthest, color="#ece3d2", linewidth=0)
    angles = np.linspace(0, 89, 500)
    ax.plot(angles, np.tan(np.radians(angles)), "--", color=GREY, linewidth=1.6)
    ax.plot([0, 180], [0, math.pi], ":", color=GREY, linewidth=2)
    words = {"fontsize": 17, "color": GREY, "va": "center"}
    ax.text(75, 3.0, "pinhole", **words)
    ax.text(168, 3.15, "equidistant", ha="right", **words)
    for i, (degrees, low, high, name) in enumerate(found):
        middle, colour = (low + high) / 2, COLOURS[2 * i]
        ax.fill_between(degrees, low, high, color=colour, alpha=0.35, linewidth=0)
        ax.plot(degrees, middle, color=colour, linewidth=3.2)
        if middle[-1] < MOST[1]:
            ax.plot(degrees[-1], middle[-1], "o", color=colour, markersize=10, clip_on=False)
        if name:
            ax.text(100, (0.95, 0.45)[i], name, fontsize=19, color=colour)
    ax.set(xlim=(0, MOST[0]), ylim=(0, MOST[1]), xticks=range(0, 181, 30), yticks=range(4))
    ax.set_xticklabels([f"{angle}°" for angle in range(0, 181, 30)])
    ax.tick_params(labelsize=19, colors=INK, length=5)
    ax.spines[["top", "right"]].set_visible(False)
    ax.set_facecolor(PAPER)


def image_of(camera: ct.Camera) -> Image.Image:
    """The image of one camera."""
    height, width = PANEL
    total = height + STRIP + 3 * GAP
    small = fitted(camera, height, width)
    figure = plt.figure(figsize=(WIDTH / 100, total / 100), dpi=100, facecolor=PAPER)
    left = WIDTH - GAP - width + (width - small.width) // 2
    top = GAP + (height - small.height) // 2
    ax = figure.add_axes(
        (left / WIDTH, 1 - (top + small.height) / total, small.width / WIDTH, small.height / total), facecolor="white"
    )
    cube(ax, small)
    ax.set(xticks=[], yticks=[])
    ax.spines[:].set_color(RIM)
    side = 56
    curve(figure.add_axes((side / WIDTH, 44 / total, (WIDTH - side - 40) / WIDTH, (STRIP - 40) / total)), camera)
    sheet = drawn(figure)
    sheet.paste(room_image(small), (GAP + (width - small.width) // 2, top))
    return sheet


def overview(made: dict[str, ct.Camera]) -> Image.Image:
    """All of them, small."""
    height, width, gap, band, columns = 150, 200, 12, 28, 4
    rows = -(-len(made) // columns)
    sheet = Image.new("RGB", (columns * (width + gap) + gap, rows * (height + band + gap) + gap), PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=18)
    for i, (name, camera) in enumerate(made.items()):
        left, top = gap + i % columns * (width + gap), gap + i // columns * (height + band + gap)
        small = fitted(camera, height, width)
        sheet.paste(room_image(small), (left + (width - small.width) // 2, top + band + (height - small.height) // 2))
        draw.text((left + width / 2, top), name, INK, font, anchor="ma")
    return sheet


def main(names: list[str]) -> None:
    """Make the images of all models, or of some."""
    folder = IMAGES / "models"
    folder.mkdir(exist_ok=True)
    made = cameras()
    for camera in made.values():
        if not names or camera.key in names:
            image_of(camera).save(folder / f"{camera.key}.jpg", quality=80, optimize=True)
    if not names or "all" in names:
        overview(made).save(folder / "all.jpg", quality=60, optimize=True)
