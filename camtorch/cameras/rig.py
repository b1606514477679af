"""Named cameras and where they are: what a calibration file holds."""

from __future__ import annotations

from collections.abc import Collection, ItemsView, Iterator, KeysView, Mapping, MutableMapping, Sequence, ValuesView
from itertools import islice
from typing import TypeVar, cast

from torch import Tensor, nn
from torch.nn.utils.parametrize import type_before_parametrizations

from camtorch.cameras.camera import Camera
from camtorch.evaluate.known import values_of
from camtorch.poses.extrinsics import Extrinsics
from camtorch.values.arguments import as_mapping, shown
from camtorch.values.module import BatchedModule, UnsharedState

M = TypeVar("M", bound=BatchedModule)
_SHOWN = 8
_OF_CAMERAS = ("intrinsics", "distortion", "image_size")  # beside what their class has


class NamedModules(nn.Module, MutableMapping[str, M]):
    """Modules by name, in order: a mapping as `nn.ModuleDict`, whose names may have dots, as those of files do.

    Rows of a `batch`, of one batch dim, have `names`: 200,000 of them take no more time than one, as `mapping[name]` is
    `batch[row]`, made when it is asked for. With another `NamedModules` this one shares its modules.
    """

    batch: M | None

    def __init__(
        self, kind: type[M], modules: Mapping[str, M] | None = None, names: Sequence[str] = (), batch: M | None = None
    ):
        super().__init__()
        self._kind: type[M] = kind
        self._places: dict[str, str | int] = {}  # the key of the module, or the row of the batch
        self.batch = None
        if isinstance(modules, NamedModules):
            self._places = dict(modules._places)
            self._modules.update(modules._modules)
            self.batch = modules.batch
        else:
            word = "cameras" if kind.__name__ == "Camera" else kind.__name__.lower()
            for name, module in as_mapping(modules, word, "Rig", f"{{'left': {kind.__name__}}}").items():
                self[name] = module
        if batch is None and not names:
            return
        owner = kind.__name__
        if not isinstance(batch, kind):
            raise TypeError(f"{owner}: the batch of named rows must be {owner}; got {type(batch).__name__}")
        if batch.batch_shape != (len(names),):
            raise ValueError(f"{owner}: {len(names)} names do not fit a batch {tuple(batch.batch_shape)}")
        for row, name in enumerate(names):
            if not isinstance(name, str):
                raise TypeError(f"{owner}: names must be strings; got {name!r}")
            if name in self._places:
                raise ValueError(f"{owner}: the name {name!r} appears twice")
            self._places[name] = row
        self.batch = batch

    def __getitem__(self, name: str) -> M:
        place = self._places.get(name) if isinstance(name, str) else None
        if place is None:
            raise KeyError(f"no {self._kind.__name__} is called {name!r}; there are {_some(self)}")
        return cast(M, self._modules[place] if isinstance(place, str) else cast(M, self.batch)[place])

    def __setitem__(self, name: str, module: M) -> None:
        if not isinstance(name, str) or not isinstance(module, self._kind):
            raise TypeError(f"Rig: takes names and {self._kind.__name__}; got {name!r}: {type(module).__name__}")
        place = self._places.get(name)
        if not isinstance(place, str):
            # nn.Module takes no dots; a percent sign before other names than those of its attributes
            place = name.replace("%", "%25").replace(".", "%2E")
            place = f"%{place}" if not place or hasattr(self, place) else place
            self._places[name] = place
        self._modules[place] = module

    def __delitem__(self, name: str) -> None:
        place = self._places.pop(name)
        if isinstance(place, str):
            del self._modules[place]

    def __iter__(self) -> Iterator[str]:
        return iter(self._places)

    def __len__(self) -> int:
        return len(self._places)

    def __contains__(self, name: object) -> bool:
        return name in self._places

    def row(self, name: str) -> int | None:
        """The row of `batch` that has this name, or None for a module of its own."""
        place = self._places[name]
        return None if isinstance(place, str) else place

    # a module is itself and nothing else, as the sets that nn.Module keeps of them want it
    def __eq__(self, other: object) -> bool:
        return self is other

    __hash__ = object.__hash__

    def __repr__(self) -> str:
        lines = [f"  {name!r}: {self[name]!r}" for name in list(self)[:_SHOWN]]
        if len(self) > _SHOWN:
            lines.append(f"  and {len(self) - _SHOWN} more")
        return "\n".join((f"{self._kind.__name__} by name:", *lines))


