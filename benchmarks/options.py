"""What the command line decides, and how it shows what it is at."""

from __future__ import annotations

import sys
from dataclasses import dataclass

import torch


@dataclass(frozen=True)
class Options:
    """One run of the benchmarks.

    Args:
        size: number of points of the subject "points".
        models: keys of `camtorch.MODELS`; empty for each subject's own choice.
        device: where tensors live. OpenCV always works on the CPU.
        threads: for torch and OpenCV.
        repeats: rounds of which the median is taken.
        seconds: for the rounds of one operation; slow contestants take fewer.
        compile: whether `torch.compile` competes.
        quick: small inputs, to see that everything works.
    """

    size: int
    models: tuple[str, ...]
    device: torch.device
    threads: int
    repeats: int
    seconds: float
    compile: bool
    quick: bool

    def chosen(self, keys: tuple[str, ...]) -> tuple[str, ...]:
        """Those of a subject's models that were asked for."""
        return tuple(key for key in keys if not self.models or key in self.models)


def progress(text: str) -> None:
    """Say on stderr what is being measured: one line that is overwritten, or a line each where that is a file."""
    if sys.stderr.isatty():
        sys.stderr.write(f"\r\x1b[K{text[:110]}")
    elif text:
        sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


def complain(text: str) -> None:
    """Say something on stderr that is to stay there."""
    progress("")
    sys.stderr.write(f"{text}\n")
