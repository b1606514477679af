"""A law of all front ends: whatever a sample holds comes out as by the native call, or is refused."""

import contextlib
import importlib
import itertools

import numpy as np
import pytest
import torch
from torchvision_stand_in import torchvision_of

import camtorch as ct
import camtorch.augment.numpy
from camtorch.augment import BoxCrop, Compose, HorizontalFlip, Pad, RandomCamera, RandomMount, RandomResizedCrop
from camtorch.augment.fields import IMAGES, KINDS

SIZE = 48, 64
EDITS = {
    "mirrored and padded": lambda **o: Compose([HorizontalFlip(p=1.0, landmarks=[(0, 1)]), Pad((1, 2, 3, 4))], **o),
    "a part": lambda **o: Compose([RandomResizedCrop((40, 50), scale=(0.3, 0.6)), Pad(1)], fill=9, **o),
}
AUGMENTATIONS = {
    "mount": lambda **o: RandomMount(zoom=0.2, padding_mode="border", **o),
    "filled": lambda **o: RandomMount(min_filled=0.9, p=0.7, **o),
    "a chain": lambda **o: Compose([RandomMount(), RandomCamera("dms60", image_size=(40, 50), min_filled=0)], **o),
    "a box": lambda **o: BoxCrop((40, 44), yaw=4, zoom=(0.9, 1.1), **o),
    **EDITS,
}


def camera():
    return ct.BrownConrady([65.0, 65, 31.5, 23.5], [-0.2, 0.05, 1e-3, -1e-3], image_size=SIZE).requires_grad_(False)


def sample(*batch):
    """A field of every kind, two faces among them, for all front ends; channels come last in memory as in arrays."""
    seeded = torch.Generator().manual_seed(1)

    def pixels(*shape):
        return torch.rand(*batch, *shape, 2, generator=seeded) * 30 + 8

    def rays(*shape):
        return torch.nn.functional.normalize(torch.randn(*batch, *shape, 3, generator=seeded), dim=-1)

    pose = torch.eye(4).repeat(*batch, 1, 1)
    fields = {name: rays() for name in ("gaze", "rvec", "tvec")} | {name: rays(4) for name in ("points", "directions")}
    fields |= {name: torch.rand(*batch, 1, *SIZE, generator=seeded) for name in ("depth", "distance")}
    return fields | {
        "image": torch.rand(*batch, *SIZE, 3, generator=seeded).movedim(-1, -3),
        "mask": torch.randint(9, (*batch, 1, *SIZE), generator=seeded, dtype=torch.uint8),
        "keypoints": pixels(5),
        "landmarks": pixels(2, 5),
        "polygons": pixels(2, 4),
        "boxes": torch.tensor([[9.0, 8, 41, 38]]).repeat(*batch, 1, 1),
        "boxes_xywh": torch.tensor([[9.0, 8, 32, 30]]).repeat(*batch, 1, 1),
        "boxes_cxcywh": torch.tensor([[25.0, 23, 32, 30]]).repeat(*batch, 1, 1),
        "pitch_yaw": pixels() / 100,
        "head_pose": pose,
        "pose": pose,
        "rotation": pose[..., :3, :3],
    }


def as_arrays(fields):
    fields = {n: v.movedim(-3, -1) if n in IMAGES else v for n, v in fields.items()}
    return {n: v.numpy() if isinstance(v, torch.Tensor) else v for n, v in fields.items()}


def as_tensors(out):
    out = {n: torch.as_tensor(v) for n, v in out.items() if isinstance(v, np.ndarray)}
    return {n: v.movedim(-1, -3) if n in IMAGES else v for n, v in out.items()}


def by_arrays(augment, lens, fields, _):
    return as_tensors(ct.augment.numpy.Transform(augment, lens)(**as_arrays(fields))), {}


def by_albumentations(augment, lens, fields, _):
    A = pytest.importorskip("albumentations", reason="albumentations is not installed")  # noqa: N806
    one = importlib.import_module("camtorch.augment.albumentations").Transform(augment, lens, p=1)
    arrays = as_arrays(fields)
    params = {"bbox_params": A.BboxParams("pascal_voc"), "keypoint_params": A.KeypointParams("xy", None, False)}
    out = A.Compose([one], **params)(**arrays, bboxes=arrays["boxes"] + 0.5)
    size = np.array(out["image"].shape[1::-1] * 2)
    np.testing.assert_allclose(out["bboxes"], np.clip(out["boxes"] + 0.5, 0, size), atol=1e-3)
    return as_tensors(out), {"draw": {n: torch.tensor(v, dtype=torch.float64) for n, v in one.params["draw"].items()}}


