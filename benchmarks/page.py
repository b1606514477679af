"""The tables of the page on performance, from the figures of one run: `python -m benchmarks.page RUN.json`.

A run is what `python -m benchmarks ... --json RUN.json` writes. The page marks the place of each table that it shows,
`<!-- points --> ... <!-- /points -->`; their figures are kept beside it, so that every number can be looked up.
"""

import argparse
import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from benchmarks.__main__ import TABLES
from benchmarks.harness import Figure

PAGE = Path(__file__).parent.parent / "docs" / "performance.md"
FIGURES = PAGE.with_suffix(".json")
_PLACE = re.compile(r"(<!-- (\w[\w, ]*) -->\n).*?(<!-- /\2 -->)", re.S)

Run = Mapping[str, Any]


def filled(page: str, run: Run) -> str:
    """Return a page whose tables are those of a run.

    Raises:
        ValueError: If the page has no place for a table of the run, or the run has no figures for a place.
    """
    places = [found[2] for found in _PLACE.finditer(page)]
    wanted = ["machine", *run["results"]]
    if sorted(places) != sorted(wanted):
        raise ValueError(f"the page's places must be those of the run, {sorted(wanted)}; got {sorted(places)}")
    return _PLACE.sub(lambda match: f"{match[1]}{_text(match[2], run)}\n{match[3]}", page)


def _text(name: str, run: Run) -> str:
    if name == "machine":
        facts = run["machine"]
        return (
            f"On {facts['threads']} threads of {facts['cpu']} with {facts['cores']} cores; torch {facts['torch']}, "
            f"OpenCV {facts['OpenCV']}, kornia {facts['kornia']}, deltacamera {facts['deltacamera']}, "
            f"Python {facts['python']}, camtorch {facts['camtorch']}, {facts['library']}."
        )
    rows = run["results"][name].items()
    return TABLES[name].markdown({row: {who: Figure(*f) for who, f in figures.items()} for row, figures in rows})


def main(arguments: list[str] | None = None) -> None:
    """Fill the page."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.page", description=__doc__)
    parser.add_argument("run", type=Path, help="what `python -m benchmarks ... --json` wrote")
    run = json.loads(parser.parse_args(arguments).run.read_text())
    page = PAGE.read_text()
    run["results"] = {name: rows for name, rows in run["results"].items() if f"<!-- {name} -->" in page}
    run["arguments"].pop("json", None)  # where it was written
    PAGE.write_text(filled(page, run))
    FIGURES.write_text(json.dumps(run) + "\n")


if __name__ == "__main__":
    main()
