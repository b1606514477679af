"""The images of the documentation, rendered: `python docs/make_images.py`, or those of one part, or some of these.

`guides` makes those of the guides, `guides dewarp learn` two of them, `models kannala_brandt` that of one camera model;
`case-study` takes a quarter of an hour and is made by its name only.
"""

import sys
from pathlib import Path

import matplotlib

matplotlib.use("agg")

import matplotlib.pyplot as plt
import torch
from PIL import Image

sys.path.append(str(Path(__file__).parents[1] / "tests"))  # which have boards, and photographs of them

from drawings import augmentations, concepts, guides, models, views
from drawings.pages import IMAGES
from scenes import training, training_data

from camtorch.cli.main import main
from camtorch.plot.axes import COLOURS

DEMOS = {
    "augment": ["augment", *("--preset", "dms130", "--fov", "source", "--min-filled", "0.95", "-n", "5")],
    "demo": ["demo"],
    **{name: ["demo", name] for name in ("stereo", "surround", "camera")},
}
"""Name of the file -> the words of the command that draws it."""


def save(image: Image.Image, name: str) -> None:
    """A large drawing, as small as pages show it."""
    image.thumbnail((960, 2000), Image.Resampling.LANCZOS)
    image.convert("RGB").save(IMAGES / f"{name}.jpg", quality=70, optimize=True)


def case_study(seeds: int = 3) -> None:
    """What networks find, how they come to it, and the medians over some seeds."""
    runs = [training.run(lambda text: print(text, flush=True), seed=seed) for seed in range(seeds)]
    save(training.drawing(runs[0]), "case-study")
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
    figure.savefig(IMAGES / "case-study-curves.png", dpi=110)
    for results in zip(*runs, strict=True):
        medians = torch.tensor([[e.medians() for e in result.errors.values()] for result in results])
        print(f"{training_data.TRAINING_SETS[results[0].training_set]:<28}{medians.median(0).values.tolist()}")


def demos(names: list[str]) -> None:
    """What the demos and `camtorch augment` draw, or some of it."""
    for name in names or DEMOS:
        path = IMAGES / f"{name}.jpg"
        main([*DEMOS[name], "-o", str(path), "--force"])
        save(Image.open(path), name)


PARTS = {
    "guides": guides.main,
    "demos": demos,
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
    elif names[0] in PARTS:
        PARTS[names[0]](names[1:])
    else:
        sys.exit(f"there is no part {names[0]!r}; there are {', '.join((*PARTS, 'case-study'))}")


if __name__ == "__main__":
    make(sys.argv[1:])
