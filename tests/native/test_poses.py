"""The compiled search for poses, and linearised views: nothing outside is read or written, whatever comes."""

import os
import subprocess
from pathlib import Path

import pytest

from camtorch.native import build as building
from camtorch.native.library import library

if library() is None:
    pytest.skip("there is no library", allow_module_level=True)


@pytest.mark.slow
@pytest.mark.parametrize("variant", ["baseline", "best"])
def test_no_read_outside_and_nothing_undefined(variant, tmp_path):
    variant = variant if variant in building.VARIANTS else library().camtorch_variant().decode()
    sanitizers = ["-fsanitize=address,undefined,float-cast-overflow", "-fno-sanitize-recover=all"]
    command = [*building._compiler(None), *building._FLAGS, "-O1", "-g", f"-I{building._HERE}", *sanitizers]
    (tmp_path / "empty.c").write_text("int main(void) { return 0; }\n")
    if subprocess.run([*command, "empty.c", "-o", "empty"], cwd=tmp_path, capture_output=True).returncode:
        pytest.skip(f"{command[0]} has no sanitizers")
    sources = [str(building._HERE / name) for name in ("poses.c", "views.c")]
    sources = [*building.VARIANTS[variant], *sources, str(Path(__file__).parent / "poses_fuzz.c")]
    subprocess.run([*command, "-DVARIANT=fuzzed", *sources, "-lm", "-o", "fuzz"], cwd=tmp_path, check=True)
    environment = os.environ | {"ASAN_OPTIONS": "detect_leaks=0"}
    done = subprocess.run([tmp_path / "fuzz", "1", "4000"], capture_output=True, text=True, env=environment)
    assert done.returncode == 0, done.stdout + done.stderr
