"""The base of the structures that C reads."""

from __future__ import annotations

from collections.abc import Iterator
from ctypes import Array, Structure, addressof
from typing import TYPE_CHECKING, Any, Protocol

if TYPE_CHECKING:
    from torch import Tensor


class Numbers(Protocol):
    """An array in a structure; `[:] =` refuses other lengths."""

    def __setitem__(self, at: int | slice, values: Any) -> None: ...
    def __iter__(self) -> Iterator[int]: ...


class Struct(Structure):
    """A structure of C, which refuses other fields than its header has, and keeps alive what it points to."""

    __slots__ = ("_kept",)
    _kept: list[object]

    def keep(self, values: Tensor | Array[Any]) -> int:
        """Return the address of values that live as long as this structure, which its copies do not keep."""
        self.hold(values)
        return addressof(values) if isinstance(values, Array) else values.data_ptr()

    def hold(self, owner: object) -> None:
        """Have an owner of memory live as long as this structure. The first call comes before threads share it."""
        try:
            self._kept.append(owner)
        except AttributeError:
            self._kept = [owner]
