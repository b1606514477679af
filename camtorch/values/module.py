"""Base classes of camtorch's modules: tensors that hold geometry, and the batch dims that they share."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, ParamSpec, Self, TypeVar, cast

import torch
from torch import Tensor, nn
from torch.nn.utils.parametrize import type_before_parametrizations

from camtorch.evaluate.door import outside_inference
from camtorch.evaluate.kept import Kept
from camtorch.evaluate.tensors import is_kept
from camtorch.values.arguments import LEFT, shown

P = ParamSpec("P")
R = TypeVar("R")


def typed_as(forward: Callable[P, R]) -> Callable[[Callable[..., Any]], Callable[P, R]]:
    """Give a `__call__` the signature of `forward` for type checkers, as nn.Module's has none."""
    return lambda call: call


# Each sample makes cameras and reads their tensors many times, and torch's ways take longer than the arithmetic on a
# few points: `nn.Module.__setattr__` looks through three dicts, `__getattr__` runs after a search of the class. So
# `GeometryModule` and `remade` fill a module's dict by themselves, and the properties `Camera.intrinsics` and
# `Warp.source` read it. Only torch.compile gets torch's ways, as it follows no other.

_BARE = nn.Module().__dict__  # the state of a module without attributes
_CONTAINERS = {name: type(value) for name, value in _BARE.items() if isinstance(value, (dict, set))}
_CONTAINERS["_untraced"] = dict
_RENAMED = {"_own": "_untraced", "_warned": "_expects_unusable"}  # attributes of older pickles


def _add_containers(state: dict[str, Any]) -> None:
    """Put the empty dicts and sets of a new module into its state."""
    for name, kind in _CONTAINERS.items():
        state[name] = kind()


class UnsharedState(nn.Module):
    """A module whose state can be saved by safetensors, which refuses tensors that share memory."""

    def state_dict(self, *args: Any, **options: Any) -> Any:
        """Return the state as `nn.Module` does, but copy tensors that share memory, as of one camera twice."""
        state = super().state_dict(*args, **options)
        if self._modules and not options.get("keep_vars", False):
            seen: set[int] = set()
            for name, tensor in state.items():
                if type(tensor) is Tensor and tensor.numel() and name.startswith(options.get("prefix", "")):
                    place = tensor.untyped_storage().data_ptr()
                    state[name] = tensor.clone() if place in seen else tensor
                    seen.add(place)
        return state


