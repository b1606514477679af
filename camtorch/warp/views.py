"""Pinhole views of an image: the faces of a cube, a ring of views around, or one that looks at a box."""

import math
from collections.abc import Iterator, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from torch import Tensor, nn

from camtorch.cameras.camera import Camera
from camtorch.evaluate.door import has_tangent, keeps_graph
from camtorch.models import Pinhole
from camtorch.poses.rotations import mount_rotation
from camtorch.rays.lattices import slopes_at_axis
from camtorch.values.arguments import (
    Numbers,
    as_fov,
    as_known_size,
    as_number,
    as_values,
    as_whole,
    check_boxes,
    hinting,
    shown,
)
from camtorch.values.dtypes import check_averaged, narrow, widen
from camtorch.values.module import GeometryModule, remade, typed_as
from camtorch.warp.boxes import corners_of
from camtorch.warp.crops import CropsWarp, flattened
from camtorch.warp.options import Mode
from camtorch.warp.warp import Warp, as_sized

__all__ = ["FACES", "Views", "crop_place", "cube", "look_at", "ring"]

FACES = ("front", "right", "back", "left", "up", "down")
"""Names of a cube's faces, as the camera sees them from within; its axis goes through the middle of the front."""
_EDGE_SAMPLES = 65  # of a box's edge, and then of the steps to either side of the farthest sample
_ROUNDS = 3  # of such samples: 2e-6 of an edge
_MORE_ROUNDS = 8  # if a lens ends on the outline, where slopes may grow without bounds
_VIRTUAL = Pinhole([1.0, 1.0, 0.0, 0.0]).detach()
_STRAIGHT_UP = 1e-6  # radians from the y axis: float32 cameras round zero to this
_OVERLAP = 1.25  # the width of a view in a ring over the step to the next one


