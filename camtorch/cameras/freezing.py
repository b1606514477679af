"""Parameters of a camera that are frozen by name, while the others learn."""

from collections.abc import Sequence
from typing import Any, Self

import torch
from torch import Tensor

from camtorch.evaluate.tensors import may_write
from camtorch.projection.camera_like import CameraLike
from camtorch.values.module import is_parameter

INTRINSICS = "fx", "fy", "cx", "cy"
PREFIX = "_frozen_"
"""The prefix of buffers with the frozen values, NaN for each that learns. Derived cameras have none."""


class _Masked:
    """A hook of a Parameter that removes the gradients of frozen numbers."""

    __torch_unserializable__ = True  # a copied camera makes one when its tensors are read

    def __init__(self, learns: Tensor):
        self.learns = learns

    def __call__(self, gradient: Tensor) -> Tensor:
        return torch.where(self.learns.to(gradient.device), gradient, 0.0)


def with_frozen(tensor: Tensor, frozen: Tensor) -> Tensor:
    """Return the tensor with its frozen values, which have no gradient; a Parameter gets them in place."""
    learns = frozen.isnan()
    if not (is_parameter(tensor) and may_write(tensor)):
        return torch.where(learns, tensor, frozen)
    values = torch.where(learns, tensor.detach(), frozen)
    if not torch.equal(values, tensor.detach()):  # an optimizer's weight decay and momentum move it without a gradient
        tensor.data.copy_(values)
    if tensor.requires_grad and not _hooks_of(tensor):
        tensor.register_hook(_Masked(learns))
    return tensor


def _hooks_of(tensor: Tensor) -> list[int]:
    """Return the keys of this file's hooks."""
    return [key for key, hook in (tensor._backward_hooks or {}).items() if isinstance(hook, _Masked)]


def frozen_names(camera: CameraLike) -> tuple[str, ...]:
    """Return the names of all frozen parameters."""
    found = []
    for tensor, names in _tensors_of(camera):
        frozen = camera._buffers.get(PREFIX + tensor)
        if frozen is not None:
            kept = ~frozen.isnan().reshape(-1, len(names)).any(0)
            found += [name for name, is_kept in zip(names, kept.tolist(), strict=True) if is_kept]
    return tuple(found)


def all_frozen(camera: CameraLike, tensor: str) -> bool:
    """Whether all parameters of a tensor are frozen by name."""
    names = dict(_tensors_of(camera)).get(tensor, ())
    return bool(names) and {*names} <= {*frozen_names(camera)}


def learning_words(camera: CameraLike) -> list[str]:
    """Return the end of `repr`: the dtype, "learns" if any parameter does, else "frozen", and all frozen names."""
    names = frozen_names(camera)
    tensors = [*camera.parameters(), *camera.buffers()]
    learns = any(t.requires_grad for t in tensors) and len(names) < sum(len(own) for _, own in _tensors_of(camera))
    words = [str(tensors[0].dtype).removeprefix("torch."), "learns" if learns else "frozen"]
    return [*words, f"frozen=({', '.join(names)})"] if names else words


def _freeze(camera: CameraLike, names: Sequence[str], frozen: bool) -> None:
    """Freeze the parameters of these names, or let them learn again; all of them if there are no names."""
    owner = f"{type(camera).__name__}.{'freeze' if frozen else 'unfreeze'}"
    if camera.is_mixed:
        raise TypeError(f"{owner}: camera must be of one model; got a Mixed. Use the cameras that it is made of")
    if len(names) == 1 and isinstance(names[0], (list, tuple)):
        names = names[0]
    known = [name for _, each in _tensors_of(camera) for name in each]
    for name in names:
        if name not in known:
            raise ValueError(f"{owner}: names must be among {', '.join(known)}; got {name!r}")
    for tensor, own in _tensors_of(camera):
        chosen = [i for i, name in enumerate(own) if not names or name in names]
        before = camera._buffers.get(PREFIX + tensor)
        if not chosen or (before is None and not frozen):
            continue
        if "parametrizations" in camera._modules and tensor in camera.parametrizations:  # type: ignore[operator]
            raise TypeError(f"{owner}: {tensor} must not be parametrized; got one that is. Use remove_parametrizations")
        held = getattr(camera, tensor)
        for key in _hooks_of(held):
            del held._backward_hooks[key]
        values = held.detach().clone()
        now = torch.full_like(values, torch.nan) if before is None else before.clone()
        now[..., chosen] = values[..., chosen] if frozen else torch.nan
        if bool(now.isnan().all()):
            del camera._buffers[PREFIX + tensor]
        else:
            camera.put(PREFIX + tensor, now)


def _tensors_of(camera: CameraLike) -> tuple[tuple[str, tuple[str, ...]], ...]:
    """Return the names of the tensors that hold parameters, and those of their columns; a Mixed has none of its own."""
    return () if camera.is_mixed else (("intrinsics", INTRINSICS), ("distortion", tuple(camera.distortion_names)))


class Freezable(CameraLike):
    """A module whose parameters can be frozen by name."""

    def freeze(self, *names: str) -> Self:
        """Freeze parameters, while the others learn: `camera.freeze("fx", "fy", "k3")`.

        They have no gradient, and neither weight decay nor the momentum of an optimizer moves them; `ct.fit` and
        `ct.calibrate` hold them if they start from the camera. States, pickles and `copy.deepcopy` keep them frozen;
        cameras made from this one, as by `resize` or `clone`, send gradients to the parameters that learn here.

        Args:
            names: "fx", "fy", "cx", "cy", and those of `distortion_names`; all parameters by default.
        """
        _freeze(self, names, True)
        return self

    def unfreeze(self, *names: str) -> Self:
        """Let frozen parameters learn again, from the values that they have; all of them by default."""
        _freeze(self, names, False)
        return self

    def _save_to_state_dict(self, destination: Any, prefix: str, keep_vars: bool) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        # the state shares the memory of the Parameters, which have their frozen values once they are read
        for tensor, _ in _tensors_of(self):
            getattr(self, tensor)
        names = frozen_names(self)
        if names and hasattr(destination, "_metadata"):
            destination._metadata[prefix[:-1]]["frozen"] = names

    def _load_from_state_dict(self, *arguments: Any) -> None:
        super()._load_from_state_dict(*arguments)
        # frozen parameters take the values of the state, and those that are frozen in the state are frozen here too
        names = {*frozen_names(self), *arguments[2].get("frozen", ())}
        for tensor, _ in _tensors_of(self):
            self._buffers.pop(PREFIX + tensor, None)
        if names:
            _freeze(self, sorted(names), True)
