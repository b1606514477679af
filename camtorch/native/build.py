"""Compile the sampler: `python -m camtorch.native.build`. It needs a C compiler and no package, not even camtorch.

`kernel.c` is compiled once for each kind of CPU, `dispatch.c` once; one shared library of both has no symbol of Python
or torch, so it fits every version of them. It never has `-march=native`, as it may move to another machine, nor
with `-ffast-math`, which links code that changes how the whole process rounds.
"""

from __future__ import annotations

import os
import platform
import shlex
import shutil
import subprocess
import sys
import sysconfig
import tempfile
import zlib
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

_HERE = Path(__file__).resolve().parent
_MACHINE = platform.machine().lower()
_SUFFIX = {"win32": "dll", "darwin": "dylib"}.get(sys.platform, "so")

# two dots in its name, as tools that walk a package's modules would import a _sampler.so
LIBRARY = f"_sampler.{_MACHINE}.{_SUFFIX}"

# the files that are compiled for each kind of CPU
_KERNELS = ("kernel.c", "geometry.c", "draws.c", "consensus.c", "poses.c", "views.c")

# the file in which installation gives the reason, in one line, why it built no library
REASON = "_sampler.reason.txt"

_FLAGS = ["-std=gnu11", "-O3", "-fPIC", "-fvisibility=hidden"]
_FLAGS += ["-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast"]
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
        sources: The folder of `kernel.c` and `dispatch.c`; by default this file's.

    Returns:
        The path of the library.

    Raises:
        BuildError: If there is no compiler, or if it fails.
        OSError: If `directory` cannot be written; on Windows also while a process has the library loaded.
    """
    command = _compiler()
    here = _HERE if sources is None else Path(sources).absolute()
    target = (_HERE if directory is None else Path(directory).absolute()) / LIBRARY
    # next to the target: a file is renamed in one step only on one file system
    with tempfile.TemporaryDirectory(prefix="_building", dir=target.parent) as folder:

        def compiled(source: Path, name: str, flags: Sequence[str], defined: Sequence[str] = ()) -> str:
            words = [*_FLAGS, *flags, *(f"-D{word}" for word in defined), "-c", str(source), "-o", f"{name}.o"]
            _run([*command, *words], folder)
            return f"{name}.o"

        def accepts(flags: tuple[str, ...]) -> bool:
            # a compiler may be too old for a kind of CPU, or for another machine
            probe = Path(folder, "probe.c")
            probe.write_text("int probe(int x) { return x + 1; }\n")
            try:
                compiled(probe, "probe", flags)
            except BuildError:
                return not flags  # without flags, the sources show the true reason
            return True

        known = {name: flags for name, flags in VARIANTS.items() if accepts(flags)}
        has = [f"HAS_{name.upper()}" for name in known if name != "baseline"]
        has.append(f"SOURCES={checksum(here)}u")
        units: list[tuple[Path, str, tuple[str, ...], list[str]]] = [(here / "dispatch.c", "dispatch", (), has)]
        kernels = [here / name for name in _KERNELS if (here / name).exists()]
        units += [
            (kernel, f"{kernel.stem}_{name}", flags, [f"VARIANT={name}"])
            for kernel in kernels
            for name, flags in known.items()
        ]
        with ThreadPoolExecutor(os.cpu_count()) as pool:
            objects = list(pool.map(lambda unit: compiled(*unit), units))
        libraries = [] if sys.platform == "win32" else ["-lm"]
        _run([*command, "-shared", "-o", LIBRARY, *objects, *libraries], folder)
        os.replace(Path(folder, LIBRARY), target)
    return target


def _run(command: list[str], folder: str) -> None:
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
        raise BuildError(f"{error}\n(of {shlex.join(command)})") from error
    if done.returncode:
        raise BuildError(f"{(done.stderr + done.stdout).strip()}\n(of {shlex.join(command)})")


def _compiler() -> list[str]:
    """Return the words of the compiler's command, which may have options as in CC="ccache gcc"."""
    named = os.environ.get("CC", "").strip()
    if named:
        words = [named] if shutil.which(named) else shlex.split(named)
        if shutil.which(words[0]) is None:
            raise BuildError(f"CC must name a C compiler; got {words[0]!r}, which is not on the PATH")
        return words
    names = ("gcc", "clang") if sys.platform == "win32" else ("cc", "gcc", "clang")
    for name in names:
        if shutil.which(name):
            return [name]
    raise BuildError(f"no C compiler: one of {', '.join(names)} must be on the PATH; got none. Install one, or set CC")


if __name__ == "__main__":
    try:
        print(build())
    except (BuildError, OSError) as error:
        sys.exit(f"camtorch.native.build: {error}")
