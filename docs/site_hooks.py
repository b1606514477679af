"""What mkdocs does beside building pages: it takes pages from the repository's root, and lets images load lazily."""

import io
import re
from pathlib import Path
from urllib.parse import urljoin

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from PIL import Image

ROOT = Path(__file__).parent.parent
PAGES = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Pages that GitHub wants in the root, with links as seen from docs/."""
    for source, target in PAGES.items():
        text = (ROOT / source).read_text()
        for other, page in PAGES.items():
            text = text.replace(f"]({other}", f"]({page}")
        files.append(File.generated(config, target, content=text.replace("](docs/", "](")))
    return files


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Images of the site have their size, so that text stays where it is while they load, when they are scrolled to."""

    def sized(tag: re.Match[str]) -> str:
        file = files.get_file_from_path(urljoin(page.url, tag[1]))
        if file is None or file.src_uri.endswith(".svg"):
            return tag[0].replace("<img ", '<img loading="lazy" ', 1)
        with Image.open(io.BytesIO(file.content_bytes)) as image:
            width, height = image.size
        return tag[0].replace("<img ", f'<img loading="lazy" width="{width}" height="{height}" ', 1)

    return re.sub(r'<img [^>]*?src="([^"]+)"[^>]*>', sized, html)
