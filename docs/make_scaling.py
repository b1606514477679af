"""Cost over work on the page on performance: `python docs/make_scaling.py` writes the figure, its numbers and tables.

Work grows: points, pixels, images of a batch, workers. A line's slope is that between its last point and the one two
before, on logarithmic axes: 1 where twice the work takes twice the time. It needs
`pip install -e ".[benchmark]" albumentations`.
"""

import json
import math
import os
import subprocess
import sys
from multiprocessing import Process
from pathlib import Path
from statistics import median

sys.path.insert(0, str(Path(__file__).parents[1]))

from benchmarks.__main__ import _LIMITS

DOCS = Path(__file__).parent
SEED = 0


def measured() -> dict[str, dict[str, dict[str, float]]]:
    """Part -> contestant -> amount of work -> seconds."""
    import albumentations
    import cv2
    import numpy as np
    import torch

    import camtorch as ct
    import camtorch.augment.numpy as arrays
    from benchmarks.harness import clocked

    torch.manual_seed(SEED)
    rng = np.random.default_rng(SEED)
    k = [0.02, -0.01, 0.002, -0.0005]
    result: dict[str, dict[str, dict[str, float]]] = {}

    def add(part: str, work: int, runs: dict) -> None:
        for run in runs.values():
            run()
        calls = {who: max(1, int(4e-3 / clocked(run))) for who, run in runs.items()}
        rounds = [{who: clocked(run, None, calls[who]) for who, run in runs.items()} for _ in range(9)]
        for who in runs:
            result.setdefault(part, {}).setdefault(who, {})[str(work)] = median(each[who] for each in rounds)
        print(part, work, {who: f"{median(r[who] for r in rounds):.3g}" for who in runs}, flush=True)

    def camera_of(height: int, width: int) -> ct.KannalaBrandt:
        f = width / 3
        numbers = [f, f, (width - 1) / 2, (height - 1) / 2]
        return ct.KannalaBrandt(numbers, k, image_size=(height, width)).requires_grad_(False)

    torch.set_num_threads(1)
    cv2.setNumThreads(1)
    camera, count = camera_of(480, 640), 10
    matrix = camera.K.double().numpy()
    while count <= 10_000_000:
        points = torch.randn(count, 3) * 0.5 + torch.tensor([0.0, 0.0, 2.0])
        theirs, zero = points.double().numpy()[:, None], np.zeros(3)
        runs = {"camtorch": lambda points=points: camera.project(points)}
        runs["OpenCV"] = lambda p=theirs, z=zero: cv2.fisheye.projectPoints(p, z, z, matrix, np.array(k))
        add("points projected", count, runs)
        count *= 10
    for height in (60, 120, 240, 480, 960, 1920):
        camera = camera_of(height, height * 4 // 3)
        warp, image = ct.Dewarp(camera), rng.integers(256, size=(height, height * 4 // 3, 3), dtype=np.uint8)
        maps = cv2.fisheye.initUndistortRectifyMap(
            camera.K.double().numpy(),
            np.array(k),
            np.eye(3),
            warp.target.K.double().numpy(),
            image.shape[1::-1],
            cv2.CV_16SC2,
        )
        runs = {"camtorch": lambda w=warp, i=image: w(i)}
        runs["OpenCV"] = lambda m=maps, i=image: cv2.remap(i, *m, cv2.INTER_LINEAR)
        add("pixels of an image, undone by kept maps", height * height * 4 // 3, runs)
    source = camera_of(240, 320)
    augment = ct.augment.RandomMount(camera=source, min_filled=0)
    for batch in (1, 2, 4, 8, 16, 32, 64):
        sample = {"image": torch.randint(256, (batch, 3, 240, 320), dtype=torch.uint8)}
        sample["keypoints"] = torch.rand(batch, 68, 2) * 200
        add("images of a batch, RandomMount", batch, {"camtorch": lambda s=sample: augment(s)})
    item = {"image": rng.integers(256, size=(240, 320, 3), dtype=np.uint8)}
    item["keypoints"] = (rng.random((68, 2)) * 200).astype(np.float32)
    affine = albumentations.Compose(
        [albumentations.Affine(rotate=(-10, 10), p=1)],
        keypoint_params=albumentations.KeypointParams("xy", remove_invisible=False),
    )
    functions = {"camtorch": arrays.Transform(augment), "albumentations": affine}

    class Samples(torch.utils.data.Dataset):
        def __init__(self, function):
            self.function = function

        def __len__(self):
            return 1024

        def __getitem__(self, i):
            made = self.function(**item)
            return {name: made[name] for name in item}

    for workers in range((os.cpu_count() or 1) + 1):
        runs = {}
        for who, function in functions.items():
            loader = torch.utils.data.DataLoader(
                Samples(function),
                16,
                num_workers=workers,
                persistent_workers=workers > 0,
                collate_fn=ct.augment.collate,
            )
            runs[who] = lambda loader=loader: sum(1 for _ in loader)
        add("workers, 1,024 samples (0: none)", workers, runs)

    burning = Process(target=_burn, daemon=True)
    burning.start()
    torch.set_num_threads(os.cpu_count() or 1)
    cv2.setNumThreads(os.cpu_count() or 1)
    warp, batch = ct.Dewarp(camera_of(720, 1280)), torch.randint(256, (8, 3, 720, 1280), dtype=torch.uint8)
    image = rng.integers(256, size=(720, 1280, 3), dtype=np.uint8)
    maps = cv2.fisheye.initUndistortRectifyMap(
        warp.source.K.double().numpy(),
        np.array(k),
        np.eye(3),
        warp.target.K.double().numpy(),
        (1280, 720),
        cv2.CV_16SC2,
    )
    runs = {"camtorch": lambda: warp(batch)}
    runs["OpenCV"] = lambda: [cv2.remap(image, *maps, cv2.INTER_LINEAR) for _ in range(8)]
    add("beside a busy process", 1, runs)
    burning.kill()
    burning.join()
    add("beside a busy process", 0, runs)
    result["memory"] = {"MB": _floors()}
    return result


def _burn() -> None:
    while True:
        pass


def _floors() -> dict[str, float]:
    """MB that a process holds at most after it has imported or done something."""
    steps = {
        "import torch": "import torch",
        "import camtorch": "import camtorch",
        "a projected point": "import camtorch as ct; ct.Pinhole([9.0] * 4).project([[0.0, 0, 1]])",
        "a warped image of 720x1280x3": (
            "import camtorch as ct, numpy as np; c = ct.Pinhole([900.0, 900, 639.5, 359.5], image_size=(720, 1280));"
            "ct.Dewarp(c)(np.zeros((720, 1280, 3), np.uint8))"
        ),
    }
    # not ru_maxrss, which a child takes over from the process that forked it
    print_peak = "; print(*(x.split()[1] for x in open('/proc/self/status') if x.startswith('VmHWM')))"
    return {
        name: int(subprocess.run([sys.executable, "-c", code + print_peak], capture_output=True, check=True).stdout)
        / 1e3
        for name, code in steps.items()
    }


def drawn(runs: dict[str, dict]) -> None:
    """One panel a part, a line a contestant and processor."""
    import matplotlib

    matplotlib.use("agg")
    import matplotlib.pyplot as plt

    parts = [part for part in next(iter(runs.values())) if part not in ("memory", "beside a busy process")]
    figure, axes = plt.subplots(1, len(parts), figsize=(13, 3.4), layout="constrained")
    for axis, part in zip(axes, parts, strict=True):
        for style, (cpu, run) in zip(("-", "--"), runs.items(), strict=False):
            for colour, (who, line) in zip(("#1e64f0", "#e21d48"), run[part].items(), strict=False):
                work, seconds = [int(x) for x in line], [1e3 * s for s in line.values()]
                slope = ""
                if 0 not in work:
                    (a, b), (x, y) = (work[-3], work[-1]), (seconds[-3], seconds[-1])
                    slope = f", slope {math.log(y / x) / math.log(b / a):.2f}"
                axis.plot(work, seconds, style, color=colour, marker=".", label=f"{who}, {cpu}{slope}")
        if 0 not in work:
            axis.set(xscale="log", yscale="log")
        else:
            axis.set(xticks=work, ylim=(0, None))
        axis.set(xlabel=part, ylabel="ms")
        axis.legend(fontsize=7)
        axis.grid(alpha=0.3)
    figure.savefig(DOCS / "images" / "performance-scaling.png", dpi=80)


def write_tables(runs: dict[str, dict]) -> None:
    """Write the tables of a busy process and of memory into the page."""
    rows = ["| 8 images 3x720x1280 uint8, 2 threads, ms | quiet | beside a busy process |", "|---|---:|---:|"]
    for who in ("camtorch", "OpenCV"):
        pairs = [run["beside a busy process"][who] for run in runs.values()]
        cells = (" / ".join(f"{1e3 * pair[busy]:.3g}" for pair in pairs) for busy in ("0", "1"))
        rows.append(f"| {who}, kept map: {' / '.join(runs)} | {' | '.join(cells)} |")
    rows += ["", "| a process has at most, MB | |", "|---|---:|"]
    rows += [f"| {step} | {size:.0f} |" for step, size in next(iter(runs.values()))["memory"]["MB"].items()]
    page = DOCS / "performance.md"
    start, end = "<!-- make_scaling.py -->\n", "<!-- /make_scaling.py -->"
    before, _, rest = page.read_text().partition(start)
    page.write_text("\n".join((before + start + rows[0], *rows[1:], end + rest.partition(end)[2])))


if __name__ == "__main__":
    if len(sys.argv) > 1 and sys.argv[1] == "--one":
        Path(sys.argv[2]).write_text(json.dumps(measured()))
        sys.exit()
    path = DOCS / "performance-scaling.json"
    runs = {}
    for cpu in ("avx2", "avx512"):
        environment = {**os.environ, **_LIMITS[cpu], "CAMTORCH_CPU": cpu}
        subprocess.run([sys.executable, __file__, "--one", str(path)], env=environment, check=True)
        runs["AVX2" if cpu == "avx2" else "AVX-512"] = json.loads(path.read_text())
    path.write_text(json.dumps(runs, indent=1) + "\n")
    drawn(runs)
    write_tables(runs)