class GeometryModule(UnsharedState):
    """A module whose tensors are geometry: Parameters, or tensors of a graph, in at least float32."""

    _untraced: dict[str, Tensor | None]  # the true tensors: export puts fakes into `_parameters` and `_buffers`

    def __init__(self, modules: Mapping[str, nn.Module | None] = MappingProxyType({}), /, **attributes: Any):
        """Set these attributes, which are no modules, and these parts."""
        if torch.compiler.is_compiling():
            super().__init__()
            for name, value in (*modules.items(), *attributes.items()):
                setattr(self, name, value)
        else:
            state = self.__dict__
            state.update(_BARE, **attributes)
            _add_containers(state)
            parts = state["_modules"]
            for name, module in modules.items():
                (state if module is None else parts)[name] = module

    def register_parameter(self, name: str, param: nn.Parameter | None) -> None:
        super().register_parameter(name, param)
        self._note(name)

    def register_buffer(self, name: str, tensor: Tensor | None, persistent: bool = True) -> None:
        super().register_buffer(name, tensor, persistent)
        self._note(name)

    def _note(self, name: str) -> None:
        if not torch.compiler.is_compiling():
            # a new dict, because this module and the one that it was copied from may share the old one
            self.__dict__["_untraced"] = {**self.__dict__.get("_untraced", {}), name: getattr(self, name)}

    def hold(self, name: str, value: Tensor, shape: tuple[int, ...]) -> None:
        """Register plain values as a new Parameter of `shape`, and a Parameter, or a tensor of a graph, as it is."""
        if shape[-1] == 0:  # an optimizer has nothing to learn here
            self.put(name, value if value.shape == shape and not value.requires_grad else value.detach().expand(shape))
        elif is_parameter(value):
            self.put(name, value)
        elif is_kept(value):
            self.put(name, _widen(value))
        else:
            own = _widen(value)
            self.put(name, nn.Parameter((own if own.shape == shape else own.expand(shape)).clone()))

    def put(self, name: str, tensor: Tensor | None, persistent: bool = False) -> None:
        """Register a Parameter, or anything else as a buffer, which a state_dict has if it is persistent."""
        is_learnt = tensor is not None and is_parameter(tensor)
        if torch.compiler.is_compiling():
            if is_learnt:
                self.register_parameter(name, cast("nn.Parameter", tensor))
            else:
                self.register_buffer(name, tensor, persistent)
            return
        state = self.__dict__
        state["_parameters" if is_learnt else "_buffers"][name] = state["_untraced"][name] = tensor
        if persistent or is_learnt:
            state["_non_persistent_buffers_set"].discard(name)
        else:
            state["_non_persistent_buffers_set"].add(name)

    def share(self, other: nn.Module) -> Self:
        """Take the tensors of a module of the same kind, without their graph and without a copy; return this one."""
        for name, tensor in (*other._parameters.items(), *other._buffers.items()):
            is_persistent = name not in self._non_persistent_buffers_set
            self.put(name, None if tensor is None else tensor.detach(), is_persistent)
        return self

    def freeze_like(self, *sources: nn.Module) -> Self:
        """Freeze the parameters if no tensor of `sources`, which this module was made from, requires grad."""
        tensors = [t for source in sources for t in (*source.parameters(), *source.buffers())]
        if not any(t.requires_grad for t in tensors):
            for parameter in self.parameters():
                parameter.requires_grad = False
        return self

    def _model_name(self) -> str:
        """Return the model's name, by which a state of another model is refused; empty if the state's keys suffice."""
        return ""

    def _has_left(self, name: str) -> bool:
        """Whether a state's model `name` is not a model any more."""
        return False

    def _save_to_state_dict(self, destination: Any, prefix: str, keep_vars: bool) -> None:
        super()._save_to_state_dict(destination, prefix, keep_vars)
        if self._model_name() and hasattr(destination, "_metadata"):
            destination._metadata[prefix[:-1]]["model"] = self._model_name()

    def _load_from_state_dict(self, *arguments: Any) -> None:
        _, prefix, metadata, *_, errors = arguments
        mine, its = self._model_name(), metadata.get("model")
        if mine and its not in (None, mine):
            where = f" {prefix[:-1]}" if prefix else ""
            errors.append(f"the state{where} must be of {mine}; got one of {its}" + f". {LEFT}" * self._has_left(its))
            return
        super()._load_from_state_dict(*arguments)
        # no state_dict has an empty buffer, which follows the tensors that were assigned in place of meta tensors
        for name, buffer in self._buffers.items():
            for parameter in self.parameters(recurse=False):
                if buffer is not None and buffer.is_meta and buffer.numel() == 0:
                    self._buffers[name] = torch.empty_like(buffer, device=parameter.device, dtype=parameter.dtype)
                    self._note(name)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Self:
        # network.half() must not round a principal point to whole pixels
        def at_least_float32(tensor: Tensor) -> Tensor:
            moved = fn(tensor)
            if moved.dtype.is_floating_point and torch.finfo(moved.dtype).bits < 32:
                return tensor.to(moved.device)
            return moved

        super()._apply(at_least_float32, recurse)  # type: ignore[no-untyped-call]
        for name in (*self._parameters, *self._buffers):
            self._note(name)
        return self

    def __getstate__(self) -> dict[str, Any]:
        # a tensor of a graph cannot be copied with its graph: the copy is a leaf
        state = self.__dict__.copy()
        state.pop("_told", None)  # whether a call of this module has warned
        state["_buffers"] = {
            name: b if b is None or b.is_leaf else b.detach().requires_grad_() for name, b in self._buffers.items()
        }
        state["_untraced"] = {**self._parameters, **state["_buffers"]}
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        state = {_RENAMED.get(name, name): value for name, value in state.items()}
        super().__setstate__(state)  # type: ignore[no-untyped-call]


