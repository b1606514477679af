"""Compiles the sampler: `python -m camtorch.native.build`. Needs a C compiler and no package, not camtorch either.

`kernel.c` is compiled once for each kind of CPU, `dispatch.c` once; one shared library of both has no symbol of Python
or torch, so it fits every version of them. Never with `-march=native`, for a library may move to another machine, nor
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

# two dots in its name: what walks a package's modules would take _sampler.so for one, and import it
LIBRARY = f"_sampler.{_MACHINE}.{_SUFFIX}"

# what is compiled for each kind of CPU
_KERNELS = ("kernel.c", "geometry.c", "draws.c", "consensus.c", "poses.c", "views.c")

# where installation says in one line why it built no library
REASON = "_sampler.reason.txt"

_FLAGS = ["-std=gnu11", "-O3", "-fPIC", "-fvisibility=hidden"]
_FLAGS += ["-fno-math-errno", "-fno-trapping-math", "-ffp-contract=fast"]
_AVX2 = ("-mavx2", "-mfma", "-mf16c", "-mbmi2")
_AVX512 = ("-mavx512f", "-mavx512vl", "-mavx512bw", "-mavx512dq", "-mavx512vbmi")
# for which CPUs there is code, and by which options; every library has the first
VARIANTS: dict[str, tuple[str, ...]] = {"baseline": ()}
if _MACHINE in ("x86_64", "amd64"):
    VARIANTS |= {"avx2": _AVX2, "avx512": (*_AVX512, *_AVX2, "-mprefer-vector-width=256")}

# the oldest macOS that this Python runs on, as a wheel's name says; compilers take their own machine's
_ENVIRONMENT: dict[str, str] = {}
if sys.platform == "darwin":
    _ENVIRONMENT["MACOSX_DEPLOYMENT_TARGET"] = str(sysconfig.get_config_var("MACOSX_DEPLOYMENT_TARGET"))


class BuildError(RuntimeError):
    """There is no C compiler, or it failed; says which command, and what the compiler said."""


def switched_off() -> bool:
    """Whether the environment says `CAMTORCH_NATIVE=0`."""
    return os.environ.get("CAMTORCH_NATIVE", "").strip().lower() in ("0", "off", "false")


def checksum(sources: str | os.PathLike[str] = _HERE) -> int | None:
    """A number of what the C files in a folder say, or None if it has none; a library holds that of its sources."""
    texts = [path.read_bytes() for path in sorted(Path(sources).glob("*.[ch]"))]
    return zlib.crc32(b"\0".join(texts)) if texts else None


def build(directory: str | os.PathLike[str] | None = None, *, sources: str | os.PathLike[str] | None = None) -> Path:
    """Compile the library, and put it in its place when it is whole: processes may be running the one that is there.

    The compiler, which takes GCC's options, is the environment's CC, else the first of cc, gcc and clang that is there.

    Args:
        directory: where the library goes; by default where camtorch looks for it.
        sources: the folder of `kernel.c` and `dispatch.c`; by default this file's.

    Returns:
        The path of the library.

    Raises:
        BuildError: there is no compiler, or it fails.
        OSError: `directory` cannot be written; on Windows also while a process has the library loaded.
    """
    command = _compiler()
    here = _HERE if sources is None else Path(sources).absolute()
    target = (_HERE if directory is None else Path(directory).absolute()) / LIBRARY
    # beside the target: a file is renamed in one step on one file system only
    with tempfile.TemporaryDirectory(prefix="_building", dir=target.parent) as folder:

        def compiled(source: Path, name: str, flags: Sequence[str], defined: Sequence[str] = ()) -> str:
            words = [*_FLAGS, *flags, *(f"-D{word}" for word in defined), "-c", str(source), "-o", f"{name}.o"]
            _run([*command, *words], folder)
            return f"{name}.o"

        def accepts(flags: tuple[str, ...]) -> bool:
            # a compiler may be older, or for another machine
            probe = Path(folder, "probe.c")
            probe.write_text("int probe(int x) { return x + 1; }\n")
            try:
                compiled(probe, "probe", flags)
            except BuildError:
                return not flags  # without any: the true reason comes with the sources
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
    """The words of its command, which may have options as in CC="ccache gcc"."""
    named = os.environ.get("CC", "").strip()
    if named:
        words = [named] if shutil.which(named) else shlex.split(named)
        if shutil.which(words[0]) is None:
            raise BuildError(f"the C compiler {words[0]!r}, which CC names, is not there")
        return words
    names = ("gcc", "clang") if sys.platform == "win32" else ("cc", "gcc", "clang")
    for name in names:
        if shutil.which(name):
            return [name]
    raise BuildError(f"no C compiler: none of {', '.join(names)} is on the PATH, and CC names none")


def _main() -> None:
    try:
        print(build())
    except (BuildError, OSError) as error:
        sys.exit(f"camtorch.native.build: {error}")


if __name__ == "__main__":
    _main()
