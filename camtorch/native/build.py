"""Compile the library: `python -m camtorch.native.build`. It needs a C compiler and no package, not even camtorch.

Each C file is compiled once for each kind of CPU, `dispatch.c` once; one shared library of all has no symbol of Python
or torch, so it fits every version of them. It is compiled neither with `-march=native`, as it may move to
another machine, nor with `-ffast-math`, which links code that changes how the whole process rounds. A unit is compiled
again if its text, without comments, that of its headers, the options or the compiler have changed;
`CAMTORCH_VARIANTS=baseline` compiles for one kind of CPU, to try out a change.
"""

import hashlib
import os
import platform
import runpy
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import zlib
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from pathlib import Path

_HERE = Path(__file__).resolve().parent
# as in "macosx-11.0-arm64": Python's own name for the kind of machine to build for, if that is another than this one
_HOST = os.environ.get("_PYTHON_HOST_PLATFORM", "")
_MACHINE = (_HOST.rpartition("-")[2] or platform.machine()).lower()
_SYSTEM = _HOST.partition("-")[0] or sys.platform
_SUFFIX = {"win": "dll", "win32": "dll", "macosx": "dylib", "darwin": "dylib"}.get(_SYSTEM, "so")

# two dots in its name, as tools that walk a package's modules would import a _sampler.so
LIBRARY = f"_sampler.{_MACHINE}.{_SUFFIX}"

# the file in which installation gives the reason, in one line, why it built no library
REASON = "_sampler.reason.txt"

_FLAGS = ["-std=gnu11", "-O3", "-fvisibility=hidden"]
_FLAGS += ["-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast"]
_FLAGS += [] if _SUFFIX == "dll" else ["-fPIC"]
_FLAGS += ["-fno-asynchronous-unwind-tables"] if _SUFFIX == "so" else []  # C has no exceptions to unwind
_AVX2 = ("-mavx2", "-mfma", "-mf16c", "-mbmi2")
_AVX512 = ("-mavx512f", "-mavx512vl", "-mavx512bw", "-mavx512dq", "-mavx512vbmi")
# the kinds of CPU that have code of their own, and its options; every library has the first
VARIANTS: dict[str, tuple[str, ...]] = {"baseline": ()}
if _MACHINE in ("x86_64", "amd64"):
    VARIANTS |= {"avx2": _AVX2, "avx512": (*_AVX512, *_AVX2, "-mprefer-vector-width=256")}

# the oldest macOS that this Python runs on, which is in a wheel's name; compilers would take that of their machine
_ENVIRONMENT: dict[str, str] = {}
if sys.platform == "darwin":
    _ENVIRONMENT["MACOSX_DEPLOYMENT_TARGET"] = str(sysconfig.get_config_var("MACOSX_DEPLOYMENT_TARGET"))


class BuildError(RuntimeError):
    """Raised if there is no C compiler, or if it fails, with its command and output."""


def switched_off() -> bool:
    """Whether the environment has `CAMTORCH_NATIVE=0`."""
    return os.environ.get("CAMTORCH_NATIVE", "").strip().lower() in ("0", "off", "false")


def checksum(sources: str | os.PathLike[str] = _HERE) -> int | None:
    """Return a checksum of the C files in a folder, or None if it has none; a library holds that of its sources."""
    texts = [path.read_bytes() for path in sorted(Path(sources).glob("*.[ch]"))]
    return zlib.crc32(b"\0".join(texts)) if texts else None


