"""`import camtorch` is light: torch comes with the first use of a public name, and with it all there is."""

import os
import pickle
import subprocess
import sys

import pytest
import torch

import camtorch as ct

ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}


def python(code, *words, expect=0):
    """What a fresh process prints."""
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, env=ENVIRONMENT)
    assert done.returncode == expect, done.stderr
    return done.stdout + done.stderr


@pytest.mark.parametrize(
    "words",
    [
        [],
        ["--version"],
        ["--help"],
        ["dewarp", "--help"],
        ["dewarp", "--fov", "x"],
        ["x"],
    ],
)
def test_the_command_answers_without_torch(words):
    code = """
import sys
from camtorch.cli.main import main
try:
    main(sys.argv[1:])
except SystemExit:
    pass
heavy = {"torch", "numpy", "PIL", "yaml", "kornia", "matplotlib", "camtorch.camera", "camtorch.demo"}
print("loaded:", sorted(heavy & set(sys.modules)))
"""
    assert "loaded: []" in python(code, *words)


def test_names_come_at_first_use():
    code = """
import sys
finders = list(sys.meta_path)
import camtorch as ct
assert sys.meta_path == finders
assert "torch" not in sys.modules
assert set(ct.__all__) <= set(dir(ct))
for name in ct.__all__:
    getattr(ct, name)
assert sorted(n for n in dir(ct) if not n.startswith("_")) == sorted(ct.__all__)
assert not hasattr(ct, "Pinhole2") and not hasattr(ct, "_public2")
"""
    python(code)


@pytest.mark.slow
@pytest.mark.parametrize(
    "first",
    [
        "import camtorch as ct",
        "from camtorch.camera import Camera",
        "import camtorch.io as io",
        "import torch",
    ],
)
def test_all_models_are_there_whatever_comes_first(first):
    assert python(f"{first}\nimport camtorch as ct\nprint(*ct.MODELS)").split() == list(ct.MODELS)


@pytest.mark.slow
def test_a_part_has_the_models_that_it_needs():
    code = "from camtorch.io import load\nfrom camtorch.camera import MODELS\nprint(*MODELS)"
    assert python(code).split() == list(ct.MODELS)


@pytest.mark.slow
def test_a_pickled_camera_needs_no_import(tmp_path):
    (tmp_path / "camera.pickle").write_bytes(pickle.dumps(ct.Pinhole([1.0, 2.0, 3.0, 4.0])))
    code = "import pickle, sys\nprint(pickle.load(open(sys.argv[1], 'rb')))"
    assert python(code, str(tmp_path / "camera.pickle")) == "Pinhole(fx=1, fy=2, cx=3, cy=4)\n"


@pytest.mark.slow
@pytest.mark.parametrize("imports", ["from camtorch import Camera\nimport torch", "import torch\nimport camtorch"])
def test_exported_programs_load(tmp_path, imports):
    camera = ct.KannalaBrandt([300.0, 300, 320, 240], [0.02, -0.01, 0.003, -0.001]).requires_grad_(False)

    class Rays(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.camera = camera

        def forward(self, pixels):
            return self.camera.unproject(pixels)

    program = torch.export.export(Rays(), (torch.rand(10, 2),), strict=True)
    assert any("camtorch" in str(node.target) for node in program.graph.nodes)
    torch.export.save(program, tmp_path / "rays.pt2")
    code = "\nimport sys\nprint(torch.export.load(sys.argv[1]).module()(torch.full((10, 2), 9.0))[1].all())"
    assert "True" in python(imports + code, str(tmp_path / "rays.pt2"))


@pytest.mark.slow
def test_the_first_use_may_be_compiled():
    code = """
import camtorch as ct, torch
focal = torch.nn.Parameter(torch.ones(4))
function = torch.compile(lambda p: ct.Pinhole(2 * focal).project(p)[0], backend="eager", fullgraph=True)
print(function(torch.ones(3))[0].item())
"""
    assert python(code) == "4.0\n"


@pytest.mark.slow
@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_output_that_nobody_reads_is_no_error(unbuffered):
    code = "from camtorch.cli.main import main; import sys; sys.exit(main(['augment', '--list']))"
    environment = ENVIRONMENT | {"PYTHONUNBUFFERED": unbuffered}
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", code], env=environment, **pipes) as process:
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 141


INTERRUPTED = """
import sys, types
import camtorch.cli.main as command
class Torch:
    def find_spec(name, path=None, target=None):
        if name == "torch":
            {}
sys.meta_path.insert(0, Torch)
sys.exit(command.main(["show", "camera.yml"]))
"""


@pytest.mark.slow
def test_an_interrupt_while_torch_is_imported_is_one_line():
    # as some of torch's own imports do, which lose it
    hit = "try:\n                import signal; signal.raise_signal(signal.SIGINT)\n            except: pass"
    assert python(INTERRUPTED.format(hit), expect=130) == "camtorch: interrupted\n"


@pytest.mark.slow
@pytest.mark.parametrize(
    "error",
    [
        "MemoryError()",
        "ImportError('libtorch_cpu.so: failed to map segment from shared object')",
        'RuntimeError("DefaultCPUAllocator: can\'t allocate memory")',
    ],
)
def test_a_lack_of_memory_is_one_line(error):
    found = python(INTERRUPTED.format(f"raise {error}"), expect=2)
    assert found.startswith("camtorch: error: out of memory")
    assert found.count("\n") == 1
