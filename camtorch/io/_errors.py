"""What is raised for a calibration file that cannot be used."""

from __future__ import annotations

import os


class CameraFileError(ValueError):
    """A calibration file that cannot be used.

    Args:
        path: the file.
        place: the line or the key where reading stopped.
        reason: what is wrong there, and where possible what to do.
    """

    def __init__(self, path: str | os.PathLike[str], place: str, reason: object):
        super().__init__(str(path), place, str(reason))

    def __str__(self) -> str:
        return "{}: {}: {}".format(*self.args)
