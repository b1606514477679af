"""The kind of a field by its name: a kind's own, an alias, a pattern, or one that begins with a kind."""

import difflib
import functools
import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from torch import Tensor

from camtorch.augment.fields import BOXES, KEEP, KINDS, OWN
from camtorch.augment.matrices import NAMES
from camtorch.evaluate.door import pytree

ALIASES = {
    **{"images": "image", "masks": "mask", "bboxes": "boxes", "point": "points", "face_center": "points"},
    **{name: "K" for name in NAMES if name != "K"},
}
_WORDS_OF_KINDS = {
    "roi": "boxes",
    "poly": "polygons",
    "lmk": "landmarks",
    **dict.fromkeys(("kp", "kpt", "eye", "pupil", "nose", "mouth", "corner", "center", "centre"), "keypoints"),
    **dict.fromkeys(("pt", "position", "cloud", "pointcloud"), "points"),
}
_SIMILAR, _SAME = 0.7, 0.8  # as difflib has it: img is similar to image, logits not to points; a plural is the same
_ANGLES = {"yaw", "pitch", "roll"}


def kind_of(name: str, value: object, fields: Mapping[str, str], owner: str) -> str | None:
    """Return a field's key in `KINDS`, `KEEP` if it does not move, and None if its name is unknown.

    In this order: the name among `fields`; names of `OWN` and those that end with _valid do not move; a kind's name or
    an alias; a pattern with * among `fields`; the longest kind that begins the name; the forms of boxes that end it.

    fields: the option of that name.
    """
    if not isinstance(name, str):
        raise TypeError(f"{owner}: a sample must have strings for names; got {name!r:.80}")
    if name in fields:
        return _given_kind(name, fields, owner)
    if name in OWN or name.endswith("_valid"):
        return KEEP
    kind = name if name in KINDS else ALIASES.get(name)
    if kind is None:
        pattern = _pattern_of(name, fields)
        if pattern is not None:
            return _given_kind(pattern, fields, owner)
        kind = _beginning(name, value)
    if kind == "K" and not _may_be_geometry(kind, value, single=False):  # a number of things, or a file's path
        return KEEP
    if kind == "boxes":
        form = f"boxes_{name.rpartition('_')[2]}"  # as of boxes_face_xywh
        return form if form in BOXES else kind
    return kind


def refuse_unknown(sample: Mapping[str, Any], fields: Mapping[str, str], owner: str, *, single: bool) -> None:
    """Raise a ValueError if a field of unknown name may be geometry.

    fields: name -> kind, of other names. single: whether the sample is known to be without a dim B.
    """
    for name, value in sample.items():
        is_unknown = value is not None and kind_of(name, value, fields, owner) is None
        if is_unknown and _may_be_geometry(name, value, single):
            raise ValueError(f"{owner}: {_about_unknown(name, value, fields)}")


def check_kinds(fields: Mapping[str, str], own: Iterable[str], owner: str) -> None:
    """Raise a ValueError if `fields` has a kind that there is not, or another one for a transform's `own` names."""
    wrong = {name: kind for name, kind in fields.items() if kind not in (*KINDS, KEEP)}
    if wrong:
        raise ValueError(f"{owner}: fields must map names to {', '.join(KINDS)} or {KEEP}; got {wrong}")
    taken = {name: kind for name, kind in fields.items() if name in own and kind != name}
    if taken:
        raise ValueError(
            f"{owner}: fields must not name what comes out of {owner} by itself, {', '.join(own)}; got {taken}. Give "
            "that field of the samples another name"
        )


def _given_kind(key: str, fields: Mapping[str, str], owner: str) -> str:
    """Return the kind that a key of `fields` gives, which may be `KEEP`."""
    kind = fields[key]
    if kind not in KINDS:  # another one may have been set after the transform was made
        check_kinds({key: kind}, (), owner)
    return kind


def _beginning(name: str, value: object) -> str | None:
    """Return the longest kind that begins a name; None for text: an image_path or a mask_id is no image or mask."""
    if not isinstance(value, (Tensor, np.ndarray, list, tuple)) or is_text(value):
        return None
    # K_inv is no K; compilers do not know max with a key
    begins = sorted((kind for kind in KINDS if name.startswith(kind + "_") and kind != "K"), key=len)
    return begins[-1] if begins else None


