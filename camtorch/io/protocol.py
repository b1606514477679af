"""What a file of this room provides that is a format: its names, and functions that recognise, read and write."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from camtorch.io.record import Record
from camtorch.rig import Rig


@dataclass(frozen=True)
class Names:
    """What a format and its files are called.

    Args:
        format: its key in `camtorch.load` and `camtorch.save`.
        title: what errors call it.
        suffixes: those of the files that are written, with the dot; content says what a file to read is.
        patterns: names of files, as fnmatch has them, that mean this format when one is written without another word;
            of several formats the one with the longest pattern that fits is taken.
        in_folder: files that stand for the folder they are in, the first that is there.
    """

    format: str
    title: str
    suffixes: tuple[str, ...] = ()
    patterns: tuple[str, ...] = ()
    in_folder: tuple[str, ...] = ()


class Format(Protocol):
    """Any module of a format."""

    @property
    def NAMES(self) -> Names:  # noqa: N802
        """What it and its files are called."""


class KeyFormat(Format, Protocol):
    """A module that reads keys and values: YAML, JSON, XML, Python literals, NumPy archives."""

    def matches(self, keys: dict[str, Any]) -> bool:
        """Whether these are the keys of such a file."""

    def parse(self, record: Record) -> Rig:
        """The cameras of the keys, in float64. Raises CameraFileError, as `record.fail` does."""


class ContentFormat(Format, Protocol):
    """A module that reads files of any other kind."""

    def matches(self, path: str, content: bytes) -> bool:
        """Whether this is such a file."""

    def read(self, path: str, content: bytes) -> Rig:
        """The cameras of a file, in float64, with what lies beside it. Raises CameraFileError."""


class WrittenFormat(Format, Protocol):
    """A module that writes."""

    def render(self, rig: Rig, path: str) -> str | dict[str, bytes]:
        """The text of a file; or the contents of files that are no text, or several, by their paths.

        Raises CameraFileError for what the format cannot hold.
        """
