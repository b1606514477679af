"""What a file of this room provides that is a format: its names, and functions that recognise, read and write."""

from __future__ import annotations

from typing import Any, Protocol

from camtorch.cameras.rig import Rig
from camtorch.io.record import Names, Record
from camtorch.io.writing import Lossy


class Format(Protocol):
    """Any module of a format. What it cannot read or hold is a CameraFileError, as of `record.fail`."""

    @property
    def NAMES(self) -> Names: ...  # noqa: N802


class KeyFormat(Format, Protocol):
    """A module that reads keys and values, of YAML, JSON, XML, Python literals or NumPy archives, in float64."""

    def matches(self, keys: dict[str, Any]) -> bool: ...
    def parse(self, record: Record) -> Rig: ...


class ContentFormat(Format, Protocol):
    """A module that reads files of any other kind, with the files beside them, in float64."""

    def matches(self, path: str, content: bytes) -> bool: ...
    def read(self, path: str, content: bytes) -> Rig: ...


class WrittenFormat(Format, Protocol):
    """A module that writes: the text of a file; or the contents of files that are no text, or several, by paths."""

    def render(self, rig: Rig, lossy: Lossy) -> str | dict[str, bytes]: ...
