"""Named cameras and where they are: what a calibration file holds."""

from __future__ import annotations

from camtorch.camera import Camera
from camtorch.extrinsics import Extrinsics


class Rig:
    """Cameras by name, and their poses.

    Args:
        cameras: name -> Camera.
        extrinsics: name -> Extrinsics, camera from rig, for the cameras that have a pose. For posed images the name is
            the image's and the Extrinsics are camera from world.
        images: image name -> name of the camera that took it, for the extrinsics whose name is no camera's.
        format: the file format that the rig comes from, which `camtorch.save` takes where the suffix allows it.

    Raises:
        ValueError: extrinsics, or an image, without a camera. TypeError: not cameras and Extrinsics.
    """

    cameras: dict[str, Camera]
    extrinsics: dict[str, Extrinsics]
    images: dict[str, str]

    def __init__(
        self,
        cameras: dict[str, Camera],
        extrinsics: dict[str, Extrinsics] | None = None,
        *,
        images: dict[str, str] | None = None,
        format: str | None = None,
    ):
        self.cameras, self.extrinsics, self.images = dict(cameras), dict(extrinsics or {}), dict(images or {})
        self.format = format
        for values, kind in ((self.cameras, Camera), (self.extrinsics, Extrinsics)):
            for name, value in values.items():
                if not isinstance(name, str) or not isinstance(value, kind):
                    raise TypeError(f"Rig: takes names and {kind.__name__}; got {name!r}: {type(value).__name__}")
        for image, name in self.images.items():
            if name not in self.cameras:
                raise ValueError(f"Rig: the image {image!r} is of a camera {name!r}; there are {list(self.cameras)}")
        for name in self.extrinsics:
            self.camera_of(name)

    @property
    def camera(self) -> Camera:
        """The only camera.

        Raises:
            ValueError: there are several, or none.
        """
        if len(self.cameras) != 1:
            raise ValueError(f"Rig: not one camera; rig.cameras has {list(self.cameras)}")
        return next(iter(self.cameras.values()))

    def camera_of(self, name: str) -> Camera:
        """The camera of that name, or the one that took the image of that name.

        Raises:
            ValueError: no such camera and no such image.
        """
        found = self.cameras.get(self.images.get(name, name))
        if found is None:
            names = [*self.cameras, *self.images]
            shown = ", ".join(map(repr, names[:8])) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
            raise ValueError(f"Rig: no camera and no image is called {name!r}; there are {shown}")
        return found

    def __repr__(self) -> str:
        lines = [_line(name, camera, self.extrinsics.get(name)) for name, camera in self.cameras.items()]
        images = [name for name in self.extrinsics if name in self.images]
        if images:
            shown = ", ".join(images[:3]) + (", ..." if len(images) > 3 else "")
            lines.append(f"  {len(images)} posed image{'s' * (len(images) > 1)}: {shown}")
        return "\n".join((f"Rig({self.format or ''})", *lines))


def _line(name: str, camera: Camera, extrinsics: Extrinsics | None) -> str:
    size = "" if camera.image_size is None else f" {camera.image_size[1]}x{camera.image_size[0]}"
    if camera.batch_shape:
        numbers = f" batch_shape={tuple(camera.batch_shape)}"
    else:
        numbers = " ({:.7g}, {:.7g}, {:.7g}, {:.7g})".format(*camera.intrinsics.tolist())
    where = ""
    if extrinsics is not None and not extrinsics.batch_shape:
        where = " at ({:.4g}, {:.4g}, {:.4g})".format(*(extrinsics.position + 0.0).tolist())
    return f"  {name}: {type(camera).__name__}{size}{numbers}{where}"
