"""What is tried on the pretended device: every public name that computes with tensors, and calls whose costs count."""

import copy

import cameras
import torch
from pretended import tensors_of

import camtorch as ct
from camtorch import augment, losses, views
from camtorch.native.library import native_available

SIZE, LARGE = (24, 32), (240, 320)
FISHEYE = ct.KannalaBrandt.from_fov(150, image_size=SIZE, distortion=[0.02, -0.01, 0.003, -0.001]).double()
BROWN = ct.BrownConrady([30.0, 31, 15, 12], [-0.2, 0.05, 1e-3, -5e-4], image_size=SIZE).double()
BATCH = ct.Pinhole([[30.0, 31, 15, 12], [40, 39, 16, 11]], image_size=SIZE).double()
POSE = ct.Extrinsics([0.02, -0.05, 0.03], [-0.2, 0.02, 0.05]).double()
ABOVE = ct.Extrinsics([2.0, 0, 0], [0, 0.5, 1.5]).double()
PAIR = ct.Extrinsics([[0, 0, 0], [0, 0.1, 0]], [[0, 0, 0], [-0.5, 0, 0.1]]).double()
SHUTTER = ct.RollingShutter(0.03, [0.8, 2.5, 1.6]).double()


def rand(*shape, low=0.0, high=1.0):
    return low + (high - low) * torch.rand(*shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)


POINTS, PIXELS = rand(2, 5, 3, low=-1) + torch.tensor([0, 0, 2.0]), rand(2, 5, 2, low=2, high=22)
BOXES = torch.tensor([[4.0, 5, 15, 14], [10, 6, 27, 20]]).double()
IMAGES = rand(2, 3, *SIZE)
FIELDS = IMAGES, PIXELS, BOXES.expand(2, 2, 4)
SEEN = FISHEYE.project(PAIR(POINTS[:1].expand(2, 5, 3)))[0].detach() + rand(2, 5, 2)
LATTICE, DEPTH = cameras.pixel_lattice(FISHEYE, 5, 7), rand(*SIZE) + 1


def tried(function, *inputs):
    """Return a case: results without and with a graph, and their derivatives by all inputs and parameters."""

    def moved(value, device, learns):
        if isinstance(value, torch.Tensor):
            return value.to(device).clone().requires_grad_(learns and value.is_floating_point())
        return copy.deepcopy(value).to(device)

    def case(device):
        with torch.no_grad():
            plain = function(*(moved(value, device, learns=False) for value in inputs))
        given = [moved(value, device, learns=True) for value in inputs]
        leaves, results = [t for t in tensors_of(given) if t.requires_grad], function(*given)
        outputs = [t for t in tensors_of(results) if t.requires_grad and not t.is_leaf]
        # weights that no symmetry cancels
        total = sum((t * torch.arange(1, t.numel() + 1, device=device).view(t.shape).cos()).sum() for t in outputs)
        slopes = torch.autograd.grad(total, leaves, allow_unused=True) if outputs else None
        return [t.detach() for t in tensors_of((plain, results, slopes))]

    return case


def sample(size=SIZE, count=2):
    image = torch.nn.functional.interpolate(rand(count, 3, 3, 4).float(), size, mode="bilinear")
    return {
        "image": image, "keypoints": rand(count, 5, 2, low=2, high=22), "boxes": BOXES.repeat(count, 1, 1),
        "depth": rand(count, 1, *size) + 1, "mask": rand(count, *size, high=5).long(), "rvec": rand(count, 3),
        "polygons": rand(count, 2, 4, 2, low=2, high=22), "points": rand(count, 5, 3), "tvec": rand(count, 3) + 1,
        "gaze": rand(count, 3) - 0.5, "pitch_yaw": rand(count, 2) - 0.5, "label": torch.arange(count),
        "head_pose": ct.Extrinsics(rand(count, 3), rand(count, 3)).matrix().detach(),
    }  # fmt: skip


def augmented(make, fields=3, **options):
    given = {**dict(list(sample().items())[:fields]), "camera": FISHEYE}
    return tried(lambda *values: make(**options)(dict(zip(given, values, strict=True))), *given.values())


