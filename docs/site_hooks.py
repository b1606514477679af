"""What mkdocs does beside building pages: it takes pages from the repository's root, and that of live lenses from the
library, and lets images load lazily.
"""

import io
import re
from pathlib import Path
from urllib.parse import urljoin

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files
from mkdocs.structure.pages import Page
from PIL import Image

from camtorch.viewer.viewer import page as viewer_page

ROOT = Path(__file__).parent.parent
WIDE = 700  # px: more than a phone shows
PAGES = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Pages that GitHub wants in the root, with links as seen from docs/."""
    for source, target in PAGES.items():
        text = (ROOT / source).read_text()
        for other, page in PAGES.items():
            text = text.replace(f"]({other}", f"]({page}")
        files.append(File.generated(config, target, content=text.replace("](docs/", "](")))
    files.append(File.generated(config, "viewer.html", content=viewer_page()))
    return files


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Images load when they are scrolled to, and text stays where it is meanwhile; wide ones open by themselves."""

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

    return re.sub(r"(<a [^>]*>\s*)?(<img [^>]*>)", shown, html)