class Views(GeometryModule):
    """Pinhole views of one camera's image, all of the camera `view`, as `cube` and `ring` return them.

    `views(images)` makes the views, `views.back(...)` joins a network's results for them. `warps[i]` moves
    points and boxes to view i, `warps[i].inverse()` back; `rotations[i]`, (3, 3), is `ray_view = R ray_camera`. The
    `mode` is that of `Warp`; "nearest" for labels, there and back.
    """

    rotations: Tensor
    camera: Camera
    view: Pinhole
    names: tuple[str, ...]
    mode: Mode
    warps: nn.ModuleList
    backs: nn.ModuleList

    def __init__(
        self, camera: Camera, view: Pinhole, rotations: Tensor, names: tuple[str, ...], mode: Mode = "bilinear"
    ):
        super().__init__()
        self.camera, self.view, self.names = as_sized(camera, "camera", "Views"), view, names
        self.mode = mode
        self.register_buffer("rotations", rotations, persistent=False)
        self.warps = nn.ModuleList([Warp(camera, view, rotation, mode=mode) for rotation in rotations])
        self.backs = nn.ModuleList([Warp(view, camera, r.mT, mode=mode, padding_mode="border") for r in rotations])

    def __len__(self) -> int:
        return len(self.names)

    def __iter__(self) -> Iterator[Warp]:
        return iter(self.warps)  # type: ignore[arg-type]

    def forward(self, images: Any) -> Any:
        """Return the views (..., N, C, S, S) of images (..., C, H, W), or arrays of arrays, or a list of PIL images."""
        views = [warp(images) for warp in self]
        if isinstance(images, Tensor):
            return torch.stack(views, -4)
        return np.stack(views, int(images.ndim == 4)) if isinstance(images, np.ndarray) else views

    if TYPE_CHECKING:

        @typed_as(forward)
        def __call__(self, *args: Any, **options: Any) -> Any: ...

    def valid_masks(self) -> Tensor:
        """Return (1, N, 1, S, S) bool: whether the camera sees each pixel of the views."""
        return torch.stack([warp.valid_mask() for warp in self], 1)

    @torch.no_grad()
    def weights(self) -> Tensor:
        """Return the weights (N, H, W) of the views in the wide image, which fall to a view's border and sum to 1."""
        pixels = self.view.pixel_grid()
        ends = pixels.new_tensor([self.view.width, self.view.height])
        ramp = torch.minimum(pixels + 1, ends - pixels).amin(-1)[None, None]
        # weights end one pixel beyond the outermost ones: a ray between two faces is on both
        parts = [warp(ramp, mode="bilinear", padding_mode="zeros") for warp in self.backs]
        if self.mode == "nearest":  # a fill value at the rim of a view is no label
            masks = self.valid_masks().unbind(1)
            parts = [part * warp(mask) for part, warp, mask in zip(parts, self.backs, masks, strict=True)]
        whole = torch.cat(parts)[:, 0]
        total = whole.sum(0)
        return whole / torch.where(total > 0, total, 1.0)

    def back(self, views: Tensor) -> tuple[Tensor, Tensor]:
        """Join views (..., N, C, S, S), or results for them, in the wide image.

        Returns (..., C, H, W) of the same dtype, and valid (1, 1, H, W) bool, or (1, H, W) for one image: a view shows
        the pixel. Views are averaged by their weights, and integers rounded; mode="nearest" takes the pixel of the view
        with the largest weight, as labels have no mean.
        """
        size = self.view.size_for("Views")
        want = len(self), *size
        if not isinstance(views, Tensor) or views.ndim < 4 or (views.shape[-4], *views.shape[-2:]) != want:
            raise ValueError(
                f"Views: views must be a tensor (..., {len(self)}, C, {size[0]}, {size[1]}); got {shown(views)}"
            )
        check_averaged(views, self.mode, "views", "Views")
        weights = self.weights()[:, None]
        valid = weights.sum(0) > 0
        valid = valid if views.ndim == 4 else valid[None]
        images = views if self.mode == "nearest" else widen(views)
        parts = [warp(image) for image, warp in zip(images.unbind(-4), self.backs, strict=True)]
        if self.mode != "nearest":
            shares = [torch.where(w > 0, p * w.to(p.dtype), 0.0) for p, w in zip(parts, weights, strict=True)]
            return narrow(torch.stack(shares).sum(0), views.dtype), valid
        result, most = torch.zeros_like(parts[0]), torch.zeros_like(weights[0])
        for part, weight in zip(parts, weights, strict=True):
            result, most = torch.where(weight > most, part, result), weight.maximum(most)
        return result, valid

    def extra_repr(self) -> str:
        return ", ".join(self.names)


@hinting("It takes cube(camera, size), with size the sides of a face in pixels")
def cube(camera: Camera, size: int | None = None, *, mode: Mode = "bilinear") -> Views:
    """Return the six faces of a cube around a camera, of 90 degrees each: front, right, back, left, up, down.

    The sides of a face have `size` pixels; by default its middle is as fine as the image at the axis.
    """
    angles = torch.tensor([[0, 0], [90, 0], [180, 0], [-90, 0], [0, 90], [0, -90]], dtype=torch.float64)
    rotations = mount_rotation(angles[:, 0], angles[:, 1], torch.zeros(6, dtype=torch.float64))
    return _views(camera, size, math.pi / 2, rotations, FACES, mode, "cube")


