"""Python and C share structures, values and calls, and a library that does not agree with Python is not used."""

import ast
import ctypes
import importlib
import inspect
import re
import shutil

import pytest
import torch
from cameras import needs_library
from test_build import compiles

import camtorch as ct
from camtorch.native import build as building
from camtorch.native import headers, sampler, self_test, structs
from camtorch.native.library import library
from camtorch.projection import native_calls
from camtorch.projection.evaluation import camera_rows

HERE = building._HERE


def test_the_generated_file_is_what_the_headers_give():
    if not (HERE / "dispatch.c").exists():
        pytest.skip("the sources are not here")
    assert (HERE / "structs.py").read_text() == headers.structs_py(), "run `python -m camtorch.native.headers`"


@needs_library
def test_a_wrong_field_a_wrong_length_and_a_wrong_structure_are_errors():
    rows = structs.Rows()
    with pytest.raises(AttributeError):
        rows.colour = 1
    with pytest.raises(ValueError, match="same size"):
        rows.row_strides[:] = 1, 2
    with pytest.raises(ctypes.ArgumentError):
        library().camtorch_views(rows)


def test_no_guard_of_a_call_goes_with_python_minus_o():
    files = [path for path in HERE.parent.rglob("*.py") if re.search(r"\bloaded\(\)|\blibrary\(\)", path.read_text())]
    assert len(files) > 5
    assert not [
        path for path in files for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Assert)
    ]


@needs_library
def test_rows_of_other_cameras_and_shapes_are_errors_before_a_call():
    camera = ct.Pinhole([[1.0, 1, 0, 0]] * 2, image_size=(2, 2))
    native = camera_rows(camera, *(t.detach() for t in camera.tensors)).native
    with pytest.raises(ValueError, match="must be of 2 cameras; got those of 3"):
        native_calls.project(native, torch.ones(3, 4, 3))
    with pytest.raises(ValueError, match=re.escape("must be of (2, 4) rows; got (2, 5)")):
        native_calls.project_vjp(native, torch.ones(2, 4, 3), torch.ones(2, 2, 5), True, False)


@needs_library
def test_each_call_has_a_known_answer():
    calls = headers.read().calls.items()
    assert sorted(self_test.ANSWERS) == sorted(name for name, (_, given) in calls if given not in ([], ["char*"]))


FIELD = "    int64_t next; /* the next tile that a free thread takes */\n"


@compiles
@pytest.mark.parametrize(
    ("file", "old", "new", "says"),
    [
        ("sampler.h", FIELD, "    int64_t anything[64];\n" + FIELD, "its structures, values or calls are not those"),
        ("geometry.h", "flags, factor, n, m;", "flags, factor, n, m, more;", "its structures"),  # where nothing moves
        ("sampler.h", "int64_t cell_stride, rows, columns", "int64_t cell_stride, columns, rows", "its structures"),
        ("sampler.h", "SCRATCH = 25", "SCRATCH = 26", "its structures"),
        ("sampler.h", "CELL_MARGIN 0.05f", "CELL_MARGIN 0.06f", "its structures"),
        ("dispatch.c", "ENTRY(void, views, const Views *)", "ENTRY(void, views, const Steps *)", "its structures"),
        ("sampler.h", "", "", "camtorch_geometry gives a wrong answer to a known call"),
    ],
)
def test_a_library_that_python_does_not_know_is_refused_with_words(tmp_path, monkeypatch, file, old, new, says):
    for path in [*HERE.glob("*.h"), HERE / "dispatch.c"]:
        shutil.copy(path, tmp_path)
    text = (tmp_path / file).read_text()
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new, 1))
    entries = [(name[9:], result) for name, (result, given) in headers.read(tmp_path).calls.items() if len(given) == 1]
    stubs = "".join(f"{'int' if r == 'void' else r} {name}_baseline(void *x) {{ return 0; }}\n" for name, r in entries)
    (tmp_path / "sampler.c").write_text("#include <stdint.h>\n" + stubs)
    monkeypatch.setattr(building, "_FLAGS", [*building._FLAGS, "-O0"])  # which compiles it in less time
    monkeypatch.setattr(building, "VARIANTS", {"baseline": ()})
    building.build(tmp_path, sources=tmp_path)
    loading = importlib.import_module("camtorch.native.library")
    monkeypatch.setattr(loading, "_HERE", tmp_path)
    monkeypatch.setattr(loading, "checksum", lambda: building.checksum(tmp_path))
    monkeypatch.delenv("CAMTORCH_NATIVE", raising=False)
    found, why = inspect.unwrap(loading._find)()
    assert found is None
    assert says in why


def test_a_lattice_has_the_cells_of_its_pixels():
    nodes, exact = torch.zeros(1, 2, 7, 7), torch.zeros(2, 0, 8, 8)
    with pytest.raises(ValueError, match=r"cells must be those of \(16, 17\) pixels; got \(2, 2\)"):
        sampler.lay(nodes, torch.zeros(1, 2, 2, dtype=torch.int32), exact, (16, 17))
