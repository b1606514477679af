"""What a job consists of: items, each of some files read and some files made of them; and which of them a shard has."""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeAlias, TypeVar

Json: TypeAlias = Any
"""What JSON holds."""
T = TypeVar("T")


@dataclass(frozen=True)
class Item:
    """Some files, and what is made of them."""

    inputs: tuple[Path, ...]
    """All that is read; reports call the item by the first one."""
    outputs: tuple[Path, ...]
    """All that is written, of no other item."""
    variant: str = ""
    """What the outputs depend on beside what is in the inputs and the settings of the job: a seed, for example."""
    size: int = 1
    """How much work it is: the frames of a video."""

    @property
    def name(self) -> str:
        return str(self.inputs[0])


@dataclass(frozen=True)
class Listener:
    """Who hears of the work on an item while it goes on."""

    note: Callable[[str], None]
    """Of what the user should know; where it begins with the item's name, that is left out."""
    done: Callable[[int], object]
    """Of how much of `Item.size` is done."""


Work: TypeAlias = Callable[[Item, Listener], Json]
"""Makes all outputs of an item, each whole or not at all, and returns what the manifest is to keep of it.

It is pickled, once for each process. Whatever it raises is why the item failed; of a ValueError or OSError the text is
shown as it is.
"""


def check(items: Sequence[Item], others: Iterable[Path] = ()) -> None:
    """Refuse, by a ValueError, items that would write over each other, or over what is read, by them or in `others`."""
    read = {os.path.realpath(path): path for path in (*(path for item in items for path in item.inputs), *others)}
    of_place: dict[str, Item] = {}
    for item in items:
        for path in item.outputs:
            place = os.path.realpath(path)
            other = of_place.setdefault(place, item)
            if other is not item:
                raise ValueError(f"{other.name} and {item.name} would both be written to {path}")
            if place in read:
                raise ValueError(f"{path}: would overwrite {read[place]}, which is read; name another folder")


@dataclass(frozen=True)
class Shard:
    """Every `count`-th item from the `rank`-th on, for one of `count` processes that share a job."""

    rank: int = 0
    count: int = 1
    local: int = 1
    """How many of them are on this machine."""

    @classmethod
    def of_environment(cls) -> Shard:
        """That of a process which torchrun or srun started, by what they set; else all items.

        RANK and WORLD_SIZE may be left over in a shell: without torchrun's own mark they only give a warning.

        Raises:
            ValueError: what they set is missing, or no numbers that fit.
        """
        known = os.environ
        for mark, rank, count, local in (
            ("TORCHELASTIC_RUN_ID", "RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE"),
            # a script that sbatch runs has no step: SLURM_NTASKS is what was asked for, and nobody else works
            ("SLURM_STEP_ID", "SLURM_PROCID", "SLURM_NTASKS", "SLURM_NTASKS_PER_NODE"),
        ):
            if known.get(mark, ""):
                values = [known.get(name, "") for name in (rank, count)]
                if not all(value.isascii() and value.isdigit() for value in values) or int(values[0]) >= int(values[1]):
                    raise ValueError(
                        f"{rank}={values[0]!r} and {count}={values[1]!r} do not say which shard of how many"
                    )
                here = known.get(local, "")
                return cls(int(values[0]), int(values[1]), max(1, int(here)) if here.isdigit() else 1)
        rank, count = known.get("RANK", ""), known.get("WORLD_SIZE", "")
        if rank not in ("", "0") or count not in ("", "1"):
            warnings.warn(
                f"RANK={rank} WORLD_SIZE={count} is set, but not by torchrun or srun, and was not heeded: "
                "all files were asked for; --shard 1/4 makes the first of four parts",
                stacklevel=2,
            )
        return cls()

    def of(self, items: Sequence[T]) -> Sequence[T]:
        """Its part of all items."""
        return items[self.rank :: self.count]
