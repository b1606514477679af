"""The galleries' pages, whose code makes their images."""

import re
from pathlib import Path

DOCS = Path(__file__).parent.parent
GALLERY = DOCS / "gallery"
IMAGES = DOCS / "images"
EXAMPLES = DOCS.parent / "examples"


def sections(page: str) -> dict[str, str]:
    """Headings of the third level in a page of the gallery, and what stands below each, in order."""
    parts = re.split(r"^#{2,3} (.*)$", (GALLERY / page).read_text(), flags=re.M)
    levels = re.findall(r"^(#{2,3}) ", (GALLERY / page).read_text(), flags=re.M)
    found = zip(levels, parts[1::2], parts[2::2], strict=True)
    return {title.split(" {")[0]: text for level, title, text in found if level == "###"}


def code(section: str) -> str:
    """The first block of Python in a section.

    Raises:
        ValueError: it has none.
    """
    block = re.search(r"^```python\n(.*?)^```", section, re.M | re.S)
    if block is None:
        raise ValueError(f"a section without code: {section[:80]!r}")
    return block[1]
