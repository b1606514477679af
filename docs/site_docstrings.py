"""What griffe does to docstrings before they are pages, where Markdown or its own form would misread them."""

import re
import subprocess
import sys
from typing import Any

import griffe

SECTION = re.compile(r"^( *)(?:Returns|Yields):\n((?:\1 +.*\n?)+)", re.M)
COLUMNS = 80  # of code, as in all pages


def narrow(text: str) -> str:
    """Return a docstring with its examples in the width of a page."""
    if all(len(line.strip()) <= COLUMNS for line in text.splitlines() if ">>> " in line):
        return text
    options = "docstring-code-format=true", f"docstring-code-line-length={COLUMNS - len('>>> ')}"
    ruff = [sys.executable, "-m", "ruff", "format", "--isolated", *(f"--config=format.{one}" for one in options), "-"]
    made = subprocess.run(ruff, input=f'r"""{text}"""\n', capture_output=True, text=True, check=True).stdout
    return made.strip().removeprefix('r"""').removesuffix('"""')


class Plain(griffe.Extension):
    """`*B` is batch dims and not the beginning of emphasis; what is returned has no type before a colon."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Edit the docstring of every object that has one."""
        if obj.docstring is None:
            return
        text = narrow(obj.docstring.value)
        text = SECTION.sub(lambda found: found[0].replace(":", "&#58;").replace("&#58;", ":", 1), text)
        text = re.sub(r"^( *)Example:$", r"\1Examples:", text, flags=re.M)  # the one name that griffe knows
        words = text.split("`")
        words[::2] = [re.sub(r"(?<!\*)\*(?=[A-Z])", r"\\*", word) for word in words[::2]]
        obj.docstring.value = "`".join(words)