def warped(warp, images, pixels, boxes):
    labels = warp.transform_points(pixels), warp.transform_boxes(boxes), warp.transform_rays(warp.source.rays()[0])
    return warp(images), warp(images.mul(255).byte()), warp.grid(), warp.valid_mask(), labels


def moved_in_place(camera, points):
    """Return what a camera makes of points before and after its numbers, which it keeps things of, change in place."""
    camera, warp = copy.deepcopy(camera), ct.Dewarp(copy.deepcopy(camera).requires_grad_(False))
    flip, many = augment.HorizontalFlip(p=1), camera.detach().expand(2)
    with torch.no_grad():
        before = camera.project(points), warp.grid(), flip(points=points, camera=many)
        camera.intrinsics.mul_(1.1)
        warp.source.distortion[0] += 0.01
        flipped = flip(points=points, camera=many)
    return before, camera.project(points), warp.grid(), flipped


def shifted_by_a_draw(camera, pixels):
    """Return pixels moved by a draw on the CPU, of a mount that shifts by depth, for a camera anywhere."""
    numbers = dict.fromkeys(("yaw", "pitch", "roll", "shift_x", "shift_y", "shift_z"), torch.tensor([0.1]))
    draw = {
        **numbers,
        "zoom": torch.ones(1),
        "apply": torch.tensor([True]),
        "of_distance": torch.full((1, 1, *SIZE), 2.0),
    }
    return augment.RandomMount(shift=(0.1, 0.1, 0.1)).change(camera.detach(), draw).points(pixels[:1])


def drawn_there(images, pixels, camera, gate):
    """Return images and lists of pixels moved by a draw on their own device, where it may not be read."""
    turns = dict.fromkeys(("yaw", "pitch", "roll"), 4 + gate)
    draw = {**turns, "zoom": torch.ones_like(gate), "apply": gate > 0.5}
    return augment.RandomMount(p=0.5)(image=images, keypoints=list(pixels), camera=camera, draw=draw)


def counted(make, fields=1, model=ct.Pinhole):
    """Return a case of 8 large images, called a second time."""

    def case(device):
        call = make(model.from_fov(70, image_size=LARGE).requires_grad_(False).to(device))
        given = {name: value.to(device) for name, value in list(sample(LARGE, 8).items())[:fields]}
        call(**given)
        return lambda: call(**given)

    return case


