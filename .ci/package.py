"""Builds what is published, and uses it away from the checkout, as one who installs it.

The archive of sources, and what pip makes of it: a wheel with the compiled library, where there is a compiler, and one
without. Each is installed into an environment that has what its metadata ask for and nothing else, where `installed.py`
does what camtorch is for. The libraries come by links from the environment that this runs in, which has them.

`python .ci/package.py FOLDER` leaves the files in a folder, for `twine upload`.
"""

import os
import sys
import tarfile
import tempfile
import time
from importlib.metadata import Distribution, distribution
from pathlib import Path

import wheels
from packaging.requirements import Requirement
from wheels import ROOT, run

INSTALLED = Path(__file__).resolve().with_name("installed.py")


def check_archive(path: Path) -> None:
    """All that is kept in the repository, and nothing that was compiled."""
    with tarfile.open(path) as file:
        names = {member.name.split("/", 1)[-1] for member in file.getmembers() if member.isfile()}
    if (ROOT / ".git").exists():
        lost = set(run("git", "ls-files").splitlines()) - names
        assert not lost, f"{path.name} lacks {sorted(lost)}"
    assert not [name for name in names if "/_sampler." in name], path.name


def needed(name: str, found: dict[str, Distribution], extras: tuple[str, ...] = ("",)) -> dict[str, Distribution]:
    """What an installed distribution asks for, and what that asks for."""
    for line in distribution(name).requires or ():
        wish = Requirement(line)
        if wish.name not in found and (not wish.marker or any(wish.marker.evaluate({"extra": e}) for e in extras)):
            found[wish.name] = distribution(wish.name)
            needed(wish.name, found, ("", *wish.extras))
    return found


def environment(folder: Path, file: Path) -> Path:
    """The Python of an environment that has this file installed, and what it asks for."""
    run(sys.executable, "-m", "venv", "--without-pip", folder)
    (packages,) = folder.glob("lib/python*/site-packages")
    python = folder / "bin" / "python"
    run(sys.executable, "-m", "pip", "--python", python, "install", "--quiet", "--no-deps", file, cwd=folder)
    # what it asks for, by the metadata that were installed with it
    sys.path.insert(0, str(packages))
    libraries = needed("camtorch", {}).values()
    sys.path.remove(str(packages))
    for library in libraries:
        for top in {path.parts[0] for path in library.files or () if path.parts[0] not in ("..", "__pycache__")}:
            if not (packages / top).exists():
                (packages / top).symlink_to(Path(str(library.locate_file(top))))
    run(sys.executable, "-m", "pip", "--python", python, "check", cwd=folder)
    return python


def main(folder: Path, work: Path) -> None:
    """Build, look into, install and use."""
    start = time.monotonic()
    run(sys.executable, "-m", "venv", work / "tools")
    tools = work / "tools" / "bin" / "python"
    run(tools, "-m", "pip", "install", "--quiet", "build", "twine")
    run(tools, "-m", "build", "--sdist", "--outdir", folder)
    (archive,) = folder.glob("*.tar.gz")
    targets = {"pure": "any"} | ({"native": wheels.own()} if wheels.compiler() else {})
    built = {kind: wheels.build(archive, target, folder) for kind, target in targets.items()}
    run(tools, "-m", "twine", "check", "--strict", *folder.iterdir())
    check_archive(archive)
    print(f"{archive.name}: {archive.stat().st_size / 1e6:.2f} MB")
    if "native" not in built:
        print("no C compiler is here, so no wheel has a library")
    for kind, wheel in built.items():
        needs = wheels.check(wheel)
        python = environment(work / kind, wheel)
        empty = work / f"{kind}-empty"
        empty.mkdir()
        path = f"{python.parent}{os.pathsep}{os.environ['PATH']}"
        told = run(python, "-W", "error", INSTALLED, kind, cwd=empty, PYTHONPATH="", PATH=path)
        print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.2f} MB; {needs}; {told.strip()}")
    print(f"{time.monotonic() - start:.0f} s")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        kept = Path(sys.argv[1] if len(sys.argv) > 1 else Path(made, "dist")).resolve()
        kept.mkdir(parents=True, exist_ok=True)
        if any(kept.iterdir()):
            sys.exit(f"{kept} is not empty")
        main(kept, Path(made))
