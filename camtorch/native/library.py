"""The compiled sampler: which library is loaded, or why none is."""

from __future__ import annotations

import ctypes
import functools
import os
import warnings
from pathlib import Path
from typing import NamedTuple

from camtorch.native.build import LIBRARY, REASON, VARIANTS, checksum

_HERE = Path(__file__).resolve().parent
_BUILD = "python -m camtorch.native.build"


class _Found(NamedTuple):
    library: ctypes.CDLL | None
    state: str  # a CPU's kind, or why there is no library
    stale: bool = False


@functools.cache
def _find() -> _Found:
    if os.environ.get("CAMTORCH_NATIVE", "").strip().lower() in ("0", "off", "false"):
        return _Found(None, "off (CAMTORCH_NATIVE=0)")
    path = _HERE / LIBRARY
    if not path.exists():
        reason = _HERE / REASON
        why = reason.read_text("utf-8").strip() if reason.exists() else "camtorch was not installed from here"
        return _Found(None, f"not built ({why}); with a C compiler `{_BUILD}` builds it")
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        return _Found(None, f"not loaded ({error}); `{_BUILD}` builds it again")
    here, built_from = checksum(), getattr(library, "camtorch_sources", None)
    if built_from is not None:
        built_from.restype = ctypes.c_uint32
    if here is not None and (built_from is None or built_from() != here):  # None if a package leaves the sources out
        why = "not used (built from other sources than those beside it)"
        return _Found(None, f"{why}; `{_BUILD}` or `pip install -e .` builds it again", stale=True)
    wanted = os.environ.get("CAMTORCH_CPU", "").strip().lower()
    if wanted and not library.camtorch_use(wanted.encode()):
        names = ", ".join(name for name in VARIANTS if library.camtorch_use(name.encode()))
        raise ValueError(f"CAMTORCH_CPU must be one of {names} on this CPU; got {wanted!r}. Unset it to use the best")
    library.camtorch_variant.restype = ctypes.c_char_p
    return _Found(library, library.camtorch_variant().decode())


@functools.cache
def library() -> ctypes.CDLL | None:
    """Return the library, loaded at first use, or None if there is none to use; its calls do not hold Python's lock."""
    found = _find()
    if found.stale:
        warnings.warn(f"camtorch's native sampler is {found.state}", RuntimeWarning, stacklevel=2)
    return found.library


def state() -> str:
    """Return the variant of the library that runs on this machine's CPU, like "avx2", or why none does."""
    return _find().state


@functools.cache
def native_available() -> bool:
    """Whether images are sampled by compiled code; else torch samples them, slower and to the same results.

    It is False if the environment has `CAMTORCH_NATIVE=0`, or if camtorch was installed without a C compiler:
    `camtorch --version` shows the reason.
    """
    return library() is not None
