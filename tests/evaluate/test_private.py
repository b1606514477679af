"""Torch's private parts do what camtorch takes them for: these run on every torch that is supported."""

import ctypes
import sys

import pytest
import torch
from torch._subclasses.fake_tensor import FakeTensorMode
from torch.autograd import forward_ad
from torch.fx.experimental.proxy_tensor import make_fx
from torch.utils._python_dispatch import TorchDispatchMode

from camtorch.evaluate import door
from camtorch.evaluate.kept import note, same

# newer ones warn of what they still do
pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit.trace`:FutureWarning")


class Passes(TorchDispatchMode):
    def __torch_dispatch__(self, func, types, args=(), kwargs=None):
        return func(*args, **(kwargs or {}))


def seen_in(way):
    """Return what the door says of a tensor on each way through torch."""
    said = []

    def look(t):
        said.append((door.is_concrete(t), door.is_eager(t), door.way_of("Identity", t).is_native))
        return t * 2

    x = torch.ones(2, 3)
    if way == "jvp":
        with forward_ad.dual_level():
            look(forward_ad.make_dual(x, x))
    elif way == "dispatch mode":
        with Passes():
            look(x)
    elif way == "fake":
        with FakeTensorMode():
            look(torch.ones(2, 3))
    elif way == "meta":
        look(x.to("meta"))
    elif way == "negated":
        look(torch.ones(2, dtype=torch.complex64).conj().imag)
    else:
        {
            "eager": look,
            "vmap": torch.vmap(look),
            "grad": torch.func.grad(lambda t: look(t).sum()),
            "trace": lambda t: torch.jit.trace(look, t, check_trace=False),
            "make_fx": lambda t: make_fx(look)(t),
        }[way](x)
    return said[0]


@pytest.mark.parametrize(
    ("way", "concrete", "eager"),
    [
        *(("eager", True, True), ("negated", True, False), ("dispatch mode", True, False), ("trace", True, False)),
        *(("jvp", True, False), ("vmap", False, False), ("grad", False, False), ("fake", False, False)),
        *(("meta", False, False), ("make_fx", True, False)),
    ],
)
@pytest.mark.filterwarnings("ignore::DeprecationWarning", "ignore::torch.jit.TracerWarning")
def test_the_door_sees_what_torch_is_doing(way, concrete, eager):
    assert seen_in(way) == (concrete, eager, eager)


@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_what_is_set_aside_is_not_recorded():
    def constant(x):
        with door.set_aside():
            assert not torch.jit.is_tracing()
            y = torch.arange(3.0) * 2
        return x + y

    traced = torch.jit.trace(constant, torch.ones(3))
    assert "aten::arange" not in str(traced.graph)
    assert torch.equal(traced(torch.ones(3)), torch.tensor([1.0, 3, 5]))


def test_other_parts():
    class Tagged(torch.Tensor):
        __torch_function__ = door.NO_TORCH_FUNCTION

    assert type(torch.ones(2).as_subclass(Tagged) + 1) is torch.Tensor
    if sys.platform == "linux":
        assert hasattr(ctypes.CDLL(door.TORCH_LIBRARY), "omp_set_num_threads")
    paths, _ = door.pytree.tree_flatten_with_path({"a": [1, 2]})
    assert [door.pytree.keystr(path) for path, _ in paths] == ["['a'][0]", "['a'][1]"]
    assert torch.Tensor in door.COLLATE_FUNCTIONS
    batch = door.collate_by([{"a": 1}, {"a": 2}], collate_fn_map={**door.COLLATE_FUNCTIONS, int: lambda b, **_: sum(b)})
    assert batch == {"a": 3}
    start = torch.tensor(0), torch.tensor(0)
    count, total = door.while_loop(lambda n, t: n < 4, lambda n, t: (n + 1, t + n), start)
    assert (int(count), int(total)) == (4, 6)


# -- what tells whether a tensor is as it was: values on the CPU, memory and version elsewhere


class Elsewhere(torch.Tensor):
    """A tensor that says that it is not on the CPU."""

    is_cpu = False


class WithoutMemory(Elsewhere):
    """Of a subclass that wraps others, as distributed tensors do."""

    def untyped_storage(self):
        return torch.empty(0).untyped_storage()


def changed_by(kind, change):
    tensor = torch.ones(4).as_subclass(kind)
    noted = note(tensor)
    assert same(tensor, noted)
    with torch.no_grad():
        return not same(change(tensor), noted)


@pytest.mark.parametrize("kind", [torch.Tensor, Elsewhere, WithoutMemory])
def test_changes_of_values_are_seen(kind):
    assert changed_by(kind, lambda t: t.add_(1))
    assert changed_by(kind, lambda t: torch.zeros(4).as_subclass(kind))
    assert changed_by(kind, lambda t: t[:3])
    assert changed_by(kind, lambda t: t.double())


def test_what_is_equal_in_other_memory_is_looked_at_on_the_cpu_alone():
    assert not changed_by(torch.Tensor, torch.clone)
    assert changed_by(Elsewhere, torch.clone)
    assert not changed_by(Elsewhere, lambda t: t[None])  # numbers of one camera come in both forms
