"""The compiled sampler: which library is loaded, or why none is."""

from __future__ import annotations

import ctypes
import functools
import os
import warnings
from pathlib import Path

from camtorch.native.build import LIBRARY, REASON, VARIANTS, checksum, switched_off

_HERE = Path(__file__).resolve().parent
_BUILD = "python -m camtorch.native.build"


@functools.cache
def _find() -> tuple[ctypes.CDLL | None, str, bool]:
    """Return the library, its CPU's kind or why there is none, and whether it is there but stale."""
    if switched_off():
        return None, "off (CAMTORCH_NATIVE=0)", False
    path = _HERE / LIBRARY
    if not path.exists():
        reason = _HERE / REASON
        why = reason.read_text("utf-8").strip() if reason.exists() else "camtorch was not installed from here"
        return None, f"not built ({why}); with a C compiler `{_BUILD}` builds it", False
    try:
        library = ctypes.CDLL(str(path))
    except OSError as error:
        return None, f"not loaded ({error}); `{_BUILD}` builds it again", False
    here, built_from = checksum(), getattr(library, "camtorch_sources", None)
    if built_from is not None:
        built_from.restype = ctypes.c_uint32
    if here is not None and (built_from is None or built_from() != here):  # None if a package leaves the sources out
        why = "not used (built from other sources than those beside it)"
        return None, f"{why}; `{_BUILD}` or `pip install -e .` builds it again", True
    wanted = os.environ.get("CAMTORCH_CPU", "").strip().lower()
    if wanted and not library.camtorch_use(wanted.encode()):
        names = ", ".join(name for name in VARIANTS if library.camtorch_use(name.encode()))
        raise ValueError(f"CAMTORCH_CPU must be one of {names} on this CPU; got {wanted!r}. Unset it to use the best")
    library.camtorch_variant.restype = ctypes.c_char_p
    return library, library.camtorch_variant().decode(), False


@functools.cache
def library() -> ctypes.CDLL | None:
    """Return the library, loaded at first use, or None if there is none to use; its calls do not hold Python's lock."""
    found, why, is_stale = _find()
    if is_stale:
        warnings.warn(f"camtorch's native sampler is {why}", RuntimeWarning, stacklevel=2)
    return found


def state() -> str:
    """Return the variant of the library that runs on this machine's CPU, like "avx2", or why none does."""
    return _find()[1]


@functools.cache
def native_available() -> bool:
    """Whether images are sampled by compiled code; else torch samples them, slower and to the same results.

    It is False if the environment has `CAMTORCH_NATIVE=0`, or if camtorch was installed without a C compiler:
    `camtorch --version` shows the reason.
    """
    return library() is not None