def build(directory: str | os.PathLike[str] | None = None, *, sources: str | os.PathLike[str] | None = None) -> Path:
    """Compile the library, and put it in its place when it is whole, as processes may be running the old one.

    The compiler, which takes GCC's options, is the environment's CC, or else the first of cc, gcc and clang.

    Args:
        directory: The library's folder; by default the one in which camtorch looks for it.
        sources: The folder of the C files; by default this file's.

    Returns:
        The path of the library.

    Raises:
        BuildError: If there is no compiler, or if it fails; on Windows also while a process has the library loaded.
        OSError: If `directory` cannot be written.
    """
    command = _compiler()
    here = _HERE if sources is None else Path(sources).absolute()
    target = (_HERE if directory is None else Path(directory).absolute()) / LIBRARY
    wanted = _wanted()
    # next to the target: a file is renamed in one step only on one file system
    with tempfile.TemporaryDirectory(prefix="_building", dir=target.parent) as folder:

        def accepts(flags: tuple[str, ...]) -> bool:
            # a compiler may be too old for a kind of CPU, or for another machine
            Path(folder, "probe.c").write_text("int probe(int x) { return x + 1; }\n")
            try:
                _run([*command, *_FLAGS, *flags, "-c", "probe.c"], folder)
            except BuildError:
                return not flags  # without flags, the sources show the true reason
            return True

        known = {name: flags for name, flags in VARIANTS.items() if name in wanted and accepts(flags)}
        # by its path, as a package's build has no package
        Path(folder, "layout.h").write_text(runpy.run_path(str(_HERE / "headers.py"))["layout_h"](here), "utf-8")
        has = [*(f"-DHAS_{name.upper()}" for name in known if name != "baseline"), f"-DSOURCES={checksum(here)}u"]
        units = {"dispatch": [str(here / "dispatch.c"), "-I.", *has]}
        for unit in sorted(set(here.glob("*.c")) - {here / "dispatch.c"}):
            units |= {f"{unit.stem}_{name}": [str(unit), *known[name], f"-DVARIANT={name}"] for name in known}
        objects = _objects(here) or Path(folder)
        version = _run([*command, "--version"], folder)

        def kept(name: str) -> Path:
            """Return where a unit's object is, or will be: its name has a checksum of all that it is made of."""
            source, *options = units[name]
            words = [*command, *_FLAGS, *options]
            text = _run([*words, "-E", "-P", source], folder)  # with its headers, without comments
            made_of = hashlib.sha256("\0".join([version, *words, text]).encode()).hexdigest()
            return objects / f"{name}.{made_of[:16]}.o"

        def compiled(name: str) -> None:
            part = objects / f"{name}.{os.getpid()}"
            _run([*command, *_FLAGS, *units[name], "-c", "-o", str(part)], folder)
            for old in objects.glob(f"{name}.*.o"):
                old.unlink(missing_ok=True)
            os.replace(part, places[name])

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            places = dict(zip(units, pool.map(kept, units), strict=True))
            missing = [name for name, place in places.items() if not place.exists()]
            if len(missing) > 1:
                what = f"compiling {len(missing)} units of {len(units)}, for {', '.join(known)}"
                print(f"{what}: geometry and sampler take some 10 s each, the others 1 s", file=sys.stderr, flush=True)
            list(pool.map(compiled, missing))
        libraries = [] if _SUFFIX == "dll" else ["-lm"]
        _run([*command, "-shared", "-o", LIBRARY, *map(str, places.values()), *libraries], folder)
        try:
            os.replace(Path(folder, LIBRARY), target)
        except PermissionError as error:  # of Windows; elsewhere processes keep the old file
            way = "End the processes that use camtorch, and build again"
            raise BuildError(f"{target} must not be in use; got an error: {error.strerror}. {way}") from error
    return target


def _wanted() -> set[str]:
    """Return the kinds of CPU that the environment's CAMTORCH_VARIANTS names, or all; the first one is always there."""
    named = {name for name in os.environ.get("CAMTORCH_VARIANTS", "").replace(" ", "").split(",") if name}
    if not named <= set(VARIANTS):
        raise BuildError(f"CAMTORCH_VARIANTS must be some of {','.join(VARIANTS)}; got {','.join(sorted(named))}")
    return named | {"baseline"} if named else set(VARIANTS)


def _objects(sources: Path) -> Path | None:
    """Return the folder of objects that later builds use again, or None if it cannot be written."""
    folder = sources / "_objects"
    with suppress(OSError):
        folder.mkdir(exist_ok=True)
        return folder if os.access(folder, os.W_OK) else None
    return None


def _run(command: list[str], folder: str) -> str:
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env=_ENVIRONMENT | os.environ | {"LC_ALL": "C"},
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            errors="replace",
        )
    except OSError as error:
        raise BuildError(f"{error}\n(an error of {shlex.join(command)})") from error
    if done.returncode:
        raise BuildError(f"{(done.stderr + done.stdout).strip()}\n(an error of {shlex.join(command)})")
    return done.stdout


def _compiler() -> list[str]:
    """Return the words of the compiler's command, which may have options as in CC="ccache gcc"."""
    named, windows = os.environ.get("CC", "").strip(), sys.platform == "win32"
    if named:
        # shlex takes the backslashes of a path away
        words = [named] if shutil.which(named) else shlex.split(named.replace("\\", "/") if windows else named)
        if shutil.which(words[0]) is None:
            raise BuildError(f"CC must name a C compiler; got {words[0]!r}, which is not on the PATH")
        return words
    names = ("gcc", "clang") if windows else ("cc", "gcc", "clang")
    for name in names:
        if shutil.which(name):
            return [name]
    got = "none, and Visual Studio's cl does not take their options" if windows else "none"
    raise BuildError(f"no C compiler: one of {', '.join(names)} must be on the PATH; got {got}. Install one, or set CC")


if __name__ == "__main__":
    try:
        print(build())
    except (BuildError, OSError) as error:
        sys.exit(f"camtorch.native.build: {error}")
