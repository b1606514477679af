"""The pages for contributors: their walks are taken step by step, and what they say of the rooms is so."""

import functools
import itertools
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[2]
PAGES = sorted((ROOT / "docs" / "contributing").glob("*.md"))
every_walk = pytest.mark.parametrize("page", [page.name for page in PAGES if page.name != "places.md"])


class Step(NamedTuple):
    """A block of a page: a new file, changes of one, or commands."""

    kind: str
    file: str
    text: str


def steps(page):
    text = (ROOT / "docs" / "contributing" / page).read_text()
    blocks = re.findall(r'^```(\w+)(?: title="(.*?)")?\n(.*?)^```$', text, re.M | re.S)
    assert len(blocks) == len(re.findall("^```", text, re.M)) / 2
    return [Step(*block) for block in blocks]


def changed(text, changes):
    """A text after the hunks of a diff, parted by @@; a line that ends in ... stands for the one that begins so."""
    for hunk in re.split(r"^@@\n", changes, flags=re.M):
        lines = [(line[:1], line[1:]) for line in hunk.splitlines()]
        assert {mark for mark, _ in lines} <= {" ", "+", "-"}, hunk
        old = [re.sub(r"\\\.\\\.\\\.$", ".*", re.escape(line)) for mark, line in lines if mark != "+"]
        places = [*re.finditer("^" + "\n".join(old) + "$", text, re.M)]
        assert len(places) == 1, f"the page shows lines that must be in the file once; got {len(places)}:\n{hunk}"
        (found,) = places
        was = iter(found[0].split("\n"))
        new = [line if mark == "+" else next(was) for mark, line in lines]
        kept = [line for line, (mark, _) in zip(new, lines, strict=True) if mark != "-"]
        text = text[: found.start()] + "\n".join(kept) + text[found.end() :]
    return text


def take(page, root):
    """Write into a copy of the repository what a page says."""
    for kind, file, text in filter(lambda step: step.file, steps(page)):
        path = root / file
        if kind == "diff":
            path.write_text(changed((path if path.exists() else ROOT / file).read_text(), text))
        else:
            assert not (ROOT / file).exists(), f"{file} is there already"
            path.write_text(text)


def commands(page):
    """Those that a test can run: nothing is installed, and what takes minutes is left to the reader."""
    lines = [line for kind, _, text in steps(page) if kind == "bash" for line in text.splitlines()]
    run = r"pytest |python docs/|(CAMTORCH_VARIANTS=baseline )?python -m camtorch|ruff "
    return [line for line in lines if re.match(run, line) and " -n 2" not in line]


IN_ONE_PROCESS = """
import os, pathlib, pytest, runpy, shlex, subprocess, sys
for line in sys.stdin.read().splitlines():
    print(line, flush=True)
    for program, *arguments in map(shlex.split, line.split(" && ")):
        if "=" in program:
            os.environ.update([program.split("=")])
            program, *arguments = arguments
        if program == "pytest":
            assert pytest.main(arguments) == 0  # which it is not where nothing was selected
        elif program == "ruff":
            subprocess.run([sys.executable, "-m", program, *arguments], check=True)
        elif arguments[0] == "-m":
            subprocess.run([sys.executable, *arguments], check=True)
        else:
            sys.argv, sys.path[:0] = arguments, [str(pathlib.Path(arguments[0]).parent)]
            runpy.run_path(arguments[0], run_name="__main__")
"""


@pytest.fixture(scope="module")
def clone(tmp_path_factory):
    """The repository as git knows it, with the compiled library if there is one."""
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True, text=True)
    if listed.returncode:
        pytest.skip("this is no clone of the repository")
    root = tmp_path_factory.mktemp("clone")
    made = itertools.chain.from_iterable((ROOT / "camtorch" / "native").glob(name) for name in ("*.so", "_objects/*.o"))
    native = [str(path.relative_to(ROOT)) for path in made]
    for name in [*filter(None, listed.stdout.split("\0")), *native]:
        (root / name).parent.mkdir(parents=True, exist_ok=True)
        if (ROOT / name).exists():
            shutil.copy(ROOT / name, root / name)
    return root


@pytest.fixture
def copy(clone, tmp_path):
    return Path(shutil.copytree(clone, tmp_path / "camtorch"))


@every_walk
def test_the_steps_fit_the_repository(page, tmp_path):
    files = {step.file for step in steps(page) if step.file}
    assert files
    for file in files:
        (tmp_path / file).parent.mkdir(parents=True, exist_ok=True)
    shutil.copy(ROOT / "pyproject.toml", tmp_path)
    take(page, tmp_path)
    for words in (["check"], ["format", "--check"]):
        ruff = [sys.executable, "-m", "ruff", *words, "--no-cache", "--config", f"src = ['.', '{ROOT}']", "."]
        done = subprocess.run(ruff, cwd=tmp_path, capture_output=True, text=True)
        assert done.returncode == 0, done.stdout + done.stderr


