"""The arguments with which a transform of samples is made: errors tell which keyword somebody may have meant."""

from __future__ import annotations

import contextlib
import difflib
import functools
import inspect
from collections.abc import Iterable
from typing import Any, Unpack, get_args, get_origin, get_type_hints

from camtorch.values.arguments import CLOSE, LEFT


def check_arguments(transform: Any, count: int, options: Iterable[str]) -> None:
    """Raise a TypeError if a class does not take so many arguments without a name, or one of these keywords."""
    name = transform.__name__
    if word := next((word for word in options if word not in _keywords(transform)), None):
        raise TypeError(f"{name}: unknown keyword {word!r}; {_meant(transform, word)}. {LEFT}")
    if count:
        _, *own = (p for p in inspect.signature(transform.__init__).parameters.values() if p.kind is not p.VAR_KEYWORD)
        most = sum(p.kind is p.POSITIONAL_OR_KEYWORD for p in own)
        if count > most and all(p.kind is not p.VAR_POSITIONAL for p in own):
            got = f"{count} were given. By name: {name}({', '.join(f'{p.name}=...' for p in own)})"
            raise TypeError(f"{name}: at most {most} arguments may go without a name; {got}")


def _meant(transform: Any, word: str) -> str:
    """Return the keyword that somebody may have meant, and all that are known."""
    known = [*_keywords(transform)]
    close = difflib.get_close_matches(word, [*known, *transform.other_words], 1, CLOSE)
    meant = f"did you mean {transform.other_words.get(close[0], close[0])!r}? Known" if close else "known"
    _, *bases, _module, _object = transform.__mro__
    kin = (one for base in bases for one in (base, *base.__subclasses__()))
    has = next((one.__name__ for one in kin if word in _keywords(one)), None)
    return f"{meant} are {', '.join(known)}" + (f". {has} has it" if has else "")


@functools.cache
def _keywords(transform: Any) -> dict[str, None]:
    """Return the keywords that a class of transforms takes, also by options: those of a TypedDict, or of its base."""
    names: dict[str, None] = {}
    for owner in transform.__mro__:
        if "__init__" in vars(owner):
            init, hints = vars(owner)["__init__"], {}
            _, *parameters = inspect.signature(init).parameters.values()
            names |= dict.fromkeys(p.name for p in parameters if p.kind is not p.VAR_KEYWORD)
            if not parameters:
                break
            rest = parameters[-1].name
            if rest in names:
                break
            with contextlib.suppress(NameError):  # of what is imported for checkers alone
                hints = get_type_hints(init)
            if get_origin(hints.get(rest)) is Unpack:
                return names | dict.fromkeys(get_type_hints(get_args(hints[rest])[0]))
    return names