@hinting("It takes ring(camera, count, size=...), with size the sides of a view in pixels")
def ring(
    camera: Camera,
    count: int,
    *,
    fov: float | None = None,
    size: int | None = None,
    pitch: float = 0.0,
    mode: Mode = "bilinear",
) -> Views:
    """Return `count` views side by side, from left to right, over a camera's field of view.

    Args:
        camera: the camera of the wide images, with image_size.
        count: number of views.
        fov: degrees of a view; by default a quarter more than the step from one view to the next.
        size: pixels along the sides of a view; by default its middle is as fine as the image at the axis.
        pitch: degrees by which all views look up.
        mode: as in `Warp`.
    """
    count, pitch = as_whole(count, "count", "ring", least=1), as_number(pitch, "pitch", "ring")
    seen = float(as_sized(camera, "camera", "ring").field_of_view.detach()[..., 0].max())
    step = seen / count
    wide = min(_OVERLAP * step, math.radians(150)) if fov is None else math.radians(as_fov(fov, "ring", 180))
    yaws = torch.rad2deg((torch.arange(count, dtype=torch.float64) - (count - 1) / 2) * step)
    rotations = mount_rotation(yaws, torch.full_like(yaws, pitch), torch.zeros_like(yaws))
    return _views(camera, size, wide, rotations, tuple(f"{yaw:.4g} degrees" for yaw in yaws.tolist()), mode, "ring")


def _views(
    camera: Camera, size: int | None, fov: float, rotations: Tensor, names: tuple[str, ...], mode: Mode, owner: str
) -> Views:
    as_sized(camera, "camera", owner)
    if camera.batch_shape:
        raise ValueError(f"{owner}: camera must be a single camera; got batch_shape={tuple(camera.batch_shape)}")
    if size is None:
        with torch.no_grad():
            slope = slopes_at_axis(camera.optics, camera.distortion[None])
            size = max(2, round(2 * float((camera.intrinsics[:2] * slope[0]).max()) * math.tan(fov / 2)))
    size = as_whole(size, "size", owner, least=1)
    focal, centre = size / 2 / math.tan(fov / 2), (size - 1) / 2
    intrinsics = camera.intrinsics.detach().new_tensor([focal, focal, centre, centre])
    return Views(camera, pinhole(intrinsics, (size, size)), rotations.to(intrinsics), names, mode)


@hinting("It takes look_at(camera, boxes, image_size=(height, width)), and perhaps margin")
def look_at(camera: Camera, boxes: Numbers, image_size: Sequence[int], *, margin: float = 0.25) -> Warp:
    """Return a warp to a pinhole camera that looks at a box, such as a detected face: a crop without perspective.

    A plain crop of a face off the axis shows the face as seen from the side of the lens: wider, leaning, and turned
    against the same face on the axis. The new camera looks along the ray of the box's middle, and the source's y axis
    stays in its y-z plane, so that upright stays upright. Its pixels are square, its principal point is the middle of
    the image, and its focal length is the largest at which the outline of box and margin is inside the image. For
    pinhole images this is Perspective Crop Layers (Yu et al., CVPR 2021, arXiv 2011.13607). Such a crop hides where the
    thing was: a network that needs it, as for depth, is given `crop_place(warp)` too.

    Args:
        camera: the camera of the images, of any model, with image_size; single, or a batch of B.
        boxes: (B, 4) or (4,), pixels x1, y1, x2, y2 of the camera's images, whole numbers at the middles of pixels; or
            (B, F, 4), F boxes of each of B images.
        image_size: (height, width) of the crop.
        margin: how far left and right move out, in widths of the box, and top and bottom, in heights.

    Returns:
        A `Warp` to a `Pinhole` of batch (B,), or single for one box. Images (1, C, H, W) of a single camera give B
        crops. `warp.transform_points`, `.transform_rays` and so on move labels, `warp.inverse()` takes them back,
        `warp.target` is the new camera and `warp.rotation` its turn, `ray_crop = R ray_camera`.

        For boxes (B, F, 4) it is a `CropsWarp` to a `Pinhole` of batch (B, F): images (B, C, H, W) give crops
        (B, F, C, h, w), and labels have the leading dims (B, F).

        All has gradients to boxes that require grad, so that a network can move its own crop. There is none to the
        camera by the place of the crop, which counts as given; a camera that learns has those of any `Warp`. The
        outline has the gradient of the points that touch the crop's sides: if two touch at once, that of one of them,
        and where the lens ends on the outline, as if that end stayed in its place along the edge.

    Raises:
        ValueError: If a box cannot be looked at; the message names it.
    """
    camera, owner = as_sized(camera, "camera", "look_at"), "look_at"
    given = as_values(boxes, "boxes", owner, camera.intrinsics.device)
    if given.ndim not in (1, 2, 3) or given.shape[-1] != 4:
        raise ValueError(
            f"{owner}: boxes must be (B, 4), (4,) or (B, F, 4), pixels x1, y1, x2, y2; got shape {tuple(given.shape)}"
        )
    batch = tuple(camera.batch_shape)
    if len(batch) > 1 or (batch and given.ndim > 1 and len(given) != batch[0]):
        raise ValueError(f"{owner}: boxes must be one for each camera of one batch dim; got {len(given)} for {batch}")
    size = as_known_size(image_size, owner)
    rows = given if given.ndim > 1 else given.expand(*(batch or (1,)), 4)
    each = flattened(camera, rows.shape[:-1]) if rows.ndim == 3 else camera
    intrinsics, rotation = looking_at(each, rows, size, as_margin(margin, owner), owner)
    if given.ndim == 1 and not batch:
        intrinsics, rotation = intrinsics[0], rotation[0]
    dtype = torch.promote_types(camera.intrinsics.dtype, torch.float32)
    intrinsics, rotation = intrinsics.to(dtype), rotation.to(dtype)
    if given.ndim == 3:
        return CropsWarp(camera, pinhole(intrinsics, size), rotation)
    return Warp(camera, pinhole(intrinsics, size)).turned_by(rotation)


