"""Several faces in a sample move as each does alone; the frames of clips as those of a batch of one draw a clip."""

from itertools import product

import pytest
import torch
from cameras import slow_unless

import camtorch as ct
from camtorch import augment as A  # noqa: N812

SIZE, PAIRS, B, T = (30, 40), [(0, 1), (3, 4)], 2, 3
BOX = torch.tensor([3.0, 3, 20, 24])


def camera(*batch):
    numbers = torch.tensor([30.0, 30, 19.5, 14.5]).expand(*batch, 4) + torch.rand(*batch, 1)
    return ct.BrownConrady(numbers, [-0.1, 0.02, 1e-3, -1e-3], image_size=SIZE).requires_grad_(False)


AUGMENTATIONS = {
    "mount": lambda: A.RandomMount(valid_mask=True),
    "half of them": lambda: A.RandomMount(p=0.5, min_filled=0.9),
    "mirror": lambda: A.HorizontalFlip(landmarks=PAIRS),
    "chain": lambda: A.Compose([A.RandomMount(), A.VerticalFlip(1.0, landmarks=PAIRS), A.RandomCrop((20, 30))]),
    "lens": lambda: A.RandomLens("dms60", min_filled=0, chromatic=0.02, vignetting=0.2),
    "box": lambda: A.BoxCrop((20, 24)),
    "shift": lambda: A.RandomMount(shift=(0.02, 0.02, 0.02)),
}


def equal(one, other):
    assert one.shape == other.shape
    torch.testing.assert_close(one, other, rtol=0, atol=0, equal_nan=True)


@pytest.mark.parametrize("form", ["single", "batch", "list"])
@pytest.mark.parametrize("name", [n for n in AUGMENTATIONS if n not in ("box", "shift")])
def test_each_face_moves_as_it_does_alone(name, form):
    augment, lens, count = AUGMENTATIONS[name](), camera(), 5  # as many faces as points
    augment.fields = {"visibility": "keep"}
    if name in ("mirror", "chain"):
        tables = ("keypoints", "landmarks", "points", "visibility")
        augment.mirroring = A.HorizontalFlip(landmarks=dict.fromkeys(tables, PAIRS)).mirroring
    faces = {"keypoints": torch.rand(B, count, 5, 2) * 30, "landmarks": torch.randn(B, count, 5, 3)}
    faces |= {"points": torch.randn(B, count, 5, 3), "keypoints_valid": torch.rand(B, count, 5) > 0.3}
    faces |= {"visibility": torch.randint(3, (B, count, 5)), "keypoints_pixels": torch.rand(B, count, 5, 2) * 9}
    image, draw = torch.rand(B, 3, *SIZE), augment.draw(1 if form == "single" else B)
    give = {"single": lambda v: v[0], "batch": lambda v: v, "list": list}[form]

    def stacked(out):
        return {n: torch.stack(v) if isinstance(v, list) else v for n, v in out.items() if n != "camera"}

    def moved(fields):
        given = {"image": image[0] if form == "single" else image, **{n: give(v) for n, v in fields.items()}}
        return given, stacked(augment(given, camera=lens, draw=draw))

    given, together = moved(faces)
    each = [moved({name: value[:, i] for name, value in faces.items()})[1] for i in range(count)]
    for key in {*faces, "keypoints_pixels_valid"}:
        equal(together[key], torch.stack([one[key] for one in each], 0 if form == "single" else 1))
    if form == "single" and name != "half of them":
        back = augment.inverse(keypoints=together["keypoints"], gaze=torch.ones(2, 3))
        seen = together["keypoints_valid"]
        torch.testing.assert_close(back["keypoints"][seen], given["keypoints"][seen], atol=1e-3, rtol=0)
    # a change that exists moves them as its draw does, whatever their names
    given["pixels"] = given.pop("keypoints_pixels")
    again = stacked(augment.moved_by(augment.change(lens, draw), given, {"pixels": "keypoints"}))
    for key in together:
        equal(again[key.replace("keypoints_pixels", "pixels")], together[key])


CLIPS = list(product(AUGMENTATIONS, ("one", "own", "batch", "list"), (1, B)))


