"""The notebooks of the documentation: their cells run in order and reach what they promise; saved ones are clean."""

import json
import re
import shlex
import shutil
from pathlib import Path

import pytest

from camtorch.cli.main import main

ROOT = Path(__file__).parents[2]
FOLDER = ROOT / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
NAMES = [path.stem for path in NOTEBOOKS]
SHORTER = {
    "dms": {"40 * 16": "10 * 16", "errors[-1] < 2.5": "errors[-1] < errors[0]"},
    "phone-video": {"seconds=12": "seconds=8", "max() < 4": "max() < 8", "_command(": "str("},
    "self-calibration": {"(8, 250, 0.03), (4, 120, 0.006)": "(8, 150, 0.03), (4, 60, 0.006)"},
}
"""What a test does less of; `execute.py` runs the whole."""


def code(path):
    return [cell for cell in json.loads(path.read_text())["cells"] if cell["cell_type"] == "code"]


def command(text):
    assert main(shlex.split(text)) == 0, text


def test_there_are_three():
    assert NAMES == ["dms", "phone-video", "self-calibration"]
    navigation = (ROOT / "mkdocs.yml").read_text()
    assert [name for name in NAMES if f" notebooks/{name}.md\n" not in navigation] == []


@pytest.mark.parametrize("path", NOTEBOOKS, ids=NAMES)
def test_what_is_saved_is_clean(path):
    cells, text = code(path), path.read_text()
    assert len(text) < 400_000
    assert re.search(r"^assert ", "\n".join("".join(cell["source"]) for cell in cells), re.M), "it promises nothing"
    assert [line for cell in cells for line in "".join(cell["source"]).splitlines() if len(line) > 80] == []
    assert [cell["execution_count"] for cell in cells] == list(range(1, len(cells) + 1))
    outputs = [output for cell in cells for output in cell["outputs"]]
    assert {output["output_type"] for output in outputs} <= {"stream", "display_data", "execute_result"}
    assert {output.get("name", "stdout") for output in outputs} == {"stdout"}  # no warnings
    assert sum("image/jpeg" in output.get("data", {}) for output in outputs) >= 4
    told = "".join("".join(output.get("text", output.get("data", {}).get("text/plain", ()))) for output in outputs)
    assert not re.search(r"/home/|/root/|/tmp/|/work/|/Users/|:\\|site-packages|Traceback| at 0x", told)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:__array__ implementation:DeprecationWarning")  # matplotlib given torch's tensors
@pytest.mark.parametrize("path", NOTEBOOKS, ids=NAMES)
def test_its_cells_run(path, tmp_path, monkeypatch):
    pytest.importorskip("av")
    plt = pytest.importorskip("matplotlib.pyplot")
    plt.switch_backend("agg")
    monkeypatch.setattr(plt, "show", lambda: plt.close("all"))
    for file in (*FOLDER.glob("*.jpg"), *FOLDER.glob("*.json")):
        shutil.copy(file, tmp_path)
    monkeypatch.chdir(tmp_path)
    space = {"__name__": "__main__", "_command": command}
    left = dict(SHORTER[path.stem])
    for number, cell in enumerate(code(path), 1):
        source = "".join(cell["source"]).replace("\\\n", "")
        source = re.sub(r"^!camtorch (.*)$", r"_command(r'''\1''')", source, flags=re.M)
        for old in [old for old in left if old in source]:
            source = source.replace(old, left.pop(old))
        exec(compile(source, f"{path.name}, cell {number}", "exec"), space)
    assert not left
