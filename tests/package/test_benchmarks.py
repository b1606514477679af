"""The benchmarks measure everyone in turns, and the page shows the figures of its runs."""

import json
import math
import subprocess
import sys
from pathlib import Path

import pytest

from benchmarks import __main__ as program
from benchmarks import page
from benchmarks.harness import WITHOUT_LIBRARY, Figure, Options, Table, figure

ROOT = Path(__file__).resolve().parents[2]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("subjects", "arguments", "ours"),
    [
        (["points", "images", "training", "augment", "samples", "calibration"], [], "camtorch"),
        (["training"], ["--no-library"], WITHOUT_LIBRARY),
    ],
)
def test_a_quick_run_measures_everyone_and_writes_every_figure(tmp_path, subjects, arguments, ours):
    path = tmp_path / "figures.json"
    command = [sys.executable, "-m", "benchmarks", *subjects, *arguments, "--quick", "--threads", "1", "--repeats", "1"]
    command += ["--seconds", "0", "--model", "kannala_brandt", "--json", str(path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "failed" not in done.stderr
    results = json.loads(path.read_text())["results"]
    timed = [table.name for name in subjects for table in program.SUBJECTS[name].TABLES if table.alone is not None]
    for name in timed:
        assert f"### {name}\n" in done.stdout
        for row, figures in results[name].items():
            assert ours in figures, row
            assert all(math.isfinite(median) and median > 0 for median, *_ in figures.values()), row


def test_everyone_is_limited_by_a_program_that_starts_itself_again(monkeypatch):
    started = []
    monkeypatch.setattr(program.os, "execve", lambda *given: started.append(given))
    options = program._parser().parse_args(["--cpu", "avx2"], Options())
    assert options.subject == "all"
    program._start_again(options)
    ((_, _, environment),) = started
    assert {"CAMTORCH_CPU": "avx2", "ATEN_CPU_CAPABILITY": "avx2"}.items() <= environment.items()
    monkeypatch.setattr(program.os, "environ", environment)
    program._start_again(options)
    assert len(started) == 1


def test_a_table_shows_runs_side_by_side_and_who_is_the_fastest():
    columns = {"camtorch": ("camtorch",), "OpenCV": ("float", "fixed"), "floor": ("floor",), "kornia": ("kornia",)}
    table = Table("points", "ms", columns, alone=("floor",))
    rows = {"project": {"camtorch": figure([2e-3, 1e-3, 4e-3]), "float": Figure(6e-3), "fixed": Figure(5e-3)}}
    other = {"project": {"camtorch": Figure(3e-3), WITHOUT_LIBRARY: Figure(9e-3), "float": Figure(2e-3)}}
    rows["project"]["floor"] = Figure(1e-4)
    assert table.markdown([rows]).splitlines()[2] == "| project | 2.0 | 5.0 | 0.1 | camtorch 2.5x |"
    assert table.markdown([rows], spread=True).splitlines()[2].startswith("| project | 2.0 (1.0-4.0) | 5.0 |")
    assert table.markdown([rows, other]).splitlines() == [
        f"| ms | camtorch | {WITHOUT_LIBRARY} | OpenCV | floor | fastest |",
        "|---|---:|---:|---:|---:|---:|",
        "| project | 2.0 / 3.0 | - / 9.0 | 5.0 / 2.0 | 0.1 / - | camtorch 2.5x / **OpenCV 1.5x** |",
    ]


def test_the_page_shows_the_figures_of_its_runs():
    runs = json.loads(page.FIGURES.read_text())
    assert page.filled(page.PAGE.read_text(), runs) == page.PAGE.read_text()
    for run in runs:
        for figures in run["results"]["points"].values():
            for who in {"camtorch"} & set(figures):
                figures[who][0] *= 1000
    assert page.filled(page.PAGE.read_text(), runs).count("\n* points, ") > page.PAGE.read_text().count("\n* points, ")
    with pytest.raises(ValueError, match="the page's places must be those of the runs"):
        page.filled("", runs)
