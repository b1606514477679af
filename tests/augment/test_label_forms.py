"""Laws of labels in forms that are not ours: boxes by their sides, landmarks of an image of another size."""

import re

import pytest
import torch

import camtorch as ct
from camtorch.augment import numpy as arrays

A, SIZE = ct.augment, (48, 64)
CAMERA = ct.KannalaBrandt([40.0, 41.0, 31.0, 24.0], [0.02, -0.01, 0.0, 0.0], image_size=SIZE).requires_grad_(False)
CORNERS = torch.tensor([[9.0, 8, 41, 38], [-5.0, 20, 3, 27.5], [60.0, 40, 90, 80], [500.0, 500, 510, 505]])
FORMS = {"xywh": lambda low, high: (low, high - low), "cxcywh": lambda low, high: ((low + high) / 2, high - low)}
AUGMENTATIONS = {
    "mount": lambda **o: A.RandomMount(yaw=20, roll=30, camera=CAMERA, min_filled=0, **o),
    "lens": lambda **o: A.RandomLens("pinhole", fov=(60, 60), camera=CAMERA, min_filled=0, **o),
    "flip": lambda **o: A.HorizontalFlip(**o),
    "crop": lambda **o: A.BoxCrop((30, 40), camera=CAMERA, **o),
    "chain": lambda **o: A.Compose([A.Rotate90(step=2), A.BoxCrop((9, 12), yaw=3)], camera=CAMERA, **o),
}


def form_of(boxes, form):
    return torch.cat(FORMS[form](*boxes.split(2, -1)), -1)


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", AUGMENTATIONS)
def test_boxes_of_every_form_move_as_corners(name, form):
    kind, image, ok = f"boxes_{form}", torch.rand(3, *SIZE), torch.tensor([True, True, True, False])
    for lead in ((), (2,), (2, 3)):  # one, a batch, clips
        boxes, images = CORNERS.repeat(*lead, 1, 1), image.repeat(*lead, 1, 1, 1)
        augment, other = AUGMENTATIONS[name](), AUGMENTATIONS[name](fields={"bbox": kind})
        for _ in range(2):  # as first and as later samples
            draw = augment.draw(*lead[:1] or (1,))
            expected = augment(image=images, boxes=boxes, draw=draw)
            given = augment.inverse(expected)
            for field, by, valid in ((kind, augment, {}), ("bbox", other, {"bbox_valid": ok.expand(*lead, 4)})):
                out = by({"image": images, field: form_of(boxes, form), **valid}, draw=draw)
                torch.testing.assert_close(out[field], form_of(expected["boxes"], form), rtol=1e-6, atol=1e-4)
                assert torch.equal(out[f"{field}_valid"], expected["boxes_valid"] & (ok if valid else True))
                torch.testing.assert_close(out["image"], expected["image"], rtol=0, atol=1e-4)
                back = by.inverse(out)[field]
                torch.testing.assert_close(back, form_of(given["boxes"], form), rtol=1e-5, atol=2e-3)
    lists = augment(image=[image, image], **{kind: [form_of(CORNERS, form), form_of(CORNERS[:1], form)]})
    assert [tuple(one.shape) for one in (*lists[kind], *lists[f"{kind}_valid"])] == [(4, 4), (1, 4), (4,), (1,)]


@pytest.mark.parametrize("form", FORMS)
def test_the_name_tells_the_form_and_what_does_not_move_keeps_its_bits(form):
    still, flipped, image = A.HorizontalFlip(p=0), A.HorizontalFlip(p=1), torch.zeros(3, *SIZE)
    boxes = torch.rand(5, 4, generator=torch.Generator().manual_seed(0)) * 40
    x = 63 - boxes[:, :1] - (boxes[:, 2:3] if form == "xywh" else 0)
    for name in (f"boxes_{form}", f"boxes_face_{form}", f"boxes_{form}_face"):
        for given in (boxes, boxes.half()):
            assert torch.equal(still({"image": image, name: given})[name], given)
            out = flipped({"image": image, name: given})[name]
            torch.testing.assert_close(out, torch.cat((x, boxes[:, 1:]), 1).to(given), rtol=0, atol=0.05)
    given = torch.tensor([[9.0, 8, -3, 4], [9.0, 8, 3, 4]], requires_grad=True)
    assert flipped({"image": image, name: given})[f"{name}_valid"].tolist() == [False, True]


@pytest.mark.parametrize("name", ["keypoints", "landmarks"])
@pytest.mark.parametrize("form", range(4), ids=["single", "a batch of one", "of four", "arrays"])
def test_landmarks_of_an_image_of_another_size_are_told_of_once(name, form):
    inside = torch.tensor([[3.0, 4.0], [60.0, 46.0], [20.0, 9.0]])
    far = 3 * inside + 64

    def moved(points, flags=None, by=None):
        sample = {"image": torch.zeros(3, *SIZE), name: points}
        sample |= {} if flags is None else {f"{name}_valid": torch.tensor(flags)}
        if form == 3:
            sample = {n: (v.movedim(0, -1) if n == "image" else v).numpy() for n, v in sample.items()}
            arrays.Transform(by or A.HorizontalFlip())(sample)
        else:
            (by or A.HorizontalFlip())({n: v if form == 0 else torch.stack([v] * form**2) for n, v in sample.items()})

    mount, told = A.RandomMount(camera=CAMERA), rf"Mount: {name} must be .*{re.escape(str(SIZE))}; .* of another size"
    with pytest.warns(UserWarning, match=told):
        moved(far, by=mount)
    moved(far, by=mount)
    with pytest.warns(UserWarning, match="of another size"):
        moved(torch.cat((inside, far, far[:1])))
    moved(torch.cat((inside, far)))
    moved(torch.cat((inside[:1], far)), [True, True, False, False])
    moved(torch.full((3, 2), torch.nan))


def test_boxes_that_do_not_move_are_valid_where_the_image_is():
    still, inf = A.HorizontalFlip(p=0), torch.inf
    boxes = torch.tensor(
        [[63.3, 9, 80, 20], [63.6, 9, 80, 20], [-9.0, 9, -0.3, 20], [-9.0, 9, -0.6, 20], [0, 0, 9, inf]]
    )
    out = still(image=torch.zeros(3, *SIZE), boxes=boxes)
    assert out["boxes_valid"].tolist() == [True, False, True, False, False]
    assert torch.equal(out["boxes"], boxes)


def test_depth_behind_the_camera_moves_as_its_distance():
    wide = ct.KannalaBrandt([15.0, 15.0, 31.5, 23.5], image_size=SIZE).requires_grad_(False)  # 120 degrees to the side
    z = wide.rays()[0][..., 2]
    out = A.RandomMount(roll=(90, 90), yaw=(0, 0), pitch=(0, 0), camera=wide, min_filled=0)(depth=3 * z[None])
    found = out["depth"][0]
    assert (found < -0.5).any()
    torch.testing.assert_close(found[found != 0], (3 * z)[found != 0], rtol=0, atol=0.2)
