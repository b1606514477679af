"""The images of the guides."""

import functools
import json
import math
import tempfile

import cv2
import matplotlib.pyplot as plt
import numpy as np
import torch
from photographs import fisheye, photograph
from PIL import Image, ImageDraw
from scenes import room
from scenes.exposure import expose
from scenes.portrait import driver

import camtorch as ct
from camtorch.augment.sample import Sample
from camtorch.boards.boards import Chessboard
from camtorch.poses.rotations import mount_rotation
from drawings.marks import INK, PAPER, POINT, RIM, font, marked, shown
from drawings.pages import EXAMPLES, IMAGES
from drawings.sheets import drawn, in_rows, tiles

SEED = 4
PAGE = [value / 255 for value in PAPER]  # as matplotlib has colours


def rendered(lens: ct.Camera | None = None) -> Sample:
    """A driver with labels, behind a lens."""
    found = driver(lens)
    labels = {"keypoints": found.keypoints, "boxes": found.boxes, "points": found.eyes, "gaze": found.gaze}
    valid = {"keypoints_valid": found.camera.contains(found.keypoints)}
    return {"image": found.image, "camera": found.camera, **labels, **valid}


def moved(before: Sample, warp: ct.Warp) -> Sample:
    """An image with its labels, warped."""
    keypoints, keypoints_valid = warp.transform_points(before["keypoints"])
    boxes, boxes_valid = warp.transform_boxes(before["boxes"])
    return {
        "image": warp(before["image"][None])[0],
        "camera": warp.target,
        "keypoints": keypoints,
        "keypoints_valid": keypoints_valid,
        "boxes": boxes,
        "boxes_valid": boxes_valid,
        "points": warp.transform_rays(before["points"]),
        "gaze": warp.transform_rays(before["gaze"]),
    }


def overview(columns: int = 4) -> Image.Image:
    """A fisheye image, dewarped, and as other cameras would have seen it."""
    lens = ct.KannalaBrandt.from_fov(170, image_size=(480, 640), distortion=[0.02, -0.01, 0.003, -0.001])
    fisheye = rendered(lens.double().requires_grad_(False))
    straight = moved(fisheye, ct.Dewarp(fisheye["camera"], fov=100, image_size=(480, 640)))
    mount = {"yaw": 12, "pitch": 8, "roll": 20}
    new = ct.augment.RandomCamera("dms90", **mount, fov="source", min_filled=0.98, image_size=(480, 640))
    sample = {"keypoints": fisheye["keypoints"].expand(2, -1, -1), "camera": fisheye["camera"]}
    sample = new(sample, draw=new.draw(2, torch.Generator().manual_seed(SEED)))
    warps = [ct.Warp(fisheye["camera"], c, r) for c, r in zip(sample["camera"], sample["rotation"], strict=True)]
    others = [moved(fisheye, warp) for warp in warps]
    panels = [
        (fisheye, "a fisheye of 170 degrees"),
        (straight, "dewarped"),
        *((other, "another lens and mount") for other in others),
    ]
    return labelled(panels, columns)


def moving(frames: int = 36) -> list[Image.Image]:
    """Return a loop: the image of a fisheye, and of a camera whose k1 and yaw go to and fro, with its labels."""
    lens = ct.KannalaBrandt.from_fov(190, image_size=(720, 960), distortion=[0.02, -0.01, 0.003, -0.001])
    fisheye = rendered(lens.double().requires_grad_(False))
    sheets, left = [], (marked(fisheye, 300, 400), "a driver by a fisheye of 190 degrees")
    for angle in torch.linspace(0, 2 * torch.pi, frames + 1)[:-1].tolist():
        sliders = {"k1": (0.12 - 0.16 * math.cos(angle), -0.04, 0.28), "yaw": (25 * math.sin(angle), -25.0, 25.0)}
        k1, yaw = (value for value, _, _ in sliders.values())
        target = ct.KannalaBrandt([270.0, 270.0, 319.5, 239.5], [k1, 0.0, 0.0, 0.0], image_size=(480, 640))
        turn = mount_rotation(*torch.tensor([yaw, 0.0, 0.0], dtype=torch.float64))
        view = moved(fisheye, ct.Warp(fisheye["camera"], target.double().requires_grad_(False), turn))
        sheet = in_rows([left, (marked(view, 300, 400), "ct.Warp: image and labels by any other camera")], 2)
        sheets.append(Image.new("RGB", (sheet.width, sheet.height + 34), PAPER))
        sheets[-1].paste(sheet, (0, 0))
        draw, y = ImageDraw.Draw(sheets[-1]), sheet.height + 8
        for x, (name, (value, least, most)) in zip(
            (left[0].width + 32, left[0].width + 232), sliders.items(), strict=True
        ):
            knob = x + 50 + 120 * (value - least) / (most - least)
            draw.text((x, y - 10), name, INK, font(18))
            draw.line((x + 50, y, x + 170, y), RIM, 4)
            draw.ellipse((knob - 8, y - 8, knob + 8, y + 8), POINT)
    return sheets