def crop_place(warp: Warp) -> Tensor:
    """Return where a crop lies and how wide it is: the numbers that a network of crops should be given too.

    A crop that looks at a thing hides the thing's direction and size in the whole image. A network that predicts depth,
    or anything in the camera's frame, needs them, as in Perspective Crop Layers (arXiv 2011.13607).

        >>> camera = ct.KannalaBrandt.from_fov(150, image_size=(480, 640))
        >>> warp = ct.views.look_at(camera, [[40, 200, 120, 300], [300, 200, 360, 280]], (64, 64))
        >>> ct.views.crop_place(warp).shape
        torch.Size([2, 5])

    Args:
        warp: of `look_at`, or any other whose target is the camera of the crop, such as `ct.Warp(camera,
            camera.crop(top, left, height, width))`.

    Returns:
        (*B, 5), with gradients: the unit ray of the crop's middle in the frame of the source (x right, y down, z
        forward), then the tangents of half the angles between left and right, and between top and bottom: half of width
        and height over the focal length. If the rotation mirrors, the ray is that of the scene in a mirror, x negated.
        Where the target has no ray in the middle or at a side, what follows from it is 0.

    Raises:
        TypeError: If warp is no warp.
    """
    if not isinstance(warp, Warp):
        raise TypeError(
            f"crop_place: warp must be a Warp, as of ct.views.look_at; got {shown(warp)}. BoxCrop(place=True) has the "
            "place of a sample's crop"
        )
    return place_of(warp.target, warp.rotation)


def place_of(camera: Camera, rotation: Tensor | None) -> Tensor:
    """Return the place (*B, 5) of the images of a camera turned by a rotation (*B, 3, 3); see `crop_place`."""
    right, down = camera.width - 0.5, camera.height - 0.5
    x, y = (right - 0.5) / 2, (down - 0.5) / 2
    ends = camera.intrinsics.new_tensor([[x, y], [-0.5, y], [right, y], [x, -0.5], [x, down]])
    rays, seen = camera.unproject(ends.expand(*camera.batch_shape, 5, 2))
    rays = torch.where(seen.unsqueeze(-1), rays, 0.0)
    middle, starts, stops = rays[..., 0, :], rays[..., 1::2, :], rays[..., 2::2, :]
    apart, along = (stops - starts).square().sum(-1), (stops + starts).square().sum(-1)
    known = seen[..., 1::2] & seen[..., 2::2] & (apart > 0) & (along > 0)
    tangents = torch.where(known, apart / torch.where(known, along, 1.0), 1.0).sqrt() * known
    if rotation is not None:
        middle = (rotation * middle.unsqueeze(-1)).sum(-2)
        first, second, third = rotation.unbind(-2)
        mirrors = (torch.linalg.cross(first, second) * third).sum(-1, keepdim=True) < 0
        middle = torch.where(mirrors, middle * middle.new_tensor([-1.0, 1.0, 1.0]), middle)
    return torch.cat((middle, tangents.to(middle).expand(*middle.shape[:-1], 2)), -1)


