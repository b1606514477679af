"""The images of the documentation, rendered: `python docs/make_images.py`, or those of one part, or some of these.

`guides` makes those of the guides, `guides dewarp learn` two of them, `models kannala_brandt` that of one camera model;
`case-study` draws the numbers that `examples/train_faces.py` measured, and `viewer` needs a browser (`pip install -e
".[viewer-test]"`, and Chromium): these are made by their names only.
"""

import io
import json
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import matplotlib

matplotlib.use("agg")

from PIL import Image

sys.path.append(str(Path(__file__).parents[1] / "tests"))  # which have boards, and photographs of them
sys.path.append(str(Path(__file__).parents[1] / "examples"))  # which have rendered scenes

import train_faces
from drawings import augmentations, concepts, guides, models, views
from drawings.pages import EXAMPLES, IMAGES

import camtorch as ct

SCRIPTS = {
    "room": "dewarp_room",
    "stereo": "stereo_room",
    "surround": "surround_view",
    "camera": "predict_camera",
    "robots": "robot_cameras",
    "fisheye-depth": "fisheye_depth",
}
"""Name of the file -> the example that draws it."""


def save(image: Image.Image, name: str) -> None:
    """A large drawing, as small as pages show it."""
    image.thumbnail((960, 2000), Image.Resampling.LANCZOS)
    image.convert("RGB").save(IMAGES / f"{name}.jpg", quality=70, optimize=True)


def case_study() -> None:
    """The errors of the case study, from the file of its numbers."""
    train_faces.draw(json.loads(train_faces.NUMBERS.read_text()), IMAGES / "case-study.png")


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
