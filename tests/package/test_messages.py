"""What wrong calls are told: who says it, what was passed and what is expected; of errors that no other test has."""

import math
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
import torch
from kornia.image import ImageSize
from kornia.sensors.camera import Orthographic, PinholeModel

import camtorch as ct
from camtorch.augment import numpy as arrays

SIZE = (24, 32)
CAMERA = ct.KannalaBrandt([20.0, 20.0, 15.5, 11.5], [0.02, -0.01, 0.0, 0.0], image_size=SIZE).requires_grad_(False)
BATCH = ct.Pinhole(torch.tensor([[20.0, 20.0, 15.5, 11.5]] * 2), image_size=SIZE).requires_grad_(False)
GRID = ct.Pinhole(torch.tensor([[[20.0, 20.0, 15.5, 11.5]] * 2] * 2), image_size=SIZE).requires_grad_(False)
MIXED = ct.Mixed([CAMERA, BATCH[0]])
POSE = ct.Extrinsics([0.0, 0.0, 0.0], [-0.1, 0.0, 0.0]).requires_grad_(False)
DOWN = ct.Extrinsics.from_matrix(np.diag([1.0, -1.0, -1.0]), [0.0, 0.0, 2.0])
ONE = ct.Rig({"a": CAMERA}, {"a": POSE})
WARP = ct.Warp(CAMERA, BATCH[0])
MOUNT = ct.augment.RandomMount(camera=CAMERA)
PAIR = ct.rectify(BATCH[0], BATCH[0], POSE, fov=57.3, image_size=SIZE)
PIXELS, RAYS = CAMERA.pixel_grid(), CAMERA.rays()[0]
IMAGES = torch.zeros(2, 3, *SIZE)
LEAF, EYE, HOLED = torch.ones((), requires_grad=True), np.eye(3), np.where(np.arange(160) == 7, math.nan, 0.0)
DEEP, THREE = ct.Reproject(CAMERA, CAMERA, POSE), ct.RollingShutter(0.03, torch.zeros(3, 3))
KORNIAS, MASKED = PinholeModel(ImageSize(*SIZE), torch.ones(4)), np.ma.masked_array(np.ones((2, 3)))
NORMAL, SMALL, BOARDS = [0.1, 0.3, 1.0], CAMERA.resize(12, 16), ct.Extrinsics(torch.zeros(2, 3), torch.zeros(2, 3))
CANONICAL, DEPTHS = (ct.CanonicalCamera(50.0, scales=scales, camera=CAMERA) for scales in ("image", "depth"))
TWO = BATCH.replace(intrinsics=BATCH.intrinsics * torch.tensor([[1.0], [2.0]]))
augment, at = ct.augment, ct.Extrinsics
BOX_CROP = augment.BoxCrop((8, 8), camera=CAMERA)
FORWARD = [model([200.0, 200, 319.5, 239.5], image_size=(480, 640)) for model in (ct.Pinhole, ct.KannalaBrandt)]
FORWARD += [at([-0.011, -0.008, 0.01], [3e-5, -2.5e-5, 1.0])]