def _about_unknown(name: str, value: object, fields: Mapping[str, str]) -> str:
    """Return the text of the error about geometry of unknown name, which says what it may be.

    fields: name -> kind, of other names.
    """
    if isinstance(value, Mapping):
        return (
            f"fields that move must be at the top of samples; got real numbers in the dict {name!r}. "
            f"Put them there, or keep the dict with fields={{{name!r}: '{KEEP}'}}"
        )
    if not {"K", "intrinsics", "matrix"}.isdisjoint(name.split("_")):
        meant = "A camera goes in as camera=, as ct.BrownConrady.from_matrix(K, D, image_size=(height, width)). "
    elif _is_angle(name):
        meant = "A head's angles go in as head_pose, by ct.head_rotation(), a gaze's as pitch_yaw. "
    else:
        known = difflib.get_close_matches(name, (key for key in fields if "*" not in key), 1, _SAME)
        meant = "".join(f"Did you mean {close!r}? " for close in known or _close_to(name))
    return (
        f"{name!r} must have a kind, by which its numbers move with the camera; got real numbers. {meant}"
        f"Pass fields={{{name!r}: KIND}}, with KIND one of {', '.join(KINDS)} or {KEEP}, to leave it unchanged"
    )


def _pattern_of(name: str, fields: Mapping[str, str]) -> str | None:
    """Return the first key of `fields` that a name matches, of those in which each * stands for any characters."""
    for key in fields:
        if "*" in key and re.fullmatch(re.escape(key).replace(r"\*", ".*"), name, re.DOTALL):
            return key
    return None


def is_text(value: Any) -> bool:
    """Whether a value holds strings, at least one, and nothing else, in lists of any depth."""
    texts = pytree.tree_leaves(value.tolist() if isinstance(value, np.ndarray) and value.dtype.kind in "OSU" else value)
    return len(texts) > 0 and all(isinstance(text, (str, bytes)) for text in texts)


@functools.lru_cache(64)
def _close_to(name: str) -> list[str]:
    """Return the kind that a name may mean: of the whole, or of its last word, as in `face_bbox` and `left_eye`."""
    last = name.rpartition("_")[2].removesuffix("s")
    if same := difflib.get_close_matches(name, KINDS, 1, _SAME):
        return same
    if name.startswith("seg"):
        return ["mask"]
    if "box" in last:
        return ["boxes"]
    if last in _WORDS_OF_KINDS:
        return [_WORDS_OF_KINDS[last]]
    return difflib.get_close_matches(name, KINDS, 1, _SIMILAR) or difflib.get_close_matches(last, KINDS, 1, _SIMILAR)


def _may_be_geometry(name: str, value: Any, single: bool, above: int = 0) -> bool:
    """Whether a value may have to move with the camera.

    Real numbers with a dim may; integers with two dims per sample, or one dim and a name close to a kind's; and a
    single real number whose name is an angle's, as in `head_yaw`.

    above: the number of lists around the value, which count as dims.
    """
    if isinstance(value, Mapping):
        return any(_may_be_geometry(str(key), item, single) for key, item in value.items())
    if isinstance(value, np.ndarray) and value.dtype == object:
        value = value.tolist()
    if isinstance(value, (list, tuple)):
        return any(_may_be_geometry(name, item, single, above + 1) for item in value)
    if isinstance(value, (np.ndarray, np.generic)):
        whole, known = value.dtype.kind in "iub", value.dtype.kind in "iubfcV"
    elif isinstance(value, Tensor):
        whole, known = not (value.is_floating_point() or value.is_complex()), True
    else:
        whole, known = not isinstance(value, float), isinstance(value, (int, float))
    if not known:
        return False
    dims = above + getattr(value, "ndim", 0)
    if not whole:
        return dims > 0 or _is_angle(name)
    row = 1 if single else 2
    return dims > row or (dims == row and len(_close_to(name)) > 0)


def _is_angle(name: str) -> bool:
    return not _ANGLES.isdisjoint(name.lower().split("_"))
