"""The bases of the structures that C reads, and of the library."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from ctypes import CDLL, Array, Structure, addressof, sizeof
from typing import TYPE_CHECKING, Any, ClassVar, Protocol

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
        """Return the address of values and keep them alive with this structure; its copies do not keep them alive."""
        self.hold(values)
        return addressof(values) if isinstance(values, Array) else values.data_ptr()

    def hold(self, owner: object) -> None:
        """Have an owner of memory live as long as this structure. The first call comes before threads share it."""
        kept = getattr(self, "_kept", None)
        if kept is None:
            self._kept = [owner]
        else:
            kept.append(owner)


class Calls(CDLL):
    """A library whose calls refuse other structures than their own, after `declare`."""

    types: ClassVar[dict[str, tuple[Any, list[Any]]]]

    def declare(self) -> None:
        """Give each call the type of its result and those that it takes."""
        for name, (result, takes) in self.types.items():
            call = getattr(self, name)
            call.restype, call.argtypes = result, takes


def offsets(structs: Iterable[type[Struct]]) -> Iterator[int]:
    """Yield the size of each structure, then the offset and the size of each of its fields."""
    for struct in structs:
        yield sizeof(struct)
        for name, *_ in struct._fields_:
            field = getattr(struct, name)
            yield from (field.offset, field.size)


def layout(checksum: int, structs: Iterable[type[Struct]]) -> int:
    """Return what `camtorch_layout` of a library with such names, types and values returns if fields lie like here."""
    for number in offsets(structs):
        checksum = (checksum ^ number) * 16777619 & 0xFFFFFFFF
    return checksum