WRONG = [
    # what is no tensor, or not such a one
    (lambda: ct.Camera(np.eye(3), np.zeros(4)), TypeError, r"Camera: the class must be .*from_matrix\(K"),
    (lambda: ct.Camera([20.0, 20.0, 15.5, 11.5]), TypeError, r"Use ct.KannalaBrandt\(intrinsics, distortion\)"),
    (lambda: ct.Pinhole(300, 300, 320, 240), TypeError, r"as lists.*: ct.Pinhole\(\[fx, fy, cx, cy\], image_size="),
    (lambda: ct.Pinhole(fx=300, fy=300, cx=320, cy=240), TypeError, r"argument 'fx'. Pass numbers as lists"),
    (lambda: ct.KannalaBrandt(300, 300, 320, 240, [0.1]), TypeError, r"Pass numbers as lists.* matrix by .*from_ma"),
    (lambda: ct.KannalaBrandt([3.0, 3, 1, 1], SIZE[:1], SIZE), TypeError, r"the size by name: .*image_size=\(height"),
    (lambda: ct.KannalaBrandt([300, 300, 320, 240], (480, 640)), ValueError, r"not be an image size; got \[480.0"),
    (lambda: ct.KannalaBrandt([300, 300, 320, 240], [480, 640]), ValueError, r"an image size; .* image_size=\(height"),
    (lambda: ct.Pinhole(torch.eye(4)), ValueError, r"focal lengths .* matrices \(4, 4\) use Pinhole.from_matrix\(K"),
    (lambda: ct.Pinhole.from_matrix(torch.ones(4, 4)), ValueError, r"shape \(4, 4\)\. For larger ones use K\[..., :3"),
    (lambda: ct.from_kornia(CAMERA), TypeError, r"must be a PinholeCamera or a camera of kornia.*; got Kann"),
    (lambda: ct.from_kornia(Orthographic(ImageSize(*SIZE), torch.ones(4))), ValueError, r"one point; got Orthographic"),
    (lambda: ct.from_kornia(PinholeModel(ImageSize(4, 4.5), torch.ones(4))), ValueError, r"widths \[4.5\]. Pass one"),
    (lambda: ct.Pinhole([9.0] * 4).to_kornia(), ValueError, r"Pinhole.to_kornia: camera must have an image_size;"),
    (lambda: CAMERA.convert("fisheye62").camera.to_kornia(), ValueError, r"8 of 'fisheye62'. Write camera.convert"),
    (lambda: GRID.to_kornia(), ValueError, r"must have one batch dim or none; got \(2, 2\)"),
    (lambda: CAMERA.to_kornia(POSE), ValueError, r"must be None or the identity for kornia's KannalaBrandtK3"),
    (lambda: ct.Pinhole(KORNIAS), TypeError, r"got PinholeModel; ct.from_kornia\(theirs\) makes a camera"),
    (lambda: ct.Warp(CAMERA, KORNIAS), TypeError, r"target .* got PinholeModel; ct.from_kornia\(theirs\) makes"),
    (lambda: ct.Extrinsics([0.0, 0, 0, 1], [0.0, 0, 0]), ValueError, r"got shape \(4,\)\. For quaternions.*from_quat"),
    (lambda: ct.Pinhole([9.0] * 4, image_size=EYE), TypeError, r"\(height, width\); got ndarray of shape \(3, 3\)"),
    (lambda: ct.Extrinsics(0, 0, 1), TypeError, r"It takes ct.Extrinsics\(\[rx, ry, rz\], \[tx, ty, tz\]\)"),
    (lambda: CAMERA.resize((12, 16)), TypeError, r"It takes camera.resize\(height, width\), two numbers"),
    (lambda: ct.Splined(np.ones(4), HOLED), ValueError, r"1 of 160 that are not, first distortion\[7\] = nan$"),
    (lambda: ct.Camera.from_fov(90, image_size=SIZE), TypeError, r"ct.MODELS has all models"),
    (lambda: BOX_CROP(image=IMAGES[0], boxes=[[3.0, 4, 9, 9]]), TypeError, r"as torch.tensor\(numbers\); a list has a"),
    (lambda: MOUNT(image=IMAGES[0], keypoint=torch.ones(3, 2)), ValueError, r"real numbers.* Did you mean 'keypoints'"),
    (lambda: MOUNT(image=IMAGES[0], rvec=torch.ones(3, 1)), ValueError, r"OpenCV's column goes in as rvec\[..., 0\]"),
    (lambda: MOUNT(image=IMAGES, gaze=torch.ones(2, 3, 1)), ValueError, r"column goes in as gaze\[..., 0\]"),
    (lambda: MOUNT(image=IMAGES[0], head_pose=torch.eye(3)), ValueError, r"pad\(R, \(0, 1\)\), with zeros for the"),
    (lambda: MOUNT(image=IMAGES[0], pose=torch.zeros(3)), ValueError, r"R = ct.head_rotation\(angles\), of pitch"),
    (lambda: MOUNT(image=IMAGES[0], boxes=torch.ones(4)), ValueError, r"goes in as boxes\[..., None, :\]"),
    (lambda: MOUNT(image=IMAGES, keypoints=MASKED[..., :2]), TypeError, r"keypoints .* got a MaskedArray: its mask"),
    (lambda: MOUNT(image=IMAGES[0], bbox=torch.tensor([[3, 4, 9, 9]])), ValueError, r"'bbox' .* Did you mean 'boxes'"),
    (lambda: MOUNT(image=IMAGES[0], seg=torch.ones(SIZE, dtype=torch.uint8)), ValueError, r"Did you mean 'mask'\?"),
    (lambda: MOUNT(image=IMAGES, parts=torch.ones(2, 5, 2).int()), ValueError, r"'parts' .*move with the camera"),
    (lambda: ct.Pinhole([LEAF] * 4), TypeError, r"Pinhole: intrinsics must be a tensor; got a list of ten"),
    (lambda: CAMERA.project([LEAF] * 3), TypeError, r"points must .*tensors that require grad. torch.stack"),
    (lambda: CAMERA.project(torch.ones(5, 3).to_sparse()), TypeError, r"points must be a dense tensor; got"),
    (lambda: CAMERA.project(np.ones((3, 7))), ValueError, r"shape \(3, 7\)\. Pass points in columns as points\.T"),
    (lambda: ct.Warp(np.eye(3), CAMERA), TypeError, r"got ndarray \(3, 3\); ct\.BrownConrady\.from_matrix\(K, "),
    (lambda: CAMERA.project(MASKED), TypeError, r"MaskedArray: its mask would be lost. Pass array.filled\(value\)"),
    (lambda: CAMERA.contains(torch.ones(3)), ValueError, r"pixels must be \(..., 2\); got shape \(3,\)"),
    (lambda: WARP.strips(IMAGES, rows=2.5), TypeError, r"Warp: rows must be a whole number; got 2.5"),
    (lambda: POSE.compose(np.eye(4)), TypeError, r"Extrinsics: other must be Extrinsics; got ndarray"),
    (lambda: augment.from_pitch_yaw("up"), TypeError, r"from_pitch_yaw: angles must be a tensor; got str"),
    (lambda: augment.mount_rotation(None, 0, 0), TypeError, r"mount_rotation: yaw must be a tensor; got NoneType"),
    (lambda: augment.mount_rotation([1, 2], [1, 2, 3], 0), ValueError, r"to one shape .*yaw \(2,\), pitch \(3,\)"),
    (lambda: augment.RandomMount(camera=CAMERA)(image=np.array(["a"])), TypeError, r"image must be a tensor of real"),
    # what is no number, flag, word, mapping
    (lambda: ct.Warp(CAMERA, CAMERA, antialias="False"), TypeError, r"Warp: antialias must be True or False; got"),
    (lambda: ct.Warp(CAMERA, CAMERA, tolerance="0"), TypeError, r"Warp: tolerance must be a number; got '0'"),
    (lambda: ct.Warp(CAMERA, CAMERA, fill="0"), TypeError, r"fill must be a number or one for each channel; got '0'"),
    (lambda: ct.Warp(CAMERA, CAMERA, mode=np.zeros((2, 2))), ValueError, r"mode must be one of .*ndarray of shape"),
    (lambda: CAMERA.convert("mei", max_angle="90"), TypeError, r"convert: max_angle must be a number; got '90'"),
    (lambda: ct.KannalaBrandt.from_matrix(np.eye(3), ignore_skew="no"), TypeError, r"ignore_skew must be True or"),
    (lambda: BATCH["a"], TypeError, r"Pinhole: index must be whole numbers, slices or masks; got 'a'"),
    (lambda: MIXED["a"], TypeError, r"Mixed: index must be whole numbers, slices or masks; got 'a'"),
    (lambda: ct.Mixed([CAMERA], order="first"), TypeError, r"Mixed: order must be places among 1 cameras.*'first'"),
    (lambda: ct.Mixed.of_groups([CAMERA]), TypeError, r"Mixed: groups must be pairs \(rows, cameras\)"),
    (lambda: MIXED.by_groups("mei"), TypeError, r"Mixed: change must be a function of a camera.*got 'mei'"),
    (lambda: ct.Rig(CAMERA), TypeError, r"Rig: cameras must be a dict, as \{'left': Camera\}; got KannalaBrandt"),
    (lambda: ct.Rig({"a": CAMERA}, POSE), TypeError, r"Rig: extrinsics must be a dict, as \{'left': Extrinsics\}"),
    (lambda: ct.Rig({"a": CAMERA}, (1, 2)), TypeError, r"Rig: extrinsics must be a dict, or \(names, a batch\)"),
    (lambda: ONE.cameras["b"], KeyError, r"name of Camera must be one of 'a'; got 'b'"),
    # warps
    (lambda: ct.Warp(CAMERA, "target"), TypeError, r"Warp: target must be a Camera"),
    (lambda: ct.Warp(ct.Pinhole([1.0, 1, 0, 0]), CAMERA), ValueError, r"an image_size; got None. Pass camera.rep"),
    (lambda: ct.Warp(CAMERA, CAMERA, 2 * torch.eye(3)), ValueError, r"rotation must hold rotation matrices"),
    (lambda: ct.ShutterWarp(CAMERA, CAMERA, shutter=0.03), TypeError, r"shutter must be a RollingShutter; got float"),
    (lambda: ct.ShutterWarp(BATCH, BATCH, shutter=THREE), ValueError, r"together; got cameras \(2, 1\) and shut"),
    (lambda: ct.Warp(CAMERA, CAMERA, fill=(1, 2))(IMAGES), ValueError, r"fill must have 1 value or 3, .* got 2"),
    (lambda: ct.Warp(CAMERA, BATCH)(IMAGES[:1].expand(3, -1, -1, -1)), ValueError, r"images must be 1 or 2, .* got 3"),
    (lambda: WARP(IMAGES.mT), ValueError, r"\(24, 32\).*\(32, 24\)"),
    (lambda: WARP(MASKED), TypeError, r"Warp: images must be an array without a mask; got a MaskedArray: its mask"),
    (lambda: WARP(["image"]), TypeError, r"must be a tensor .*, an array .* or a PIL image; got list.*np\.stack"),
    (lambda: WARP(IMAGES[0].numpy()), ValueError, r"got shape \(3, 24, 32\)\. .*np.moveaxis\(images, -3, -1\)"),
    (lambda: WARP(IMAGES[:, 0].numpy()), ValueError, r"\(2, 24, 32\)\. .* images\[..., None\] adds one"),
    (lambda: ct.Warp(CAMERA, BATCH)(IMAGES[:, 0]), ValueError, r"2 cameras.*\(2, 24, 32\).*masks\[:, None\]"),
    (lambda: WARP(IMAGES[0].movedim(0, -1)), ValueError, r"\(24, 32, 3\), with the channels last.*movedim\(-1, -3\)"),
    (lambda: WARP(PIL.Image.new("P", SIZE[::-1])), ValueError, r"'P'\. Labels .* mode='nearest'.*; image.convert"),
    (lambda: WARP(IMAGES.long()), ValueError, r"Warp: .*; got torch.int64\. .* mode='nearest', .* images.float\(\)"),
    (lambda: WARP(IMAGES[0, 0].short().numpy()), ValueError, r"torch.int16\. .* or .astype\('float32'\)"),
    (lambda: DEEP(IMAGES.int(), torch.ones(1, 1, *SIZE)), ValueError, r"Reproject: .*; got torch.int32"),
    (lambda: MOUNT(image=IMAGES.long()), ValueError, r"RandomMount: image must .*; got torch.int64\. .*'nearest'"),
    (lambda: augment.Pad(1)(image_b=IMAGES[0].int()), ValueError, r"Pad: image_b must be .*; got torch.int32"),
    (lambda: WARP(IMAGES + 0j), TypeError, r"complex64"),
    (lambda: ct.Dewarp(CAMERA, projection="fisheye"), ValueError, r"one of .*'perspective'.*got 'fisheye'"),
    (lambda: ct.Dewarp(CAMERA, fov=180), ValueError, r"fov must be in degrees, above 0 and below 180 for perspective"),
    (lambda: ct.Dewarp(CAMERA, fov=math.nan), ValueError, r"fov"),
    (lambda: ct.Dewarp(CAMERA, image_size=(480.0, 640)), TypeError, r"image_size must be"),
    (lambda: ct.RollingShutter(33.0, [0, 0, 0]), ValueError, r"readout must be below 2 seconds; got 33.0"),
    (lambda: ct.RollingShutter(0.03, [1, math.nan, 2]), ValueError, r"rates must be finite"),
    (lambda: ct.RollingShutter(0.03, [0, 90.0, 0]), ValueError, r"rates must be below 70 radians"),
    (lambda: ct.RollingShutter([0.03, 0.02], [[0, 0, 0]] * 3), ValueError, r"batch dims must fit together"),
    # views, stereo, planes
    (lambda: ct.views.ring(CAMERA, 3, fov=200), ValueError, r"ring: fov must be in degrees, above 0 and below 180;"),
    (lambda: ct.views.cube(BATCH), ValueError, r"cube: camera must be a single camera; got batch_shape=\(2,\)"),
    (lambda: ct.views.cube(CAMERA, 0), ValueError, r"cube: size must be at least 1; got 0"),
    (lambda: ct.BirdsEye(CAMERA, DOWN, x=3, y=(0, 1), resolution=1), ValueError, r"BirdsEye: x must be \(from, to\)"),
    (lambda: ct.BirdsEye(CAMERA, DOWN, x=(0, 1), y=(0, 1), resolution=9), ValueError, r"at 9.0 units per pixel"),
    (lambda: ct.Reproject(GRID, CAMERA, POSE), ValueError, r"Reproject: .*extrinsics must have one batch dim"),
    (lambda: ct.rectify(GRID, GRID, POSE), ValueError, r"rectify: .*extrinsics must have one batch dim"),
    (lambda: ct.rectify(CAMERA, CAMERA, POSE, fov=(60, 60, 60)), ValueError, r"fov must be horizontal, or .*\(60, 60,"),
    (lambda: ct.rectify(CAMERA, CAMERA, POSE, vertical="no"), TypeError, r"vertical must be True or False; got 'no'"),
    (lambda: PAIR.disparity_to_points(torch.ones(SIZE), [True]), ValueError, r"valid must have the shape of disparity"),
    (lambda: ct.PlaneWarp(CAMERA, CAMERA, POSE, (0, 0, 1.0), 0.0), ValueError, r"normal must not be zero, nor dist"),
    (lambda: ct.PlaneWarp(CAMERA, CAMERA, DOWN, (0, 0, 1.0), 1.0), ValueError, r"must be on the same side"),
    (lambda: ct.PlaneWarp(CAMERA, CAMERA, POSE, (0.0, 1), 1.0), ValueError, r"normal must be \(3,\) or \(B, 3\)"),
    (lambda: ct.PlaneWarp(CAMERA, CAMERA, np.eye(4), NORMAL, 1), TypeError, r"must be Extrinsics, source from target"),
    (lambda: ct.BirdsEye(CAMERA, POSE, x=(0, 1), y=(0, 1), resolution=0.1), ValueError, r"must be above the ground"),
    (lambda: ct.BirdsEye(CAMERA, DOWN, x=(1, -1), y=(0, 1), resolution=0.1), ValueError, r"\(from, to\), ascending"),
    (lambda: ct.BirdsEye(CAMERA, DOWN, x=(0, 1), y=(0, 1), resolution=0.0), ValueError, r"resolution must be positive"),
    (lambda: ct.views.ring(CAMERA, 0), ValueError, r"ring: count must be at least 1; got 0"),
    (lambda: DEEP(IMAGES, torch.ones(1, 1, *SIZE), "depth"), ValueError, r"kind must be \"z\""),
    (lambda: DEEP(IMAGES, torch.ones(1, 1, 3, 4)), ValueError, r"depth must be .*image_size \(24, 32\)"),
    (lambda: DEEP(IMAGES, torch.ones(3, 1, *SIZE)), ValueError, r"batch sizes must be 1 or equal; got .*'depth': 3"),
    (lambda: ct.Reproject(CAMERA, CAMERA, np.eye(4)), TypeError, r"must be Extrinsics, source from target"),
    (lambda: CAMERA.backproject(np.zeros(SIZE, np.uint16)), ValueError, r"/ 1000 for millimetres"),
    (lambda: CAMERA.backproject(torch.ones(2, *SIZE)), ValueError, r"depth\[:, None\]"),
    (lambda: ct.rectify(CAMERA, CAMERA, (np.eye(3), NORMAL)), TypeError, r"Extrinsics, right from left.*from_matrix"),
    (lambda: ct.rectify(CAMERA, CAMERA, at([0, 0.1, 0], [0, 0, 0])), ValueError, r"translation must not be zero; got"),
    (lambda: ct.rectify(CAMERA, CAMERA, at([0, 0, 0], [0, 0, 1])), ValueError, r"one side of their baseline; got"),
    (lambda: ct.rectify(*FORWARD, vertical=True, align="opencv"), ValueError, r"large; got \(\d+, \d+\)\. Pass \(h"),
    (lambda: ct.rectify(CAMERA, CAMERA, at([0, math.pi, 0], [-1, 0, 0])), ValueError, r"away from each other"),
    (lambda: ct.rectify(CAMERA, CAMERA, POSE, fov=(90, 190)), ValueError, r"below 180 for perspective; got 190"),
    (lambda: ct.rectify(ct.Pinhole([1.0, 1, 0, 0]), CAMERA, POSE), ValueError, r"left must have an image_size"),
    (lambda: PAIR.disparity_to_points(np.zeros(SIZE, np.int16)), ValueError, r"floating point pixels; .* / 16"),
    (lambda: PAIR.disparity_to_points(torch.zeros(64, 48)), ValueError, r"disparity must be"),
    # augmentations
    (lambda: augment.RandomMount(zoom=1.0), ValueError, r"zoom must lie within .*got 1.0, which stands for \(0, 2\)"),
    (lambda: augment.RandomMount(10), TypeError, r"were given\. By name: RandomMount\(yaw=..., pitch=..., roll"),
    (lambda: augment.Resize(12, 16), TypeError, r"were given\. By name: Resize\(size=...\)"),
    (lambda: arrays.Transform(MOUNT, np.eye(3)), TypeError, r"numpy.Transform: camera must be a Camera; got ndarray"),
    (lambda: augment.RandomMount(fov=(20, 30), camera=CAMERA).draw("2"), TypeError, r".* got '2'|fov"),
    (lambda: augment.RandomMount().draw(2, 7), TypeError, r"generator must be a torch.Generator, or None; got 7"),
    (lambda: augment.Rotate90((3, 1)), ValueError, r"Rotate90: times must be quarter turns, one number or \(least, m"),
    (lambda: augment.FaceNormalizer(axis=3), TypeError, r"FaceNormalizer: axis must be a pixel \(u, v\); got 3"),
    (lambda: MOUNT(boxes_xywh=torch.tensor([[9.0, 5, -1, 2]])), ValueError, r"boxes_xywh .* width, .*; got \[9.0, 5"),
    (lambda: MOUNT(bbox_xywh=torch.ones(1, 4)), ValueError, r"'bbox_xywh' must have a kind.*Did you mean 'boxes_xywh'"),
    (lambda: augment.collate([]), ValueError, r"collate: samples must not be empty"),
    # networks, data, calibration
    (lambda: ct.CameraHead(0, "mei", image_size=SIZE), ValueError, r"CameraHead: features must be at least 1; got 0"),
    (lambda: ct.data.to_columns(ct.Pinhole([1, 1, 0, 0])), ValueError, r"must have an image_size .*got image_size"),
    (lambda: ct.data.from_columns({}), ValueError, r"from_columns: .*must hold camera_model, .*got none"),
    (lambda: ct.data.MapBatches(WARP, key=7), TypeError, r"MapBatches: key must be the name of a column.*got 7"),
    (lambda: ct.data.MapBatches(ct.Warp(BATCH, BATCH)), ValueError, r"the warp must be a single one; got batch dims"),
    (lambda: ct.data.MapSamples(WARP, key=[]), TypeError, r"MapSamples: key must name an entry of a sample; got \[\]"),
    (lambda: ct.fit("mei", PIXELS, RAYS, weights=torch.ones(3)), ValueError, r"weights must broadcast against the"),
    (lambda: ct.fit("mei", PIXELS, RAYS, weights=-torch.ones(SIZE)), ValueError, r"weights must be .*got down to -1"),
    (lambda: ct.losses.rays(CAMERA, torch.zeros(3)), TypeError, r"target must be a Camera; got Tensor"),
    (lambda: ct.losses.rays(CAMERA, SMALL), ValueError, r"same for both cameras; got \(12, 16\) and \(24, 32\)"),
    (lambda: ct.losses.rays(BATCH, CAMERA.expand(3)), ValueError, r"must broadcast; got \(2,\) and \(3,\)"),
    (lambda: ct.losses.reprojection(BATCH, torch.zeros(2, 5, 2)), ValueError, r"points must be given if target"),
    (lambda: ct.losses.reprojection(CAMERA, CAMERA, penalty=0), ValueError, r"penalty must be a positive number of"),
    (lambda: CAMERA.parameter_groups(), ValueError, r"camera must learn; got a fixed one. Call camera.requires_grad_"),
    (lambda: ct.Pinhole(LEAF.expand(4)).parameter_groups(), TypeError, r"intrinsics must be a Parameter"),
    (lambda: ct.UCM([1, 1, 0, 0]).parameter_groups(), ValueError, r"image_size must be .* effect of its coefficients"),
    (lambda: ct.losses.rays(BATCH, CAMERA, reduction="sum"), ValueError, r'"mean" or "none"'),
    (lambda: ct.losses.rays(BATCH, CAMERA, samples=0), ValueError, r"rows and columns"),
    (lambda: ct.losses.rays(BATCH, CAMERA, weights=torch.ones(7)), ValueError, r"weights must broadcast"),
    (lambda: ct.CanonicalCamera(0.0), ValueError, r"focal must be positive"),
    (lambda: ct.CanonicalCamera(50.0, scales="labels"), ValueError, r"\"depth\" or \"image\"; got 'labels'"),
    (lambda: ct.CanonicalCamera(50.0, image_size=(4, 4)), ValueError, r"image_size must be None with scales="),
    (lambda: DEPTHS(depth=torch.ones(SIZE).short()), ValueError, r"floating point"),
    (lambda: CANONICAL.inverse(depth=torch.ones(SIZE)), ValueError, r"source_camera must be in the sample"),
    (lambda: CANONICAL(image=IMAGES, camera=TWO), ValueError, r"image_size="),
    # models, files, maps
    (lambda: ct.Rig({"a": CAMERA}, (["a"], BOARDS)), ValueError, r"for each row of \(2,\); got 1"),
    (lambda: ct.Rig({"a": CAMERA}, (["a", "a"], BOARDS)), ValueError, r"must be unique; got 'a' twice"),
    (lambda: ct.Rig({"a": CAMERA}, (["b"], BOARDS[:1])), ValueError, r"that of a camera or an image.*'b'"),
    (lambda: ct.Rig({"a": CAMERA}, ([1], BOARDS[:1])), TypeError, r"strings; got 1"),
    (lambda: ct.Rig({"a": CAMERA}, (["a"], None)), TypeError, r"got NoneType"),
    (lambda: ct.Rig({"a": CAMERA}, {"a": CAMERA}), TypeError, r"Extrinsics; got 'a': KannalaBrandt"),
    (lambda: ct.WoodScape.from_woodscape([20, 0, 0, 0], image_size=None), ValueError, r"image_size must be \(height"),
    (lambda: ct.WoodScape.from_woodscape([20, 0, 0, 0], 3, image_size=SIZE), ValueError, r"offset must be \(2,\) ="),
    (lambda: ct.io.opencv.read(None), TypeError, r"io.opencv.read: path must name a file; got None"),
    # the order of OpenCV's arguments
    (lambda: ct.solve_pnp(EYE, EYE[:2], EYE, EYE[0]), TypeError, r"A camera comes first: ct.solve_pnp\(ct.Brown.*from"),
    (lambda: ct.calibrate([EYE], [EYE], SIZE, None, None), TypeError, r"A model comes first: .*image_size=\(heig"),
    (lambda: ct.triangulate(np.eye(3), np.eye(3), 1, 2), TypeError, r"were given\. It takes lists: ct.triangulate\("),
    (lambda: ct.rectify(*[EYE] * 4, SIZE, EYE, EYE), TypeError, r"OpenCV's .* ct.rectify\(left, right, ct.Ext"),
    (lambda: ct.Dewarp(np.eye(3), np.zeros(4)), TypeError, r"were given\. It takes a camera, as .*from_matrix\(K, D"),
    (lambda: ct.views.cube(CAMERA, image_size=9), TypeError, r"Did you mean 'size'\? It takes cube\(camera, size\)"),
    (lambda: ct.views.ring(CAMERA, 3, image_size=9), TypeError, r"Did you mean 'size'\? It takes ring\(camera"),
    (lambda: ct.views.look_at(CAMERA, EYE, size=SIZE), TypeError, r"mean 'image_size'\? It takes look_at\(camera"),
    (lambda: ct.fit("mei", PIXELS, RAYS, size=SIZE), TypeError, r"mean 'image_size'\? It takes fit\(model, pix"),
    (lambda: augment.BoxCrop(size=SIZE), TypeError, r"BoxCrop: unknown keyword 'size'; did you mean 'image_size'\?"),
    (
        lambda: ct.Dewarp(CAMERA, size=SIZE),
        TypeError,
        r"^Dewarp.__init__\(\) got .* argument 'size'\. Did you mean 'image_size'\? It takes",
    ),
    (lambda: ct.Dewarp(CAMERA, balance=0.5), TypeError, r"argument 'balance'\. It takes .* fov is how much it"),
    (lambda: ct.Pinhole.from_matrix(np.eye(3), None, SIZE), TypeError, r"given\. It takes from_matrix\(K, dist"),
    (lambda: ct.Pinhole.from_fov(90), TypeError, r"'image_size'\. It takes from_fov\(degrees, image_size="),
    (lambda: ct.Extrinsics(np.eye(4)), TypeError, r"translation must be given; got .*Extrinsics.from_matrix\(T"),
    (lambda: augment.from_pitch_yaw(torch.tensor([10.0, 20.0])), ValueError, r"radians; got 20, which seems"),
    (lambda: CAMERA.crop(24, 0, 8, 8), ValueError, r"crop: .* hold a pixel of .*24, 32\); got \(24, 0, 8, 8\)"),
    (lambda: CAMERA.crop(0, -8, 8, 8), ValueError, r"crop: .* must hold a pixel"),
]


