"""Hooks of mkdocs: pages from the root and the library, llms.txt, images that load lazily, names that wrap."""

import io
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urljoin

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from PIL import Image

from camtorch.viewer.viewer import page as viewer_page

ROOT = Path(__file__).parent.parent
WIDE = 700  # px: more than a phone shows
PAGES = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md", "AGENTS.md": "agents.md"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages that GitHub expects in the root, with links as seen from docs/, the viewer and llms.txt."""
    for source, target in PAGES.items():
        text = (ROOT / source).read_text()
        for other, page in PAGES.items():
            text = text.replace(f"]({other}", f"]({page}")
        files.append(File.generated(config, target, content=text.replace("](docs/", "](")))
    files.append(File.generated(config, "viewer.html", content=viewer_page()))
    text = f"# {config.site_name}\n\n> {config.site_description}\n" + "\n".join(_lines(config.nav or []))
    files.append(File.generated(config, "llms.txt", content=text + "\n"))
    return files


def _lines(nav: list[dict[str, Any]]) -> Iterator[str]:
    """Yield the lines of llms.txt: a heading for each section and a link for each page."""
    for title, place in (item for entry in nav for item in entry.items()):
        if isinstance(place, list):
            yield f"\n## {title}\n"
            yield from _lines(place)
        else:
            yield f"- [{title}]({place.removesuffix('index.md').removesuffix('.md').rstrip('/') or '.'}/)"


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Let images load when they are scrolled to, with their size reserved, and long names in tables wrap.

    Wide images are links to themselves.
    """

    def shown(found: re.Match[str]) -> str:
        link, tag = found[1] or "", found[2]
        source = re.search(r'src="([^"]+)"', tag)
        file = files.get_file_from_path(urljoin(page.url, source[1])) if source else None
        if source is None or file is None or file.src_uri.endswith(".svg"):
            return link + tag.replace("<img ", '<img loading="lazy" ', 1)
        with Image.open(io.BytesIO(file.content_bytes)) as image:
            width, height = image.size
        tag = tag.replace("<img ", f'<img loading="lazy" width="{width}" height="{height}" ', 1)
        return f"{link}{tag}" if link or width < WIDE else f'<a href="{source[1]}">{tag}</a>'

    def wrapping(found: re.Match[str]) -> str:
        return re.sub(r"(?<=[\w,)][._,(=/])(?=[\w*&])", "<wbr>", found[0])

    html = re.sub(r"<td.*?</td>", lambda cell: re.sub(r"<code>[^<]*</code>", wrapping, cell[0]), html, flags=re.S)
    return re.sub(r"(<a [^>]*>\s*)?(<img [^>]*>)", shown, html)
