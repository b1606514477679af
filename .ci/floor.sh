#!/usr/bin/env bash
# The oldest versions that pyproject.toml declares: the laws of the models, files and warps, in a fresh environment of
# their own. Not a part of `run`: PyPI's torch for Linux brings gigabytes of CUDA, unless PIP_EXTRA_INDEX_URL names an
# index of those for CPUs.
#
# `bash .ci/floor.sh [PYTHON [FOLDER]]`: python3.11 by default; FOLDER, for the environment, is kept and used again.
set -euo pipefail
cd "$(dirname "$0")/.."
python=${1:-python3.11}
if [ $# -gt 1 ]; then
    environment=$2
else
    environment=$(mktemp -d)
    trap 'rm -rf "$environment"' EXIT
fi
if [ ! -e "$environment/bin/pip" ]; then
    "$python" -m venv "$environment"
fi
. "$environment/bin/activate"
# "name>=1.2" in dependencies becomes name==1.2.*: the last repair of that version
python - > "$environment/floor.txt" <<'END'
import sys, tomllib
project = tomllib.load(open("pyproject.toml", "rb"))["project"]
now = ".".join(map(str, sys.version_info[:2]))
if now != project["requires-python"].removeprefix(">="):
    print("this is Python", now, "rather than", project["requires-python"], file=sys.stderr)
print(*(f"{library.replace('>=', '==')}.*" for library in project["dependencies"]), sep="\n")
END
cat "$environment/floor.txt"
pip install --quiet -r "$environment/floor.txt" pytest hypothesis
pip install --quiet --no-deps -e .
# without the export of inverses, whose loops torch 2.10 does not take
pytest tests/models/test_{laws,golden,models,new_models,module,extrinsics}.py tests/io tests/warp/test_{warp,dewarp}.py \
    tests/augment/test_augment_arguments.py \
    --deselect 'tests/models/test_module.py::test_export[unproject-kannala_brandt]'
