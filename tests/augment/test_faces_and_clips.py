"""Several faces in a sample move as each does alone; the frames of clips as those of a batch of one draw a clip."""

import pytest
import torch

import camtorch as ct
from camtorch import augment as A  # noqa: N812

SIZE, PAIRS, B, T = (30, 40), [(0, 1), (3, 4)], 2, 3


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
    augment, count = AUGMENTATIONS[name](), 5  # as many faces as points
    augment.fields = {"visibility": "keep"}
    if name in ("mirror", "chain"):
        tables = ("keypoints", "landmarks", "points", "visibility")
        augment.mirroring = A.HorizontalFlip(landmarks=dict.fromkeys(tables, PAIRS)).mirroring
    faces = {"keypoints": torch.rand(B, count, 5, 2) * 30, "landmarks": torch.randn(B, count, 5, 3)}
    faces |= {"points": torch.randn(B, count, 5, 3), "keypoints_valid": torch.rand(B, count, 5) > 0.3}
    faces |= {"visibility": torch.randint(3, (B, count, 5)), "keypoints_pixels": torch.rand(B, count, 5, 2)}
    image, draw = torch.rand(B, 3, *SIZE), augment.draw(1 if form == "single" else B)
    image = image[0] if form == "single" else image

    def moved(fields):
        give = {"single": lambda v: v[0], "batch": lambda v: v, "list": list}[form]
        out = augment({"image": image, **{n: give(v) for n, v in fields.items()}}, camera=lens, draw=draw)
        return {n: torch.stack(v) if isinstance(v, list) else v for n, v in out.items() if n != "camera"}

    lens = camera()
    together = moved(faces)
    each = [moved({name: value[:, i] for name, value in faces.items()}) for i in range(count)]
    axis = 0 if form == "single" else 1
    for key in {*faces, "keypoints_pixels_valid"}:
        equal(together[key], torch.stack([one[key] for one in each], axis))


@pytest.mark.parametrize("clips", [1, B])
@pytest.mark.parametrize("cameras", ["one", "own", "batch", "list"])
@pytest.mark.parametrize("name", AUGMENTATIONS)
def test_clips_move_as_their_frames_by_one_draw(name, cameras, clips):
    augment, lens = AUGMENTATIONS[name](), camera(*[clips] * (cameras in ("batch", "list")))
    sample = {
        "image": torch.randint(256, (clips, T, 3, *SIZE), dtype=torch.uint8),
        "image_valid": torch.rand(clips, T, 1, *SIZE) > 0.1,
        "mask": torch.randint(5, (clips, T, *SIZE)),
        "depth": torch.rand(clips, T, 1, *SIZE) + 1,
        "keypoints": torch.rand(clips, T, 5, 2) * 30,
        "keypoints_faces": torch.rand(clips, T, 4, 5, 2) * 30,
        "keypoints_valid": torch.rand(clips, T, 5) > 0.3,
        "boxes": torch.tensor([3.0, 3, 20, 24]) + torch.rand(clips, T, 2, 4),
        "gaze": torch.randn(clips, T, 3),
        "head_pose": torch.eye(4).expand(clips, T, 4, 4),
    }
    rest = {"names": ["a"] * clips, "index": torch.arange(clips), "rotation": torch.eye(3).expand(clips, 3, 3)}
    draw = augment.with_boxes(augment.draw(clips), sample["boxes"][:, 0])
    if cameras == "own":
        augment.camera = lens
    given = {} if cameras == "own" else {"camera": list(lens) if cameras == "list" else lens}
    out = augment(sample, **rest, **given, draw={n: v for n, v in draw.items() if n not in augment.crops})
    rows = torch.arange(clips).repeat_interleave(T)
    frames = {n: v.flatten(0, 1) for n, v in sample.items()} | {"rotation": rest["rotation"][rows]}
    if lens.batch_shape and clips > 1:
        lens = lens[rows.tolist()]
    want = augment(
        frames, draw={n: v[rows] for n, v in draw.items()}, camera=lens[0] if clips == 1 and lens.batch_shape else lens
    )
    for key in want.keys() - {"camera", "rotation"}:
        equal(out[key], want[key].unflatten(0, (clips, T)))
    equal(out["rotation"], want["rotation"][::T])
    new = ct.Mixed(out["camera"]) if cameras == "list" else out["camera"]
    assert tuple(new.batch_shape) == (clips,)
    equal(new.intrinsics, want["camera"].intrinsics[::T])
    assert out["names"] is rest["names"]
    assert out["index"] is rest["index"]
    if name not in ("shift", "half of them"):
        for options in ({}, {"draw": draw, "camera": given.get("camera")}):
            if not options:
                augment(sample, **rest, **given, draw=draw)
            back = augment.inverse(out, **options)
            torch.testing.assert_close(back["gaze"], sample["gaze"])
            seen = out["keypoints_valid"]
            torch.testing.assert_close(back["keypoints"][seen], sample["keypoints"][seen], atol=1e-3, rtol=0)
            assert back["image"].shape == sample["image"].shape


@pytest.mark.parametrize(
    ("fields", "says"),
    [
        (
            {"keypoints": torch.zeros(B, 4, 5, 2)},
            r"keypoints must be \(2, 3, ...\), for image holds clips .* \(2, 4, 5, 2\)",
        ),
        ({"gaze": torch.zeros(B, 3)}, r"gaze must be"),
        ({"gaze": torch.zeros(3, T, 3)}, r"gaze must be \(2, 3, ...\).* got shape \(3, 3, 3\)"),
        ({"boxes": [torch.zeros(1, 4)] * B}, r"boxes must be \(2, 3, ...\).* got list"),
        ({"keypoints": torch.zeros(B, T, 5, 2), "keypoints_valid": torch.ones(B, 5)}, "keypoints_valid must be"),
        ({"image_left": torch.zeros(B, 3, *SIZE)}, "image_left must be"),
        ({"camera": camera(3)}, "camera is of 3 clips, image of 2"),
        ({"rotation": torch.eye(3)}, "rotation is of 3 clips, image of 2"),
        ({"draw": A.RandomMount().draw(3)}, r"draw\['apply'\] is of 3 clips, image of 2"),
    ],
)
def test_what_does_not_fit_a_clip_is_told_by_name(fields, says):
    with pytest.raises(ValueError, match=f"RandomMount: {says}"):
        A.RandomMount(camera=camera())(image=torch.zeros(B, T, 3, *SIZE), **fields)
    with pytest.raises(ValueError, match=r"FaceNormalizer: image must be \(B, C, H, W\); .* image.flatten\(0, 1\)"):
        A.FaceNormalizer(camera=camera())(image=torch.zeros(B, T, 3, *SIZE), head_pose=torch.eye(4))