def as_margin(value: object, owner: str) -> float:
    """Return a checked margin around a box, as a part of its sides."""
    margin = as_number(value, "margin", owner)
    if not -0.5 < margin < math.inf:
        raise ValueError(f"{owner}: margin must be finite and more than -0.5, which leaves no box; got {value!r}")
    return margin


def pinhole(intrinsics: Tensor, size: tuple[int, int]) -> Pinhole:
    """Return a pinhole camera of valid intrinsics (*B, 4), which do not learn."""
    return remade(_VIRTUAL, intrinsics=intrinsics, distortion=intrinsics[..., :0], image_size=size)


def _refuse(wrong: Tensor, boxes: Tensor, what: str, owner: str) -> None:
    """Raise a ValueError that names the first of `boxes` (*B, 4) at which `wrong`, in their order, is True."""
    if bool(wrong.any()):
        i = int(wrong.flatten().nonzero()[0])
        place = ", ".join(str(int(n)) for n in np.unravel_index(i, boxes.shape[:-1]))
        raise ValueError(f"{owner}: boxes must {what}; got boxes[{place}] = {boxes.reshape(-1, 4)[i].tolist()}")


def looking_at(
    camera: Camera, boxes: Tensor, size: tuple[int, int], margin: float, owner: str
) -> tuple[Tensor, Tensor]:
    """Return intrinsics (*B, 4) and rotations (*B, 3, 3), in float64, of the cameras of `look_at` for boxes (*B, 4).

    camera: a single one, or one for each box, with one batch dim. Derivatives go to the boxes.
    """
    with torch.no_grad():
        middles, corners = _middles_and_corners(boxes.detach(), margin)
        rotation = _rotation_to(_checked_axes(camera, boxes, middles, owner))
        farthest, edges, shares = _outermost(camera, corners, rotation, boxes, owner)
    if keeps_graph(boxes) or has_tangent(boxes):
        # the largest slope of all has the derivative of the slope at the point that has it
        camera = camera.detach() if keeps_graph(*camera.tensors) else camera
        middles, corners = _middles_and_corners(boxes, margin)
        rotation = _rotation_to(camera.unproject(middles)[0])
        rows = torch.arange(len(corners), device=corners.device)[:, None]
        start, end = corners[rows, edges], corners[rows, (edges + 1) % 4]
        rays = camera.unproject(start + shares[..., None] * (end - start))[0] @ rotation.mT
        farthest = rays[..., :2].diagonal(dim1=1, dim2=2).abs() / rays[..., 2]
    sides = farthest.new_tensor(size[::-1])
    focal = (sides / 2 / farthest).amin(-1, keepdim=True).expand(-1, 2)
    intrinsics = torch.cat((focal, ((sides - 1) / 2).expand_as(focal)), -1)
    return intrinsics.view(*boxes.shape[:-1], 4), rotation.view(*boxes.shape[:-1], 3, 3)


def _rotation_to(axis: Tensor) -> Tensor:
    """Return rotations (B, 3, 3) to cameras that look along unit rays (B, 3), with the y axis in their y-z plane."""
    axis = axis / axis.norm(dim=-1, keepdim=True)
    across = torch.stack((axis[:, 2], torch.zeros_like(axis[:, 0]), -axis[:, 0]), -1)
    across = across / across.norm(dim=-1, keepdim=True)
    return torch.stack((across, torch.linalg.cross(axis, across), axis), -2)