@pytest.mark.slow
@every_walk
def test_a_walk_ends_with_green_tests(page, copy):
    take(page, copy)
    drawn = copy / "docs" / "drawings" / "augmentations.py"
    drawn.write_text(drawn.read_text().replace("(480, 640)", "(120, 160)"))  # a driver of that size takes half a minute
    lines = commands(page)
    assert any(line.startswith("pytest") for line in lines)
    environment = {**os.environ, "PYTHONPATH": str(copy), "PYTEST_ADDOPTS": "-p no:cacheprovider -p no:xdist"}
    run = [sys.executable, "-c", IN_ONE_PROCESS]
    done = subprocess.run(run, input="\n".join(lines), cwd=copy, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stdout + done.stderr


def test_the_places_are_there():
    places = re.findall(r"`((?:camtorch|tests|docs)/[\w/.]+)(?::(\w+))?`", (PAGES[0].parent / "places.md").read_text())
    assert len(places) > 30
    for file, name in places:
        assert (ROOT / file).exists(), file
        text = (ROOT / file).read_text() if name else ""
        in_c = rf"(?:static|INLINE) .*\b(?:T\({name}\)|{name})\("
        made = rf"^(?:(?:def|class|#define) {name}\b|{name}\b.*=|{in_c}|(?:from|import) .*\b{name}\b)"
        assert not name or re.search(made, text, re.M), f"{file} has no {name}"


def rooms():
    """Of the table in CONTRIBUTING.md, in order: the names in camtorch/ that each row is about."""
    text = (ROOT / "CONTRIBUTING.md").read_text().split("## Where things are")[1].split("\n## ")[0]
    rows = re.findall(r"^\| (`.*?) \|", text, re.M)
    return [re.findall(r"`camtorch/(\w+)(?:/|\.py)`", row) for row in rows]


@functools.cache
def arrows():
    """(room, imported room, file) of all imports but those of type checkers; a room is a folder or a file."""
    found, package = set(), ROOT / "camtorch"
    for path in package.rglob("*.py"):
        file = path.relative_to(package)
        text = re.sub(r"^( *)if TYPE_CHECKING:\n(?:\1 +.*\n|\n)+", "", path.read_text(), flags=re.M)
        imports = re.findall(r"^ *(?:import|from) camtorch(?: import \(?\s*|\.)(\w+(?:, \w+)*)", text, re.M)
        found |= {(file.with_suffix("").parts[0], other, file) for names in imports for other in names.split(", ")}
    return found


def test_every_room_has_its_row():
    paths = (ROOT / "camtorch").iterdir()
    there = {path.stem for path in paths if path.suffix == ".py" or (path / "__init__.py").exists()}
    assert sorted(itertools.chain(*rooms())) == sorted(there)


def test_every_folder_of_tests_has_the_name_of_a_room_or_a_row():
    text = (ROOT / "CONTRIBUTING.md").read_text().split("## The tests")[1].split("\n## ")[0]
    told = {*itertools.chain(*rooms()), *re.findall(r"`(\w+)/", "\n".join(re.findall(r"^\| (`.*?) \|", text, re.M)))}
    folders = {path.parent.name for path in (ROOT / "tests").glob("*/test_*.py")}
    assert len(folders) > 10
    assert folders <= told, folders - told


def test_imports_go_down_the_table():
    place = {name: i for i, row in enumerate(rooms()) for name in row}
    assert len(arrows()) > 100
    upwards = [arrow for arrow in arrows() if arrow[0] != arrow[1] in place and place[arrow[0]] >= place[arrow[1]]]
    assert upwards == [], "these files import what stands above"


def test_the_picture_shows_the_rooms_and_no_arrow_too_many():
    names = [name for row in rooms() for name in row]
    below = {name: {other for room, other, _ in arrows() if room == name != other in names} for name in names}
    for name in reversed(names):  # which import from below only
        below[name] |= set().union(*(below[other] for other in below[name]))
    shown = {name for name in names if not name.startswith("_")}
    indirect = {name: set().union(*(below[other] for other in below[name])) for name in shown}
    direct = {(name, other) for name in shown for other in (below[name] & shown) - indirect[name]}
    picture = re.findall(r"^ +(\w+) --> (.*)$", (ROOT / "CONTRIBUTING.md").read_text(), re.M)
    assert sorted((name, other) for name, others in picture for other in others.split(" & ")) == sorted(direct)
