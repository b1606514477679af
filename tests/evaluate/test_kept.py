"""What tells whether a tensor is as it was: values on the CPU, memory and version elsewhere."""

import pytest
import torch

from camtorch.evaluate.kept import note, same


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
