"""Write docs/commands.md, what commands are for and all options, from the parser: python docs/make_commands.py."""

from __future__ import annotations

import argparse
from pathlib import Path

from camtorch.cli.main import make_parser

PAGE = Path(__file__).parent / "commands.md"
HEAD = r"""# The command line

What each command is for, then all options, as `--help` shows them. Sizes are WIDTHxHEIGHT here, and (height, width) in
Python; angles are degrees here, and [some of them](conventions.md) in Python. An error is one line.

```bash
camtorch show camera.yml
camtorch show camera.yml --against other.yml  # a second calibration of it
camtorch convert camera.yml --model kannala_brandt -o new.json
camtorch dewarp photo.jpg --camera camera.yml -o straight.png
```

* `show`: model, field of view, part of the image with rays, distortion at the corners, valid angles; `--against`
  compares with another camera by rms, largest and median distance, and the part of the image within a pixel (a few rays
  at the rim may make nearly all of the rms); `-o` draws all that (needs `pip install -e ".[plot]"`); `--html page.html`
  writes [a page](gallery/viewer.md) to try the lens in a browser, `--image photo.jpg` with a photograph.
* `convert`: to another model, with rms, largest error and the angle up to which it holds; or to another format.
  `--model` is the model of the new file. `--name cam1` saves that camera alone, without its pose, for formats that hold
  no poses.
* `dewarp`: works on the pixels as they are stored and keeps an Exif orientation, or says that the new file's format
  cannot; `--guess-fov 120` does without a calibration, by a camera of that many degrees. A photograph of a hundred
  megapixels goes strip by strip. Nothing that is read is ever overwritten, even with `--force`. Folders, patterns and
  videos: [on many files](guides/dewarp.md#folders).
* `map`: a dewarping as a lookup table for OpenCV, ONNX or a camera chip, and how far that is from exact;
  `--check` measures one that is there: [maps](guides/maps.md).
* `lenses` finds [lenses that exist](guides/real-lenses.md) by name, field of view or resolution.
* `calibrate` makes a camera or a rig of photographs of a board: [calibrating](guides/calibration.md).

An OpenCV file of four coefficients that does not say whether they are a fisheye's takes `--from-model kannala_brandt`
or `--from-model brown_conrady`, with every command that reads one (`dewarp` also calls it `--model`).
Without it `convert` refuses the file. The other commands read its coefficients as those of `cv2.calibrateCamera`, and a
note says so. If a file states its model, naming another one is an error.

A photograph of another size than its calibration takes `--rescale`, where the aspect ratios are within 1 % of each
other: a cropped image, or one whose width and height are exchanged, is not mended by scaling and refused.

Exit status: 0; 1 if some of many files failed; 2 for an error; 130 for an interrupt; 141 for a closed pipe.
"""


def text() -> str:
    """The whole page."""
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
