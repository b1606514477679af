"""The benchmarks measure everyone in turns, and the page shows the figures of its runs."""

import copy
import json
import math
import subprocess
import sys
from pathlib import Path

import pytest
import torch

from benchmarks import __main__ as program
from benchmarks import page
from benchmarks.harness import OPENCV_MAPS, WITHOUT_LIBRARY, Figure, Options, Table

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
    table, (floats, fixed) = (
        Table("points", "ms", ("camtorch", "OpenCV", "floor", "kornia"), alone=("floor",)),
        OPENCV_MAPS,
    )
    rows = {"project": {"camtorch": Figure(2e-3, 1e-3, 4e-3), floats: Figure(6e-3), fixed: Figure(5e-3)}}
    other = {"project": {"camtorch": Figure(3e-3), WITHOUT_LIBRARY: Figure(9e-3), floats: Figure(2e-3)}}
    rows["project"]["floor"] = Figure(1e-4)
    assert table.markdown([rows]).splitlines()[2] == "| project | 2.0 | 5.0 | 0.1 | camtorch 2.5x |"
    assert table.markdown([rows], spread=True).splitlines()[2].startswith("| project | 2.0 (1.0-4.0) | 5.0 |")
    assert table.markdown([rows, other]).splitlines() == [
        f"| ms | camtorch | {WITHOUT_LIBRARY} | OpenCV | floor | fastest |",
        "|---|---:|---:|---:|---:|---:|",
        "| project | 2.0 / 3.0 | 9.0 | 5.0 / 2.0 | 0.1 / - | camtorch 2.5x / **OpenCV 1.5x** |",
    ]
    assert table.fastest(other["project"], WITHOUT_LIBRARY) == "**OpenCV 4.5x**"


def test_the_page_readme_and_the_picture_show_the_figures_of_the_runs(tmp_path):
    runs = json.loads(page.FIGURES.read_text())
    for path in (page.PAGE, page.README):
        assert page.filled(path.read_text(), runs) == path.read_text()
    page.picture(runs, tmp_path / "bars.svg")
    assert (tmp_path / "bars.svg").read_text() == page.PICTURE.read_text()
    assert page.PICTURE.read_text().count("next best: ") == len(page.FIRST) == 12
    for run in runs:
        for figures in run["results"]["points"].values():
            for who in {"camtorch"} & set(figures):
                figures[who][0] *= 1000
    assert page.filled(page.PAGE.read_text(), runs).count("\n* points, ") > page.PAGE.read_text().count("\n* points, ")
    with pytest.raises(ValueError, match=r"the page's places must be those of the runs.* got \['seconds'\]"):
        page.filled("<!-- seconds -->\n<!-- /seconds -->", runs)


def test_a_run_on_a_gpu_has_a_place_of_its_own():
    runs, place = json.loads(page.FIGURES.read_text()), "<!-- gpu -->\n<!-- /gpu -->"
    assert "No GPU was measured" in page.filled(place, runs)
    there = copy.deepcopy(runs[0])
    there["arguments"]["device"], there["machine"]["gpu"] = "cuda", "a chip"
    shown = page.filled(place, [there, *runs])
    assert ", gpu a chip." in shown
    assert "| Brown-Conrady project |" in shown
    assert page.filled(page.README.read_text(), [there, *runs]) == page.README.read_text()


@pytest.mark.slow
def test_a_machine_without_a_gpu_is_named():
    done = subprocess.run(["bash", ".ci/gpu"], cwd=ROOT, capture_output=True, text=True)
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    assert done.returncode == 1
    assert "No GPU: torch sees no CUDA device here" in done.stderr
