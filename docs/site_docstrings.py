"""What griffe does to docstrings before they are pages, where Markdown or its own form would misread them."""

import re
from typing import Any

import griffe

SECTION = re.compile(r"^( *)(?:Returns|Yields):\n((?:\1 +.*\n?)+)", re.M)


class Plain(griffe.Extension):
    """`*B` is batch dims and not the beginning of emphasis; what is returned has no type before a colon."""

    def on_instance(self, *, obj: griffe.Object, **_: Any) -> None:
        """Edit the docstring of every object that has one."""
        if obj.docstring is None:
            return
        text = SECTION.sub(lambda found: found[0].replace(":", "&#58;").replace("&#58;", ":", 1), obj.docstring.value)
        text = re.sub(r"^( *)Example:$", r"\1Examples:", text, flags=re.M)  # the one name that griffe knows
        words = text.split("`")
        words[::2] = [re.sub(r"(?<!\*)\*(?=[A-Z])", r"\\*", word) for word in words[::2]]
        obj.docstring.value = "`".join(words)
