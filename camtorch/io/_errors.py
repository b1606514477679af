"""What is raised for a calibration file that cannot be used."""


class CameraFileError(ValueError):
    """A calibration file that cannot be used.

    Args:
        path: the file.
        place: the line or the key where reading stopped.
        reason: what is wrong there, and where possible what to do.
    """

    def __init__(self, path, place: str, reason: object):
        super().__init__(str(path), place, str(reason))

    def __str__(self) -> str:
        return "{}: {}: {}".format(*self.args)
