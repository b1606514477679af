"""What a script does to a folder of JPEGs: read, warp, write. A process of its own, on every nth file, one thread.

`python -m benchmarks.bare CAMERA FOLDER OUT RANK COUNT`
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import torch
from PIL import Image

import camtorch as ct

TOLERANCE, QUALITY = 0.001, 95
"""As of `camtorch dewarp`, so that the files are the same."""


def main(camera: str, folder: str, out: str, rank: str, count: str) -> None:
    """Dewarp those of a folder's files that are this process's."""
    torch.set_num_threads(1)
    warp = ct.Dewarp(ct.load(camera).camera, tolerance=TOLERANCE)
    for path in sorted(Path(folder).iterdir())[int(rank) :: int(count)]:
        image = torch.from_numpy(np.array(Image.open(path))).permute(2, 0, 1)
        with torch.no_grad():
            result = warp(image[None])[0].permute(1, 2, 0).contiguous().numpy()
        Image.fromarray(result).save(Path(out, path.name), quality=QUALITY)


if __name__ == "__main__":
    main(*sys.argv[1:])
