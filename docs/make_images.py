"""The images of the documentation, rendered: `python docs/make_images.py`, or some of them by their names.

`models kannala_brandt` makes that of one camera model, `models` those of all; `case-study` takes a quarter of an hour
and is made by its name only.
"""

import functools
import io
import sys
import tempfile
from pathlib import Path

import matplotlib.pyplot as plt
import torch
from drawings import augmentations, concepts, models, views
from PIL import Image, ImageDraw, ImageFont

import camtorch as ct
from camtorch.cli.labelled_image import LabelledImage, rendered
from camtorch.cli.labels import Labels
from camtorch.cli.main import main
from camtorch.cli.sheet import marked
from camtorch.demo import room, training, training_data
from camtorch.demo.example import driver
from camtorch.demo.exposure import expose
from camtorch.plot.axes import COLOURS
from camtorch.rotations import mount_rotation

SEED = 4
HERE = Path(__file__).parent / "images"
INK, GREY, RIM, PAPER = (43, 42, 46), (122, 112, 100), (214, 202, 182), (250, 245, 235)


def moved(before: LabelledImage, warp: ct.Warp) -> LabelledImage:
    """An image with its labels, warped."""
    labels = before.labels
    keypoints, keypoints_valid = warp.transform_points(labels.keypoints)
    boxes, boxes_valid = warp.transform_boxes(labels.boxes)
    new = Labels(keypoints, boxes, warp.transform_rays(labels.eyes), warp.transform_rays(labels.gaze))
    return LabelledImage(warp(before.image[None])[0], warp.target, new, [], keypoints_valid, boxes_valid)


def overview(columns: int = 4) -> Image.Image:
    """A fisheye image, dewarped, and as other cameras would have seen it."""
    lens = ct.KannalaBrandt.from_fov(170, image_size=(480, 640), distortion=[0.02, -0.01, 0.003, -0.001])
    fisheye = rendered(driver(lens.double().requires_grad_(False)))
    straight = moved(fisheye, ct.Dewarp(fisheye.camera, fov=1.75, image_size=(480, 640)))
    mount = {"yaw": 12, "pitch": 8, "roll": 20}
    new = ct.augment.RandomCamera("dms90", **mount, fov="source", min_filled=0.98, image_size=(480, 640))
    sample = {"keypoints": fisheye.labels.keypoints.expand(2, -1, -1), "camera": fisheye.camera}
    sample = new(sample, draw=new.draw(2, torch.Generator().manual_seed(SEED)))
    warps = [ct.Warp(fisheye.camera, c, r) for c, r in zip(sample["camera"], sample["rotation"], strict=True)]
    others = [moved(fisheye, warp) for warp in warps]
    panels = [
        (fisheye, "a fisheye of 170 degrees"),
        (straight, "dewarped"),
        *((other, "another lens and mount") for other in others),
    ]
    return in_rows(panels, columns)


