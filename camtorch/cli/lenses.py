"""The command `camtorch lenses`: lenses that exist, by their names."""

from __future__ import annotations

import argparse

from camtorch import lenses
from camtorch.cli import targets
from camtorch.io import save


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    words, output, size = " ".join(arguments.words), arguments.output, arguments.size
    if output is not None:
        targets.check(output, force=arguments.force)
    camera = lenses.find(words, image_size=size)
    found = lenses.search(words, image_size=size)
    for lens in found[: arguments.n]:
        print(str(lens)[1:-1])
    if len(found) > arguments.n:
        print(f"and {len(found) - arguments.n} more; -n {len(found)} lists them all")
    if output is not None:
        output.parent.mkdir(parents=True, exist_ok=True)
        save(camera, output, arguments.format)
        print(f"{output}: {found[0].name}, {camera.width}x{camera.height}")
