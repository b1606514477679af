"""Names that a package imports at their first use: its stub lists them, as it does for type checkers."""

import os


def listed_names(folder: str) -> dict[str, str]:
    """Return the module of each name in the stub of a package: `from module import name as name`, one a line."""
    places: dict[str, str] = {}
    with open(os.path.join(folder, "__init__.pyi"), encoding="utf-8") as stub:
        for line in stub:
            if line.startswith("from "):
                module, _, name, *_ = line.split()[1:]
                if name == "*":  # all names of a package in this one
                    places |= dict.fromkeys(listed_names(os.path.join(folder, module.rpartition(".")[2])), module)
                else:
                    places[name] = module
    return places
