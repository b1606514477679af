"""The bases of the structures that C reads, and of the library."""

from __future__ import annotations

import ctypes
from collections.abc import Iterable, Iterator
from typing import TYPE_CHECKING, Annotated, Any, Protocol, get_args

if TYPE_CHECKING:
    from torch import Tensor

# the type of a value for Python, and for C
Int32 = Annotated[int, ctypes.c_int32]
Int64 = Annotated[int, ctypes.c_int64]
Unsigned = Annotated[int, ctypes.c_uint32]
Double = Annotated[float, ctypes.c_double]
Text = Annotated[bytes, ctypes.c_char_p]
Pointer = Annotated[int | None, ctypes.c_void_p]
Void = Annotated[None, None]


class Numbers(Protocol):
    """An array in a structure; `[:] =` refuses other lengths."""

    def __setitem__(self, at: int | slice, values: Any) -> None: ...
    def __iter__(self) -> Iterator[int]: ...


class Struct(ctypes.Structure):
    """A structure of C, which refuses other fields than its header has, and keeps alive what it points to."""

    __slots__ = ("_kept",)
    _kept: list[object]

    @classmethod
    def lay_out(cls) -> None:
        """Make the fields that the class names, after those of structures in it."""
        cls._fields_ = [(name, _type_in_c(hint)) for name, hint in cls.__annotations__.items()]

    def keep(self, values: Tensor | ctypes.Array[Any]) -> int:
        """Return the address of values and keep them alive with this structure; its copies do not keep them alive."""
        self.hold(values)
        return ctypes.addressof(values) if isinstance(values, ctypes.Array) else values.data_ptr()

    def hold(self, owner: object) -> None:
        """Have an owner of memory live as long as this structure. The first call comes before threads share it."""
        kept = getattr(self, "_kept", None)
        if kept is None:
            self._kept = [owner]
        else:
            kept.append(owner)


class TypedLibrary(ctypes.CDLL):
    """A library whose calls refuse other structures than their own, after `declare`."""

    def declare(self) -> None:
        """Give each call the type of its result and those that it takes, structures by their addresses."""
        for name, hint in type(self).__annotations__.items():
            takes, result = get_args(hint)
            call = getattr(self, name)
            call.restype = _type_in_c(result)
            call.argtypes = [_type_in_c(one) if get_args(one) else ctypes.POINTER(one) for one in takes]


def _type_in_c(hint: Any) -> Any:
    """Return what `Annotated` says of C, or the structure that a hint is."""
    return get_args(hint)[1] if get_args(hint) else hint


def offsets(structs: Iterable[type[Struct]]) -> Iterator[int]:
    """Yield the size of each structure, then the offset and the size of each of its fields."""
    for struct in structs:
        yield ctypes.sizeof(struct)
        for name, *_ in struct._fields_:
            field = getattr(struct, name)
            yield from (field.offset, field.size)


def layout(checksum: int, structs: Iterable[type[Struct]]) -> int:
    """Return what `camtorch_layout` of a library with such names, types and values returns if fields lie like here."""
    for number in offsets(structs):
        checksum = (checksum ^ number) * 16777619 & 0xFFFFFFFF
    return checksum
