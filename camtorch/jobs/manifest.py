"""The account of a job: which outputs were made, of what, and how; so that a job goes on where it was broken off.

A file of JSON lines in the folder of outputs, `.camtorch-JOB.jsonl`, and one for each shard. Lines are only ever added,
each in one piece; one that was cut off by a crash counts for nothing. What a line says of a file is checked by what is
in the file, so it never matters whether a line is old.

    {"settings": DIGEST, "is": {...}}      what the job was told, as of here
    {"begun": [OUTPUT, ...]}               from here on these files are the job's own
    {"made": {OUTPUT: SUM, ...}, "of": {INPUT: HASH, ...}, "variant": ..., "settings": DIGEST, "result": ...}
    {"failed": [OUTPUT, ...], "reason": ...}

Outputs are relative to the folder. Hashes are of files, BLAKE2b, 16 bytes, hexadecimal. A sum is "SIZE-CRC32": it
has to tell what befell a file by accident, and takes a fifth of the time.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
import os
import zlib
from collections import defaultdict
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import Any

from camtorch.jobs.items import Item, Json, Shard

try:
    import fcntl
except ImportError:  # on Windows nobody is kept from running a shard twice
    fcntl = None  # type: ignore[assignment]


@dataclass
class History:
    """What is known of an item's outputs."""

    records: list[dict[str, Json]] = field(default_factory=list)
    """Lines that say of what they were made."""
    begun: bool = False
    """Whether the job has ever begun to write them."""


@dataclass(frozen=True)
class Terms:
    """How outputs are called, and of what they are made: all that a process of a pool has to know of a manifest."""

    folder: Path
    settings: str
    """A hash of them."""

    def name(self, output: Path) -> str:
        """What lines call an output."""
        try:
            return output.relative_to(self.folder).as_posix()
        except ValueError:
            return str(output)

    def record(self, item: Item, hashes: dict[str, str], result: Json) -> dict[str, Json]:
        """A line about an item whose outputs were made of inputs with these hashes."""
        made = {self.name(path): _sum_of(path) for path in item.outputs}
        return {"made": made, "of": hashes, "variant": item.variant, "settings": self.settings, "result": result}

    def standing(self, item: Item, records: list[dict[str, Json]], hashes: dict[str, str]) -> dict[str, Json] | None:
        """The one of some lines by which all outputs are there as they would be made anew, or None."""
        wanted = list(hashes.values()), item.variant, self.settings
        fitting = [line for line in records if (list(line["of"].values()), line["variant"], line["settings"]) == wanted]
        if not fitting or not all(path.is_file() for path in item.outputs):
            return None
        made = {self.name(path): _sum_of(path) for path in item.outputs}
        return next((line for line in fitting if line["made"] == made), None)


def _sum_of(path: Path) -> str:
    size = found = 0
    with open(path, "rb") as file:
        while block := file.read(1 << 20):
            size, found = size + len(block), zlib.crc32(block, found)
    return f"{size}-{found:08x}"


class Manifest:
    """The account of a job in a folder, to be used in a `with` block.

    Args:
        folder: that of the outputs; made if there is none.
        job: what kind of job it is, a word.
        settings: all that outputs depend on beside their inputs; JSON.
        shard: whose account.

    Raises:
        OSError: no such folder can be made, or written to. BlockingIOError: somebody does the same right now.
    """

    folder: Path
    job: str
    settings: Any
    shard: Shard
    path: Path
    terms: Terms

    def __init__(self, folder: Path, job: str, settings: Json, shard: Shard | None = None):
        shard = shard or Shard()
        of = "" if shard.count == 1 else f"-{shard.rank}-of-{shard.count}"
        self.folder, self.job, self.settings, self.shard = folder, job, settings, shard
        self.path = folder / f".camtorch-{job}{of}.jsonl"
        text = json.dumps(settings, sort_keys=True, allow_nan=False)
        self.terms = Terms(folder, hashlib.blake2b(text.encode(), digest_size=16).hexdigest())
        self._histories: dict[str, History] = defaultdict(History)
        self._file = -1

    def __enter__(self) -> Manifest:
        self.folder.mkdir(parents=True, exist_ok=True)
        self._file = os.open(self.path, os.O_RDWR | os.O_CREAT | os.O_APPEND, 0o666)
        try:
            self._lock()
            end = os.lseek(self._file, 0, os.SEEK_END)
            if end:
                os.lseek(self._file, end - 1, os.SEEK_SET)
                if os.read(self._file, 1) != b"\n":  # cut off
                    os.write(self._file, b"\n")
            self.read()
            self._append({"settings": self.terms.settings, "is": self.settings})
        except BaseException:
            os.close(self._file)
            raise
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        os.close(self._file)

    def _lock(self) -> None:
        if fcntl is None:
            return
        try:
            fcntl.flock(self._file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EACCES):
                raise BlockingIOError(errno.EAGAIN, "another process does this right now", str(self.path)) from None
            # some network file systems know no locks

    def read(self) -> None:
        """Take up what all shards have said so far, of whatever number they were; nothing if there is no folder."""
        self._histories.clear()
        for path in sorted(self.folder.glob(f".camtorch-{self.job}*.jsonl")):
            for line in path.read_bytes().splitlines():
                with contextlib.suppress(ValueError, TypeError, AttributeError):  # cut off, or of somebody else
                    self._take(json.loads(line))

    def _take(self, line: dict[str, Json]) -> None:
        for name in line.get("begun", ()):
            self._histories[name].begun = True
        for name in line.get("made", ()):
            self._histories[name].records.append(line)

    def history(self, item: Item) -> History:
        """Of an item's outputs, before this run."""
        names = list(map(self.terms.name, item.outputs))
        histories = [self._histories.get(name, History()) for name in names]
        records = [line for line in histories[0].records if set(line["made"]) == set(names)]
        return History(records, all(one.begun for one in histories))

    def begin(self, item: Item) -> None:
        """Say that an item's outputs are to be written."""
        self._append({"begun": list(map(self.terms.name, item.outputs))})

    def made(self, record: dict[str, Json]) -> None:
        """Say that they were."""
        self._append(record)

    def failed(self, item: Item, reason: str) -> None:
        """Say that they could not."""
        self._append({"failed": list(map(self.terms.name, item.outputs)), "reason": reason})

    def _append(self, line: dict[str, Any]) -> None:
        rest = json.dumps(line, allow_nan=False).encode() + b"\n"
        while rest:  # less is written than asked for where a disk gets full, and then nothing, which is an error
            rest = rest[os.write(self._file, rest) :]
