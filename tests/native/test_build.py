"""The compiled library is built where there is a C compiler, found where it lies, and its absence has a reason."""

import ctypes
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from camtorch.native import build as building
from camtorch.native.build import LIBRARY, REASON, BuildError, build

ROOT = Path(__file__).parents[2]
COMPILER = os.environ.get("CC") or next(filter(shutil.which, ("cc", "gcc", "clang")), None)
compiles = pytest.mark.skipif(COMPILER is None, reason="no C compiler is here: neither CC nor cc, gcc or clang")

# as small as a sampler can be: what is tested here is how it is built
SAMPLER = """
#define NAME_(variant) twice_##variant
#define NAME(variant) NAME_(variant)
int NAME(VARIANT)(int x) { return 2 * x; }
"""
DISPATCH = """
#define API __attribute__((visibility("default")))
int twice_baseline(int);
API unsigned camtorch_sources(void) { return SOURCES; }
API int twice(int x) { return twice_baseline(x); }
#ifdef HAS_AVX2
int twice_avx2(int);
API int twice_fast(int x) { return twice_avx2(x); }
#endif
"""


def write(folder, sampler=SAMPLER):
    (folder / "sampler.c").write_text(sampler)
    (folder / "dispatch.c").write_text(DISPATCH)
    return folder


@pytest.fixture
def no_compiler(monkeypatch, tmp_path):
    monkeypatch.delenv("CC", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path / "nothing"))


