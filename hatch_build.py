"""What hatchling does beside copying files: it compiles the native library for a wheel, if there is a C compiler.

Where there is none, or it fails, the wheel is pure Python and holds the reason, which `camtorch --version` tells:
installers show what a build says only when asked to (`pip install -v`). scikit-build-core can do the same, and brings
CMake to a library of two files.

And it makes the README one that an index of packages can show: there its links have no repository around them.
"""

import os
import platform
import re
import runpy
import sys
import sysconfig
import tempfile
from contextlib import suppress
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface
from hatchling.metadata.plugin.interface import MetadataHookInterface

_RAW = "https://raw.githubusercontent.com/camtorch/camtorch/main"
_BLOB = "https://github.com/camtorch/camtorch/blob/main"


class Readme(MetadataHookInterface):
    """Links from elsewhere, for `dynamic = ["readme"]`."""

    def update(self, metadata: dict[str, Any]) -> None:
        """Put it in, with images and pages by their whole addresses."""
        text = Path(self.root, "README.md").read_text("utf-8")
        text = re.sub(r"(!\[[^]]*\]\()(?!https?:)", rf"\g<1>{_RAW}/", text)
        text = re.sub(r"(?<!!)(\[[^]]*\]\()(?!https?:|#)", rf"\g<1>{_BLOB}/", text)
        text = re.sub(r'(\b(?:src|srcset)=")(?!https?:)', rf"\g<1>{_RAW}/", text)
        metadata["readme"] = {"content-type": "text/markdown", "text": text}


class NativeSampler(BuildHookInterface):
    """Puts the library into a wheel, or for an editable install beside its sources."""

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Compile, and say what else the wheel holds and what it runs on."""
        native = Path(self.root, "camtorch", "native")
        # by its path, as its package may not be importable here
        building = SimpleNamespace(**runpy.run_path(str(native / "build.py")))
        # as an attribute: it is there until the wheel is written, and gone after
        self.folder = tempfile.TemporaryDirectory()
        folder = native if version == "editable" else Path(self.folder.name)
        library, reason = folder / building.LIBRARY, folder / building.REASON
        try:
            if building.switched_off():
                raise building.BuildError("CAMTORCH_NATIVE=0 when it was installed")
            building.build(folder)
            reason.unlink(missing_ok=True)
        except (building.BuildError, OSError) as error:
            why = _line(str(error))
            self.app.display_warning(f"camtorch is installed without its compiled library: {why}")
            with suppress(PermissionError):  # on Windows, where a process has it loaded
                library.unlink(missing_ok=True)
            reason.write_text(why + "\n", "utf-8")
        if version == "editable":  # a path and nothing else
            return
        held = library if library.exists() else reason
        build_data["force_include"][str(held)] = f"camtorch/native/{held.name}"
        if held == library:
            build_data["pure_python"] = False
            build_data["tag"] = f"py3-none-{_platform()}"


def _line(text: str) -> str:
    """The one that says most."""
    lines = text.strip().splitlines()
    return next((line for line in lines if "error" in line), lines[0])


def _platform() -> str:
    """As wheels name it. A library for Linux fits where the C library is no older, which .ci/wheels.py looks into."""
    other = os.environ.get("_PYTHON_HOST_PLATFORM", "")  # which build.py reads too
    if other or sys.platform != "darwin":
        return re.sub("[-.]", "_", other or sysconfig.get_platform())
    # a universal Python compiles for the machine that it runs on; from macOS 11 on names have no minor version
    target = os.environ.get("MACOSX_DEPLOYMENT_TARGET") or str(sysconfig.get_config_var("MACOSX_DEPLOYMENT_TARGET"))
    major, minor = (int(part) for part in f"{target}.0".split(".")[:2])
    major, minor = (max(major, 11), 0) if major > 10 or platform.machine() == "arm64" else (major, minor)
    return f"macosx_{major}_{minor}_{platform.machine()}"
