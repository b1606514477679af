"""The images of the documentation, rendered: `python docs/make_images.py`, or those of one part, or some of these.

`guides` makes those of the guides, `guides dewarp learn` two of them, `models kannala_brandt` that of one camera model;
`case-study` takes a quarter of an hour, `viewer` a browser (`pip install -e ".[viewer-test]"`, and Chromium): these are
made by their names only.
"""

import io
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import torch
from PIL import Image

sys.path.append(str(Path(__file__).parents[1] / "tests"))  # which have boards, and photographs of them
sys.path.append(str(Path(__file__).parents[1] / "examples"))  # which have rendered scenes

import train_faces
from drawings import augmentations, concepts, guides, models, views
from drawings.pages import EXAMPLES, IMAGES

import camtorch as ct
from camtorch.plot.axes import COLOURS

SCRIPTS = {
    "room": "dewarp_room",
    "stereo": "stereo_room",
    "surround": "surround_view",
    "camera": "predict_camera",
    "drivers": "driver_monitoring",
    "robots": "robot_cameras",
    "fisheye-depth": "fisheye_depth",
}
"""Name of the file -> the example that draws it."""


def save(image: Image.Image, name: str) -> None:
    """A large drawing, as small as pages show it."""
    image.thumbnail((960, 2000), Image.Resampling.LANCZOS)
    image.convert("RGB").save(IMAGES / f"{name}.jpg", quality=70, optimize=True)


def case_study(seeds: int = 3) -> None:
    """What networks find, how they come to it, and the medians over some seeds."""
    runs, tests = zip(*(train_faces.run(seed=seed) for seed in range(seeds)), strict=True)
    with tempfile.TemporaryDirectory() as folder:
        train_faces.draw(runs[0], tests[0], f"{folder}/faces.png")
        save(Image.open(f"{folder}/faces.png"), "case-study")
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
    for colour, (name, title) in zip(COLOURS, train_faces.TRAINING_SETS.items(), strict=False):
        curves = torch.tensor([run[name].curves["mounts"] for run in runs])  # (seeds, looks, 3)
        for j, ax in enumerate(axes):
            values = curves[..., 1 + j] * (100 if j == 0 else 1)
            ax.plot(curves[0, :, 0], values.median(0).values, color=colour, label=title)
            ax.fill_between(curves[0, :, 0], values.amin(0), values.amax(0), color=colour, alpha=0.15, linewidth=0)
    axes[0].set_title("landmarks, % of the distance between the eyes", fontsize="medium")
    axes[1].set_title("gaze, degrees", fontsize="medium")
    axes[1].legend(frameon=False, fontsize="small")
    for ax, top in zip(axes, (16, 30), strict=True):
        ax.set_xlabel("steps")
        ax.set_ylim(0, top)
        ax.spines[["top", "right"]].set_visible(False)
    figure.savefig(IMAGES / "case-study-curves.png", dpi=110)
    for name, title in train_faces.TRAINING_SETS.items():
        last = torch.tensor([[curve[-1][1:] for curve in run[name].curves.values()] for run in runs])
        print(f"{title:<28}{last.median(0).values.tolist()}")


def viewer() -> None:
    """The page that shows a lens live, with a photograph."""
    from playwright.sync_api import sync_playwright

    browser = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        page, photograph = Path(folder) / "lens.html", EXAMPLES / "photographs" / "fisheye"
        ct.write_viewer(ct.load(f"{photograph}.yml").camera, page, f"{photograph}.jpg")
        tab = playwright.chromium.launch(executable_path=browser).new_page(viewport={"width": 1440, "height": 900})
        tab.goto(f"{page.as_uri()}#view=perspective&fov=100&draw=canvas")
        tab.locator("#message:empty").wait_for(state="attached")
        tab.wait_for_timeout(2000)  # until the photograph is drawn
        save(Image.open(io.BytesIO(tab.screenshot())), "viewer")


def examples(names: list[str]) -> None:
    """What the examples draw, or some of it."""
    for name in names or SCRIPTS:
        with tempfile.TemporaryDirectory() as folder:
            script = EXAMPLES / f"{SCRIPTS[name]}.py"
            subprocess.run([sys.executable, script, "-o", f"{folder}/{name}.png"], check=True)
            save(Image.open(f"{folder}/{name}.png"), name)


PARTS = {
    "guides": guides.main,
    "examples": examples,
    "models": models.main,
    "augmentations": augmentations.main,
    "views": views.main,
    "concepts": concepts.main,
}
"""Name -> what makes the images of a part, or those of it that are named."""


def make(names: list[str]) -> None:
    """All images, those of a part, or those of a part that are named after it."""
    if not names:
        for part in PARTS.values():
            part([])
    elif names == ["case-study"]:
        case_study()
    elif names == ["viewer"]:
        viewer()
    elif names[0] in PARTS:
        PARTS[names[0]](names[1:])
    else:
        sys.exit(f"there is no part {names[0]!r}; there are {', '.join((*PARTS, 'case-study', 'viewer'))}")


if __name__ == "__main__":
    make(sys.argv[1:])