@compiles
def test_a_library_is_built_and_nothing_else_is_left(tmp_path):
    write(tmp_path)
    path = build(tmp_path, sources=tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([LIBRARY, "_objects", "dispatch.c", "sampler.c"])
    loaded, inode = ctypes.CDLL(str(path)), path.stat().st_ino
    assert not hasattr(loaded, "twice_baseline")  # what is not marked stays inside
    assert not [name for name in (b"Py", b"crtfast", b"OMP") if name in path.read_bytes()]
    # one in use is replaced beneath nobody
    assert build(tmp_path, sources=tmp_path).stat().st_ino != inode
    assert loaded.twice(21) == 42


@compiles
def test_every_variant_that_the_compiler_knows_is_in_it(tmp_path, monkeypatch):
    write(tmp_path)

    def fast(name, **variants):
        (tmp_path / name).mkdir()
        monkeypatch.setattr(building, "VARIANTS", {"baseline": (), **variants})
        loaded = ctypes.CDLL(str(build(tmp_path / name, sources=tmp_path)))
        return hasattr(loaded, "twice_fast") and loaded.twice_fast(21) == 42

    assert fast("all", avx2=("-O1",), avx512=("-mno-such-cpu",))
    assert not fast("one")
    assert not fast("older", avx2=("-mno-such-cpu",))


@compiles
def test_more_words_reach_the_compiler_and_the_linker(tmp_path, monkeypatch):
    write(tmp_path, sampler="#ifndef MORE\n#error no MORE\n#endif\n" + SAMPLER)
    with pytest.raises(BuildError, match="no MORE"):
        build(tmp_path, sources=tmp_path)
    monkeypatch.setenv("CC", f"{COMPILER} -DMORE -g -fsanitize=undefined")
    assert b"ubsan" in build(tmp_path, sources=tmp_path).read_bytes()


@compiles
def test_an_error_is_what_the_compiler_said_and_leaves_the_library_that_was(tmp_path):
    write(tmp_path)
    before = build(tmp_path, sources=tmp_path).read_bytes()
    write(tmp_path, sampler="int broken(void) { return nowhere; }\n")
    with pytest.raises(BuildError, match="nowhere") as caught:
        build(tmp_path, sources=tmp_path)
    assert "sampler.c" in str(caught.value)
    assert (tmp_path / LIBRARY).read_bytes() == before
    assert sorted(p.name for p in tmp_path.iterdir()) == sorted([LIBRARY, "_objects", "dispatch.c", "sampler.c"])


@compiles
def test_a_unit_is_compiled_again_if_it_or_its_headers_or_the_options_changed(tmp_path, monkeypatch, capfd):
    (tmp_path / "twice.h").write_text("enum { TWO = 2 }; /* a number */\n")
    write(tmp_path, sampler='#include "twice.h"\n' + SAMPLER.replace("2 *", "TWO *"))
    monkeypatch.setattr(building, "VARIANTS", {"baseline": (), "avx2": ("-O1",)})

    def compiled():
        before = {path: path.stat().st_mtime_ns for path in (tmp_path / "_objects").glob("*")}
        twice = ctypes.CDLL(str(shutil.copy(build(tmp_path, sources=tmp_path), tmp_path / f"{len(done)}.so"))).twice(21)
        after = {path: path.stat().st_mtime_ns for path in (tmp_path / "_objects").glob("*")}
        done.append(sorted(path.name.split(".")[0] for path in after.keys() - before.keys()))
        assert len(after) == len({path.name.split(".")[0] for path in after})  # older ones are gone
        return twice, {path for path in before if path in after and after[path] != before[path]}

    done = []
    assert compiled() == compiled() == (42, set())
    assert done == [["dispatch", "sampler_avx2", "sampler_baseline"], []]
    assert "compiling 3 units of 3, for baseline, avx2" in capfd.readouterr().err
    (tmp_path / "twice.h").write_text("enum { TWO = 2 }; /* another comment */\n")
    compiled()
    (tmp_path / "twice.h").write_text("enum { TWO = 3 };\n")
    monkeypatch.setenv("CAMTORCH_VARIANTS", "baseline")
    assert compiled() == (63, set())
    monkeypatch.setenv("CC", f"{COMPILER} -DMORE")
    compiled()
    assert done[2:] == [["dispatch"], ["dispatch", "sampler_baseline"], ["dispatch", "sampler_baseline"]]
    monkeypatch.setenv("CAMTORCH_VARIANTS", "baseline,sse9")
    with pytest.raises(BuildError, match="must be some of baseline,avx2; got baseline,sse9"):
        compiled()


def test_without_a_compiler_the_error_says_what_was_sought(tmp_path, no_compiler, monkeypatch):
    with pytest.raises(BuildError, match="no C compiler: one of cc, gcc, clang must be on the PATH"):
        build(tmp_path, sources=write(tmp_path))
    monkeypatch.setenv("CC", "my-own-cc -m64")
    with pytest.raises(BuildError, match="'my-own-cc'"):
        build(tmp_path, sources=tmp_path)
    monkeypatch.setattr(building.sys, "platform", "win32")
    monkeypatch.setenv("CC", r"C:\tools\my-own-cc.exe -m64")
    with pytest.raises(BuildError, match=r"'C:/tools/my-own-cc\.exe'"):
        building._compiler()
    monkeypatch.delenv("CC")
    with pytest.raises(BuildError, match=r"one of gcc, clang .*; got none, and Visual Studio's cl does not take"):
        building._compiler()


@compiles
def test_a_library_that_windows_does_not_replace_says_what_to_do(tmp_path, monkeypatch):
    write(tmp_path)

    def replace(source, target):
        if str(target).endswith(LIBRARY):
            raise PermissionError(13, "Access is denied", source, 5, target)
        os.rename(source, target)

    monkeypatch.setattr(os, "replace", replace)
    with pytest.raises(BuildError, match=r"must not be in use; got .* denied. End the processes that use camtorch"):
        build(tmp_path, sources=tmp_path)


def copy(folder):
    """A package of camtorch's with no library in it, and the path of its `native`."""
    ignore = shutil.ignore_patterns("_sampler.*", "_objects", "__pycache__", "*.[ch]")
    return shutil.copytree(ROOT / "camtorch", folder / "camtorch", ignore=ignore) / "native"


def python(folder, *words, **environment):
    environment = {k: v for k, v in os.environ.items() if k != "CAMTORCH_NATIVE"} | environment
    words = [sys.executable, "-W", "error", *words]
    environment["PYTHONPATH"] = str(folder)
    done = subprocess.run(words, capture_output=True, text=True, check=True, cwd=folder, env=environment)
    return done.stdout.strip()


WARP = """
import atexit, warnings, torch, camtorch as ct
told = []
warnings.simplefilter("always")
warnings.showwarning = lambda message, *_: told.append(str(message))
atexit.register(lambda: print(len(told), *told))
camera = ct.KannalaBrandt.from_fov(100, image_size=(48, 64)).requires_grad_(False)
ct.Dewarp(camera)(torch.zeros(3, 48, 64))
"""


def version(folder, **environment):
    return python(folder, "-m", "camtorch", "--version", **environment)


@compiles
@pytest.mark.slow
@pytest.mark.parametrize("older", [DISPATCH, DISPATCH.replace("camtorch_sources", "no_number")])
def test_a_library_of_other_sources_is_not_used_and_said_once_and_the_environment_turns_it_off(tmp_path, older):
    folder = write(copy(tmp_path))
    (folder / "dispatch.c").write_text(older)
    build(folder, sources=folder)
    (folder / "dispatch.c").write_text(DISPATCH + "/* mended */\n")
    assert "not used" in version(tmp_path)
    if older == DISPATCH:
        told = python(tmp_path, "-c", WARP)
        assert told.startswith("1 camtorch's compiled library is not used (built from other sources than those")
        assert "pip install -e ." in told
    for path in folder.glob("*.[ch]"):  # what packs programs may leave out what is no program
        path.unlink()
    assert "not used (its structures, values or calls are not those" in version(tmp_path)
    if (ROOT / "camtorch" / "native" / LIBRARY).exists():
        shutil.copy(ROOT / "camtorch" / "native" / LIBRARY, folder)
        assert version(tmp_path, CAMTORCH_NATIVE="1", CAMTORCH_CPU="baseline").endswith("native sampler: baseline")
    for value in ("FALSE", "off"):
        assert version(tmp_path, CAMTORCH_NATIVE=value).endswith("native sampler: off (CAMTORCH_NATIVE=0)")


def test_where_none_was_built_or_loads_version_says_why(tmp_path):
    folder = copy(tmp_path)
    assert "native sampler: not built (" in version(tmp_path)
    (folder / REASON).write_text("the compiler was on holiday\n")
    assert "native sampler: not built (the compiler was on holiday)" in version(tmp_path)
    (folder / LIBRARY).write_bytes(b"no library")
    told = version(tmp_path)
    assert "native sampler: not loaded (" in told
    assert "python -m camtorch.native.build" in told
