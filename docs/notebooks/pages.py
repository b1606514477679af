"""Makes pages of the notebooks when the site is built, from what is saved in them: a hook of MkDocs, see mkdocs.yml.

Nothing is executed, and the pages have the site's own looks, light and dark, and load nothing from elsewhere.
"""

import base64
import json
import textwrap
from pathlib import PurePosixPath
from typing import Any

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files


def on_files(files: Files, *, config: MkDocsConfig) -> Files:
    """Add for each notebook a page of Markdown and its figures."""
    for file in [file for file in files if file.src_uri.endswith(".ipynb")]:
        name = PurePosixPath(file.src_uri)
        page, figures = rendered(json.loads(file.content_string), name.stem)
        files.append(File.generated(config, str(name.with_suffix(".md")), content=page))
        for figure, content in figures.items():
            files.append(File.generated(config, str(name.with_name(figure)), content=content))
    return files


def rendered(notebook: dict[str, Any], name: str) -> tuple[str, dict[str, bytes]]:
    """A notebook as a page of Markdown, and the figures that it shows by their names."""
    parts: list[str] = []
    figures: dict[str, bytes] = {}
    heading = ""
    for cell in notebook["cells"]:
        source = "".join(cell["source"])
        if cell["cell_type"] == "markdown":
            parts.append(source)
            heading = next((line.lstrip("# ") for line in source.splitlines() if line.startswith("#")), heading)
            if len(parts) == 1:
                parts.append(f"*This page is a notebook: [{name}.ipynb]({name}.ipynb).*")
            continue
        parts.append(f"```python\n{source}\n```")
        for output in cell["outputs"]:
            data = output.get("data", {})
            if "image/jpeg" in data:
                figure = f"{name}-{len(figures) + 1}.jpg"
                figures[figure] = base64.b64decode("".join(data["image/jpeg"]))
                parts.append(f"![{heading}]({figure})")
            else:
                text = "".join(output.get("text", data.get("text/plain", "")))
                lines = (textwrap.fill(line, 80) if len(line) > 80 else line for line in text.rstrip().splitlines())
                parts.append("```text\n" + "\n".join(lines) + "\n```")
    return "\n\n".join(parts) + "\n", figures
