"""`camtorch dewarp` on a folder of JPEGs, beside a script that reads, warps and writes.

Both sides are new processes, so the time in which they start and import torch is in both; what they write is checked to
be the same files.
"""

import filecmp
import shutil
import subprocess
import sys
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
import torch
from PIL import Image

import camtorch as ct
from benchmarks import cameras
from benchmarks.harness import OURS, Options, Row, Table, measure

SCRIPT = "read + warp + write"
TABLES = (Table("folders", "a folder, s", {OURS: (OURS,), SCRIPT: (SCRIPT,)}, 1),)
_ROOT = Path(__file__).resolve().parents[1]
_SIZE, _QUICK_SIZE = (720, 1280), (120, 160)
_SOURCE = """
import sys
from pathlib import Path
import numpy as np
import torch
from PIL import Image
import camtorch as ct

camera, folder, out, rank, count = sys.argv[1:]
torch.set_num_threads(1)
warp = ct.Dewarp(ct.load(camera).camera, tolerance=0.001)  # as of camtorch dewarp, like the quality
for path in sorted(Path(folder).iterdir())[int(rank) :: int(count)]:
    image = torch.from_numpy(np.array(Image.open(path))).permute(2, 0, 1)
    with torch.no_grad():
        result = warp(image[None])[0].permute(1, 2, 0).contiguous().numpy()
    Image.fromarray(result).save(Path(out, path.name), quality=95)
"""


def rows(options: Options) -> Iterator[Row]:
    """Measure a folder, with one job and with two."""
    size, count = (_QUICK_SIZE, 6) if options.quick else (_SIZE, 300)
    with TemporaryDirectory(prefix="camtorch-benchmark-") as name:
        source, camera, ours, theirs = (Path(name, part) for part in ("images", "camera.yml", "ours", "theirs"))
        lens = cameras.camera("kannala_brandt", torch.device("cpu"), size=size).requires_grad_(False)
        ct.save(lens, camera, format="opencv")
        _write_images(source, count, size)
        for jobs in (1, 2):
            dewarp = [["-m", "camtorch", "dewarp", source, "--camera", camera, "-o", ours, "--jobs", jobs]]
            script = [["-c", _SOURCE, camera, source, theirs, rank, jobs] for rank in range(jobs)]
            runs = {OURS: partial(_into, ours, dewarp), SCRIPT: partial(_into, theirs, script)}
            yield measure("folders", f"{count} JPEGs of {size[1]}x{size[0]}, --jobs {jobs}", runs, options)
            _, *different = filecmp.cmpfiles(ours, theirs, [path.name for path in source.iterdir()], shallow=False)
            if any(different):
                raise RuntimeError(f"folders: camtorch dewarp and the script wrote different files: {different}")


def _into(output: Path, commands: list[list[Any]]) -> None:
    """Run Python with each of the arguments at the same time, into a folder that is empty before."""
    shutil.rmtree(output, ignore_errors=True)
    output.mkdir()
    processes = [subprocess.Popen([sys.executable, *map(str, c)], cwd=_ROOT, stderr=subprocess.PIPE) for c in commands]
    for process in processes:
        _, errors = process.communicate()
        if process.returncode:
            raise RuntimeError(f"folders: {errors.decode()[-1000:]}")


def _write_images(folder: Path, count: int, size: tuple[int, int]) -> None:
    """JPEGs with about as much in them as photographs have."""
    folder.mkdir()
    random = np.random.default_rng(0)
    for i in range(count):
        coarse = random.integers(256, size=(size[0] // 8, size[1] // 8, 3), dtype=np.uint8)
        Image.fromarray(coarse).resize(size[::-1], Image.Resampling.BICUBIC).save(folder / f"{i:05}.jpg", quality=90)
