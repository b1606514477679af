"""The tables of the page on performance, from the figures of one run: `python -m benchmarks.page RUN.json`.

A run is what `python -m benchmarks points images samples augment loader calibration stereo --json RUN.json` writes. The
figures that the page shows are kept beside it, so that every number on it can be looked up.
"""

from __future__ import annotations

import argparse
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

PAGE = Path(__file__).parent.parent / "docs" / "performance.md"
FIGURES = PAGE.with_suffix(".json")

Run = Mapping[str, Any]
# a table's rows by (case, operation), its columns by contestants, of whom the fastest is shown
Columns = Mapping[str, tuple[str, ...]]
OURS = "camtorch"
_POINTS = ("kannala_brandt", "brown_conrady", "fisheye624")
_LOADER = "DataLoader, "
NAMES = {
    "kannala_brandt": "Kannala-Brandt",
    "brown_conrady": "Brown-Conrady",
    "fisheye624": "Fisheye624",
    " f+b": " and backward",
    "fresh maps": "new cameras",
    "cached map": "kept map",
}


def tables(run: Run) -> dict[str, str]:
    """The tables by the names that the page marks their places with, and the sentence on the machine."""
    return {
        "machine": _machine(run),
        "points": _points(run),
        "images": _images(run),
        "samples": _samples(run),
        "augment": _augment(run),
        "loader": _loader(run),
        "calibration": _calibration(run),
        "stereo": _stereo(run),
    }


def filled(page: str, run: Run) -> str:
    """A page whose tables are those of a run.

    Raises:
        ValueError: the page lacks the place of a table.
    """
    for name, text in tables(run).items():
        place = re.compile(rf"(<!-- {name} -->\n).*?(<!-- /{name} -->)", re.S)
        page, found = place.subn(lambda match, text=text: f"{match[1]}{text}\n{match[2]}", page)
        if found != 1:
            raise ValueError(f"the page has {found} places <!-- {name} --> ... <!-- /{name} -->; one was expected")
    return page


def shown(run: Run) -> dict[str, Any]:
    """What the tables need of a run."""
    wanted = {"seconds", "per second"}
    results = {
        subject: [record for record in records if record["quantity"] in wanted]
        for subject, records in run["results"].items()
    }
    results = {
        subject: [{**r, "value": float(f"{r['value']:.4g}")} for r in found] for subject, found in results.items()
    }
    results["points"] = [record for record in results["points"] if record["case"] in _POINTS]
    results["loader"] = [record for record in results["loader"] if record["quantity"] == "per second"]
    results["images"] = [record for record in results["images"] if _is_shown(record["case"], record["operation"])]
    arguments = {name: value for name, value in run["arguments"].items() if name != "json"}  # where it was written
    return {"machine": run["machine"], "arguments": arguments, "results": results}


def _figures(run: Run, subject: str, quantity: str = "seconds") -> dict[tuple[str, str], dict[str, float]]:
    found: dict[tuple[str, str], dict[str, float]] = {}
    for record in run["results"][subject]:
        if record["quantity"] == quantity:
            found.setdefault((record["case"], record["operation"]), {})[record["contestant"]] = record["value"]
    return found


def _table(
    title: str,
    rows: Iterable[tuple[str, Mapping[str, float]]],
    columns: Columns,
    *,
    scale: float = 1e3,
    alone: Sequence[str] = (),
) -> str:
    """Markdown; figures of others have beside them how many times ours they are, but for those that stand alone."""
    lines = [f"| {title} | {' | '.join(columns)} |", "|---|" + "---:|" * len(columns)]
    for name, times in rows:
        cells = []
        for column, contestants in columns.items():
            values = [times[who] for who in contestants if who in times]
            if not values:
                cells.append("-")
                continue
            text, ratio = digits(min(values) * scale), min(values) / times[OURS]
            cells.append(text if column == OURS or column in alone else f"{text} ({ratios(ratio)}x)")
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def digits(value: float) -> str:
    """Two digits, and whole numbers from ten on."""
    return f"{value:.0f}" if value >= 9.95 else f"{value:.1f}" if value >= 0.095 else f"{value:.2f}"


def ratios(value: float) -> str:
    """One place behind the point below ten."""
    return f"{value:.0f}" if value >= 9.95 else f"{value:.1f}"


def _named(text: str) -> str:
    for key, name in NAMES.items():
        text = text.replace(key, name)
    return text