class BatchedModule(GeometryModule):
    """A module whose tensors share batch dims, and which is indexed and counted by them like a tensor."""

    tensor_names: ClassVar[tuple[str, ...]]
    """Names of the tensors (*B, n); a shared one may have fewer batch dims, or dims of size 1."""
    memo_names: ClassVar[tuple[str, ...]] = ()  # memos of results, which are empty in another module

    @property
    def batch_shape(self) -> torch.Size:
        """*B, the batch dims of the parameters."""
        raise NotImplementedError

    def __getitem__(self, index: Any) -> Self:
        """Return the part of the batch at `index`, as of a tensor: an int, a slice, a mask, a list, or a tuple of them.

        If this one learns, gradients of the part, which has no Parameters, go to it. The part of a frozen one is
        frozen, and shares its values if indexing a tensor does.

        Raises:
            TypeError: If it has no batch dims. IndexError: If an index is beyond them.
        """
        batch, key = self._needed_batch("indexed"), index
        if type(index) is not int:  # the dim of numbers is the last one, which no index may take
            parts = index if isinstance(index, tuple) else (index,)
            key = (*parts, slice(None)) if any(part is Ellipsis for part in parts) else (*parts, ..., slice(None))
        tensors = {}
        for name in self.tensor_names:
            tensor = getattr(self, name)
            try:
                tensors[name] = (tensor if tensor.shape[:-1] == batch else tensor.expand(*batch, tensor.shape[-1]))[key]
            except (IndexError, TypeError, ValueError, RuntimeError) as error:
                raise refused_index(self, index, error) from None
        return remade(self, **tensors)

    def __len__(self) -> int:
        """Return the size of the first batch dim."""
        return self._needed_batch("counted")[0]

    def __iter__(self) -> Iterator[Self]:
        """Iterate along the first batch dim."""
        return (self[i] for i in range(self._needed_batch("iterated over")[0]))

    def __bool__(self) -> bool:
        return True

    def _needed_batch(self, what: str) -> torch.Size:
        batch = self.batch_shape
        if not batch:
            raise TypeError(f"{type(self).__name__}: it must have batch dims to be {what}; got a single one")
        return batch

    def detach(self) -> Self:
        """Return the same values without a graph: the new module shares them with this one, and does not learn."""
        return self.each(Tensor.detach)

    def clone(self) -> Self:
        """Return a copy whose tensors are its own.

        As with a tensor, gradients of the copy go to this one if it learns; the copy of a fixed one is fixed.
        `copy.deepcopy` makes independent Parameters that learn.
        """
        with outside_inference():
            return self.each(torch.clone)

    def expand(self, *batch: int | Sequence[int]) -> Self:
        """Return the batch of shape `batch` as `torch.Tensor.expand` does: nothing is copied, and -1 keeps a dim.

        Raises:
            ValueError: If the batch dims do not expand to `batch`.
        """
        sizes: Any = batch[0] if len(batch) == 1 and isinstance(batch[0], Sequence) else batch
        if tuple(sizes) == tuple(self.batch_shape):
            return self
        try:
            return self.each(lambda t: t.expand(*self.batch_shape, t.shape[-1]).expand(*sizes, t.shape[-1]))
        except (RuntimeError, TypeError):
            raise ValueError(
                f"{type(self).__name__}: batch must fit dims {tuple(self.batch_shape)}; got {shown(tuple(sizes))}"
            ) from None

    def each(self, change: Callable[[Tensor], Tensor]) -> Self:
        """Return a new module like this one, with `change` applied to each of its tensors (*B, n)."""
        return remade(self, **{name: change(getattr(self, name)) for name in self.tensor_names})

    def learn_like(self, source: Self) -> Self:
        """Let the Parameters learn that learn in the module of the same kind that this one was made from."""
        for name in self.tensor_names:
            tensor = getattr(self, name)
            if isinstance(tensor, nn.Parameter):
                tensor.requires_grad_(getattr(source, name).requires_grad)
        return self

    def to_dict(self) -> dict[str, Any]:
        """Return plain numbers, strings and lists, as camtorch's JSON has them.

        Returns:
            For a camera the keys model, intrinsics, image_size, and distortion_names and distortion if there is any;
            for a pose rotation and translation; and "dtype": "float32" unless it is float64. `from_dict` gives the same
            numbers, to the last bit; whether they learn is not kept.

        Raises:
            TypeError: If it is a `Mixed`, or a model without a key. ValueError: If a number is not finite.
        """
        import camtorch  # as in `Camera.load`

        return camtorch.io.dict_of(cast("Any", self))


