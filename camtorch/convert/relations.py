"""Models that are special cases of others, and coefficients carried over from one to another."""

from collections import deque
from collections.abc import Iterator, Mapping

import torch
from torch import Tensor

from camtorch.projection.camera_like import CameraLike

Model = type[CameraLike]
Models = Mapping[str, Model]
Step = tuple[Model, Mapping[str, str]]  # a model, and its names by the names before; coefficients without one are lost

_MOST_COEFFICIENTS = 33  # more are not compared


def default_count(model: Model, source: CameraLike, models: Models) -> int:
    """Return the least number of coefficients, from the default on, that holds most of a related camera's."""
    if isinstance(source, model):
        return len(source.distortion_names)
    steps = _path(type(source), model, models)
    if steps is None:
        return model.fit_counts[0] if model.fit_counts else model.default_count
    needed = {_carried(source, name, steps)[0] for name in source.distortion_names}
    named = {n: model.names_of(n) for n in range(model.default_count, _MOST_COEFFICIENTS)}
    held = {n: len(needed & set(names)) for n, names in named.items() if names}
    return min((n for n, number in held.items() if number == max(held.values())), default=model.default_count)


def carry_over(
    source: CameraLike, values: Tensor, model: Model, names: tuple[str, ...], models: Models
) -> tuple[Tensor, Tensor] | None:
    """Return `values` as coefficients (C, n) of a related model, and whether none is lost (C,); None if unrelated."""
    steps = _path(type(source), model, models)
    if steps is None:
        return None
    result = values.new_tensor(model.ideal(len(names))).repeat(len(values), 1)
    lossless = torch.ones(len(values), dtype=torch.bool, device=values.device)
    for i, old in enumerate(source.distortion_names):
        name, without = _carried(source, old, steps)
        if name in names:
            result[:, names.index(name)] = values[:, i]
        else:
            lossless &= values[:, i] == without
    return result, lossless


def _path(start: Model, end: Model, models: Models) -> list[Step] | None:
    """Return the shortest path from a model to a related one, None if there is none."""
    queue: deque[tuple[Model, list[Step]]] = deque([(start, [])])
    seen = {start}
    while queue:
        model, steps = queue.popleft()
        if model is end or (model is start and issubclass(start, end)):
            return steps
        for step in _neighbours(model, models):
            if step[0] not in seen:
                seen.add(step[0])
                queue.append((step[0], [*steps, step]))
    return None


def _neighbours(model: Model, models: Models) -> Iterator[Step]:
    for general in (model, *models.values()):
        for key, names in general.special_cases:
            special = models.get(key)
            if special is not None and general is model:
                yield special, dict(zip(names, _all_names(special), strict=False))
            elif special is model:
                yield general, dict(zip(_all_names(model), names, strict=False))


def _carried(source: CameraLike, name: str, steps: list[Step]) -> tuple[str | None, float]:
    """Return a coefficient's name at the end of a path, None if lost; and the value whose loss changes nothing."""
    model, known, end = type(source), source.distortion_names, name
    for later, names in steps:
        if end not in names:
            return None, dict(zip(known, model.ideal(len(known)), strict=True))[end]
        model, end, known = later, names[end], _all_names(later)
    return end, dict(zip(known, model.ideal(len(known)), strict=True))[end]


def _all_names(model: Model) -> tuple[str, ...]:
    """Return the names of the most coefficients that the model takes, fewer than `_MOST_COEFFICIENTS`."""
    return max(
        (names for names in map(model.names_of, range(_MOST_COEFFICIENTS)) if names is not None), key=len, default=()
    )