class Rig(UnsharedState):
    """Cameras by name, and their poses.

    A module: `.to`, `.float`, `state_dict` and `requires_grad_` reach all cameras and poses. And a mapping of names
    to cameras: `rig["cam0"]`, `len(rig)`, `for name in rig`, `rig.items()`. `rig[name]` and `name in rig` take
    the names of images as well. `rig.cameras` and `rig.extrinsics` are mappings that may be changed.

    Args:
        cameras: name -> Camera.
        extrinsics: name -> Extrinsics, camera from rig, for the cameras that have a pose. For posed images the name is
            the image's and the Extrinsics are camera from world. Or the names and one batch, a pair (names,
            Extrinsics of batch dims (N,)): that is how a reader gives many images, whose poses are then rows of
            `rig.extrinsics.batch` and become modules of their own only when they are asked for by name.
        images: image name -> name of the camera that took it, for the extrinsics whose name is no camera's.
        format: the file format that the rig comes from, which `camtorch.save` takes where the suffix allows it.

    Raises:
        ValueError: extrinsics, or an image, without a camera. TypeError: not cameras and Extrinsics.
    """

    cameras: NamedModules[Camera]
    extrinsics: NamedModules[Extrinsics]
    images: dict[str, str]

    def __init__(
        self,
        cameras: Mapping[str, Camera],
        extrinsics: Mapping[str, Extrinsics] | tuple[Sequence[str], Extrinsics] | None = None,
        *,
        images: Mapping[str, str] | None = None,
        format: str | None = None,
    ):
        super().__init__()
        self.cameras = NamedModules(Camera, cameras)
        if isinstance(extrinsics, tuple):
            if len(extrinsics) != 2 or not isinstance(extrinsics[0], Sequence):
                raise TypeError(f"Rig: extrinsics must be a dict, or (names, a batch); got {shown(extrinsics)}")
            names, batch = extrinsics
            self.extrinsics = NamedModules(Extrinsics, names=names, batch=batch)
        else:
            self.extrinsics = NamedModules(Extrinsics, extrinsics)
        self.images = dict(as_mapping(images, "images", "Rig", "{'0001.png': 'left'}"))
        self.format = format
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
        found = self.cameras.get(self.images.get(name, name)) if isinstance(name, str) else None
        if found is None:
            there = _some([*self.cameras, *self.images])
            raise ValueError(f"Rig: no camera and no image is called {name!r}; there are {there}")
        return found

    def between(self, left: str, right: str) -> Extrinsics:
        """Right from left, `p_right = R p_left + t`: what `rectify` takes.

            ct.rectify(rig["left"], rig["right"], rig.between("left", "right"))

        Composed anew from `extrinsics` at each call; where these learn, gradients reach them.

        Args:
            left: the name of a camera, or of an image, whose pose the rig has.
            right: that of another.

        Raises:
            ValueError: no such camera, or it has no pose.
        """
        for name in (left, right):
            self.camera_of(name)
            if name not in self.extrinsics:
                raise ValueError(f"Rig: {name!r} has no pose in rig.extrinsics; there is {_some(self.extrinsics)}")
        return self.extrinsics[right].compose(self.extrinsics[left].inverse())

    def _way_to_cameras(self) -> str:
        """Where they are, for errors about what only a camera can."""
        if len(self.cameras) == 1:
            return "whose only camera is its .camera"
        return f"whose cameras are {_some(self.cameras, 'rig[{!r}]')}" if self.cameras else "which has no camera"

    def __getattr__(self, name: str) -> Tensor | nn.Module:
        try:
            return super().__getattr__(name)
        except AttributeError:
            if name in _OF_CAMERAS or (not name.startswith("_") and hasattr(Camera, name)):
                raise AttributeError(
                    f"Rig: {name} is a camera's, and this is a Rig, {self._way_to_cameras()}"
                ) from None
            raise

    def __getitem__(self, name: str) -> Camera:
        """The same as `camera_of`, but that an unknown name is a KeyError."""
        try:
            return self.camera_of(name)
        except ValueError as error:
            raise KeyError(str(error)) from None

    def __contains__(self, name: object) -> bool:
        return name in self.cameras or name in self.images

    def __len__(self) -> int:
        """The number of cameras."""
        return len(self.cameras)

    def __iter__(self) -> Iterator[str]:
        """Over the names of the cameras."""
        return iter(self.cameras)

    def __bool__(self) -> bool:
        return True

    def keys(self) -> KeysView[str]:
        """The names of the cameras."""
        return self.cameras.keys()

    def values(self) -> ValuesView[Camera]:
        """The cameras."""
        return self.cameras.values()

    def items(self) -> ItemsView[str, Camera]:
        """The cameras with their names."""
        return self.cameras.items()

    def __repr__(self) -> str:
        lines = [_line(name, camera, self.extrinsics.get(name)) for name, camera in self.cameras.items()]
        images = [name for name in self.extrinsics if name in self.images]
        if images:
            shown = ", ".join(images[:3]) + (", ..." if len(images) > 3 else "")
            lines.append(f"  {len(images)} posed image{'s' * (len(images) > 1)}: {shown}")
        return "\n".join((f"Rig({self.format or ''})", *lines))


def _some(names: Collection[str], form: str = "{!r}") -> str:
    """Names in words, the first few of many."""
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return (", ".join(map(form.format, islice(names, _SHOWN))) or "none") + more


def _line(name: str, camera: Camera, extrinsics: Extrinsics | None) -> str:
    size = "" if camera.image_size is None else f" {camera.image_size[1]}x{camera.image_size[0]}"
    numbers = where = ""
    if camera.batch_shape:
        numbers = f" batch_shape={tuple(camera.batch_shape)}"
    elif (values := values_of(camera.intrinsics)) is not None:
        numbers = " ({:.7g}, {:.7g}, {:.7g}, {:.7g})".format(*values.tolist())
    if extrinsics is not None and not extrinsics.batch_shape and (at := values_of(extrinsics.position)) is not None:
        where = " at ({:.4g}, {:.4g}, {:.4g})".format(*(at + 0.0).tolist())
    return f"  {name}: {type_before_parametrizations(camera).__name__}{size}{numbers}{where}"
