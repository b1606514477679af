"""`import camtorch` is light: torch comes with the first use of a public name, and with it all there is."""

import os
import pickle
import subprocess
import sys

import pytest
import torch
from cameras import Unproject

import camtorch as ct

ENVIRONMENT = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
LENSES = pytest.param(["lenses", "gopro"], marks=pytest.mark.slow)


def python(code, *words, expect=0):
    done = subprocess.run([sys.executable, "-c", code, *words], capture_output=True, text=True, env=ENVIRONMENT)
    assert done.returncode == expect, done.stderr
    return done.stdout + done.stderr


@pytest.mark.parametrize("words", [["--version"], ["dewarp", "--help"], ["dewarp", "--fov", "x"], LENSES])
def test_the_command_imports_what_it_needs(words):
    code = """
import gc, sys
from camtorch.cli.main import main
try:
    main(sys.argv[1:])
except SystemExit:
    pass
heavy = {"PIL", "yaml", "kornia", "matplotlib", "camtorch.boards", "camtorch.io"}
heavy |= set() if "lenses" in sys.argv else {"torch", "numpy", "camtorch.cameras.camera"}
print("loaded:", sorted(heavy & set(sys.modules)), gc.isenabled())
"""
    assert "loaded: [] True" in python(code, *words)


FIRST_USES = {
    """
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
""": "",
    """
import camtorch as ct, torch
focal = torch.nn.Parameter(torch.ones(4))
function = torch.compile(lambda p: ct.Pinhole(2 * focal).project(p)[0], backend="eager", fullgraph=True)
print(function(torch.ones(3))[0].item())
""": "4.0",
    """
import sys, torch, camtorch as ct
camera = ct.KannalaBrandt([300, 300, 319.5, 239.5], image_size=(480, 640))
torch.nn.Sequential(ct.Extrinsics([0, 0, 0.1], [0, 0, 0]), camera)(torch.rand(10, 3))
camera.rays()
ct.Dewarp(camera.requires_grad_(False))(torch.rand(1, 3, 480, 640))
print({"sympy", "kornia"} & {*sys.modules})
""": "set()",
    """
import sys, camtorch as ct
from concurrent.futures import ThreadPoolExecutor
sys.setswitchinterval(1e-5)
orders = [ct.__all__[i:] + ct.__all__[:i] for i in range(0, 64, 4)]
with ThreadPoolExecutor(16) as pool:
    print(len(list(pool.map(lambda names: [getattr(ct, name) for name in names], orders))))
""": "16",
}


@pytest.mark.slow
@pytest.mark.parametrize("code", FIRST_USES, ids=["names", "compiled", "no sympy", "threads"])
def test_what_is_used_first_may_be_anything(code):
    assert python(code).strip() == FIRST_USES[code]


@pytest.mark.slow
def test_a_pickled_camera_needs_no_import(tmp_path):
    (tmp_path / "camera.pickle").write_bytes(pickle.dumps(ct.Pinhole([1.0, 2.0, 3.0, 4.0])))
    code = """
import pickle, sys
camera = pickle.load(open(sys.argv[1], "rb"))
from torch.utils.data import default_collate
print(camera, *default_collate([camera, camera]).batch_shape)
"""
    assert python(code, str(tmp_path / "camera.pickle")) == "Pinhole(fx=1, fy=2, cx=3, cy=4, float32, learns) 2\n"


@pytest.mark.slow
def test_exported_programs_load(tmp_path):
    camera = ct.FThetaBackward([300.0, 300, 320, 240], [0.01, 0.0]).requires_grad_(False)

    program = torch.export.export(Unproject(camera), (torch.rand(10, 2),), strict=True)
    assert any("camtorch" in str(node.target) for node in program.graph.nodes)
    torch.export.save(program, tmp_path / "rays.pt2")
    code = "\nimport sys\nprint(torch.export.load(sys.argv[1]).module()(torch.full((10, 2), 9.0))[1].all())"
    assert "True" in python("from camtorch import Camera\nimport torch" + code, str(tmp_path / "rays.pt2"))


@pytest.mark.slow
def test_output_that_nobody_reads_is_no_error():
    code = "from camtorch.cli.main import main; import sys; sys.exit(main(['lenses', 'GoPro']))"
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    with subprocess.Popen([sys.executable, "-c", code], env=ENVIRONMENT, **pipes) as process:
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
@pytest.mark.parametrize(
    ("hit", "status", "says"),
    [
        ("raise KeyboardInterrupt", 130, "camtorch: interrupted"),
        ("raise ImportError('libtorch_cpu.so: failed to map segment from shared object')", 2, "failed to map segment"),
        ('raise RuntimeError("DefaultCPUAllocator: can\'t allocate memory")', 2, "out of memory"),
    ],
)
def test_what_ends_an_import_of_torch_is_one_line(hit, status, says):
    found = python(INTERRUPTED.format(hit), expect=status)
    assert found.startswith("camtorch: ")
    assert says in found
    assert found.count("\n") == 1
