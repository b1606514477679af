"""The machine that the figures belong to."""

from __future__ import annotations

import os
import platform
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path

import cv2
import torch

import camtorch
from camtorch.native import library


def describe(device: torch.device) -> dict[str, str | int]:
    """What has to be known to compare a figure with another run's. Call it after the threads are set."""
    facts = {
        "cpu": _cpu(),
        "cores": os.cpu_count() or 1,
        "torch threads": torch.get_num_threads(),
        "OpenCV threads": cv2.getNumThreads(),
        "python": platform.python_version(),
        "torch": torch.__version__,
        "camtorch": camtorch.__version__,
        "native sampler": library.state(),
        "kornia": version("kornia"),
        "OpenCV": cv2.__version__,
        "deltacamera": _version("deltacamera"),
    }
    if device.type == "cuda":
        facts["gpu"] = torch.cuda.get_device_name(device)
    return facts


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return "not installed"


def _cpu() -> str:
    """The processor's name, and what tells it where a virtual machine hides that."""
    listing = Path("/proc/cpuinfo")
    if not listing.exists():
        return platform.processor() or platform.machine()
    facts = dict(
        (part.strip() for part in line.split(":", 1)) for line in listing.read_text().splitlines() if ":" in line
    )
    family, model = (facts.get(part, "?") for part in ("cpu family", "model"))
    vectors = torch.backends.cpu.get_cpu_capability()
    return f"{facts.get('model name', platform.machine())} (family {family}, model {model}; {vectors})"
