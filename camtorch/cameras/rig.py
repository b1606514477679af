"""Named cameras and their poses, as a calibration file holds them."""

from collections.abc import Collection, ItemsView, Iterator, KeysView, Mapping, MutableMapping, Sequence, ValuesView
from itertools import islice
from typing import TypeVar, cast

from torch import Tensor, nn
from torch.nn.utils.parametrize import type_before_parametrizations

from camtorch.cameras.camera import Camera
from camtorch.evaluate.tensors import values_of
from camtorch.poses.extrinsics import Extrinsics
from camtorch.values.arguments import as_mapping, shown
from camtorch.values.module import BatchedModule, UnsharedState

M = TypeVar("M", bound=BatchedModule)
_SHOWN = 8
_OF_CAMERAS = ("intrinsics", "distortion", "image_size")  # in addition to the class's


class NamedModules(nn.Module, MutableMapping[str, M]):
    """Modules by name, in order: a mapping like `nn.ModuleDict`, but names may have dots, as those of files do.

    With `names`, modules are the rows of a `batch` of one dim: `mapping[name]` is `batch[row]`, made at each access, so
    that 200,000 of them take no more time than one. With another `NamedModules` this one shares its modules.
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
            raise ValueError(f"{owner}: names must be one for each row of {tuple(batch.batch_shape)}; got {len(names)}")
        for row, name in enumerate(names):
            if not isinstance(name, str):
                raise TypeError(f"{owner}: names must be strings; got {name!r}")
            if name in self._places:
                raise ValueError(f"{owner}: names must be unique; got {name!r} twice")
            self._places[name] = row
        self.batch = batch

    def __getitem__(self, name: str) -> M:
        place = self._places.get(name) if isinstance(name, str) else None
        if place is None:
            raise KeyError(f"name of {self._kind.__name__} must be one of {_some(self)}; got {name!r}")
        return cast(M, self._modules[place] if isinstance(place, str) else cast(M, self.batch)[place])

    def __setitem__(self, name: str, module: M) -> None:
        if not isinstance(name, str) or not isinstance(module, self._kind):
            raise TypeError(f"Rig: items must be str: {self._kind.__name__}; got {name!r}: {type(module).__name__}")
        place = self._places.get(name)
        if not isinstance(place, str):
            # nn.Module takes no dots; a percent sign separates names from its attributes
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
        """Return the row of `batch` that has this name, or None for a module of its own."""
        place = self._places[name]
        return None if isinstance(place, str) else place

    # compare by identity: nn.Module keeps modules in sets
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

    It is a module: `.to`, `.float`, `state_dict` and `requires_grad_` reach all cameras and poses. It is also a mapping
    of names to cameras: `rig["cam0"]`, `len(rig)`, `for name in rig`, `rig.items()`. `rig[name]` and `name in rig` take
    the names of images as well. `rig.cameras` and `rig.extrinsics` are mappings that may be changed.

    Args:
        cameras: name -> Camera.
        extrinsics: name -> Extrinsics, camera from rig, for the cameras that have a pose. For posed images the name is
            the image's and the Extrinsics are camera from world. Or a pair (names, Extrinsics of batch dims (N,)), as
            readers give many images: the poses are rows of `rig.extrinsics.batch`, and become modules of their own only
            when they are accessed by name.
        images: image name -> name of the camera that took it, for the extrinsics whose name is no camera's.
        format: The file format that the rig comes from, which `camtorch.save` takes if the suffix allows it.

    Raises:
        ValueError: If extrinsics, or an image, have no camera. TypeError: If something is not Camera or Extrinsics.
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
                raise ValueError(f"Rig: the camera of {image!r} must be one of {list(self.cameras)}; got {name!r}")
        for name in self.extrinsics:
            self.camera_of(name)

    @property
    def camera(self) -> Camera:
        """The only camera.

        Raises:
            ValueError: If there are several, or none.
        """
        if len(self.cameras) != 1:
            raise ValueError(f"Rig: cameras must be one for rig.camera; got {list(self.cameras)}. Take rig[name]")
        return next(iter(self.cameras.values()))

    def camera_of(self, name: str) -> Camera:
        """Return the camera of that name, or the one that took the image of that name.

        Raises:
            ValueError: If there is no such camera and no such image.
        """
        found = self.cameras.get(self.images.get(name, name)) if isinstance(name, str) else None
        if found is None:
            there = _some([*self.cameras, *self.images])
            raise ValueError(f"Rig: name must be that of a camera or an image, {there}; got {name!r}")
        return found

    def between(self, left: str, right: str) -> Extrinsics:
        """Return the pose right from left, `p_right = R p_left + t`, which `rectify` takes.

            ct.rectify(rig["left"], rig["right"], rig.between("left", "right"))

        It is composed from `extrinsics` at each call; if these learn, gradients reach them.

        Args:
            left: The name of a camera, or of an image, whose pose the rig has.
            right: Another such name.

        Raises:
            ValueError: If there is no such camera, or it has no pose.
        """
        for name in (left, right):
            self.camera_of(name)
            if name not in self.extrinsics:
                raise ValueError(f"Rig: name must have a pose, as {_some(self.extrinsics)} have; got {name!r}")
        return self.extrinsics[right].compose(self.extrinsics[left].inverse())

    def _way_to_cameras(self) -> str:
        """Return where the cameras are, for errors about attributes that only a camera has."""
        if len(self.cameras) == 1:
            return "whose only camera is its .camera"
        return f"whose cameras are {_some(self.cameras, 'rig[{!r}]')}" if self.cameras else "which has no camera"

    def __getattr__(self, name: str) -> Tensor | nn.Module:
        try:
            return super().__getattr__(name)
        except AttributeError:
            if name in _OF_CAMERAS or (not name.startswith("_") and hasattr(Camera, name)):
                raise AttributeError(
                    f"Rig: the owner of {name} must be a camera; got a Rig, {self._way_to_cameras()}"
                ) from None
            raise

    def __getitem__(self, name: str) -> Camera:
        """Return the same as `camera_of`, but raise a KeyError for an unknown name."""
        try:
            return self.camera_of(name)
        except ValueError as error:
            raise KeyError(str(error)) from None

    def __contains__(self, name: object) -> bool:
        return name in self.cameras or name in self.images

    def __len__(self) -> int:
        """Return the number of cameras."""
        return len(self.cameras)

    def __iter__(self) -> Iterator[str]:
        """Iterate over the names of the cameras."""
        return iter(self.cameras)

    def __bool__(self) -> bool:
        return True

    def keys(self) -> KeysView[str]:
        """Return the names of the cameras."""
        return self.cameras.keys()

    def values(self) -> ValuesView[Camera]:
        """Return the cameras."""
        return self.cameras.values()

    def items(self) -> ItemsView[str, Camera]:
        """Return the cameras with their names."""
        return self.cameras.items()

    def __repr__(self) -> str:
        lines = [_line(name, camera, self.extrinsics.get(name)) for name, camera in self.cameras.items()]
        images = [name for name in self.extrinsics if name in self.images]
        if images:
            shown = ", ".join(images[:3]) + (", ..." if len(images) > 3 else "")
            lines.append(f"  {len(images)} posed image{'s' * (len(images) > 1)}: {shown}")
        return "\n".join((f"Rig({self.format or ''})", *lines))


def _some(names: Collection[str], form: str = "{!r}") -> str:
    """Return names in words, the first few of many."""
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return (", ".join(map(form.format, islice(names, _SHOWN))) or "none") + more


def _line(name: str, camera: Camera, extrinsics: Extrinsics | None) -> str:
    size = "" if camera.image_size is None else f" {camera.image_size[1]}x{camera.image_size[0]}"
    intrinsics = None if camera.batch_shape else values_of(camera.intrinsics)
    numbers = "" if intrinsics is None else " ({:.7g}, {:.7g}, {:.7g}, {:.7g})".format(*intrinsics.tolist())
    numbers = f" batch_shape={tuple(camera.batch_shape)}" if camera.batch_shape else numbers
    position = None if extrinsics is None or extrinsics.batch_shape else values_of(extrinsics.position)
    where = "" if position is None else " at ({:.4g}, {:.4g}, {:.4g})".format(*(position + 0.0).tolist())
    return f"  {name}: {type_before_parametrizations(camera).__name__}{size}{numbers}{where}"
