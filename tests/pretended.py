"""A device that is pretended: it computes on the CPU, refuses a mix of devices as CUDA does, and counts what it does.

`python tests/pretended.py MODULE [NAME ...]` tries the cases of a module of tests on the CPU and on this device, and
prints a table of launches, waits for a value (syncs) and copies. The module has `CASES`, name -> function(device) that
returns tensors, in lists, tuples, dicts, objects and modules, or a function: then its calls alone are counted. It may
have `BOUNDS`, name -> the most launches, syncs and copies. The device changes torch for the whole process, so tests
start one: `try_cases`. With `CAMTORCH_DEVICE=cuda` the cases are tried on a real device instead, where nothing is
counted.
"""

import collections
import functools
import importlib
import inspect
import os
import subprocess
import sys
from pathlib import Path

import torch
from torch import nn
from torch.utils.backend_registration import _DummyBackendModule, _setup_privateuseone_for_python_backend

NAME, DEVICE = "pretended", os.environ.get("CAMTORCH_DEVICE", "pretended")
COUNTS = collections.Counter()
TOLERANCE = {torch.bool: 0, torch.float64: 1e-7, torch.float32: 1e-3}
"""Or 1e-7 of a tensor's largest number, if that is more. Whole numbers, as grey levels, may differ by 1."""

# operators whose result is a value, or has a shape that depends on values, or that look whether they succeeded
SYNCS = {"_local_scalar_dense", "_unique2", "bincount", "equal", "is_nonzero", "masked_select", "nonzero", "unique_dim"}
SYNCS |= {"_linalg_check_errors", "_linalg_eigh", "_linalg_svd", "linalg_eig", "linalg_lstsq", "repeat_interleave"}
# operators that compute nothing, beside views
FREE = {"_local_scalar_dense", "_unsafe_view", "empty", "empty_like", "empty_strided", "new_empty", "new_empty_strided"}
INDEXING = {"index", "index_put", "index_put_", "_index_put_impl_", "_unsafe_index"}
MAKERS = "arange empty empty_permuted empty_strided eye full linspace logspace ones rand randint randn randperm "
MAKERS += "scalar_tensor tril_indices triu_indices zeros"


class Pretended(torch.Tensor):
    """A tensor on the device; its values are those of `on_host`."""

    __torch_function__ = torch._C._disabled_torch_function_impl

    @staticmethod
    def __new__(cls, on_host):
        options = {"dtype": on_host.dtype, "layout": on_host.layout, "device": torch.device(NAME, 0)}
        options |= {"strides": on_host.stride(), "storage_offset": on_host.storage_offset()}
        made = cls._make_wrapper_subclass(cls, on_host.shape, **options)
        made.on_host = on_host
        return made

    @classmethod
    def __torch_dispatch__(cls, operator, types, arguments=(), options=None):
        return run(operator, arguments, options or {})

    def untyped_storage(self):
        return self.on_host.untyped_storage()

    def tolist(self):
        COUNTS["syncs"] += 1
        return self.on_host.tolist()

    def numpy(self, *, force=False):
        if not force:
            raise TypeError(f"can't convert {NAME}:0 device type tensor to numpy. Use Tensor.cpu() first.")
        return self.cpu().numpy(force=True)


@functools.cache
def known(operator):
    """An operator's name, and whether it only looks: its results are views."""
    schema = operator._schema
    views = any(value.alias_info and not value.alias_info.is_write for value in schema.returns)
    return schema.name.partition("::")[2], views


def run(operator, arguments, options):
    """Run an operator on the CPU, count it, and wrap its results."""
    (name, views), mine, others = known(operator), {}, []

    def on_host(value):
        if isinstance(value, Pretended):
            mine[id(value.on_host)] = value
            return value.on_host
        if isinstance(value, torch.Tensor):
            others.append(value)
        elif isinstance(value, (list, tuple)):
            return [on_host(v) for v in value]
        return torch.device("cpu") if isinstance(value, torch.device) and value.type == NAME else value

    def wrapped(value):
        if isinstance(value, torch.Tensor):  # what was changed in place is the tensor that was given
            return mine[id(value)] if id(value) in mine else Pretended(value) if here else value
        return [wrapped(v) for v in value] if isinstance(value, (list, tuple)) else value

    plain, named, device = on_host(arguments), {n: on_host(v) for n, v in options.items()}, options.get("device")
    here = bool(mine) if device is None else device.type == NAME
    if not mine and not here:
        return operator(*arguments, **options)
    if name in ("_to_copy", "copy_"):
        COUNTS["copies"] += bool(others) or not here
    elif mine:
        for tensor in filter(torch.Tensor.dim, others):
            if name not in INDEXING or tensor is arguments[0]:
                found = f"found at least two devices, {NAME}:0 and cpu! (when checking {name})"
                raise RuntimeError(f"Expected all tensors to be on the same device, but {found}")
            COUNTS["copies"] += 1  # of an index
        if name in INDEXING and not (len(arguments) > 2 and arguments[2].numel() == 1):  # which CUDA fills at once
            COUNTS["syncs"] += any(i is not None and i.dtype == torch.bool for i in arguments[1])
    COUNTS["syncs"] += name in SYNCS
    COUNTS["launches"] += not views and name not in FREE
    return wrapped(operator(*plain, **named))