@pytest.mark.parametrize(("call", "error", "says"), WRONG, ids=[says[:40] for _, _, says in WRONG])
def test_wrong_calls_are_told_in_words(call, error, says):
    with pytest.raises(error, match=says):
        call()


@pytest.mark.parametrize(("name", "columns"), [("boxes", 4), ("keypoints", 2), ("landmarks", 2)])
def test_labels_that_are_parts_of_an_image_are_warned_of(name, columns):
    parts = torch.tensor([[0.1, 0.2, 0.5, 0.6], [0.0, 0.5, 1.0, 1.0]])[:, :columns]
    with pytest.warns(UserWarning, match=rf"RandomMount: {name} must be pixels.* \[0, 1\], as parts of an image's"):
        MOUNT(image=IMAGES[0], **{name: parts})
    for labels in (20 * parts, parts.round(), torch.zeros(2, columns), torch.full((2, columns), math.nan)):
        MOUNT(image=IMAGES[0], **{name: labels})
    lost = 20 * parts
    lost[1] = -1.0
    MOUNT(image=IMAGES[0], **{name: lost, f"{name}_valid": torch.tensor([True, False])})
    if columns == 2:
        with pytest.warns(UserWarning, match=rf"RandomMount: {name} has .*\(-1, -1\).*pass NaN, or {name}_valid"):
            ct.augment.RandomMount(camera=CAMERA)(image=IMAGES[0], **{name: lost})


