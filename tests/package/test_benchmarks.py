"""The benchmarks measure everyone in turns, judge what is required, and leave no busy process behind."""

import json
import math
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from benchmarks import page
from benchmarks.verdict import Requirement, verdict

ROOT = Path(__file__).resolve().parents[2]
linux = pytest.mark.skipif(not Path("/proc/self/stat").exists(), reason="looks at processes in Linux's /proc")


@pytest.mark.slow
def test_a_quick_run_measures_everyone_and_writes_every_figure(tmp_path):
    path = tmp_path / "figures.json"
    command = [sys.executable, "-m", "benchmarks", "images", "--quick", "--threads", "1", "--repeats", "1"]
    command += ["--seconds", "0", "--model", "kannala_brandt", "--json", str(path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stderr[-2000:]
    assert "failed" not in done.stderr
    assert "### What is required" in done.stdout
    found = json.loads(path.read_text())["results"]["images"]
    times = [figure["value"] for figure in found if figure["quantity"] == "seconds"]
    assert times
    assert all(math.isfinite(value) and value > 0 for value in times)
    assert {"camtorch", "OpenCV, float map"} <= {figure["contestant"] for figure in found}


def test_the_verdict_names_the_worst_row():
    least = Requirement("at least 2", 2.0, {"a": 3.0, "b": 1.5, "c": 2.0})
    most = Requirement("at most 2", 2.0, {"a": 3.0, "b": 2.5, "c": 2.0}, at_most=True)
    unknown = Requirement("at most 1", 1.0, {"a": 0.5, "b": math.nan}, at_most=True)
    assert (least.worst, most.worst, unknown.worst[0]) == (("b", 1.5), ("a", 3.0), "b")
    lines = verdict([least, most, unknown, Requirement("of nothing", 1.0, {})]).splitlines()
    judgements = [line.split("|")[-2].strip() for line in lines if line.startswith("| at")]
    assert judgements == ["NOT in 1", "NOT in 2", "NOT in 1"]
    assert "of nothing" not in "\n".join(lines)
    assert verdict([Requirement("holds", 2.0, {"a": 2.0})]).splitlines()[-1].endswith("ok |")


@linux
@pytest.mark.parametrize("ending", [signal.SIGKILL, signal.SIGTERM])
def test_busy_processes_end_with_whoever_started_them(ending):
    code = """
import signal, time
from benchmarks import page
from benchmarks.busy import Busy
signal.signal(signal.SIGINT, signal.default_int_handler)  # what runs in the background ignores it
with Busy(2) as busy:
    busy.spin(1)
    print(*busy.ids, flush=True)
    time.sleep(60)
"""
    command = [sys.executable, "-c", code]
    with subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL) as it:
        ids = [int(pid) for pid in it.stdout.readline().split()]
        assert len(ids) == 2
        assert all(map(_runs, ids))
        os.kill(it.pid, ending)
        it.wait(30)
    end = time.monotonic() + 10
    while any(map(_runs, ids)) and time.monotonic() < end:
        time.sleep(0.05)
    assert not any(map(_runs, ids))


def _runs(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


def test_the_page_shows_the_figures_of_one_run():
    run = json.loads(page.FIGURES.read_text())
    assert page.filled(page.PAGE.read_text(), run) == page.PAGE.read_text()
    changed = json.loads(page.FIGURES.read_text())
    for record in changed["results"]["points"]:
        record["value"] *= 3
    assert page.filled(page.PAGE.read_text(), changed) != page.PAGE.read_text()
    with pytest.raises(ValueError, match="0 places <!-- machine -->"):
        page.filled("", run)
