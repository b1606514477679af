"""What tests of the compiled library share."""

import os
import subprocess
from pathlib import Path

import pytest

from camtorch.native import build as building
from camtorch.native.library import library

HERE = Path(__file__).parent
SANITIZERS = ["-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all"]


@pytest.fixture(params=["baseline", "best"])
def fuzzed(request, tmp_path):
    """Builds sources of the library with a driver and sanitizers, for a kind of CPU, and runs so many random jobs."""
    variant = request.param if request.param in building.VARIANTS else library().camtorch_variant().decode()

    def run(driver, sources, jobs):
        command = [*building._compiler(None), *building._FLAGS, "-O1", "-g", f"-I{building._HERE}", *SANITIZERS]
        (tmp_path / "empty.c").write_text("int main(void) { return 0; }\n")
        if subprocess.run([*command, "empty.c", "-o", "empty"], cwd=tmp_path, capture_output=True).returncode:
            pytest.skip(f"{command[0]} has no sanitizers")
        paths = [*(str(building._HERE / name) for name in sources), str(HERE / driver)]
        command += ["-DVARIANT=fuzzed", *building.VARIANTS[variant], *paths, "-lm", "-o", "fuzz"]
        subprocess.run(command, cwd=tmp_path, check=True)
        environment = os.environ | {"ASAN_OPTIONS": "detect_leaks=0"}
        done = subprocess.run([tmp_path / "fuzz", "1", str(jobs)], capture_output=True, text=True, env=environment)
        assert done.returncode == 0, done.stdout + done.stderr

    return run
