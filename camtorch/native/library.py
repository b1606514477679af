"""The compiled library: which one is loaded, or why none is."""

import ctypes
import functools
import os
from pathlib import Path

from camtorch.native.build import LIBRARY, REASON, VARIANTS, checksum, switched_off
from camtorch.native.self_test import wrong
from camtorch.native.structs import CHECKSUM, STRUCTS, Library
from camtorch.native.structure import layout

_HERE = Path(__file__).resolve().parent
_BUILD = "python -m camtorch.native.build"
_HEADERS = "python -m camtorch.native.headers"
# most rows of docs/performance.json with both figures are within these
_SLOWER = "without it most work on the CPU takes 4 to 80 times as long"
_told: set[str] = set()


@functools.cache
def _find() -> tuple[Library | None, str]:
    """Return the library, and its CPU's kind or why there is none."""
    if switched_off():
        return None, "off (CAMTORCH_NATIVE=0)"
    path = _HERE / LIBRARY
    if not path.exists():
        reason = _HERE / REASON
        why = reason.read_text("utf-8").strip() if reason.exists() else "camtorch was not installed from here"
        return None, f"not built ({why}); with a C compiler `{_BUILD}` builds it; {_SLOWER}"
    try:
        library = Library(str(path))
    except OSError as error:
        return None, f"not loaded ({error}); `{_BUILD}` builds it again; {_SLOWER}"
    here = checksum()
    built_from = _number(library, "camtorch_sources")
    laid_out = _number(library, "camtorch_layout")
    if here is not None and built_from != here:  # None if a package leaves the sources out
        why = "not used (built from other sources than those beside it)"
        return None, f"{why}; `{_BUILD}` or `pip install -e .` builds it again; {_SLOWER}"
    if laid_out != layout(CHECKSUM, STRUCTS):
        why = "not used (its structures, values or calls are not those of camtorch/native/structs.py)"
        return None, f"{why}; `{_HEADERS}` writes that file, `{_BUILD}` builds the library again; {_SLOWER}"
    library.declare()
    wanted = os.environ.get("CAMTORCH_CPU", "").strip().lower()
    if wanted and not library.camtorch_use(wanted.encode()):
        names = ", ".join(name for name in VARIANTS if library.camtorch_use(name.encode()))
        raise ValueError(f"CAMTORCH_CPU must be one of {names} on this CPU; got {wanted!r}. Unset it to use the best")
    if (name := wrong(library)) is not None:
        return None, f"not used ({name} gives a wrong answer to a known call); `{_BUILD}` builds it again; {_SLOWER}"
    return library, library.camtorch_variant().decode()


def _number(library: Library, name: str) -> int | None:
    call = getattr(library, name, None)
    if call is not None:
        call.restype = ctypes.c_uint32
    return call and call()


@functools.cache
def library() -> Library | None:
    """Return the library, loaded at first use, or None if there is none to use; its calls do not hold Python's lock."""
    return _find()[0]


def warn_if_missing() -> None:
    """Warn, once a process, that long work is done without the library, unless CAMTORCH_NATIVE=0 turned it off.

    In a DataLoader, only the first worker warns.
    """
    if _told or library() is not None or switched_off():
        return
    from torch.utils.data import get_worker_info  # `camtorch --version` takes no time to import torch

    from camtorch.values.arguments import warn

    _told.add(state())
    worker = get_worker_info()
    if worker is None or worker.id == 0:
        warn(f"camtorch's compiled library is {state()}. CAMTORCH_NATIVE=0 in the environment silences this")


@functools.cache
def loaded() -> Library:
    """Return the library, for calls that are made only if there is one."""
    if (found := library()) is None:
        raise RuntimeError(f"camtorch: the library must be there for compiled calls; got none: it is {state()}")
    return found


def state() -> str:
    """Return the variant of the library that runs on this machine's CPU, like "avx2", or why none does."""
    return _find()[1]


@functools.cache
def native_available() -> bool:
    """Whether images are sampled by native code; else torch samples them, slower and to the same results.

    It is False if the environment has `CAMTORCH_NATIVE=0`, or if camtorch was installed without a C compiler:
    `camtorch --version` shows the reason.
    """
    return library() is not None
