"""The command line: `python -m benchmarks --help`."""

from __future__ import annotations

import argparse
import json
import sys
import time
from dataclasses import asdict
from pathlib import Path

try:
    import cv2
    import torch

    from benchmarks import (
        augment,
        calibration,
        cameras,
        folders,
        images,
        load,
        loader,
        machine,
        points,
        samples,
        scaling,
        stereo,
    )
    from benchmarks.options import Options, progress
except ModuleNotFoundError as error:
    sys.exit(f"{error}. The benchmarks need more than camtorch: pip install -e '.[benchmark]'")

SUBJECTS = {
    "points": points,
    "images": images,
    "samples": samples,
    "augment": augment,
    "loader": loader,
    "calibration": calibration,
    "stereo": stereo,
    "folders": folders,
    "load": load,
    "scaling": scaling,
}
# torch keeps so many compiled versions of one function and then gives up; here every contestant is a version
_COMPILED_VERSIONS = 64


def main(arguments: list[str] | None = None) -> None:
    """Measure what the arguments ask for, and print it."""
    parser = _parser()
    given = parser.parse_args(arguments)
    if given.device == "cuda" and not torch.cuda.is_available():
        parser.error("--device cuda: torch sees no GPU here")
    torch.set_num_threads(given.threads)
    cv2.setNumThreads(given.threads)
    torch._dynamo.config.recompile_limit = _COMPILED_VERSIONS
    options = Options(
        size=given.size or (10_000 if given.quick else 1_000_000),
        models=tuple(given.model),
        device=torch.device(given.device),
        threads=given.threads,
        repeats=given.repeats or (3 if given.quick else 9),
        seconds=given.seconds,
        compile=given.compile and not given.quick,
        quick=given.quick,
    )
    facts = machine.describe(options.device)
    print(", ".join(f"{name}: {fact}" for name, fact in facts.items()), flush=True)
    print(f"Medians of at most {options.repeats} rounds, in which the contestants take turns.", flush=True)
    results = {}
    start = time.perf_counter()
    for name in given.subject or SUBJECTS:
        records, tables = SUBJECTS[name].run(options)
        results[name] = [asdict(record) for record in records]
        progress("")
        print("".join(tables), flush=True)
    print(f"({time.perf_counter() - start:.0f} s)")
    if given.json:
        content = {"machine": facts, "arguments": vars(given) | {"json": str(given.json)}, "results": results}
        given.json.write_text(json.dumps(content, indent=1) + "\n")


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Measure camtorch beside OpenCV, kornia and the floor of this machine: speed, memory and accuracy. "
        "Tables go to stdout as markdown, progress to stderr. (2.0x) means: takes twice as long.",
    )
    parser.add_argument("subject", nargs="*", choices=list(SUBJECTS), help="default: all")
    parser.add_argument("--size", type=_positive, metavar="N", help="points of the subject points (default: 1000000)")
    parser.add_argument(
        "--model",
        nargs="+",
        choices=tuple(cameras.COEFFICIENTS),
        default=[],
        metavar="KEY",
        help=f"only these models; of {', '.join(cameras.COEFFICIENTS)}. images, calibration, stereo and scaling have "
        "a few",
    )
    parser.add_argument("--device", choices=("cpu", "cuda"), default="cpu", help="where tensors live (default: cpu)")
    parser.add_argument("--threads", type=_positive, default=2, help="of torch and of OpenCV (default: 2)")
    parser.add_argument("--repeats", type=_positive, metavar="R", help="rounds that medians are taken of (default: 9)")
    parser.add_argument(
        "--seconds",
        type=float,
        default=0.6,
        metavar="S",
        help="for the rounds of one operation: slow contestants take fewer, three at least (default: 0.6)",
    )
    parser.add_argument(
        "--no-compile",
        dest="compile",
        action="store_false",
        help="without torch.compile, which takes about a minute a model",
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the machine and every figure to this file")
    parser.add_argument("--quick", action="store_true", help="small inputs, nothing compiled: does everything work?")
    return parser


def _positive(text: str) -> int:
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1; got {value}")
    return value


if __name__ == "__main__":
    main()