def by_torchvision(augment, lens, fields, tv):
    """A nest, of which some is known by its type and the rest by its name."""
    transform = importlib.import_module("camtorch.augment.torchvision").Transform(augment, lens, valid=True)
    target = {name: value for name, value in fields.items() if name != "image"}
    image, mask = tv.Image(fields["image"]), tv.Mask(target.pop("mask"))
    points = tv.KeyPoints(target.pop("keypoints"), canvas_size=SIZE)
    image, (moved, mask, points) = transform(image, ({"label": 3, **target}, mask, points))
    assert moved.pop("label") == 3
    assert points.canvas_size == tuple(image.shape[-2:])
    typed = {"image": image, "mask": mask, "keypoints": points}
    return {**moved, **{name: value.as_subclass(torch.Tensor) for name, value in typed.items()}}, {}


def by_kornia(augment, lens, fields, _):
    K = pytest.importorskip("kornia.augmentation")  # noqa: N806
    adapter = importlib.import_module("camtorch.augment.kornia")
    single = fields["image"].ndim == 3
    pipeline = K.AugmentationSequential(adapter.CameraAugmentation(augment, lens), data_keys=None, keepdim=single)
    corners = fields["boxes"][..., [0, 1, 2, 1, 2, 3, 0, 3]].unflatten(-1, (4, 2))
    out = pipeline({"label": 3, "image_path": [["a"], []], "bbox": corners, **fields})
    torch.testing.assert_close(out["bbox"][..., [0, 2], :].flatten(-2), out["boxes"])
    return out, {}


FRONT_ENDS = {
    "arrays": (by_arrays, None),
    "torchvision": (by_torchvision, "real"),
    "its stand-in": (by_torchvision, "stand-in"),
    "albumentations": (by_albumentations, None),
    "kornia": (by_kornia, None),
}


def both(front_end, augment, lens, fields, monkeypatch, native=None):
    """What comes of the fields by a front end, and of them or `native` by the native call with the same draw."""
    move, kind = FRONT_ENDS[front_end]
    torch.manual_seed(3)
    with torchvision_of(kind, monkeypatch) if kind else contextlib.nullcontext() as tv_tensors:
        moved, draw = move(augment, lens, fields, tv_tensors)
    torch.manual_seed(3)
    return moved, augment(native or (fields if lens is None else {**fields, "camera": lens}), **draw)


def assert_same(front_end, moved, want, names):
    for name in names:
        tolerance = 1e-5 if (front_end, name) == ("albumentations", "keypoints") else 0
        torch.testing.assert_close(moved[name], want[name], rtol=0, atol=tolerance, msg=f"{name}: {{}}".format)


CASES = [
    (front_end, name, batch)
    for front_end in FRONT_ENDS
    for name in (*AUGMENTATIONS, *(f"{name}, no camera" for name in EDITS))
    for batch in ((), (2,))
    # batches are for tensors, and kornia's wants a camera, and boxes by `with_boxes`
    if not (batch and front_end in ("arrays", "albumentations"))
    and not (front_end == "kornia" and (name == "a box" or "no camera" in name))
]


@pytest.mark.filterwarnings("ignore:.*will show nothing")
@pytest.mark.parametrize(("front_end", "name", "batch"), CASES)
def test_all_fields_move_as_by_the_native_call(front_end, name, batch, monkeypatch):
    lens = None if "no camera" in name else camera()
    clip = bool(batch) and front_end != "kornia"  # of which all frames have one draw
    augment = AUGMENTATIONS[name.split(",")[0]](same_on_batch=clip)
    fields = sample(*batch)
    assert fields.keys() == KINDS.keys() - {"K"}  # which this lens has none of
    moved, want = both(front_end, augment, lens, fields, monkeypatch)
    assert_same(front_end, moved, want, fields.keys() | {n for n in want if n.endswith("_valid") and n in moved})