def install():
    """Teach torch the device, as long as the result lives."""
    backend = type("Backend", (_DummyBackendModule,), {"get_amp_supported_dtype": lambda _: [torch.bfloat16]})
    _setup_privateuseone_for_python_backend(NAME, backend())
    torch.__future__.set_overwrite_module_params_on_conversion(True)  # .to() cannot change the class of a tensor
    library = torch.library.Library("aten", "IMPL")
    library.impl("_copy_from", lambda a, b, _=False: run(torch.ops.aten.copy_.default, (b, a), {}), "PrivateUse1")
    packets = [getattr(torch.ops.aten, name) for name in MAKERS.split()]
    for operator in (getattr(packet, overload) for packet in packets for overload in packet.overloads()):
        given = operator._schema.arguments
        if any(a.name == "device" for a in given) and not any("Tensor" in str(a.type) for a in given):
            made = functools.partial(lambda operator, *given, **options: run(operator, given, options), operator)
            library.impl(operator, made, "PrivateUse1", allow_override=True)
    return library


def tensors_of(result):
    """Yield the tensors of what a case returns."""
    if isinstance(result, torch.Tensor):
        yield result
    elif isinstance(result, nn.Module):
        yield from (*result.parameters(), *result.buffers())
    elif isinstance(result, (list, tuple, dict)) or hasattr(result, "__dict__"):
        parts = result if isinstance(result, (list, tuple, dict)) else vars(result)
        for value in parts.values() if isinstance(parts, dict) else parts:
            yield from tensors_of(value)


def tried(name, case, limits):
    """Print a row of the table; return whether a result differs from the CPU's, or lies there, or a limit is passed."""
    results = []
    try:
        for device in ("cpu", DEVICE):
            torch.manual_seed(0)
            COUNTS.clear()
            result = case(device)
            if inspect.isfunction(result):
                COUNTS.clear()
                result = result()
            results.append(list(tensors_of(result)))
        counts = tuple(COUNTS[kind] for kind in ("launches", "syncs", "copies"))
        print("{:8} {:6} {:7} ".format(*counts), name, flush=True)
        assert all(map(int.__le__, counts, limits or counts)), f"more than {limits}"
        assert len(results[0]) == len(results[1]) > 0, "another number of tensors"
        for i, (there, here) in enumerate(zip(*results, strict=True)):
            assert here.device.type == DEVICE, f"tensor {i} {tuple(here.shape)} lies on {here.device}"
            large = there.detach().double().nan_to_num(0, 0, 0).abs().amax().item() if there.numel() else 0
            close = {"rtol": 0, "atol": max(TOLERANCE.get(there.dtype, 1), 1e-7 * large), "equal_nan": True}
            found = here.on_host if DEVICE == NAME else here.cpu()
            torch.testing.assert_close(found, there, msg=lambda text, i=i: f"tensor {i}: {text}", **close)
    except Exception as error:
        print(f"FAILED  {name}: {type(error).__name__}: {error}")
        return True
    return False


def try_cases(module):
    """Try the cases of a module in a process of its own; return its exit status, and what it printed."""
    command = [sys.executable, "-W", "error", __file__, module]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    return done.returncode, done.stdout + done.stderr


if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).parent / "devices"))
    torch.set_num_threads(1)
    installed = install() if DEVICE == NAME else None
    table = importlib.import_module(sys.argv[1])
    print("launches  syncs  copies")
    names = sys.argv[2:] or table.CASES
    sys.exit(sum(tried(name, table.CASES[name], getattr(table, "BOUNDS", {}).get(name)) for name in names) > 0)
