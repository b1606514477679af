"""Bare tables of a mesh, which say nothing of themselves: their sizes come from the description written beside them."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch

from camtorch.maps.exact import Exact, Floats
from camtorch.maps.lookup import LookupMap
from camtorch.maps.mesh import STEP, STEPS, Mesh, as_step, mesh_of, nodes_every
from camtorch.maps.protocol import MapFormat, Options, checked


class Table(MapFormat):
    """A format whose file is a table of a mesh with a node at every `step` pixels of the target.

    Attributes:
        step: of a mesh of which nobody says it.
        steps: those that the format takes.
    """

    described = True
    step: int = STEP
    steps: Sequence[int] = STEPS

    @abstractmethod
    def pack(self, path: str, mesh: Mesh, exact: Exact, options: Options) -> tuple[bytes, dict[str, Any]]:
        """The file of a mesh, and the facts that its user needs beside its step and its number of nodes."""

    @abstractmethod
    def unpack(self, content: bytes, columns: Floats, rows: Floats, given: Options) -> tuple[Floats, dict[str, Any]]:
        """The positions (n, m, 2) of nodes at columns (m,) and rows (n,), and what else is known of the file."""

    def encode(self, path: str, exact: Exact, options: Options) -> tuple[bytes, dict[str, Any]]:
        step = as_step(options.step, "Warp.save", self.steps, self.step)
        height, width = exact.target_size
        mesh = mesh_of(path, exact, nodes_every(step, width), nodes_every(step, height))
        content, facts = self.pack(path, mesh, exact, options)
        return content, {"step": step, "nodes": (len(mesh.rows), len(mesh.columns)), **facts}

    def decode(self, content: bytes, given: Options) -> LookupMap:
        source, target = checked("source_size", given.source_size), checked("target_size", given.target_size)
        step = as_step(given.step, "load_map", self.steps, self.step)
        columns, rows = nodes_every(step, target[1]), nodes_every(step, target[0])
        nodes, facts = self.unpack(content, columns, rows, given)
        if not np.isfinite(nodes).all():
            raise ValueError("positions that are not finite")
        positions = torch.from_numpy(Mesh(columns, rows, nodes).positions(target))
        return LookupMap(positions, source, self.name, {"step": step, "nodes": (len(rows), len(columns)), **facts})


def table(content: bytes, dtype: str, shape: tuple[int, ...]) -> np.ndarray:
    """The numbers of a table of that shape, and of nothing else.

    Raises:
        ValueError: another length.
    """
    expected = int(np.prod(shape, dtype=object)) * np.dtype(dtype).itemsize
    if len(content) != expected:
        raise ValueError(f"{len(content)} bytes; {'x'.join(map(str, shape))} of {np.dtype(dtype)} are {expected}")
    return np.frombuffer(content, dtype).reshape(shape)
