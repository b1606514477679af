"""The command line: `python -m benchmarks --help`."""

import argparse
import json
import os
import sys
import time
from pathlib import Path

try:
    import cv2
    import torch

    from benchmarks import augment, calibration, cameras, harness, images, points, samples, training
except ModuleNotFoundError as error:
    sys.exit(f"{error}. The benchmarks need more than camtorch: pip install -e '.[benchmark]'")

_MODULES = (points, images, training, augment, samples, calibration)
SUBJECTS = {module.__name__.rpartition(".")[2]: module for module in _MODULES}
TABLES = {table.name: table for subject in SUBJECTS.values() for table in subject.TABLES}
_LIMITS = {
    "avx2": {
        "ATEN_CPU_CAPABILITY": "avx2",
        "ONEDNN_MAX_CPU_ISA": "AVX2",
        "MKL_ENABLE_INSTRUCTIONS": "AVX2",
        "OPENCV_CPU_DISABLE": "AVX512-SKX,AVX512-ICL",
        "OPENCV_IPP": "avx2",
        "NUMBA_CPU_FEATURES": "-avx512f",
        "NPY_DISABLE_CPU_FEATURES": "X86_V4 AVX512_ICL AVX512_SPR",
    },
    "avx512": {},
}
"""Each kind of processor -> what keeps torch, OpenCV, NumPy and their libraries from using a better one."""


def main(arguments: list[str] | None = None) -> None:
    """Measure what the arguments ask for, and print it."""
    parser = _parser()
    options = parser.parse_args(arguments, harness.Options())
    if min(n for n in (options.size, options.threads, options.repeats) if n is not None) < 1:
        parser.error("--size, --threads and --repeats must be at least 1")
    if options.device == "cuda" and not torch.cuda.is_available():
        parser.error("--device cuda: torch sees no GPU here")
    _start_again(options)
    arguments = vars(options) | {"json": str(options.json)}
    torch.set_num_threads(options.threads)
    cv2.setNumThreads(options.threads)
    torch._dynamo.config.recompile_limit = 64  # versions of a function: every contestant is one
    options.device = torch.device(options.device)
    options.size = options.size or (10_000 if options.quick else 1_000_000)
    options.repeats = options.repeats or (3 if options.quick else 9)
    options.compile = options.compile and not (options.quick or options.no_library)
    facts = harness.machine(options.device)
    print(*(f"{name}: {fact}" for name, fact in facts.items()), sep=", ")
    print(f"Medians of at most {options.repeats} rounds, with the fastest and the slowest round.", flush=True)
    results: dict[str, dict[str, harness.Figures]] = {}
    start = time.perf_counter()
    for name in SUBJECTS if "all" in options.subject else options.subject:
        for row in SUBJECTS[name].rows(options):
            if row.figures:
                results.setdefault(row.table, {})[row.name] = dict(row.figures)
        for table in SUBJECTS[name].TABLES:
            if found := results.get(table.name):
                print(f"\n### {table.name}\n\n{table.markdown([found], spread=True)}", flush=True)
    print(f"({time.perf_counter() - start:.0f} s)")
    if options.json:
        content = {"machine": facts, "arguments": arguments, "results": results}
        options.json.write_text(json.dumps(content, indent=1) + "\n")


def _start_again(options: harness.Options) -> None:
    """Start this program again if a library has to be told, before it loads, which processor it runs on."""
    told = {"CAMTORCH_CPU": options.cpu, **_LIMITS[options.cpu]} if options.cpu else {}
    told |= {"CAMTORCH_NATIVE": "0"} if options.no_library else {}
    if any(os.environ.get(name) != value for name, value in told.items()):
        os.execve(sys.executable, [sys.executable, "-m", "benchmarks", *sys.argv[1:]], os.environ | told)


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks",
        description="Measure camtorch beside OpenCV, kornia and the floor of this machine: speed, memory and accuracy. "
        "Tables go to stdout as markdown, progress to stderr. camtorch 2.0x: the next takes twice its time.",
    )
    add = parser.add_argument
    keys = tuple(cameras.COEFFICIENTS)
    add("subject", nargs="*", choices=[*SUBJECTS, "all"], default="all", help="default: all")
    add("--size", type=int, metavar="N", help="points of the subject points (default: 1000000)")
    add("--model", nargs="+", choices=keys, default=[], metavar="KEY", help=f"only these models of {', '.join(keys)}")
    add("--rows", default="", metavar="PATTERN", help="only rows whose name has this regular expression")
    add("--device", choices=("cpu", "cuda"), default="cpu", help="where tensors live (default: cpu)")
    add("--threads", type=int, default=2, help="of torch and of OpenCV (default: 2)")
    add("--cpu", choices=list(_LIMITS), help="limit everyone to this kind of processor (default: what it is)")
    add("--no-library", action="store_true", help="camtorch alone, without its compiled library")
    add("--repeats", type=int, metavar="R", help="rounds that medians are taken of (default: 9)")
    add("--seconds", type=float, default=0.6, metavar="S", help="of a row's rounds, three at least (default: 0.6)")
    add("--no-compile", dest="compile", action="store_false", help="without torch.compile: about a minute a model")
    add("--json", type=Path, metavar="FILE", help="write the machine and every figure to this file")
    add("--quick", action="store_true", help="small inputs, nothing compiled: does everything work?")
    return parser


if __name__ == "__main__":
    main()