def test_a_size_with_height_and_width_exchanged_is_warned_of():
    with pytest.warns(UserWarning, match=r"resize: .*\(height, width\).* to \(64, 48\).* as \(48, 64\)\. .*rot90"):
        CAMERA.resize(64, 48)
    CAMERA.resize(32, 32)  # of another shape, as networks want it


# -- warnings show the line that called the package, however deep they come from


def unusable():
    camera = ct.Pinhole([300.0, 300.0, 319.5, 239.5], image_size=(480, 640))
    with torch.no_grad():
        camera.intrinsics[0] = -3.0
    return camera


NARROW = ct.Pinhole([2000.0, 2000.0, 319.5, 239.5], image_size=(480, 640))
CALLS = {
    "taken as .height, width.": lambda: ct.Pinhole([300.0, 300.0, 319.5, 239.5], image_size=(640, 480)),
    "seem to be": lambda: ct.Pinhole([600.0, 320.0, 600.0, 240.0], image_size=(480, 640)),
    "fov=170 leaves 2 of 32 columns for the middle 60 degrees": lambda: ct.Dewarp(CAMERA, fov=170),
    "is warped to .640, 480.": lambda: ct.Dewarp(NARROW, image_size=(640, 480)),
    "this one's stays .32, 32.": lambda: ct.Pinhole([1.0] * 4, image_size=(32, 32)).load_state_dict(
        NARROW.state_dict()
    ),
    "yaw is in degrees, and 0.3 seems": lambda: ct.augment.RandomMount(yaw=0.3),
    "rates is in degrees per second, and 0.3 seems": lambda: ct.augment.RandomShutter(0.01, rates=0.3),
    "as .width, height., but .* middle of .640, 480.": lambda: ct.loads(
        {"K": NARROW.K.tolist(), "image_size": [480, 640]}
    ),
    "is stretched to": lambda: NARROW.resize(640, 480),
    "will show nothing": lambda: ct.augment.RandomCamera(fov=(120, 130), camera=NARROW)(image=torch.zeros(1, 480, 640)),
    "became unusable": lambda: unusable().project(torch.tensor([0.0, 0.0, 1.0])),
}


@pytest.mark.parametrize("says", CALLS)
def test_warnings_show_the_callers_line(says):
    with pytest.warns(UserWarning, match=says) as caught:
        CALLS[says]()
    assert {warning.filename for warning in caught} == {__file__}


def test_there_is_one_way_to_warn():
    folder = Path(ct.__file__).parent
    files = [path for path in folder.rglob("*.py") if "warnings.warn(" in path.read_text()]
    assert {path.relative_to(folder).as_posix() for path in files} == {"values/arguments.py"}
