"""Models made of others, whose coefficients stand before their own: as behind a windshield."""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, TypeVar, cast

import torch
from torch import Tensor

from camtorch.optics import Before, Bending, Chart, Lens, Surface
from camtorch.optics.ray_maps import order_of, powers

if TYPE_CHECKING:
    from camtorch.camera import Camera

CameraT = TypeVar("CameraT", bound="Camera")
Optics = tuple[Chart, Lens]

_models: dict[tuple[type[Camera], str], type[Camera]] = {}


def variant(model: type[CameraT], text: str) -> type[CameraT]:
    """The model of the key `key:text`, for that of the key: "windshield=6,3" is behind one of so many coefficients,
    "elastic=10,8" has a surface of so many control points across and down after its lens.

    Raises:
        ValueError: there is none of that text.
    """
    found = re.fullmatch(r"(windshield|elastic)=(\d{1,4}),(\d{1,4})", text)
    if found is not None:
        counts = int(found[2]), int(found[3])
        if found[1] == "elastic" and min(counts) > 3:
            return with_surface(model, *counts)
        if found[1] == "windshield" and None not in map(order_of, counts):
            return behind_windshield(model, *counts)
    raise ValueError(
        f"{model.__name__}: there is no variant {text!r:.60}; there are windshield=N,M of 1, 3, 6, 10, ... and "
        "elastic=N,M from 4 on"
    )


def with_surface(model: type[CameraT], columns: int, rows: int) -> type[CameraT]:
    """The model of cameras whose lens ends with a cubic `Surface`: its cells and centre, and its control points."""
    text, place = f"elastic={columns},{rows}", ("cells_a", "cells_b", "centre_a", "centre_b")
    if (model, text) in _models:
        return cast("type[CameraT]", _models[model, text])
    names = tuple(f"{w}{i}_{j}" for j in range(rows) for i in range(columns) for w in "ab")

    def optics(optics: Optics, k: Sequence[Tensor]) -> Optics:
        chart, lens = optics
        surface = Surface(k[4:], columns, rows, cells=(k[0], k[1]), centre=(k[2], k[3]))
        return chart, Lens(*lens.stages, surface)

    def mirrored(across: bool) -> Mapping[str, str]:
        turned, centre = ("a", "centre_a") if across else ("b", "centre_b")
        found = {centre: f"-{centre}"}
        for j in range(rows):
            for i in range(columns):
                there = f"{columns - 1 - i}_{j}" if across else f"{i}_{rows - 1 - j}"
                found |= {f"{w}{i}_{j}": f"{'-' if w == turned else ''}{w}{there}" for w in "ab"}
        return MappingProxyType(found)

    return _derived(
        model,
        text,
        "Elastic",
        (*place, *names),
        # so wide that it is everywhere
        (1e-6, 1e-6, 0.0, 0.0, *[0.0] * len(names)),
        optics,
        mirror_x=MappingProxyType({**model.mirror_x, **mirrored(True)}),
        mirror_y=MappingProxyType({**model.mirror_y, **mirrored(False)}),
        quarter_turn=None,
        fit_bounds=MappingProxyType({**model.fit_bounds, **dict.fromkeys(place)}),
    )


def behind_windshield(model: type[CameraT], across: int, down: int) -> type[CameraT]:
    """The model of cameras behind a windshield of so many coefficients, h0 h1 ... v0 v1 ..."""
    own = [("h", i, *ij) for i, ij in enumerate(powers(order_of(across) or 0))]
    own += [("v", i, *ij) for i, ij in enumerate(powers(order_of(down) or 0))]
    place = {(letter, i, j): f"{letter}{n}" for letter, n, i, j in own}
    turned = None
    if model.quarter_turn is not None and across == down:
        signs = {(letter, i): "-" if (i % 2 == 0) == (letter == "h") else "" for letter, _, i, _ in own}
        turned = {f"{k}{n}": signs[k, i] + place["v" if k == "h" else "h", j, i] for k, n, i, j in own}

    def optics(optics: Optics, k: Sequence[Tensor]) -> Optics:
        chart, lens = optics
        return Before(Bending(k[:across], k[across:]), chart), lens

    return _derived(
        model,
        f"windshield={across},{down}",
        "BehindWindshield",
        tuple(place.values()),
        tuple(float(one in (("h", 1, 0), ("v", 0, 1))) for one in place),
        optics,
        # mirrored, the angle across changes its sign, before and after
        odd_in_x=model.odd_in_x | {f"{letter}{n}" for letter, n, i, _ in own if (i % 2 == 1) != (letter == "h")},
        odd_in_y=model.odd_in_y | {f"{letter}{n}" for letter, n, _, j in own if (j % 2 == 1) != (letter == "v")},
        quarter_turn=None if turned is None else MappingProxyType({**(model.quarter_turn or {}), **turned}),
    )


def _derived(
    model: type[CameraT],
    text: str,
    suffix: str,
    names: tuple[str, ...],
    ideals: tuple[float, ...],
    make: Callable[[Optics, Sequence[Tensor]], Optics],
    **stated: Any,
) -> type[CameraT]:
    """The model with coefficients of these names after its own, at `ideals` the same lens; the same class each time.

    make: of the model's chart and lens, and these coefficients. stated: attributes of the class.
    """
    found: Any = _models.get((model, text))
    if found is not None:
        return found  # type: ignore[no-any-return]
    added = len(names)
    # of which models without distortion have one of their own
    general: Any = next(cls for cls in reversed(model.__mro__) if "optics" in vars(cls))

    class Derived(model):  # type: ignore[misc, valid-type]
        __init__ = general.__init__
        distortion_names = (*model.distortion_names, *names)
        default_count = model.default_count + added
        fit_counts = tuple(count + added for count in model.fit_counts)
        special_cases = ((model.key, model.names_of(model.default_count) or ()), *model.special_cases)

        @classmethod
        def names_of(cls, count: int) -> tuple[str, ...] | None:
            own = model.names_of(count - added) if count >= added else None
            return None if own is None else (*own, *names)

        @classmethod
        def counts_text(cls) -> str:
            return f"{added} coefficients ({names[0]} ... {names[-1]}) after {model.counts_text()}"

        @classmethod
        def ideal(cls, count: int) -> tuple[float, ...]:
            return (*model.ideal(count - added), *ideals)

        @staticmethod
        def defined(k: Sequence[Tensor]) -> Tensor | None:
            return model.defined(k[:-added]) if len(k) > added else None

        @staticmethod
        def optics(k: Sequence[Tensor]) -> Optics:
            return make(model.optics(k[:-added]), k[-added:])

        @classmethod
        def smoothness(cls) -> Tensor | None:
            own = model.smoothness()
            return None if own is None else torch.nn.functional.pad(own, (0, added))

        @classmethod
        def searched(cls) -> type[Camera]:
            return cls if model.searched() is model else variant(model.searched(), text)

        @classmethod
        def fit_start(cls, names: tuple[str, ...], angles: Tensor, radii: Tensor) -> Tensor:
            own = model.fit_start(names[:-added], angles, radii)
            return torch.cat((own, own.new_tensor(ideals).expand(*own.shape[:-1], added)), -1)

    for name, value in {"always_defined": model.always_defined, **stated}.items():
        setattr(Derived, name, value)
    Derived.__name__ = f"{model.__name__}{suffix}"
    Derived.key = f"{model.key or model.__qualname__}:{text}"  # which stands for it, without an entry in MODELS
    # where pickles find it
    Derived.__module__, Derived.__qualname__ = "camtorch.camera", Derived.key
    made: type[CameraT] = Derived
    _models[model, text] = made
    return made