def _machine(run: Run) -> str:
    facts = run["machine"]
    return (
        f"On {facts['torch threads']} threads of {facts['cpu']} with {facts['cores']} cores; torch {facts['torch']}, "
        f"OpenCV {facts['OpenCV']}, kornia {facts['kornia']}, deltacamera {facts['deltacamera']}, "
        f"Python {facts['python']}, camtorch {facts['camtorch']}, {facts['native sampler']}."
    )


def _points(run: Run) -> str:
    columns = {
        OURS: (OURS,),
        "compiled": ("camtorch compiled",),
        "compiled, planes": ("camtorch compiled, planes",),
        "OpenCV": ("OpenCV",),
        "kornia": ("kornia",),
        "cold copy": ("cold copy",),
    }
    rows = [
        (_named(f"{case} {operation}"), times)
        for (case, operation), times in _figures(run, "points").items()
        if case in _POINTS
    ]
    million = run["arguments"]["size"] or 1_000_000
    alone = ("compiled", "compiled, planes", "cold copy")
    return _table(f"{million / 1e6:g}M float32 points, ms", rows, columns, alone=alone)


def _is_shown(case: str, operation: str) -> bool:
    return re.search(r" [18]x3x\d+x\d+ \w+$", case) is not None and operation in ("cached map", "fresh maps")


def _images(run: Run) -> str:
    columns = {
        OURS: (OURS,),
        "OpenCV": ("OpenCV, float map", "OpenCV, fixed-point map"),
        "deltacamera": ("deltacamera",),
        "kornia": ("kornia",),
        "`grid_sample` alone": ("grid_sample alone",),
        "clone": ("clone",),
    }
    rows = []
    for (case, operation), times in _figures(run, "images").items():
        if not _is_shown(case, operation):
            continue
        key, shape, dtype = case.split()
        batch, _, size = shape.split("x", 2)
        rows.append((_named(f"{key}, {batch} of 3x{size} {dtype}, {operation}"), times))
    return _table("images, ms", rows, columns, alone=("clone",))


def _augment(run: Run) -> str:
    columns = {OURS: (OURS,), "RandomAffine": ("kornia RandomAffine",), "OpenCV": ("OpenCV",)}
    columns |= {"torchvision, by sample": ("torchvision crop, flip",), "one draw": ("torchvision, one draw",)}
    rows = [
        (_named(f"{case}, {operation}"), times)
        for (case, operation), times in _figures(run, "augment").items()
        if not case.startswith(_LOADER)
    ]
    return _table("8 images, ms", rows, columns)


def _samples(run: Run) -> str:
    columns = {
        OURS: (OURS,),
        "albumentations": ("albumentations Affine", "OpticalDistortion, no landmarks"),
        "OpenCV": ("OpenCV",),
    }
    rows = [(_named(f"{case}, {operation}"), times) for (case, operation), times in _figures(run, "samples").items()]
    return _table("one image, ms", rows, columns)


def _loader(run: Run) -> str:
    columns = {name: (name,) for name in (OURS, "OpenCV", "kornia RandomAffine", "albumentations Affine")}
    rows = [
        (_named(f"{case.removeprefix(_LOADER)}, {operation}"), rates)
        for (case, operation), rates in _figures(run, "loader", "per second").items()
    ]
    return _table("samples a second", rows, columns, scale=1, alone=tuple(columns))


def _calibration(run: Run) -> str:
    columns = {OURS: (OURS,), "OpenCV": ("OpenCV",), "OpenCV, covariances": ("OpenCV, covariances",)}
    rows = [
        (_named(f"{case}, {operation}"), times) for (case, operation), times in _figures(run, "calibration").items()
    ]
    return _table("54 corners a view, s", rows, columns, scale=1)


def _stereo(run: Run) -> str:
    columns = {OURS: (OURS,), "OpenCV": ("OpenCV, float map", "OpenCV, fixed-point map")}
    rows = []
    for (case, operation), times in _figures(run, "stereo").items():
        key, shape, dtype = case.split()
        _, channels, size = shape.split("x", 2)
        rows.append((_named(f"{key}, {channels}x{size} {dtype}{operation.removeprefix('a pair')}"), times))
    return _table("a pair rectified, ms", rows, columns)


def main(arguments: list[str] | None = None) -> None:
    """Fill the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.page", description=__doc__)
    parser.add_argument("run", type=Path, help="what `python -m benchmarks ... --json` wrote")
    run = shown(json.loads(parser.parse_args(arguments).run.read_text()))
    PAGE.write_text(filled(PAGE.read_text(), run))
    FIGURES.write_text(json.dumps(run) + "\n")


if __name__ == "__main__":
    main()
