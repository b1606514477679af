"""Bare tables of a mesh, which say nothing of themselves: their sizes come from the description written beside them."""

from __future__ import annotations

import numpy as np
import torch

from camtorch.io._errors import CameraFileError
from camtorch.maps.exact import Floats
from camtorch.maps.lookup import LookupMap
from camtorch.maps.mesh import Mesh, nodes_every
from camtorch.maps.protocol import Given, checked

Size = tuple[int, int]


def sizes(path: str, given: Given) -> tuple[Size, Size]:
    """(height, width) of the source and of the target.

    Raises:
        CameraFileError: nobody says them.
    """
    return checked(path, "source_size", given.source_size), checked(path, "target_size", given.target_size)


def table(path: str, content: bytes, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    """The numbers of a table of that shape, and of nothing else.

    Raises:
        CameraFileError: another length.
    """
    expected = int(np.prod(shape, dtype=object)) * np.dtype(dtype).itemsize
    if len(content) != expected:
        raise CameraFileError(
            path, "size", f"{len(content)} bytes; {'x'.join(map(str, shape))} of {np.dtype(dtype)} are {expected}"
        )
    return np.frombuffer(content, dtype).reshape(shape)


def lookup(
    path: str, format: str, nodes: Floats, step: int, source: Size, target: Size, facts: dict[str, object]
) -> LookupMap:
    """The map of a mesh with nodes (n, m, 2) at every `step` pixels of the target."""
    if not np.isfinite(nodes).all():
        raise CameraFileError(path, "content", "positions that are not finite")
    mesh = Mesh(nodes_every(step, target[1]), nodes_every(step, target[0]), nodes)
    shape = nodes.shape[0], nodes.shape[1]
    return LookupMap(torch.from_numpy(mesh.positions(target)), source, format, {"step": step, "nodes": shape, **facts})
