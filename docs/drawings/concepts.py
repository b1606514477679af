"""The drawings of the pages on concepts and conventions."""

import math

import torch

import camtorch as ct
from camtorch.poses.rotations import mount_rotation
from drawings.pages import IMAGES
from drawings.svg import BLUE, GREEN, GREY, INK, PALE, PAPER, RED, RIM, VIOLET, Drawing, Point

FORWARD = 0.62, -0.40
"""Where one unit along z goes on paper; x goes to the right, and y down."""


def oblique(point: Point, origin: Point, scale: float) -> tuple[float, float]:
    """Where a point (x, y, z) is drawn."""
    x, y, z = point
    return origin[0] + scale * (x + FORWARD[0] * z), origin[1] + scale * (y + FORWARD[1] * z)


def frame(draw: Drawing, origin: Point, axes: torch.Tensor, scale: float, names: str = "xyz") -> None:
    """Three axes, the columns of (3, 3), red, green and blue."""
    for i, (colour, name) in enumerate(zip((RED, GREEN, BLUE), names, strict=True)):
        end = oblique(axes[:, i].tolist(), origin, scale)
        draw.arrow(origin, end, colour)
        length = math.dist(origin, end)
        place = [b + 22 * (b - a) / length for a, b in zip(origin, end, strict=True)]
        draw.text((place[0], place[1] + 8), name, colour, anchor="middle", bold=True)


