"""`typing.get_type_hints` works on all that is public, as pydantic, jsonargparse and beartype ask for it."""

import inspect
import typing

import pytest
from public_names import FRONT_ENDS, ROOMS, public, room_of

import camtorch as ct


def of_room(room):
    module = (
        pytest.importorskip(f"camtorch.{room}", exc_type=ImportError)
        if room in FRONT_ENDS
        else ct
        if room == "ct"
        else room_of(room)
    )
    for name in public(getattr(module, "__all__", vars(module))):
        value = getattr(module, name)
        if callable(value) and value.__module__.startswith("camtorch"):
            yield name, value
            for member in ["__init__", *public(dir(value))] if inspect.isclass(value) else ():
                attribute = inspect.getattr_static(value, member)
                attribute = getattr(attribute, "fget", getattr(attribute, "__func__", attribute))
                if inspect.isfunction(attribute) and attribute.__module__.startswith("camtorch"):
                    yield f"{name}.{member}", attribute


@pytest.mark.parametrize("room", ["ct", *(room for room in ROOMS if room_of(room)), *FRONT_ENDS])
def test_hints_of_all_that_is_public_are_types(room):
    checked = 0
    for name, value in of_room(room):
        try:
            assert isinstance(typing.get_type_hints(value), dict)
        except (NameError, TypeError) as error:
            pytest.fail(f"{room}: {name}: {error}")
        checked += 1
    assert checked or room == "models"
