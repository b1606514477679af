"""The benchmarks measure everyone in turns, and the page shows the figures of one run."""

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import page
from benchmarks.harness import Figure, Table, figure

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
@pytest.mark.parametrize("subjects", [["points", "images"], ["augment", "samples", "calibration"]])
def test_a_quick_run_measures_everyone_and_writes_every_figure(tmp_path, subjects):
    path = tmp_path / "figures.json"
    command = [sys.executable, "-m", "benchmarks", *subjects, "--quick", "--threads", "1", "--repeats", "1"]
    command += ["--seconds", "0", "--model", "kannala_brandt", "--json", str(path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "failed" not in done.stderr
    results = json.loads(path.read_text())["results"]
    for subject in subjects:
        assert f"### {subject}\n" in done.stdout
        for row, figures in results[subject].items():
            assert "camtorch" in figures, row
            assert all(math.isfinite(median) and median > 0 for median, _ in figures.values()), row


def test_a_table_shows_the_best_of_a_column_beside_ours_and_the_spread():
    table = Table("points", "ms", {"camtorch": ("camtorch",), "OpenCV": ("float", "fixed"), "kornia": ("kornia",)})
    rows = {"project": {"camtorch": figure([2e-3, 2e-3]), "float": Figure(6e-3), "fixed": Figure(5e-3, 0.1)}}
    assert table.markdown(rows).splitlines()[2] == "| project | 2.0 | 5.0 (2.5x) | - |"
    assert table.markdown(rows, spread=True).splitlines()[2] == "| project | 2.0 ±0% | 5.0 ±10% (2.5x) | - |"


def test_the_page_shows_the_figures_of_one_run():
    run = json.loads(page.FIGURES.read_text())
    assert page.filled(page.PAGE.read_text(), run) == page.PAGE.read_text()
    for figures in run["results"]["points"].values():
        figures["camtorch"][0] *= 3
    assert page.filled(page.PAGE.read_text(), run) != page.PAGE.read_text()
    with pytest.raises(ValueError, match="the page's places must be those of the run"):
        page.filled("", run)
