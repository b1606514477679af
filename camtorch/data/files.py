"""Label files of data sets, as samples: which formats there are, and which of them a file is in."""

from __future__ import annotations

import difflib
import os
import re
from pathlib import Path

from camtorch._arguments import check_path
from camtorch.data.json_files import Coco, Vcd
from camtorch.data.labelled import Samples, files_in
from camtorch.data.landmark_files import Lapa, Pts, Wflw
from camtorch.data.matrix_files import Mat, XGaze

FORMATS: dict[str, type[Samples]] = {
    "coco": Coco,
    "wflw": Wflw,
    "300w": Pts,
    "300w_lp": Mat,
    "lapa": Lapa,
    "eth_xgaze": XGaze,
    "vcd": Vcd,
}
_OF_SUFFIX = {".pts": "300w", ".mat": "300w_lp", ".h5": "eth_xgaze", ".hdf5": "eth_xgaze"}


def read(
    path: str | os.PathLike[str], format: str | None = None, *, images: str | os.PathLike[str] | None = None
) -> Samples:
    """The samples of a data set's label files, read one by one as they are asked for.

        samples = ct.data.read("300W/01_Indoor")
        flip = ct.augment.HorizontalFlip(landmarks=samples.landmarks)
        sample = flip(samples[0])

    A sample is a dict as augmentations take it: `image` (3, H, W) uint8, or (1, H, W) if it is grey; float32 labels in
    pixels with the middle of the top-left one at (0, 0), in the format's own order; and `path`, of the image. A
    sample is one face or one person; an image with two of them is in two samples. In pixels are `keypoints` (N, 2) and
    `boxes` (M, 4) x1, y1, x2, y2.

    | format | path | fields |
    |---|---|---|
    | `"coco"` | .json of keypoints | keypoints, boxes, see `Coco` |
    | `"wflw"` | list of WFLW, .txt | 98 keypoints, boxes, attributes, see `Wflw` |
    | `"300w"` | .pts, or a folder of such | 68 keypoints, see `Pts` |
    | `"300w_lp"` | .mat of 300W-LP or AFLW2000-3D, or a folder | 68 keypoints, head_pose, see `Mat` |
    | `"lapa"` | a folder with `landmarks`, or one of its .txt | 106 keypoints, mask, see `Lapa` |
    | `"eth_xgaze"` | .h5, or a folder of such | gaze, pitch_yaw_head, rotation, camera, see `XGaze` |
    | `"vcd"` | OpenLABEL or VCD, .json, as the DMD | boxes, keypoints, actions, camera, see `Vcd` |

    Images lie where the data set has them: beside the labels, or in a folder of its name there or up to three folders
    above.

    Args:
        path: of a file or a folder.
        format: one of these; by default it is seen from suffixes and the first lines.
        images: the folder of the images, for `"coco"`, `"wflw"` and `"vcd"`, whose labels name them.

    Returns:
        Samples: `len`, `[i]`, iteration; `samples.landmarks` is the table that a mirror needs.

    Raises:
        ValueError: a file that is not of the format, cut short, or in another encoding, here or when a sample is asked
            for; the text names the file and the line. A format that is not known or not seen. FileNotFoundError: no
            such path. ImportError: files of HDF5 need h5py, `pip install "camtorch[datasets]"`.
    """
    check_path(path, "read")
    found = Path(path)
    if format is not None and format not in FORMATS:
        close = difflib.get_close_matches(str(format).lower(), FORMATS, 1)
        meant = f"; did you mean {close[0]!r}?" if close else ""
        raise ValueError(f"read: format must be one of {', '.join(FORMATS)}; got {format!r}{meant}")
    if not found.exists():
        raise FileNotFoundError(f"read: no file or folder {str(found)!r}")
    name = _format_of(found) if format is None else format
    named = name in ("coco", "wflw", "vcd")
    if found.is_dir() and named:
        raise ValueError(f"read: the labels of {name} are a file; {str(found)!r} is a folder")
    if images is not None:
        check_path(images, "read")
        if not named:
            raise ValueError(f"read: images of {name} lie beside the labels; images= is for coco, wflw and vcd")
        if not Path(images).is_dir():
            raise FileNotFoundError(f"read: no folder of images {str(images)!r}")
    samples = FORMATS[name](found)
    samples.format, samples.images = name, None if images is None else Path(images)
    return samples


def _format_of(path: Path) -> str:
    """The format of a file or a folder.

    Raises:
        ValueError: none is seen, or several in a folder.
    """
    if path.is_dir():
        names = {name for ending, name in _OF_SUFFIX.items() if files_in(path, ending)}
        names |= {"lapa"} if files_in(path, ".txt", within="landmarks") else set()
    else:
        names = {_OF_SUFFIX.get(path.suffix.lower()) or _seen_in(path)}
    if len(names) != 1 or "" in names:
        seen = f"seems to be of {' and '.join(sorted(names))}" if len(names) > 1 else "seems to be of no known format"
        raise ValueError(f"read: {str(path)!r} {seen}; format= one of {', '.join(FORMATS)} says which")
    return names.pop()


def _seen_in(path: Path) -> str:
    """The format that the beginning of a text says; an empty string if none."""
    with path.open("rb") as file:
        begin = file.read(1 << 16)
    words = begin.partition(b"\n")[0].split()
    if re.match(rb"\s*(\xef\xbb\xbf)?\{", begin):
        keys = re.findall(rb'"(openlabel|vcd|images|annotations)"\s*:', begin)
        return "vcd" if keys[:1] in ([b"openlabel"], [b"vcd"]) else "coco" if keys else ""
    return "lapa" if words == [b"106"] else "wflw" if len(words) in (197, 207) else ""