Made = TypeVar("Made", bound=BatchedModule)


def model_of(module: Made) -> type[Made]:
    """Return the module's class; for a parametrized module, the class that it had before."""
    return type_before_parametrizations(module) if "parametrizations" in module._modules else type(module)


def remade(module: Made, /, **changes: Any) -> Made:
    """Return the module with other attributes and tensors, neither checked nor copied.

    New tensors without a graph are `fixed`.
    """
    model: Any = model_of(module)
    tensors = {name: changes.pop(name) if name in changes else getattr(module, name) for name in module.tensor_names}
    made: Made
    if torch.compiler.is_compiling() and "image_size" in module.__dict__:
        # the compiler follows a constructor
        numbers = [fixed(tensor) for tensor in tensors.values() if tensor.shape[-1]]
        made = model(*numbers, image_size=changes.get("image_size", module.image_size))
    else:
        made = model.__new__(model)
        state = made.__dict__
        state.update(module.__dict__, _is_full_backward_hook=None, **changes)
        _add_containers(state)
        for name in module.memo_names:
            state[name] = Kept.__new__(Kept)  # without a call of Python
        parameters, untraced = state["_parameters"], state["_untraced"]
        for name, tensor in tensors.items():
            if not tensor.shape[-1]:
                made.put(name, tensor.detach() if tensor.requires_grad else tensor)
                continue
            its = tensor if type(tensor) is nn.Parameter else fixed(tensor)  # most are one
            if type(its) is nn.Parameter or is_parameter(its):
                parameters[name] = untraced[name] = its
            else:
                made.put(name, _widen(its))
    return made


def refused_index(module: BatchedModule, index: Any, error: Exception) -> Exception:
    """Return the error for an index that a batch does not take."""
    name = type(module).__name__
    if isinstance(error, IndexError):
        return IndexError(f"{name}: index must lie within a batch {tuple(module.batch_shape)}; got {index!r}: {error}")
    hint = ". Slices go forwards; use a list of rows like [2, 1, 0]" if isinstance(index, slice) else ""
    return TypeError(f"{name}: index must be whole numbers, slices or masks; got {shown(index)}{hint}")


def _widen(value: Tensor) -> Tensor:
    """Return the tensor in at least float32."""
    return value if value.dtype.itemsize >= 4 else value.to(torch.float32)


def fixed(tensor: Tensor) -> Tensor:
    """Return a Parameter or a tensor of a graph itself; make others Parameters that do not learn, without a copy."""
    if is_parameter(tensor):
        return tensor
    if is_kept(tensor):
        of = None if torch.compiler.is_compiling() or not tensor.is_leaf else tensor._base
        # a view, taken without a graph, of a tensor that learns: requires_grad is set, but it does not learn
        if of is None or not of.requires_grad:
            return tensor
    return nn.Parameter(tensor, requires_grad=False)


def is_parameter(tensor: Tensor) -> bool:
    """Whether `tensor` is an `nn.Parameter`, found out without torch's slow metaclass."""
    kind = type(tensor)
    return kind is nn.Parameter or (kind is not Tensor and isinstance(tensor, nn.Parameter))
