"""What a job consists of: items, each of some files read and some files made of them; and which of them a shard has."""

from __future__ import annotations

import os
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
    """What the outputs depend on beside what is in the inputs and the settings of the job: labels, for example."""

    @property
    def name(self) -> str:
        return str(self.inputs[0])


Work: TypeAlias = Callable[[Item], Json]
"""Makes all outputs of an item, each whole or not at all, and returns what the account is to keep of it. It is pickled,
once for each process. Whatever it raises is why the item failed, and its warnings are notes about the item.
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

        RANK alone, which may be left over in a shell, means nothing; nor does a script that sbatch runs without srun.

        Raises:
            ValueError: what they set is missing, or no numbers that fit.
        """
        for mark, *names in (
            ("TORCHELASTIC_RUN_ID", "RANK", "WORLD_SIZE", "LOCAL_WORLD_SIZE"),
            ("SLURM_STEP_ID", "SLURM_PROCID", "SLURM_NTASKS", "SLURM_NTASKS_PER_NODE"),
        ):
            if os.environ.get(mark, ""):
                rank, count, local = (os.environ.get(name, "") for name in names)
                if not (rank.isdecimal() and count.isdecimal() and int(rank) < int(count)):
                    raise ValueError(f"{names[0]}={rank!r} and {names[1]}={count!r} do not say which shard of how many")
                return cls(int(rank), int(count), max(1, int(local)) if local.isdecimal() else 1)
        return cls()

    def of(self, items: Sequence[T]) -> Sequence[T]:
        """Its part of all items."""
        return items[self.rank :: self.count]