def labelled(panels: list[tuple[Sample, str]], columns: int) -> Image.Image:
    """Images with their labels, small, and titles."""
    return in_rows([(marked(view, 300, 400), title) for view, title in panels], columns)


def lenses() -> Image.Image:
    """One fisheye image as lenses that exist would have seen it."""
    source = ct.KannalaBrandt.from_fov(200, image_size=(900, 1200)).requires_grad_(False)
    image, panels = room.render(source, samples=4)[None], []
    names = "Laowa 7.5mm Panasonic G7", "GoPro HERO9 wide", "DJI Osmo Action", "Sony ZV-E10 16mm", "iPhone 13 pro"
    for name in (*names, "Pixel 6"):
        camera = ct.lenses.find(name, image_size=(1080, 1920)).float().resize(225, 400)
        degrees = float(camera.fov[0])
        panels.append((ct.Warp(source, camera, antialias=True)(image)[0], f"{name}: {degrees:.0f} degrees"))
    return tiles(panels, 3)


def shutters() -> Image.Image:
    """An image as a rolling shutter takes it while the camera turns, and that undone."""
    source = ct.KannalaBrandt.from_fov(130, image_size=(300, 400)).requires_grad_(False)
    rates = torch.tensor([1.0, -5.0, 4.0])
    times = 0.03 * ((torch.arange(300) + 0.5) / 300 - 0.5)
    x, y, z = rates.tolist()
    turns = torch.linalg.matrix_exp(times[:, None, None] * torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
    rolled = expose(source, lambda rays: room.radiance((turns[:, None] @ rays[..., None])[..., 0]), samples=8)
    straight = ct.Pinhole.from_fov(95, image_size=(300, 400)).requires_grad_(False)
    shutter = ct.RollingShutter(0.03, rates)
    panels = [
        (rolled, "rows rendered one by one, turning"),
        (ct.Warp(source, straight)(rolled[None])[0], "lens undone"),
        (ct.ShutterWarp(source, straight, shutter=shutter)(rolled[None])[0], "lens and shutter undone"),
    ]
    return tiles(panels, 3)


def mounted(pitch: float, roll: float) -> torch.Tensor:
    """(3, 3) camera from room, of a camera that looks up by `pitch` and leans right by `roll` degrees."""
    return mount_rotation(*(torch.tensor(float(angle), dtype=torch.float64) for angle in (0, pitch, roll)))


def fields() -> Image.Image:
    """Latitude and up over images of a room, by cameras that hang in it differently."""
    size = (480, 640)
    lens = ct.KannalaBrandt.from_fov(170, image_size=size, distortion=[0.02, -0.01, 0.003, -0.001]).double()
    narrow = ct.Pinhole.from_fov(80, image_size=size).double()
    panels = [
        (narrow, (0, 0), "a pinhole camera, level"),
        (narrow, (-12, 14), "looking down, leaning"),
        (lens, (-12, 14), "a fisheye of 170 degrees, likewise"),
    ]
    found = []
    for camera, (pitch, roll), title in panels:
        turned = mounted(pitch, roll)
        image = (room.render(camera, turned, samples=3) * 255).byte().permute(1, 2, 0).numpy()
        tile = Image.fromarray((0.45 * image + 0.55 * 255).astype("uint8"))
        down = turned[:, 1]  # y of the room
        latitude, _, valid = camera.perspective_field(down)
        bands = (latitude.rad2deg() / 15).floor()
        edge = torch.zeros_like(valid)
        edge[1:, 1:] = (bands[1:, 1:] != bands[:-1, 1:]) | (bands[1:, 1:] != bands[1:, :-1])
        horizon = edge & (latitude.abs() < 0.02)
        draw = ImageDraw.Draw(tile)
        for where, colour in ((edge & valid, (60, 110, 180)), (horizon & valid, (200, 60, 50))):
            for v, u in where.nonzero().tolist():
                draw.rectangle((u - 1, v - 1, u, v), colour)
        _, up, seen = camera.perspective_field(down, stride=40)
        for (u, v), (x, y), has_ray in zip(
            camera.pixel_grid(40).flatten(0, 1).tolist(),
            up.flatten(0, 1).tolist(),
            seen.flatten().tolist(),
            strict=True,
        ):
            if has_ray:
                draw.line((u, v, u + 18 * x, v + 18 * y), INK, 2)
                draw.ellipse((u - 3, v - 3, u + 3, v + 3), INK)
        found.append((tile.resize((320, 240), Image.Resampling.LANCZOS), title))
    return in_rows(found, len(found))


def augment() -> Image.Image:
    """A rendered driver, and what `ct.augment.RandomCamera` makes of it."""
    before = rendered()
    new = ct.augment.RandomCamera("dms130", image_size=(945, 1260), antialias=True, min_filled=0.95, fov="source")
    generator, panels = torch.Generator().manual_seed(0), [(before, "before")]
    for _ in range(5):
        after = new(before, draw=new.draw(1, generator))
        panels.append((after, f"dms130, {float(after['camera'].fov[0]):.0f}° wide"))
    return labelled(panels, 3)


def edits() -> Image.Image:
    """Edits of a fisheye image, and a chain of them with another lens."""
    augment = ct.augment
    lens = ct.KannalaBrandt.from_fov(130, image_size=(480, 640), distortion=[0.02, -0.01, 0.003, -0.001])
    before = rendered(lens.double().requires_grad_(False))
    crop, flip = augment.RandomResizedCrop((480, 640), scale=(0.5, 0.5)), augment.HorizontalFlip(p=1.0)
    whole = augment.RandomResizedCrop((480, 640), scale=(0.85, 0.85))
    other = augment.RandomCamera("dms130", fov="source", min_filled=0.97, yaw=4, pitch=4, roll=(18, 18), crop=None)
    chain = augment.Compose([whole, flip, other])
    named = {
        "RandomResizedCrop": crop,
        "HorizontalFlip": flip,
        "Rotate90": augment.Rotate90(1),
        "Pad": augment.Pad(size=(640, 640), fill=210),
        "crop, flip, another lens and mount: one warp": chain,
    }
    panels = [(before, "an image with its labels")]
    for title, edit in named.items():
        torch.manual_seed(SEED)
        panels.append((edit(before), title))
    return labelled(panels, 3)


def maps() -> Image.Image:
    """What meshes of a fisheye are off by: on the source, and over the target."""
    lens = ct.KannalaBrandt.from_fov(170, image_size=(480, 640), distortion=[0.02, -0.01, 0.003, -0.001])
    fisheye = rendered(lens.double().requires_grad_(False))
    warp = ct.Dewarp(fisheye["camera"], projection="cylindrical", fov=166, image_size=(480, 640))
    images = [image[0].permute(1, 2, 0) for image in (fisheye["image"][None], warp(fisheye["image"][None]))]
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/map.bin"
        found = []
        for format, title in (("dw100", "DW100: every 16 px, in 1/16 px"), ("ti_ldc", "TI LDC: every 8 px, in 1/8 px")):
            report = ct.save_map(warp, path, format)
            found.append(
                (
                    f"{title}\n{report.max_error:.2f} px at most, rms {report.rms_error:.2f}",
                    ct.load_map(path).error(warp),
                )
            )
        mesh = ct.load_map(path).positions
    figure, axes = plt.subplots(1, 4, figsize=(16.4, 3.9), facecolor=PAGE, layout="constrained")
    for axis, image, title in zip(axes, images, ("a fisheye, and a mesh of every 16 px", "dewarped"), strict=False):
        axis.imshow(image)
        axis.set_title(title)
    for lines, ends in ((mesh[::16], mesh.shape[1]), (mesh[:, ::16].transpose(0, 1), mesh.shape[0])):
        for line in lines[:, :ends]:
            axes[0].plot(*line.T, color="white", linewidth=0.5)
    most = max(float(error.nan_to_num(0).max()) for _, error in found)
    for axis, (title, error) in zip(axes[2:], found, strict=True):
        shown = axis.imshow(error, cmap="magma", vmin=0, vmax=most)
        axis.set_title(title)
    figure.colorbar(shown, ax=axes[2:], label="px of the source", pad=0.01)
    for axis in axes:
        axis.set(xticks=[], yticks=[], xlim=(-0.5, 639.5), ylim=(479.5, -0.5))
    return drawn(figure, bbox_inches="tight")


def dewarp() -> Image.Image:
    """A fisheye image of a room, and what `ct.Dewarp` makes of it."""
    lens = ct.KannalaBrandt.from_fov(190, image_size=(600, 800), distortion=[0.02, -0.01, 0.003, -0.001])
    lens = lens.requires_grad_(False)
    image = room.render(lens, samples=4)[None]
    size = (300, 400)
    options = {"image_size": size, "antialias": True}
    warps = {
        "a fisheye of 190 degrees": ct.Warp(lens, lens.resize(*size), antialias=True),
        "perspective, 100 degrees": ct.Dewarp(lens, fov=100, **options),
        "cylindrical, 180 degrees": ct.Dewarp(lens, projection="cylindrical", fov=180, **options),
        "equirectangular": ct.Dewarp(lens, projection="equirectangular", **options),
    }
    return tiles([(warp(image)[0], title) for title, warp in warps.items()], 2)


def calibration() -> Image.Image:
    """Photographs of a board with the corners that were found, and how far projections are known."""
    board, lens = Chessboard(9, 6, 0.024), fisheye()
    poses = [
        ((0.5 * np.cos(a), 0.5 * np.sin(a), 0.1), (0.12 * np.sin(a) - 0.1, 0.08 * np.cos(a) - 0.07, 0.18 + 0.01 * a))
        for a in np.linspace(0, 6, 12)
    ]
    views = [photograph(board, lens, *pose, seed=i) for i, pose in enumerate(poses)]
    found = [cv2.findChessboardCornersSB(image, (9, 6))[1] for image, _ in views]
    seen = [np.full((54, 2), np.nan) if corners is None else corners.reshape(54, 2) for corners in found]
    result = ct.calibrate("kannala_brandt", board.points(), seen, image_size=(480, 640))
    figure, axes = plt.subplots(2, 2, figsize=(8.3, 6.6), facecolor=PAGE, layout="constrained")
    for axis, i in zip(axes.flat, (1, 6, 11), strict=False):
        axis.imshow(views[i][0], cmap="gray", vmin=0, vmax=255)
        axis.plot(*seen[i].T, "o", color="#e0245e", markersize=3.5)
        axis.set(xticks=[], yticks=[], title=f"photograph {i}, and its corners")
    sigma = result.uncertainty(result.camera.pixel_grid(4).double()).numpy(force=True)
    shown = axes[1, 1].imshow(
        sigma, cmap="magma_r", vmax=np.nanquantile(sigma, 0.97), extent=(-0.5, 639.5, 479.5, -0.5)
    )
    figure.colorbar(shown, ax=axes[1, 1], label="px", shrink=0.8)
    axes[1, 1].set(xticks=[], yticks=[], title="how far projections are known")
    return drawn(figure)


def photograph_dewarped() -> Image.Image:
    """What the first command of the README makes."""
    folder = EXAMPLES / "photographs"
    image = torch.from_numpy(np.array(Image.open(folder / "fisheye.jpg").convert("RGB"))).permute(2, 0, 1)
    camera = ct.load(folder / "fisheye.yml").camera
    after = ct.Dewarp(camera)(image[None])[0]
    panels = [(image, "a photograph of a fisheye"), (after, "dewarped")]
    return in_rows([(shown(part, 290, 464), title) for part, title in panels], 2)


def learn() -> Image.Image:
    """A camera that learns from rays and pixels: the image that it dewarps, while it does."""
    truth = ct.KannalaBrandt.from_fov(170, image_size=(480, 640), distortion=[0.02, -0.01, 0.003, -0.001])
    image = room.render(truth.requires_grad_(False), samples=4)[None]
    points, _ = truth.unproject(truth.pixel_grid(40).reshape(-1, 2))
    wanted = truth.pixel_grid(40).reshape(-1, 2)
    camera = ct.KannalaBrandt([260.0, 260.0, 290.0, 255.0], image_size=(480, 640))
    groups = [{"params": [camera.intrinsics], "lr": 1.0}, {"params": [camera.distortion], "lr": 0.002}]
    optimizer = torch.optim.Adam(groups)
    target = ct.Pinhole.from_fov(100, image_size=(300, 400)).requires_grad_(False)
    panels = [(ct.Warp(truth, truth.resize(300, 400), antialias=True)(image)[0], "a fisheye of 170 degrees")]
    for step in range(301):
        pixels, valid = camera(points)
        loss = (pixels - wanted)[valid].square().sum(-1).mean()
        if step in (0, 20, 300):
            with torch.no_grad():
                straight = ct.Warp(camera, target, antialias=True)(image)[0]
            panels.append((straight, f"dewarped after {step} steps: {loss.sqrt():.1f} px"))
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return tiles(panels, 2)


def head_pose() -> Image.Image:
    """What a pinhole camera, assumed for a lens of 130 degrees, makes of a head that faces the camera's axis."""
    lens = ct.KannalaBrandt.from_fov(130, image_size=(480, 640)).double().requires_grad_(False)
    assumed = ct.Pinhole(lens.intrinsics.detach(), image_size=(480, 640)).requires_grad_(False)
    face, degrees = ct.augment.face_points(), torch.linspace(0, 60, 31, dtype=torch.float64)
    away = torch.deg2rad(degrees)
    places = 0.6 * torch.stack((away.sin(), 0 * away, away.cos()), -1)
    pixels, _ = lens.project(face + places[:, None])
    true, wrong = (ct.solve_pnp(camera, face, pixels) for camera in (lens, assumed))
    figure, axes = plt.subplots(1, 2, figsize=(9, 3), layout="constrained", facecolor=PAGE)
    for pose, colour, title in ((true, "#1e64f0", "its own lens"), (wrong, "#e21d48", "a pinhole assumed")):
        pitch, yaw, _ = torch.rad2deg(ct.head_angles(pose)).unbind(-1)
        axes[0].plot(degrees, yaw, color=colour, label=f"yaw, {title}")
        axes[0].plot(degrees, pitch, "--", color=colour, label=f"pitch, {title}")
        axes[1].plot(degrees, 100 * pose.extrinsics.translation.norm(dim=-1), color=colour, label=title)
    axes[0].set_ylabel("degrees off (the truth is 0)")
    axes[1].set_ylabel("distance, cm (the truth is 60)")
    for axis in axes:
        axis.set_xlabel("degrees of the head from the axis")
        axis.legend(frameon=False, fontsize="small")
        axis.set_facecolor(PAGE)
    return drawn(figure)


def detectors() -> Image.Image:
    """A photograph with dlib's landmarks, far from the axis of a fisheye, in crops and augmented."""
    found = json.loads((IMAGES.parents[1] / "tests/files/detected_faces.json").read_text())
    image = torch.from_numpy(np.array(Image.open(EXAMPLES / "photographs/astronaut.jpg"))).permute(2, 0, 1)
    pinhole = ct.Pinhole.from_fov(20, image_size=image.shape[1:]).requires_grad_(False)
    lens = ct.KannalaBrandt.from_fov(160, image_size=(960, 1280)).requires_grad_(False)
    put = ct.Warp(pinhole, lens, mount_rotation(*torch.tensor([-55.0, 25.0, 0.0])), antialias=True)
    keypoints, _ = put.transform_points(torch.tensor(found["photograph"]["dlib"]).float())
    boxes = torch.cat((keypoints.amin(0), keypoints.amax(0)))[None]
    seen = {"image": put(image[None])[0], "keypoints": keypoints, "boxes": boxes, "camera": lens}
    left, top, right, bottom = (boxes[0] + 0.5 * torch.tensor([-70, -70, 70, 70])).round().int().tolist()
    window = {"image": seen["image"][:, top:bottom, left:right], "keypoints": keypoints - torch.tensor([left, top])}
    crop = ct.augment.BoxCrop((256, 256), margin=0.5)(seen)
    flip = ct.augment.HorizontalFlip(p=1.0, landmarks="ibug68")
    torch.manual_seed(3)
    new = ct.augment.Compose([ct.augment.RandomCamera(yaw=2, pitch=2, roll=25), flip])(crop)
    panels = [(seen, "a fisheye of 160°"), (window, "a window of it"), (crop, "BoxCrop"), (new, "augmented, mirrored")]
    views = [({name: view[name] for name in view if "boxes" not in name}, title) for view, title in panels]
    return in_rows([(marked(view, 300, 400), title) for view, title in views], 4)


PICTURES = {
    "detectors": detectors,
    "head-pose": head_pose,
    "overview": overview,
    "overview-phone": functools.partial(overview, 2),
    "photograph": photograph_dewarped,
    "dewarp": dewarp,
    "lenses": lenses,
    "shutter": shutters,
    "augment": augment,
    "edits": edits,
    "fields": fields,
    "learn": learn,
    "calibration": calibration,
    "maps": maps,
}
"""Name of the file -> what draws it."""


def main(names: list[str]) -> None:
    """Make all of them, or those that are named."""
    for name, draw in PICTURES.items():
        if not names or name in names:
            draw().save(IMAGES / f"{name}.jpg", quality=82, optimize=True)
    if not names or "moving" in names:
        first, *others = moving()
        options = {"duration": 90, "loop": 0, "quality": 72, "method": 6, "kmin": 0, "kmax": 1}  # each frame whole
        first.save(IMAGES / "moving.webp", save_all=True, append_images=others, **options)
