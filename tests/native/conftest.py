"""What tests of the compiled library share."""

import os
import subprocess
from pathlib import Path

import pytest
from cameras import slow_unless

from camtorch.native import build as building
from camtorch.native.library import library, native_available

HERE = Path(__file__).parent
SANITIZERS = ["-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all"]

BEST = library().camtorch_variant().decode() if native_available() else "baseline"


@pytest.fixture(params=slow_unless(BEST.__eq__, building.VARIANTS))
def each_variant(request):
    """The variants that this CPU runs, one after the other in the place of the best one, which is used."""
    native = library()
    used = native.camtorch_variant()
    if not native.camtorch_use(request.param.encode()):
        pytest.skip("this CPU does not run it")
    yield request.param
    native.camtorch_use(used)


@pytest.fixture
def fuzzed(tmp_path):
    """Builds a driver, and sources of the library for some variants, with sanitizers, and runs random jobs."""

    def run(driver, sources, variants, first, jobs):
        command = [*building._compiler(), "-std=gnu11", "-g1", "-Wno-psabi", f"-I{building._HERE}", *SANITIZERS]
        (tmp_path / "empty.c").write_text("int main(void) { return 0; }\n")
        if subprocess.run([*command, "empty.c", "-o", "empty"], cwd=tmp_path, capture_output=True).returncode:
            pytest.skip(f"{command[0]} has no sanitizers")
        units = [[str(HERE / driver), *(f"-DHAS_{name.upper()}" for name in variants)]]
        for name, options in variants.items():
            words = [*building._FLAGS, *options, f"-DVARIANT={name}"]
            units += [[*words, str(building._HERE / source)] for source in sources]
        commands = [[*command, *unit, "-O1", "-c", "-o", f"{i}.o"] for i, unit in enumerate(units)]
        compilers = [subprocess.Popen(words, cwd=tmp_path) for words in commands]
        assert [compiler.wait() for compiler in compilers] == [0] * len(units)
        objects = [f"{i}.o" for i in range(len(units))]
        subprocess.run([*command, *objects, "-lm", "-o", "fuzz"], cwd=tmp_path, check=True)
        # what is allocated is the driver's own, and not each debugger lets leaks be looked for
        environment, words = os.environ | {"ASAN_OPTIONS": "detect_leaks=0"}, [str(first), str(jobs)]
        done = subprocess.run([tmp_path / "fuzz", *words], capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout.split()[::2]

    return run