@pytest.mark.filterwarnings("ignore:.*will show nothing")
@pytest.mark.parametrize("front_end", FRONT_ENDS)
@pytest.mark.parametrize(
    ("name", "key"),
    [("mount", "intrinsics"), *itertools.product(("mount", "filled", "a box", *EDITS), ("K", None))],
)
def test_a_matrix_or_a_number_stands_for_the_camera(front_end, key, name, monkeypatch):
    kornia = front_end == "kornia"
    if kornia and name == "a box":
        pytest.skip("kornia wants boxes by `with_boxes`")
    fields = sample(2) if kornia else sample()
    matrix = torch.tensor([[65.0, 0, 30], [0, 66, 24], [0, 0, 1]]).expand(*fields["pose"].shape[:-2], 3, 3)
    known = ct.Pinhole.from_matrix(matrix, image_size=SIZE) if key else ct.Pinhole.from_fov(50, image_size=SIZE)
    native = {**fields, "camera": known.requires_grad_(False)}
    fields |= {key: matrix} if key else {}
    number = 50 if kornia or not key else None
    moved, want = both(front_end, AUGMENTATIONS[name](), number, fields, monkeypatch, native)
    assert_same(front_end, moved, want, native.keys() - {"camera"})
    if key:
        new = want["camera"].intrinsics
        assert torch.equal(moved[key][..., (0, 1, 0, 1), (0, 1, 2, 2)], new.expand(*matrix.shape[:-2], 4))
        assert (moved[key] == 0).sum() == 4 * matrix[..., 0, 0].numel()


@pytest.mark.parametrize("front_end", FRONT_ENDS)
def test_numbers_of_unknown_names_are_refused(front_end, monkeypatch):
    batch = (2,) if front_end == "kornia" else ()
    fields = sample(*batch) | {"lidar": sample(*batch)["points"]}
    with pytest.raises(ValueError, match=r"'lidar' must have a kind.*fields=\{'lidar': KIND\}"):
        both(front_end, RandomMount(fields={"lid*dar": "points"}), camera(), fields, monkeypatch)  # it has more letters
    label_map = torch.ones(*batch, *SIZE, dtype=torch.uint8)
    for name, hidden in (("keypts", [[10, 20], [30, 40]]), ("eyes", [np.float32(3)] * 2), ("label_map", label_map)):
        with pytest.raises(ValueError, match=f"'{name}' must have a kind"):
            both(front_end, RandomMount(), camera(), sample(*batch) | {name: hidden}, monkeypatch)
    for key, kind in {"lidar": "keep", "li*ar": "points", "*": "keep"}.items():
        # the first pattern that matches counts, and names that are known need none
        own = {key: kind, "*dar": "gaze", "keypoints*": "keep"}
        moved, want = both(front_end, RandomMount(fields=own), camera(), fields, monkeypatch)
        assert not torch.equal(moved["keypoints"], fields["keypoints"])
        assert torch.equal(moved["lidar"], want["lidar"])
        assert torch.equal(moved["lidar"], fields["lidar"]) == (kind == "keep")


@pytest.mark.parametrize("front_end", FRONT_ENDS)
def test_fields_comes_before_what_other_transforms_return(front_end, monkeypatch):
    """`scale` is no geometry, unless `fields` says what it is."""
    batch = (2,) if front_end == "kornia" else ()
    fields = sample(*batch) | {"scale": sample(*batch)["points"]}
    for kinds, moves in (({"scale": "points"}, True), ({"scale": "keep"}, False), ({"sc*": "points"}, False)):
        moved, want = both(front_end, RandomMount(fields=kinds), camera(), fields, monkeypatch)
        assert torch.equal(moved["scale"], want["points"] if moves else fields["scale"])


@pytest.mark.slow  # for the compiler
@pytest.mark.parametrize("front_end", ["kornia", "torchvision"])
def test_front_ends_compile(front_end, monkeypatch):
    fields = {name: sample(2)[name] for name in ("image", "keypoints")}
    kornia, results = front_end == "kornia", []
    with contextlib.nullcontext() if kornia else torchvision_of("real", monkeypatch):
        module = importlib.import_module(f"camtorch.augment.{front_end}")
        if kornia:
            sequential = importlib.import_module("kornia.augmentation").AugmentationSequential
            move = sequential(module.RandomMount(camera()), data_keys=["input", "keypoints"])
        else:
            move = module.Transform(RandomMount(), camera())
        for call in (torch.compile(move, backend="eager", fullgraph=kornia), move):
            torch.manual_seed(3)
            results.append([*call(*fields.values())] if kornia else [*call(fields).values()])
    for one, other in zip(*results, strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-3)
