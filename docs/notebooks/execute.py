"""Executes the notebooks and saves them with what they show: python docs/notebooks/execute.py [NOTEBOOK ...].

Needs `pip install -e ".[notebooks]"`. Each runs in a folder of its own, with a copy of the files that lie beside it.
"""

import json
import shutil
import sys
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient

HERE = Path(__file__).parent


def execute(path: Path) -> None:
    """Execute a notebook and write it anew: figures as JPEGs, nothing about the machine or the time."""
    notebook = nbformat.read(path, 4)
    with tempfile.TemporaryDirectory() as folder:
        for file in (*HERE.glob("*.jpg"), *HERE.glob("*.json")):
            shutil.copy(file, folder)
        NotebookClient(
            notebook,
            timeout=600,
            coalesce_streams=True,
            extra_arguments=["--InlineBackend.figure_formats=jpeg"],
            resources={"metadata": {"path": folder}},
        ).execute()
    for number, cell in enumerate(notebook.cells):
        cell.id = f"cell-{number}"
        cell.metadata = {}
        for output in cell.get("outputs", ()):
            if "image/jpeg" in output.get("data", {}):
                output["data"].pop("text/plain", None)
    notebook.metadata = {
        "kernelspec": {"display_name": "Python 3", "language": "python", "name": "python3"},
        "language_info": {"name": "python"},
    }
    nbformat.validate(notebook)
    path.write_text(json.dumps(notebook, indent=1, ensure_ascii=False) + "\n")


if __name__ == "__main__":
    for path in map(Path, sys.argv[1:]) if sys.argv[1:] else sorted(HERE.glob("*.ipynb")):
        execute(path)
