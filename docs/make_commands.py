"""Write docs/commands.md, the page of all commands and options, from the parser: python docs/make_commands.py."""

import argparse
from pathlib import Path

from camtorch.cli.main import make_parser

PAGE = Path(__file__).parent / "commands.md"
HEAD = r"""# The command line

This page explains each command, and lists all options as `--help` shows them. Sizes are WIDTHxHEIGHT here, and
(height, width) in Python. Angles are in degrees here, and [only some of them](conventions.md) in Python. An error is
one line.

```bash
camtorch show camera.yml
camtorch show camera.yml --against other.yml  # a second calibration of it
camtorch convert camera.yml --model kannala_brandt -o new.json
camtorch dewarp photo.jpg --camera camera.yml -o straight.png
```

* `show` prints model, field of view, part of the image with rays, distortion at the corners, and valid angles.
  `--against` compares with another camera by rms, largest and median distance, and the part of the image within a
  pixel (a few rays at the rim may cause nearly all of the rms). `-o` draws all of it (needs `pip install -e
  ".[plot]"`). `--html page.html` writes [a page](gallery/viewer.md) to try the lens in a browser, `--image photo.jpg`
  with a photograph.
* `convert` writes another model, and prints rms, largest error and the angle up to which it holds; or it writes
  another format. `--model` is the model of the new file. `--name cam1` saves that camera alone, without its pose, for
  formats that hold no poses.
* `dewarp` reads stored pixels and keeps an Exif orientation, or prints that the new file's format cannot.
  `--guess-fov 120` needs no calibration and assumes a camera of that many degrees. A photograph of a hundred
  megapixels is processed in strips. Inputs are never overwritten, even with `--force`. For folders, patterns and
  videos, see [many files](guides/dewarp.md#folders).
* `map` writes a dewarping as a lookup table for OpenCV, ONNX or a camera chip, and prints its error. `--check`
  measures an existing map: [maps](guides/maps.md).
* `lenses` finds [real lenses](guides/real-lenses.md) by name, field of view or resolution.
* `calibrate` makes a camera or a rig from photographs of a board: [calibrating](guides/calibration.md).

If an OpenCV file has four coefficients and does not state whether they are a fisheye's, pass `--from-model
kannala_brandt` or `--from-model brown_conrady` to every command that reads it (`dewarp` also calls it `--model`).
Without it, `convert` raises an error. The other commands read the coefficients like `cv2.calibrateCamera`, and print
a note. If a file states its model, naming another one is an error.

For a photograph of another size than its calibration, pass `--rescale`, if the aspect ratios are within 1 % of each
other. A cropped image, or one whose width and height are exchanged, cannot be scaled and raises an error.

Exit status: 0; 1 if some of many files failed; 2 for an error; 130 for an interrupt; 141 for a closed pipe.
"""


def text() -> str:
    """Return the whole page."""
    (commands,) = (a for a in make_parser()._actions if isinstance(a, argparse._SubParsersAction))
    return HEAD + "".join(_section(name, command) for name, command in commands.choices.items())


def _section(name: str, command: argparse.ArgumentParser) -> str:
    lines = [f"\n## camtorch {name}\n", f"{_cell(command.description or '')}\n", "| | |\n|---|---|"]
    for action in command._actions:
        if action.help == argparse.SUPPRESS or isinstance(action, argparse._HelpAction):
            continue
        value = "" if action.nargs == 0 else _value(action)
        names = ", ".join(f"`{one}{value}`" for one in action.option_strings) or f"`{value.strip()}`"
        lines.append(f"| {_cell(names)} | {_cell(action.help or '')} |")
    return "\n".join(lines) + "\n"


def _value(action: argparse.Action) -> str:
    metavar = action.metavar if action.metavar is not None else action.dest.upper()
    if action.choices is not None and action.metavar is None:
        metavar = "{" + ",".join(map(str, action.choices)) + "}"
    one = " ".join(metavar) if isinstance(metavar, tuple) else metavar
    return {"+": f" {one} ...", "*": f" [{one} ...]", "?": f" [{one}]"}.get(str(action.nargs), f" {one}")


def _cell(words: str) -> str:
    return " ".join(words.replace("%%", "%").replace("|", "\\|").split())


if __name__ == "__main__":
    PAGE.write_text(text(), encoding="utf-8")