def in_rows(panels: list[tuple[LabelledImage, str]], columns: int) -> Image.Image:
    """Labelled images with their titles above them."""
    height, width, gap, band = 300, 400, 16, 34
    rows = -(-len(panels) // columns)
    sheet = Image.new("RGB", (columns * (width + gap) + gap, rows * (height + band + gap) + gap), PAPER)
    draw = ImageDraw.Draw(sheet)
    font = ImageFont.load_default(size=18)
    for i, (view, title) in enumerate(panels):
        left, top = gap + i % columns * (width + gap), gap + i // columns * (height + band + gap)
        tile = marked(view, height, width)
        sheet.paste(tile, (left, top + band))
        draw.rectangle((left - 1, top + band - 1, left + tile.width, top + band + tile.height), outline=RIM)
        draw.text((left, top), title, INK, font)
    return sheet


def tiles(panels: list[tuple[torch.Tensor, str]], columns: int) -> Image.Image:
    """Images (3, H, W) in [0, 1] of one size with their titles, in rows."""
    (height, width), gap, band = panels[0][0].shape[1:], 16, 30
    rows = -(-len(panels) // columns)
    sheet = Image.new("RGB", (columns * (width + gap) + gap, rows * (height + band + gap) + gap), PAPER)
    draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(size=18)
    for i, (image, title) in enumerate(panels):
        left, top = gap + i % columns * (width + gap), gap + i // columns * (height + band + gap)
        tile = Image.fromarray((image * 255).round().byte().permute(1, 2, 0).numpy())
        sheet.paste(tile, (left, top + band))
        draw.rectangle((left - 1, top + band - 1, left + width, top + band + height), outline=RIM)
        draw.text((left, top), title, INK, font)
    return sheet


def lenses() -> Image.Image:
    """One fisheye image as lenses that exist would have seen it."""
    source = ct.KannalaBrandt.from_fov(200, image_size=(900, 1200)).requires_grad_(False)
    image, panels = room.render(source, samples=4)[None], []
    names = "Laowa 7.5mm Panasonic G7", "GoPro HERO9 wide", "DJI Osmo Action", "Sony ZV-E10 16mm", "iPhone 13 pro"
    for name in (*names, "Pixel 6"):
        camera = ct.lenses.find(name, image_size=(1080, 1920)).float().resize(270, 480)
        degrees = float(camera.field_of_view[0].rad2deg())
        panels.append((ct.Warp(source, camera, antialias=True)(image)[0], f"{name}: {degrees:.0f} degrees"))
    return tiles(panels, 3)


def shutters() -> Image.Image:
    """An image as a rolling shutter takes it while the camera turns, that undone, and the blur of an exposure."""
    source = ct.KannalaBrandt.from_fov(130, image_size=(300, 400)).requires_grad_(False)
    rates = torch.tensor([1.0, -5.0, 4.0])
    times = 0.03 * ((torch.arange(300) + 0.5) / 300 - 0.5)
    x, y, z = rates.tolist()
    turns = torch.linalg.matrix_exp(times[:, None, None] * torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]]))
    rolled = expose(source, lambda rays: room.radiance((turns[:, None] @ rays[..., None])[..., 0]), samples=8)
    straight = ct.Pinhole.from_fov(95, image_size=(300, 400)).requires_grad_(False)
    shutter = ct.RollingShutter(0.03, rates)
    blur = ct.RollingShutter(0.0, rates, exposure=0.01, gamma=2.2, samples=24)
    still = room.render(source, samples=8)
    panels = [
        (rolled, "rows rendered one by one, turning"),
        (ct.Warp(source, straight)(rolled[None])[0], "lens undone"),
        (ct.Warp(source, straight, shutter=shutter)(rolled[None])[0], "lens and shutter undone"),
        (ct.Warp(source, straight, target_shutter=blur)(still[None])[0], "an exposure put on"),
    ]
    return tiles(panels, 4)


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
    gap, band = 16, 34
    sheet = Image.new("RGB", (len(panels) * (size[1] + gap) + gap, size[0] + band + 2 * gap), PAPER)
    font = ImageFont.load_default(size=24)
    for i, (camera, (pitch, roll), title) in enumerate(panels):
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
        for (u, v), (x, y), shown in zip(
            camera.pixel_grid(40).flatten(0, 1).tolist(),
            up.flatten(0, 1).tolist(),
            seen.flatten().tolist(),
            strict=True,
        ):
            if shown:
                draw.line((u, v, u + 18 * x, v + 18 * y), INK, 2)
                draw.ellipse((u - 3, v - 3, u + 3, v + 3), INK)
        left = gap + i * (size[1] + gap)
        sheet.paste(tile, (left, gap + band))
        ImageDraw.Draw(sheet).text((left, gap - 4), title, INK, font)
    return sheet.resize((sheet.width // 2, sheet.height // 2), Image.Resampling.LANCZOS)


def edits() -> Image.Image:
    """Edits of a fisheye image, and a chain of them with another lens."""
    augment = ct.augment
    lens = ct.KannalaBrandt.from_fov(130, image_size=(480, 640), distortion=[0.02, -0.01, 0.003, -0.001])
    before = rendered(driver(lens.double().requires_grad_(False)))
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
        labels = before.labels
        given = {"keypoints": labels.keypoints, "boxes": labels.boxes, "points": labels.eyes, "gaze": labels.gaze}
        out = edit(image=before.image, camera=before.camera, **given)
        moved_labels = Labels(out["keypoints"], out["boxes"], out["points"], out["gaze"])
        flags = out["keypoints_valid"], out["boxes_valid"]
        panels.append((LabelledImage(out["image"], out["camera"], moved_labels, [], *flags), title))
    return in_rows(panels, 3)


def maps() -> Image.Image:
    """What meshes of a fisheye are off by: on the source, and over the target."""
    lens = ct.KannalaBrandt.from_fov(170, image_size=(480, 640), distortion=[0.02, -0.01, 0.003, -0.001])
    fisheye = rendered(driver(lens.double().requires_grad_(False)))
    warp = ct.Dewarp(fisheye.camera, projection="cylindrical", fov=2.9, image_size=(480, 640))
    images = [image[0].permute(1, 2, 0) for image in (fisheye.image[None], warp(fisheye.image[None]))]
    with tempfile.TemporaryDirectory() as folder:
        path = f"{folder}/map.bin"
        found = []
        for format, title in (("dw100", "DW100: every 16 px, in 1/16 px"), ("ti_ldc", "TI LDC: every 8 px, in 1/8 px")):
            report = warp.save(path, format)
            found.append(
                (
                    f"{title}\n{report.max_error:.2f} px at most, rms {report.rms_error:.2f}",
                    ct.load_map(path).error(warp),
                )
            )
        warp.save(path, "depthai")
        mesh = ct.load_map(path).positions
    paper = [value / 255 for value in PAPER]
    figure, axes = plt.subplots(1, 4, figsize=(16.4, 3.9), facecolor=paper, layout="constrained")
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
    file = io.BytesIO()
    figure.savefig(file, dpi=100, bbox_inches="tight")
    plt.close(figure)
    return Image.open(file).convert("RGB")


def case_study(seeds: int = 3) -> None:
    """What networks find, how they come to it, and the medians over some seeds."""
    runs = [training.run(lambda text: print(text, flush=True), seed=seed) for seed in range(seeds)]
    training.drawing(runs[0]).save(HERE / "case-study.jpg", quality=85)
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    for i, title in enumerate(training_data.TRAINING_SETS.values()):
        curves = torch.tensor([run[i].curves["mounts"] for run in runs])  # (seeds, looks, 3)
        for j, ax in enumerate(axes):
            values = curves[..., 1 + j] * (100 if j == 0 else 1)
            ax.plot(curves[0, :, 0], values.median(0).values, color=COLOURS[i], label=title)
            ax.fill_between(curves[0, :, 0], values.amin(0), values.amax(0), color=COLOURS[i], alpha=0.15, linewidth=0)
    axes[0].set_title("landmarks, % of the distance between the eyes", fontsize="medium")
    axes[1].set_title("gaze, degrees", fontsize="medium")
    axes[1].legend(frameon=False, fontsize="small")
    for ax, top in zip(axes, (16, 30), strict=True):
        ax.set_xlabel("steps")
        ax.set_ylim(0, top)
        ax.spines[["top", "right"]].set_visible(False)
    figure.savefig(HERE / "case-study-curves.png", dpi=110)
    for results in zip(*runs, strict=True):
        medians = torch.tensor([[e.medians() for e in result.errors.values()] for result in results])
        print(f"{training_data.TRAINING_SETS[results[0].training_set]:<28}{medians.median(0).values.tolist()}")


def by_commands() -> None:
    """What the demos and `camtorch augment` draw."""
    full = ["--preset", "dms130", "--fov", "source", "--min-filled", "0.95", "-n", "5"]
    for words in (["augment", *full], ["demo"], ["demo", "stereo"], ["demo", "surround"], ["demo", "camera"]):
        path = HERE / f"{words[1] if words[0] == 'demo' and words[1:] else words[0]}.jpg"
        main([*words, "-o", str(path), "--force"])
        image = Image.open(path)
        image.thumbnail((1100, 2000), Image.Resampling.LANCZOS)
        image.save(path, quality=75)


SHEETS = {
    "lenses": (lenses, 85),
    "shutter": (shutters, 85),
    "fields": (fields, 85),
    "maps": (maps, 85),
    "overview": (overview, 88),
    "overview-phone": (functools.partial(overview, 2), 85),
    "edits": (edits, 85),
}
"""Name of the file -> what draws it, and its quality."""
PARTS = {
    "models": models.main,
    "augmentations": augmentations.main,
    "views": views.main,
    "concepts": concepts.main,
}
"""Name -> what makes the images of a part, or those of it that are named."""


def make(names: list[str]) -> None:
    """All images, or those named: of a part the names after it."""
    if names == ["case-study"]:
        return case_study()
    if names and names[0] in PARTS:
        return PARTS[names[0]](names[1:])
    unknown = [name for name in names if name not in (*SHEETS, "commands")]
    if unknown:
        known = ", ".join((*SHEETS, "commands", *PARTS, "case-study"))
        sys.exit(f"there is no image {unknown[0]!r}; there are {known}")
    for name in names or SHEETS:
        if name in SHEETS:
            draw, quality = SHEETS[name]
            draw().save(HERE / f"{name}.jpg", quality=quality)
    if not names or "commands" in names:
        by_commands()
    if not names:
        for part in PARTS.values():
            part([])
    return None


if __name__ == "__main__":
    make(sys.argv[1:])
