"""The account of a job, by which it goes on where it was broken off: which outputs were made, of what, and how.

A file of JSON lines in the folder of outputs, `.camtorch-JOB.jsonl`, and one for each shard. Lines are only ever added;
one that was cut off by a crash is skipped. What a line says is compared with the files, so old lines do no harm.

    {"settings": DIGEST, "is": {...}}      what the job was told from here on
    {"begun": [OUTPUT, ...]}               from here on these files are the job's own
    {"outputs": [OUTPUT, ...], "hashes": [HASH, ...], "inputs": [HASH, ...], "variant": ..., "settings": DIGEST,
     "result": ...}                        these were made

Outputs are relative to the folder; hashes are of files, BLAKE2b, 16 bytes, hexadecimal.
"""

from __future__ import annotations

import contextlib
import errno
import hashlib
import json
from pathlib import Path
from typing import IO, Any

from camtorch.jobs.items import Item, Json, Shard

try:
    import fcntl
except ImportError:  # Windows: a shard can be run twice at the same time there
    fcntl = None  # type: ignore[assignment]


class Manifest:
    """The account of a kind of job in a folder, that of its outputs, which is made if need be; for a `with` block.

    `settings` are all that outputs depend on beside their inputs, JSON. A second process with the same account is
    refused by a BlockingIOError.
    """

    def __init__(self, folder: Path, job: str, settings: Json, shard: Shard | None = None):
        self.folder, self.shard, self._job, self._stated = folder, shard or Shard(), job, settings
        text = json.dumps(settings, sort_keys=True, allow_nan=False)
        self.settings: str = hashlib.blake2b(text.encode(), digest_size=16).hexdigest()
        self._begun: set[str] = set()
        self._records: dict[tuple[str, ...], list[dict[str, Json]]] = {}

    def __enter__(self) -> Manifest:
        self.folder.mkdir(parents=True, exist_ok=True)
        of = "" if self.shard.count == 1 else f"-{self.shard.rank}-of-{self.shard.count}"
        self._file = (self.folder / f".camtorch-{self._job}{of}.jsonl").open("ab")
        try:
            lock(self._file, wait=False)
        except OSError:
            self._file.close()
            raise
        self.read()
        if self._file.tell():
            self._file.write(b"\n")  # the last line may be cut off
        self._append({"settings": self.settings, "is": self._stated})
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def read(self) -> None:
        """Take up what all shards have said so far, of whatever number they were; nothing if there is no folder."""
        self._begun, self._records = set(), {}
        for path in sorted(self.folder.glob(f".camtorch-{self._job}*.jsonl")):
            for text in path.read_bytes().splitlines():
                with contextlib.suppress(ValueError, TypeError, AttributeError):  # cut off, or not written by a job
                    line = json.loads(text)
                    self._begun.update(line.get("begun", ()))
                    if "outputs" in line:
                        self._records.setdefault(tuple(line["outputs"]), []).append(line)

    def _names(self, item: Item) -> list[str]:
        return [path.relative_to(self.folder).as_posix() for path in item.outputs]

    def has_begun(self, item: Item) -> bool:
        """Whether the job had ever begun to write all outputs of an item."""
        return self._begun.issuperset(self._names(item))

    def records(self, item: Item) -> list[dict[str, Json]]:
        """Lines that say of what an item's outputs were made."""
        return self._records.get(tuple(self._names(item)), [])

    def begin(self, item: Item) -> None:
        """Say that an item's outputs are to be written."""
        self._append({"begun": self._names(item)})

    def made(self, item: Item, record: dict[str, Json]) -> None:
        """Say that they were."""
        self._append({"outputs": self._names(item), **record})

    def _append(self, line: dict[str, Any]) -> None:
        self._file.write(json.dumps(line, allow_nan=False).encode() + b"\n")
        self._file.flush()


def lock(file: IO[bytes], *, wait: bool) -> None:
    """Have a file alone until it is closed, or raise a BlockingIOError; some file systems know no locks."""
    if fcntl is not None:
        try:
            fcntl.flock(file, fcntl.LOCK_EX if wait else fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            if error.errno in (errno.EAGAIN, errno.EACCES):
                raise BlockingIOError(errno.EAGAIN, "another process does this right now", file.name) from None