@pytest.mark.parametrize(("name", "cameras", "clips"), slow_unless(lambda c: c[2] == B or c[0] == "chain", CLIPS))
def test_clips_move_as_their_frames_by_one_draw(name, cameras, clips):
    augment, lens = AUGMENTATIONS[name](), camera(*[clips] * (cameras in ("batch", "list")))
    first = clips, T
    sample = {"image": torch.randint(256, (*first, 3, *SIZE), dtype=torch.uint8), "mask": torch.rand(*first, *SIZE)}
    sample |= {"image_valid": torch.rand(*first, 1, *SIZE) > 0.1, "depth": torch.rand(*first, 1, *SIZE) + 1}
    sample |= {"keypoints": torch.rand(*first, 5, 2) * 30, "keypoints_faces": torch.rand(*first, 4, 5, 2) * 30}
    sample |= {"keypoints_valid": torch.rand(*first, 5) > 0.3, "boxes": torch.rand(*first, 2, 4) + BOX}
    sample |= {"gaze": torch.randn(*first, 3), "head_pose": torch.eye(4).expand(*first, 4, 4)}
    rest = {"names": ["a"] * clips, "index": torch.arange(clips), "rotation": torch.eye(3).expand(clips, 3, 3)}
    draw = augment.with_boxes(augment.draw(clips), sample["boxes"][:, 0])
    if cameras == "own":
        augment.camera = lens
    own = {} if cameras == "own" else {"camera": list(lens) if cameras == "list" else lens}
    out = augment(sample, **rest, **own, draw={n: v for n, v in draw.items() if n not in augment.crops})
    rows = torch.arange(clips).repeat_interleave(T)
    frames = {n: v.flatten(0, 1) for n, v in sample.items()} | {"rotation": rest["rotation"][rows]}
    lens = lens[0 if clips == 1 else rows.tolist()] if lens.batch_shape else lens
    want = augment(frames, draw={n: v[rows] for n, v in draw.items()}, camera=lens)
    for key in want.keys() - {"camera", "rotation"}:
        equal(out[key], want[key].unflatten(0, first))
    equal(out["rotation"], want["rotation"][::T])
    new = ct.Mixed(out["camera"]) if cameras == "list" else out["camera"]
    equal(new.intrinsics, want["camera"].intrinsics[::T])
    assert all(out[key] is rest[key] for key in ("names", "index"))
    for options in ({}, {"draw": draw, **own}) if name not in ("shift", "half of them") else ():
        back = augment.inverse(out, **options)
        torch.testing.assert_close(back["gaze"], sample["gaze"])
        seen = out["keypoints_valid"]
        torch.testing.assert_close(back["keypoints"][seen], sample["keypoints"][seen], atol=1e-3, rtol=0)
        assert back["image"].shape == sample["image"].shape


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        ({"keypoints": torch.zeros(B, 4, 5, 2)}, r"keypoints must be \(2, 3, .*image is of clips.* \(2, 4, 5, 2\)"),
        ({"gaze": torch.zeros(B, 3)}, r"gaze must be"),
        ({"image": torch.zeros(B, 0, 3, *SIZE)}, r"image must be \(2, T > 0, ...\).* got shape \(2, 0, "),
        ({"boxes": [torch.zeros(1, 4)] * B}, r"boxes must be \(2, 3, ...\).* got list"),
        ({"keypoints": torch.zeros(B, T, 5, 2), "keypoints_valid": torch.ones(B, 5)}, "keypoints_valid must be"),
        ({"camera": camera(3)}, "camera must be of 2 clips, .* got 3"),
        ({"rotation": torch.eye(3)}, "rotation must be of 2 clips, .* got 3"),
        ({"draw": A.RandomMount().draw(3)}, r"draw\['apply'\] must be of 2 clips, .* got 3"),
    ],
)
def test_what_does_not_fit_a_clip_is_told_by_name(fields, says):
    mount = A.RandomMount(camera=camera())
    with pytest.raises(ValueError, match=f"RandomMount: {says}"):
        mount(**{"image": torch.zeros(B, T, 3, *SIZE)} | fields)
    with pytest.raises(ValueError, match="RandomMount: the sample must be of 3, as the change; got 6"):
        mount.moved_by(mount.change(None, mount.draw(3)), {"image": torch.zeros(B, T, 3, *SIZE)})
    with pytest.raises(ValueError, match=r"FaceNormalizer: image must be \(B, C, H, W\); .* image.flatten\(0, 1\)"):
        A.FaceNormalizer(camera=camera())(image=torch.zeros(B, T, 3, *SIZE), head_pose=torch.eye(4))


def test_an_image_tells_a_sample_of_several_faces_from_a_batch_in_any_order():
    camera = ct.Pinhole.from_fov(60, image_size=(30, 40)).requires_grad_(False)
    out = A.RandomMount(camera=camera)(keypoints=torch.ones(4, 5, 2), image=torch.zeros(3, 30, 40))
    assert out["keypoints"].shape == (4, 5, 2)
    assert out["camera"].batch_shape == ()


def test_lists_of_labels_move_by_the_cameras_of_several_models():
    lens = ct.KannalaBrandt([30.0, 30.0, 19.5, 14.5], image_size=(30, 40)).requires_grad_(False)
    cameras = [ct.Pinhole.from_fov(fov, image_size=(30, 40)).requires_grad_(False) for fov in (50, 90)]
    cameras.insert(1, lens)
    mount, points = A.RandomMount(), [torch.rand(n, 2) * 30 for n in (2, 3, 4)]
    draw = mount.draw(3)
    moved = mount(keypoints=points, camera=cameras, draw=draw)["keypoints"]
    for i, (camera, one) in enumerate(zip(cameras, points, strict=True)):
        alone = mount(keypoints=one[None], camera=camera, draw={n: v[i : i + 1] for n, v in draw.items()})
        torch.testing.assert_close(moved[i], alone["keypoints"][0])