def axes() -> Drawing:
    """The camera's frame, and the pixels of an image."""
    draw = Drawing(960, 470)
    origin, scale = (100, 285), 150.0
    near, far, half = 1.9, 3.0, (0.80, 0.55)
    corners = [(sx * half[0], sy * half[1], near) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    shown = [oblique(c, origin, scale) for c in corners]
    for corner in shown:
        draw.line((origin, corner), RIM, 2)
    draw.line(shown, GREY, 2.5, fill="#ffffff", closed=True)
    frame(draw, origin, torch.diag(torch.tensor([0.9, 0.7, 0.95])), scale)
    ray = torch.tensor([0.34, 0.16, near])
    crossing, point = oblique(ray.tolist(), origin, scale), oblique((ray * far / near).tolist(), origin, scale)
    draw.line((origin, crossing), VIOLET, 2, dash="7 7")
    draw.line((crossing, point), VIOLET, 2, dash="7 7")
    draw.arrow(origin, oblique((0.7 * ray).tolist(), origin, scale), VIOLET, 3)
    draw.dot(crossing, VIOLET, 5)
    draw.dot(point, INK, 6)
    draw.text((point[0] - 4, point[1] - 18), "point", INK, 24, anchor="middle")
    draw.text((crossing[0] + 4, crossing[1] + 34), "pixel (u, v)", VIOLET, 24, anchor="middle")
    for end, name, to in (((70, 0), "u", (84, 8)), ((0, 60), "v", (16, 56))):
        draw.arrow(shown[0], (shown[0][0] + end[0], shown[0][1] + end[1]), INK, 2.5)
        draw.text(
            (shown[0][0] + to[0], shown[0][1] + to[1] + (22 if name == "u" else 0)), name, INK, 24, anchor="middle"
        )
    draw.text((30, 42), "The camera's frame", INK, 26, bold=True)
    draw.text((30, 450), "x right, y down, z forward", GREY, 24)

    left, top, cell, rows, columns = 610, 120, 72, 3, 4
    draw.text((540, 42), "Pixels", INK, 26, bold=True)
    width, height = columns * cell, rows * cell
    draw.line(((left, top), (left + width, top), (left + width, top + height), (left, top + height)), INK, 3,
              fill="#ffffff", closed=True)  # fmt: skip
    for i in range(1, columns):
        draw.line(((left + i * cell, top), (left + i * cell, top + height)), RIM, 2)
    for i in range(1, rows):
        draw.line(((left, top + i * cell), (left + width, top + i * cell)), RIM, 2)

    def place(u: float, v: float) -> tuple[float, float]:
        return left + (u + 0.5) * cell, top + (v + 0.5) * cell

    box = [place(*corner) for corner in ((1, 0), (3, 0), (3, 2), (1, 2))]
    draw.line(box, "#b86e00", 4, closed=True)
    for v in range(rows):
        for u in range(columns):
            draw.dot(place(u, v), RED if u == v == 0 else GREY, 5)
    draw.text((left + 6, top + 66), "(0, 0)", RED, 22)
    draw.arrow((left, top - 46), (left + 110, top - 46), INK, 3)
    draw.text((left + 122, top - 38), "u", INK, bold=True)
    draw.arrow((left - 44, top), (left - 44, top + 110), INK, 3)
    draw.text((left - 44, top + 140), "v", INK, anchor="middle", bold=True)
    draw.text((left, top - 12), "-0.5", GREY, 22, anchor="middle")
    draw.text((left + width, top - 12), "W - 0.5", GREY, 22, anchor="middle")
    draw.text((left - 8, top + height + 8), "H - 0.5", GREY, 22, anchor="end")
    draw.text((place(3, 2)[0] - 6, top + height + 30), "box (1, 0, 3, 2)", "#b86e00", 24, anchor="end")
    draw.text((540, 450), "centres whole, edges half", GREY, 24)
    return draw


def motions() -> Drawing:
    """Extrinsics, and the rotation of a warp."""
    draw = Drawing(960, 430)
    draw.text((30, 42), "Extrinsics: camera from world", INK, 26, bold=True)
    world, camera, point = (110, 330), (330, 250), (250, 110)
    upright = torch.tensor([[0.75, 0.0, 0.0], [0.0, -0.75, 0.0], [0.0, 0.0, 0.75]])
    frame(draw, world, upright[:, [0, 2, 1]], 100, names="XYZ")
    turned = mount_rotation(*torch.tensor([-24.0, 0.0, 14.0], dtype=torch.float64)).mT.float()
    frame(draw, camera, 0.75 * turned, 100)
    draw.line((world, point), VIOLET, 2, dash="7 7")
    draw.line((camera, point), VIOLET, 2, dash="7 7")
    draw.dot(point, INK, 6)
    draw.text((point[0], point[1] - 16), "p", INK, anchor="middle", bold=True)
    draw.line((camera, world), INK, 2.5)
    draw.head(camera, (world[0] + 14, world[1] - 5), INK, 3)
    draw.text((236, 276), "t", INK, 26, bold=True)
    draw.text((30, 412), "p_camera = R p_world + t", GREY, 24)

    draw.text((520, 42), "A warp turns rays", INK, 26, bold=True)
    middle = (690.0, 330.0)

    def towards(angle: float, length: float) -> tuple[float, float]:
        """On a map seen from above, the angle to the right of straight ahead."""
        return middle[0] + length * math.sin(math.radians(angle)), middle[1] - length * math.cos(math.radians(angle))

    for yaw, half, length, colour, name, spot in (
        (0, 52, 200, GREY, "source", (-38, 240)),
        (22, 30, 235, BLUE, "target", (12, 250)),
    ):
        arc = [towards(yaw - half + 2 * half * i / 40, length) for i in range(41)]
        draw.line((middle, *arc), colour, 2.5, closed=True, fill="#ffffff" if colour == GREY else "none")
        draw.text(towards(*spot), name, colour, 24, anchor="middle")
        draw.arrow(middle, towards(yaw, 0.62 * length), colour, 3)
    draw.line((middle, towards(40, 270)), VIOLET, 2, dash="7 7")
    draw.dot(towards(40, 270), INK, 6)
    draw.dot(middle, INK, 5)
    draw.text((middle[0] + 138, middle[1] - 60), "one ray,", VIOLET, 24)
    draw.text((middle[0] + 138, middle[1] - 32), "two pixels", VIOLET, 24)
    draw.text((520, 412), "ray_target = R ray_source", GREY, 24)
    return draw


def _panel(draw: Drawing, left: float, top: float, title: str, below: str) -> tuple[float, float]:
    """A titled place of 400 x 320 in which something is drawn; its middle."""
    draw.text((left, top), title, INK, 26, bold=True)
    draw.text((left, top + 352), below, GREY, 24)
    return left + 200, top + 168


def chart_and_lens() -> Drawing:
    """From rays to pixels in three steps, with the fold."""
    camera = ct.KannalaBrandt(
        torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64),
        torch.tensor([-0.05, -0.03, 0.0, 0.0], dtype=torch.float64),
    ).requires_grad_(False)
    angles = torch.linspace(0, math.pi, 4001, dtype=torch.float64)
    rays = torch.stack((angles.sin(), 0 * angles, angles.cos()), -1)
    pixels, valid = camera.project(rays)
    fold, most = float(angles[valid][-1]), float(pixels[valid][-1, 0])

    draw = Drawing(960, 820)
    x, y = _panel(draw, 40, 46, "1  Rays", "theta, from the axis")
    centre, radius = (x, y + 90), 175
    draw.line([(centre[0] + radius * math.sin(a), centre[1] - radius * math.cos(a)) for a in
               (math.radians(d) for d in range(-110, 111, 4))], RIM, 2)  # fmt: skip
    for degrees in range(-105, 106, 15):
        a = math.radians(degrees)
        end = centre[0] + radius * math.sin(a), centre[1] - radius * math.cos(a)
        good = abs(a) < fold
        draw.line((centre, end), BLUE if good else RIM, 2.5, dash="" if good else "6 6")
        draw.dot(end, BLUE if good else GREY, 5, fill=None if good else PAPER)
    draw.dot(centre, INK, 6)

    def disc(where: Point, r: float, colour: str, fill: str = "none", dash: str = "") -> None:
        around = [(where[0] + r * math.cos(t), where[1] + r * math.sin(t)) for t in torch.arange(0, 6.28, 0.1).tolist()]
        draw.line(around, colour, 2.5, fill=fill, closed=True, dash=dash)

    def lattice(where: Point, scale: float, lens: bool) -> None:
        """A square lattice of the chart's plane, through the lens or not, as far as it is valid."""
        steps = torch.arange(-7, 8, dtype=torch.float64) * 0.25
        along = torch.linspace(-fold, fold, 61, dtype=torch.float64)
        for k in steps.tolist():
            for turn in (False, True):
                plane = torch.stack((along, torch.full_like(along, k)), -1)
                plane = plane.flip(-1) if turn else plane
                theta = plane.norm(dim=-1)
                inside = theta < fold
                if lens:
                    ray = torch.cat((plane * (theta.sin() / theta.clamp(min=1e-12))[:, None], theta.cos()[:, None]), -1)
                    plane = camera.project(ray)[0]
                line = [(where[0] + scale * a, where[1] + scale * b) for a, b in plane[inside].tolist()]
                if len(line) > 1:
                    draw.line(line, BLUE, 1.3)

    scale = 150 / fold
    where = _panel(draw, 530, 46, "2  Chart: rays to a plane", "here equidistant: r = theta")
    disc(where, 150, GREY, "#ffffff", "7 7")
    lattice(where, scale, False)
    where = _panel(draw, 40, 442, "3  Lens: the plane bent", "up to the fold, where r turns back")
    disc(where, scale * most, RED, "#ffffff")
    lattice(where, scale, True)
    draw.text((where[0] + 0.8 * scale * most + 14, where[1] - 0.6 * scale * most), "fold", RED, 26)
    where = _panel(draw, 530, 442, "4  Pixels: focal length, centre", "grey: pixels that no ray has")
    half = (185.0, 120.0)
    corners = [(where[0] + sx * half[0], where[1] + sy * half[1]) for sx, sy in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
    draw.line(corners, INK, 2.5, fill="#d9d4ca", closed=True)
    off = where[0] + 14, where[1]
    disc(off, scale * most, RED, "#ffffff")
    lattice(off, scale, True)
    draw.line(corners, INK, 2.5, closed=True)
    for start, end in (((452, 210), (512, 210)), ((452, 606), (512, 606))):
        draw.arrow(start, end, INK, 4)
    draw.arrow((512, 376), (452, 420), INK, 4)
    return draw


def valid() -> Drawing:
    """The radius over the angle up to the fold, and past it."""
    draw = Drawing(960, 440)
    camera = ct.BrownConrady(
        torch.tensor([1.0, 1.0, 0.0, 0.0], dtype=torch.float64), torch.tensor([-0.25, 0, 0, 0], dtype=torch.float64)
    ).requires_grad_(False)
    degrees = torch.arange(0, 72.01, 0.25, dtype=torch.float64)
    t = degrees.deg2rad().tan()
    formula = t * (1 - 0.25 * t**2)
    ray = torch.stack((t, 0 * t, torch.ones_like(t)), -1)
    good = camera.project(ray)[1]
    last = int(good.nonzero()[-1])
    left, bottom, across, up = 90, 350, 10.8, 330.0

    def place(d: float, r: float) -> tuple[float, float]:
        return left + across * d, bottom - up * r

    end = degrees[last].item()
    draw.line((place(0, 0), place(end, 0), place(end, 0.93), place(0, 0.93)), PAPER, 0, fill=PALE, closed=True)
    draw.line((place(0, 0.97), place(0, 0), place(78, 0)), INK, 2.5)
    for angle in (0, 30, 60):
        draw.text((place(angle, 0)[0], bottom + 32), f"{angle}°", INK, 24, anchor="middle")
    draw.text((place(78, 0)[0], bottom + 32), "angle", GREY, 24, anchor="end")
    draw.text((left - 14, place(0, 0.9)[1]), "r", GREY, 26, anchor="end")
    curve = [place(d, r) for d, r in zip(degrees.tolist(), formula.tolist(), strict=True)]
    shown = [i for i, (_, y) in enumerate(curve) if y < bottom + 1 and y > 20]
    draw.line([curve[i] for i in shown if i <= last], BLUE, 5)
    draw.line([curve[i] for i in shown if i >= last], GREY, 3, dash="9 9")
    level = 0.55
    crossings = [i for i in range(1, len(curve)) if (formula[i] - level) * (formula[i - 1] - level) < 0]
    first, second = crossings[0], crossings[1]
    draw.line((place(0, level), place(degrees[second].item(), level)), VIOLET, 2, dash="5 6")
    draw.dot(curve[first], BLUE, 8)
    draw.dot(curve[second], GREY, 8, fill=PAPER)
    draw.dot(curve[last], RED, 8)
    draw.text((curve[last][0] + 2, curve[last][1] - 22), "fold", RED, 26, anchor="middle")
    draw.text((left + 22, place(0, 0.86)[1]), "valid", INK, 26, bold=True)
    for i, words in enumerate(("another ray:", "the formula gives", "the same pixel;", "not valid")):
        draw.text((curve[second][0] + 36, place(0, level)[1] - 44 + 30 * i), words, GREY, 24)
    draw.text((left + 22, place(0, level)[1] - 12), "one pixel", VIOLET, 24)
    return draw


TITLES = {
    "axes": (axes, "The camera's frame: x right, y down, z forward. Pixels: the centre of the top left one is (0, 0)"),
    "motions": (motions, "Extrinsics take points from the world to the camera; the rotation of a warp turns rays"),
    "chart-and-lens": (chart_and_lens, "Rays, their chart on a plane, the lens that bends it up to a fold, and pixels"),
    "valid": (valid, "The radius over the angle, valid up to the fold"),
}


def main(names: list[str]) -> None:
    """Make all drawings, or some."""
    folder = IMAGES / "concepts"
    folder.mkdir(exist_ok=True)
    for name, (draw, title) in TITLES.items():
        if not names or name in names:
            draw().save(folder / f"{name}.svg", title)