CASES = {
    f"{ct.MODELS[key].__name__} {key}": tried(
        lambda c, points, pixels: (c.project(points), c.unproject(pixels)),
        *(cameras.spread(key), cameras.fan(170, 7, 5), cameras.pixel_lattice(cameras.spread(key), 5, 7)),
    )
    for key in cameras.KEYS
}
SIZED = "Resize", "RandomResizedCrop", "RandomCrop", "CenterCrop"
CASES |= {f"augment.{name}": augmented(getattr(augment, name), size=(15, 20)) for name in SIZED}
CASES |= {
    "Camera": tried(lambda c: (c.K, c.field_of_view, c.fov, c.fx, c.detach(), c.clone(), c[:1]), BATCH),
    "Camera edits": tried(lambda c: (c.crop(2, 3, 9, 9), c.pad(1, 2, 3, 4), c.rot90(), c.hflip()), BROWN),
    "Camera fields": tried(lambda c, e: (c.perspective_field([0, 1.0, 0], 4), c.plucker(e, 4), c.rays(4)), BROWN, POSE),
    "Camera lines": tried(lambda c, p: (c.project_polyline(p), c.local_pinhole(p[:, :2])), FISHEYE, POINTS[0]),
    "Camera depth": tried(lambda c, d: c.backproject(d), FISHEYE, DEPTH),
    "Camera moved in place": tried(moved_in_place, FISHEYE, POINTS),
    "Camera frozen": tried(lambda c, p: c.freeze("fx", "k2").project(p), FISHEYE, POINTS),
    "Camera from_fov": tried(lambda f: ct.EUCM.from_fov(f, image_size=SIZE, distortion=[0.5, 1]), BOXES[:, 0] + 90),
    "Camera from_matrix": tried(lambda c: ct.KannalaBrandt.from_matrix(c.K, [[0.1, 0], [0.2, 0]]), BATCH),
    "Camera convert": tried(lambda c: c[0].convert(ct.UCM), BATCH),
    "cat": tried(lambda c, k: ct.cat([c, c.replace(intrinsics=k)]), FISHEYE, FISHEYE.intrinsics.detach() + 1),
    "Mixed": tried(lambda a, b, p: ct.Mixed([a, b]).project(p), FISHEYE, BROWN, POINTS),
    "Extrinsics": tried(lambda e, p: (e(p), e.inverse(), e.compose(e), e.from_matrix(e.matrix())), POSE, POINTS),
    "Rig": tried(lambda a, b, p: [c.project(p) for c in ct.Rig({"a": a, "b": b}).values()], FISHEYE, BROWN, POINTS),
    "Warp": tried(lambda a, b, e, *w: warped(ct.Warp(a, b, e.matrix()[:3, :3]), *w), FISHEYE, BROWN, POSE, *FIELDS),
    "Dewarp": tried(lambda c, i: ct.Dewarp(c)(i), FISHEYE, IMAGES),
    "Reproject": tried(lambda a, b, e, *i: ct.Reproject(a, b, e)(*i), FISHEYE, BROWN, POSE, IMAGES, DEPTH),
    "PlaneWarp": tried(lambda c, e, *w: warped(ct.PlaneWarp(c, c, e, [0, 0.2, 1], 2.0), *w), BROWN, POSE, *FIELDS),
    "BirdsEye": tried(lambda c, e, i: ct.BirdsEye(c, e, x=(-1, 1), y=(1, 3), resolution=0.1)(i), BROWN, ABOVE, IMAGES),
    "RollingShutter": tried(ct.RollingShutter.detach, SHUTTER),
    "ShutterWarp": tried(lambda a, b, s, i: ct.ShutterWarp(a, b, shutter=s)(i), FISHEYE, BROWN, SHUTTER, IMAGES),
    "vignetting": tried(lambda c: ct.vignetting(c, 2.0), FISHEYE),
    "views.cube": tried(lambda c, i: (v := views.cube(c, 8)) and (v.valid_masks(), v.back(v(i))), FISHEYE, IMAGES),
    "views.ring": tried(lambda c, i: views.ring(c, 3, size=8)(i), FISHEYE, IMAGES),
    "views.look_at": tried(lambda c, b, i: views.look_at(c, b, (8, 8))(i), FISHEYE, BOXES, IMAGES[:1]),
    "views.crop_place": tried(lambda c, b: views.crop_place(views.look_at(c, b[None], (8, 8))), FISHEYE, BOXES),
    "rectify": tried(lambda c, e, i: ct.rectify(c, c, e).left(i), BROWN, POSE, IMAGES),
    "triangulate": tried(ct.triangulate, FISHEYE, PAIR, SEEN),
    "solve_pnp": tried(lambda c, e, p: ct.solve_pnp(c, p, c.project(e(p))[0]), FISHEYE, POSE, POINTS[0]),
    "head_angles": tried(ct.head_angles, POSE),
    "head_rotation": tried(ct.head_rotation, rand(4, 3)),
    "fit": tried(lambda *given: ct.fit("kannala_brandt", *given), LATTICE, FISHEYE.unproject(LATTICE)[0].detach()),
    "losses.angles": tried(losses.angles, POINTS, POINTS.flip(0)),
    "losses.rays": tried(losses.rays, BATCH, BROWN),
    "losses.reprojection": tried(lambda *pair: losses.reprojection(*pair, penalty=50), BATCH, BROWN),
    "CameraHead": tried(lambda h, f: h(f), ct.CameraHead(6, "kannala_brandt", image_size=SIZE).double(), rand(2, 6)),
    "CanonicalCamera": augmented(ct.CanonicalCamera, focal=30),
    "augment.FaceNormalizer": augmented(augment.FaceNormalizer, 13, image_size=(16, 16), distance=1, focal=40),
    "augment.RandomMount": augmented(augment.RandomMount, 13, min_filled=0.9),
    "augment.RandomMount shift": augmented(augment.RandomMount, 4, shift=(0.1, 0.1, 0.1)),
    "augment.RandomMount shift by a draw": tried(shifted_by_a_draw, FISHEYE, PIXELS),
    "augment.RandomLens": augmented(augment.RandomLens, 2, p=0.5, chromatic=0.02, vignetting=(0.2, 0.4)),
    "augment.RandomMount of Mixed": tried(
        lambda i, *each: augment.RandomMount()(augment.HorizontalFlip(p=1)(image=i, camera=ct.Mixed(each))),
        *(IMAGES, FISHEYE, BROWN),
    ),
    "augment.RandomMount by a draw there": tried(drawn_there, IMAGES, PIXELS, FISHEYE, torch.tensor([1.0, 0.0])),
    "augment.RandomCamera": augmented(augment.RandomCamera, 5, like="dms60", image_size=(20, 30)),
    "augment.BoxCrop": augmented(augment.BoxCrop, image_size=(16, 16), yaw=3),
    "augment.HorizontalFlip": augmented(augment.HorizontalFlip, 13),
    "augment.VerticalFlip": augmented(augment.VerticalFlip),
    "augment.Pad": augmented(augment.Pad, padding=(1, 2, 3, 4)),
    "augment.Rotate90": augmented(augment.Rotate90, step=2),
    "augment.RandomShutter": augmented(augment.RandomShutter, 2, readout=0.03, rates=(0.5, 1.0)),
    "augment.Compose": augmented(lambda: augment.Compose([augment.RandomResizedCrop(15), augment.RandomMount()]), 3),
    "augment.from_pitch_yaw": tried(augment.from_pitch_yaw, rand(4, 2)),
    "augment.to_pitch_yaw": tried(augment.to_pitch_yaw, rand(4, 3)),
    "augment.mount_rotation": tried(augment.mount_rotation, *rand(3, 4)),
    "augment.outlines": tried(augment.outlines, BOXES),
    "augment.collate": tried(lambda i: augment.collate([{"image": i[0]}, {"image": i[1]}]), IMAGES),
}
CAMERA = {"like": "dms60", "min_filled": 0}
COUNTED = {
    "project": (counted(lambda c: lambda image: c.project(image[:, :, 0].mT), 1, ct.KannalaBrandt), 136, 0, 0),
    "unproject": (counted(lambda c: lambda image: c.unproject(image[:, :2, 0].mT), 1, ct.KannalaBrandt), 348, 0, 0),
    "Dewarp, kept map": (counted(lambda c: (warp := ct.Dewarp(c)) and (lambda image: warp(image))), 1, 0, 0),
    "RandomMount": (counted(lambda c: augment.RandomMount(camera=c)), 23, 0, 2),
    "RandomLens": (counted(lambda c: augment.RandomLens(camera=c)), 24, 0, 2),
    "RandomCamera": (counted(lambda c: augment.RandomCamera(camera=c, **CAMERA)), 29, 0, 2),
    "RandomCamera, labels": (counted(lambda c: augment.RandomCamera(camera=c, **CAMERA), 3), 684, 0, 5),
    "min_filled, labels": (counted(lambda c: augment.RandomMount(camera=c, min_filled=0.9), 3), 491, 0, 4),
    "HorizontalFlip": (counted(lambda c: augment.HorizontalFlip(camera=c)), 20, 0, 3),
    "Resize": (counted(lambda c: augment.Resize((120, 160), camera=c)), 7, 0, 2),
    "RandomResizedCrop": (counted(lambda c: augment.RandomResizedCrop(120, camera=c)), 41, 0, 4),
}
CASES |= {f"counted: {name}": row[0] for name, row in COUNTED.items()}
ROOM = 1.1  # one launch more does no harm, and a loop over samples makes many; waits and copies have no room
BOUNDS = {f"counted: {name}": (int(ROOM * row[1]) + 1, *row[2:]) for name, row in COUNTED.items() if native_available()}
