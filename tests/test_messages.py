"""What camtorch says where something is wrong: laws of its statements that raise, and what wrong calls are told.

`pytest --messages FILE` lists all statements, with what they said in a run of the tests.
"""

import ast
import re

from messages import everything

# -- laws of the statements

STATEMENTS = everything()
_TOLD_ELSEWHERE = (  # by whoever catches it, with the file and the place in it
    *("io/npz", "calibration/corners", "calibration/selection", "cli/coco", "cli/rle"),
    *("maps/arrays", "maps/onnx", "maps/stmap", "maps/texture_mesh", "calibration/observations"),
)
_OF_NO_CALL = ("demo", "native", "jobs", "cli")  # which speak of files, options and machines
_EXCEPTIONS = {
    "module {__name__} has no attribute": "Python's words",
    "MapReport of {": "Python's words",
    "no {self._kind.__name__} is called": "a KeyError, which Python quotes",
    "{str(error)}": "the message of another one",
    "shapes {": "caught by whoever names them",
    "no camera in the sample": "named by the caller, with the sample",
    "what makes the warp of a camera": "named by the caller, with the sample",
    "the key {repeated": "told by the caller, with the file",
}
_LACKS = re.compile(r"\b(no|needs?|give|nothing|neither|empty)\b")  # what says what is missing shows nothing
_NO_VALUE = {
    "Compose: what comes after a rolling shutter": "of a whole chain",
    "Compose: the colours or the light": "of a whole chain",
    "Seeded: same_on_batch=True": "says it",
    "Mixed: cameras must be a list of cameras; of a dict": "says it",
    "{owner}: {name} is a list of tensors that require grad": "says it",
    "{self._name}: image_size must be two integers (height, width); got None": "says it",
    "RollingShutter: image_size must be two integers (height, width); got None": "says it",
    "{self._name}: to go back": "says what is missing",
}


def text_of(expression: ast.expr) -> str:
    """A message as its source has it, what it shows in braces."""
    if isinstance(expression, ast.Constant):
        return str(expression.value)
    if isinstance(expression, ast.JoinedStr):
        return "".join(map(text_of, expression.values))
    if isinstance(expression, ast.FormattedValue):
        return "{" + ast.unparse(expression.value) + "}"
    if isinstance(expression, ast.BinOp) and isinstance(expression.op, ast.Add):
        return text_of(expression.left) + text_of(expression.right)
    return "{" + ast.unparse(expression) + "}"


TEXTS = [(s, text_of(s.arguments[-1])) for s in STATEMENTS if s.arguments]
OF_CALLS = [
    (s, text)
    for s, text in TEXTS
    if s.kind in ("ValueError", "TypeError", "IndexError", "KeyError", "AttributeError", "warning")
    and not s.file.startswith(tuple(f"camtorch/{room}/" for room in _OF_NO_CALL))
    and s.file not in [f"camtorch/{file}.py" for file in _TOLD_ELSEWHERE]
]


def of(pairs):
    return "\n".join(f"{s.place} {s.function}: {text}" for s, text in pairs)


def test_there_are_statements():
    assert len(STATEMENTS) > 800
    assert len(OF_CALLS) > 400


def test_messages_are_one_line_without_a_full_stop():
    wrong = [(s, t) for s, t in TEXTS if s.kind != "BuildError" and (t.endswith((".", "!", " ")) or "\n" in t)]
    assert not of(wrong)


def test_nothing_in_braces_is_shown_as_it_stands():
    """An f that lacks before the quotes."""
    plain = re.compile(r"\{[a-z_]+[\w.()]*(![rs])?(:[^}]*)?\}")
    wrong = []
    for s in STATEMENTS:
        constants = [c for a in s.arguments for c in ast.walk(a) if isinstance(c, ast.Constant)]
        wrong += [(s, c.value) for c in constants if isinstance(c.value, str) and plain.search(c.value)]
    assert not of(wrong)


def test_what_is_raised_without_a_message_is_caught_where_it_is_raised():
    silent = [s for s in STATEMENTS if not s.arguments and s.kind != "NotImplementedError"]
    assert len(silent) >= 3
    assert not [s.place for s in silent if not s.tried]


def test_messages_of_calls_begin_with_who_says_it():
    known = tuple(_EXCEPTIONS)
    speaks = re.compile(r"^(?=\S)[\w.]*(\{[^}]*\})?[\w.]*: \S")
    wrong = [(s, t) for s, t in OF_CALLS if not speaks.search(t) and not t.startswith(known)]
    assert not of(wrong)


def test_messages_of_calls_show_what_was_passed():
    known = tuple(_NO_VALUE)
    owners = re.compile(r"\{(owner|_OWNER|self\._name|self\.owner|cls\.__name__|type\(self\)\.__name__)\}")
    wrong = [
        (s, t) for s, t in OF_CALLS if "{" not in owners.sub("", t) and not (_LACKS.search(t) or t.startswith(known))
    ]
    assert not of(wrong)
