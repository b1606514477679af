"""A warp as an ONNX model: one GridSample with a constant grid, of opset 16, that any runtime since 2022 takes.

The input "images" (batch, channels, H, W) of float32 or uint8, of any batch and any number of channels; the output
"warped" (batch, channels, H', W') of the same type. Positions, mode, padding and fill are the warp's own, so images are
too, but for a panorama of a whole turn, which GridSample ends at its edges; align_corners is 0. By the extra `onnx`.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch

from camtorch.maps.lookup import Exact, LookupMap
from camtorch.maps.protocol import MapFormat, checked
from camtorch.native.structs import OUTSIDE
from camtorch.values.arguments import imported

_OPSET, _IR = 16, 8
_DTYPES = ("float32", "uint8")
_NEEDED = "onnx", "models of ONNX need onnx", "onnx"


class ONNX(MapFormat):
    """The format of ONNX models; see the module. Features on which runtimes differ are refused."""

    name = "onnx"
    suffixes: tuple[str, ...] = (".onnx",)
    options: tuple[str, ...] = ("dtype",)

    def encode(self, path: str, exact: Exact, options: Mapping[str, Any]) -> tuple[bytes, dict[str, Any]]:
        warp, dtype = exact.warp, options.get("dtype", "float32")
        if dtype not in _DTYPES:
            raise ValueError(f"save_map: dtype must be one of {_DTYPES}; got {dtype!r}")
        if warp.antialias:
            raise ValueError("save_map: antialias must be False for ONNX; got True. Save a warp with antialias=False")
        if warp.mode == "bicubic" and warp.padding_mode != "zeros":
            raise ValueError(
                f"save_map: padding_mode must be 'zeros' for 'bicubic', as runtimes differ; got {warp.padding_mode!r}. "
                "Or save a warp with mode='bilinear'"
            )
        return _model(exact, dtype).SerializeToString(), {"dtype": dtype, "opset": _OPSET}

    def decode(self, content: bytes, described: Mapping[str, Any]) -> LookupMap:
        onnx = imported(*_NEEDED)
        graph = onnx.load_model_from_string(content).graph
        (grid,) = (onnx.numpy_helper.to_array(t).astype(np.float64) for t in graph.initializer if t.name == "grid")
        images = graph.input[0].type.tensor_type
        kind = onnx.helper.tensor_dtype_to_np_dtype(images.elem_type).name
        size = checked("source_size", [int(dim.dim_value) for dim in images.shape.dim[2:4]])
        positions = ((grid[0] + 1) * (size[1], size[0]) - 1) / 2
        positions[(grid[0] == OUTSIDE).all(-1) | ~np.isfinite(positions).all(-1)] = np.nan
        return LookupMap(torch.from_numpy(positions), size, self.name, {"dtype": kind})


def _model(exact: Exact, dtype: str) -> Any:
    onnx = imported(*_NEEDED)
    helper, kinds = onnx.helper, onnx.TensorProto
    warp, (height, width) = exact.warp, exact.source_size
    with torch.no_grad():
        grid = warp.grid().float().cpu().numpy()  # the grid of the warp itself
    mapped = ~(grid == OUTSIDE).all(-1)
    fill = np.array(warp.fill, np.float32).reshape(1, -1, 1, 1)
    shapes = {"planes": [1, -1, height, width], "target_size": exact.target_size, "first": [0], "third": [2]}
    constants = {"grid": grid, **{name: np.array(shape, np.int64) for name, shape in shapes.items()}}
    nodes: list[Any] = []

    def add(kind: str, *inputs: str, **attributes: Any) -> str:
        nodes.append(helper.make_node(kind, list(inputs), [f"step{len(nodes)}"], **attributes))
        return f"step{len(nodes) - 1}"

    images = add("Cast", "images", to=kinds.FLOAT) if dtype == "uint8" else "images"
    blended = warp.padding_mode == "zeros" and bool(fill.any())  # the rim fades to the fill instead of zero
    filled = warp.padding_mode != "zeros" and not mapped.all()
    if blended or filled:
        constants["fill"] = fill
    if blended:
        images = add("Sub", images, "fill")
    flat = add("Reshape", images, "planes")  # all channels as one image: the grid is read once
    options = {"mode": warp.mode, "padding_mode": warp.padding_mode, "align_corners": 0}
    sampled = add("GridSample", flat, "grid", **options)
    leading = add("Slice", add("Shape", "images"), "first", "third")
    result = add("Reshape", sampled, add("Concat", leading, "target_size", axis=0))
    if blended:
        result = add("Add", result, "fill")
    elif filled:
        constants["mapped"] = mapped[:, None]
        result = add("Where", "mapped", result, "fill")
    if dtype == "uint8":
        constants["least"], constants["most"] = np.array(0, np.float32), np.array(255, np.float32)
        result = add("Cast", add("Clip", add("Round", result), "least", "most"), to=kinds.UINT8)
    nodes[-1].output[0] = "warped"
    kind = kinds.UINT8 if dtype == "uint8" else kinds.FLOAT
    channels: int | str = fill.shape[1] if fill.shape[1] > 1 else "channels"
    graph = helper.make_graph(
        nodes,
        "warp",
        [helper.make_tensor_value_info("images", kind, ["batch", channels, height, width])],
        [helper.make_tensor_value_info("warped", kind, ["batch", channels, *exact.target_size])],
        [onnx.numpy_helper.from_array(array, name) for name, array in constants.items()],
    )
    model = helper.make_model(graph, producer_name="camtorch", opset_imports=[helper.make_opsetid("", _OPSET)])
    model.ir_version = _IR
    return model
