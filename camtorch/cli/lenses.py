"""The command `camtorch lenses`: lenses that exist, by their names."""

import argparse

from camtorch import lenses


def run(arguments: argparse.Namespace) -> None:
    """Run the command."""
    words, output, size = " ".join(arguments.words), arguments.output, arguments.size
    if output is not None:
        from camtorch.cli import targets  # the import takes a tenth of a second, as that of camtorch.io does

        targets.check(output, force=arguments.force)
    found = find(words, size)
    for lens in found[: arguments.n]:
        print(str(lens)[1:-1])
    if len(found) > arguments.n:
        print(f"and {len(found) - arguments.n} more; -n {len(found)} lists them all")
    if output is not None:
        from camtorch.io import save

        camera = lenses.find(words, image_size=size)
        output.parent.mkdir(parents=True, exist_ok=True)
        save(camera, output, arguments.format)
        print(f"{output}: {found[0].name}, {camera.width}x{camera.height}")


def find(words: str, size: tuple[int, int] | None = None) -> list[lenses.Lens]:
    """Return the lenses of a name, best first; raise a ValueError if there is none."""
    try:
        lenses.find(words, image_size=size)
    except ValueError as error:
        raise ValueError(f"{error}. On the command line write --guess-fov DEGREES") from None
    return lenses.search(words, image_size=size)