def _middles_and_corners(boxes: Tensor, margin: float) -> tuple[Tensor, Tensor]:
    """Return the middles (B, 2) of boxes (*B, 4), and their corners (B, 4, 2) with the margin, in float64."""
    low, high = boxes.reshape(-1, 4).double().split(2, -1)
    moved = margin * (high - low)
    return (low + high) / 2, corners_of(torch.cat((low - moved, high + moved), -1))


def _checked_axes(camera: Camera, boxes: Tensor, middles: Tensor, owner: str) -> Tensor:
    """Return the rays (B, 3) of the middles of boxes; raise if one of these is none, or no camera can look at it."""
    check_boxes(boxes, "boxes", owner)
    _refuse(~torch.isfinite(boxes).all(-1), boxes, "be finite", owner)
    _refuse(~(boxes[..., :2] < boxes[..., 2:]).all(-1), boxes, "have a width and a height: x1 < x2 and y1 < y2", owner)
    limits = boxes.new_tensor((camera.width, camera.height)) - 0.5
    is_shown = ((boxes[..., :2] < limits) & (boxes[..., 2:] > -0.5)).all(-1)
    _refuse(~is_shown, boxes, f"be on the image, {camera.width} x {camera.height}, in part", owner)
    axes, has_ray = camera.unproject(middles)
    _refuse(~has_ray, boxes, "have a middle that the lens sees", owner)
    what = "lie off the camera's y axis, along which no direction is up"
    _refuse(axes[:, ::2].norm(dim=-1) < _STRAIGHT_UP * axes.norm(dim=-1), boxes, what, owner)
    return axes


def _outermost(
    camera: Camera, corners: Tensor, rotation: Tensor, boxes: Tensor, owner: str
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the largest slopes x / z and y / z (B, 2) of outlines (B, 4, 2), turned by rotations (B, 3, 3).

    And where on the outlines they are, (B, 2) each: the edge, and the share of it from its start. Errors name `boxes`.
    """
    start, edge = corners[:, :, None, None], (corners.roll(-1, 1) - corners)[:, :, None, None]
    steps = torch.linspace(-1, 1, _EDGE_SAMPLES, dtype=corners.dtype, device=corners.device)
    farthest = corners.new_full((len(corners), 2), -math.inf)
    # along each edge, in smaller and smaller steps around the farthest sample
    place, half = corners.new_full((len(corners), 4, 1), 0.5), 0.5
    all_seen = True
    for i in range(_MORE_ROUNDS):
        share = (place[..., None] + half * steps).clamp(0, 1)  # (B, 4, 1 or 2, K)
        rays, seen = camera.unproject((start + share[..., None] * edge).flatten(1, 3))
        turned, seen = (rays @ rotation.mT).view(*share.shape, 3), seen.view(share.shape)
        all_seen = all_seen and bool(seen.all())
        behind = (seen & (turned[..., 2] <= 1e-9)).flatten(1).any(-1)
        _refuse(behind, boxes, "have an outline less than 90 degrees from the middle", owner)
        slopes = turned[..., :2].abs() / turned[..., 2:].clamp(min=1e-9)
        slopes = torch.where(seen[..., None], slopes, -math.inf)
        slopes = slopes.expand(-1, -1, 2, -1, -1).diagonal(dim1=2, dim2=4).mT  # (B, 4, 2, K)
        best, index = slopes.max(-1)
        farthest = torch.maximum(farthest, best.amax(1))
        place = share.expand(*best.shape, -1).gather(-1, index[..., None])[..., 0]
        half = 2 * half / (_EDGE_SAMPLES - 1)
        if i == _ROUNDS - 1 and all_seen:
            break
    _refuse(~torch.isfinite(farthest).all(-1), boxes, "have an outline that the lens sees", owner)
    edges = best.argmax(1)
    return farthest, edges, place.gather(1, edges[:, None])[:, 0]
