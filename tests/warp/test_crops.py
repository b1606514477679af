"""Crops that look at boxes: gradients to the boxes, several crops of each image, and the place of a crop."""

import pytest
import torch

import camtorch as ct

SIZE = (24, 32)


def fisheye():
    camera = ct.KannalaBrandt([80.0, 82.0, 79.0, 60.5], [0.01, -0.002, 0.001, 0.0003], image_size=(120, 160))
    return camera.double().requires_grad_(False)


def boxes():
    return torch.tensor([[20.3, 15.2, 61.7, 48.1], [90.4, 61.3, 139.2, 103.9]], dtype=torch.float64)


def smooth_images(count):
    v, u = torch.meshgrid(torch.arange(120.0).double(), torch.arange(160.0).double(), indexing="ij")
    return torch.stack([torch.sin(u / (9 + i)) * torch.cos(v / 11) for i in range(count)])[:, None]


LOSSES = {
    "image": lambda warp: warp(smooth_images(2), mode="bicubic").square().sum(),
    "camera": lambda warp: warp.target.intrinsics.log().sum(),
    "rotation": lambda warp: (warp.rotation * torch.arange(9.0).double().view(3, 3)).sum(),
    "points": lambda warp: warp.transform_points(boxes()[:, None, :2] + 9)[0].square().sum(),
    "boxes": lambda warp: warp.transform_boxes(boxes()[:, None])[0].square().sum(),
    "place": lambda warp: (ct.views.crop_place(warp) * torch.arange(5.0).double()).sum(),
}


@pytest.mark.parametrize("loss", LOSSES.values(), ids=LOSSES)
@pytest.mark.parametrize("model", ["fisheye", "pinhole"])
def test_gradients_reach_the_box(loss, model):
    camera = fisheye()
    if model == "pinhole":
        camera = ct.Pinhole(camera.intrinsics, image_size=camera.image_size).requires_grad_(False)

    def of(box):
        return loss(ct.views.look_at(camera, box, SIZE))

    box = boxes().requires_grad_()
    (gradient,) = torch.autograd.grad(of(box), box)
    step = torch.eye(8, dtype=torch.float64).view(8, 2, 4) * 1e-5
    numbers = torch.stack([(of(boxes() + s) - of(boxes() - s)) / 2e-5 for s in step]).view(2, 4)
    torch.testing.assert_close(gradient, numbers, rtol=1e-3, atol=1e-3 * float(numbers.abs().max()))


def test_a_box_without_a_gradient_gives_the_same_crop():
    camera = fisheye()
    plain, learns = (ct.views.look_at(camera, boxes().requires_grad_(g), SIZE) for g in (False, True))
    assert not plain.rotation.requires_grad
    torch.testing.assert_close(learns.target.intrinsics, plain.target.intrinsics, rtol=1e-9, atol=0)
    torch.testing.assert_close(learns.rotation, plain.rotation, rtol=0, atol=1e-12)
    learner = ct.views.look_at(fisheye().requires_grad_(True), boxes(), SIZE)
    assert not learner.target.intrinsics.requires_grad  # the place of the crop counts as given
    camera = fisheye().requires_grad_(True)
    both = ct.views.look_at(camera, boxes().requires_grad_(), SIZE)
    gradients = torch.autograd.grad(both.target.intrinsics.sum(), camera.intrinsics, allow_unused=True)
    assert gradients == (None,)


@pytest.mark.parametrize("count", [None, 2], ids=["one camera", "a camera each"])
def test_several_crops_of_each_image(count):
    camera = fisheye() if count is None else ct.cat([fisheye(), fisheye().replace(intrinsics=[90.0, 91.0, 75.0, 63.0])])
    many = torch.stack((boxes(), boxes() + 7, boxes().flip(0) - 3), 1).requires_grad_()
    warp, images = ct.views.look_at(camera, many, SIZE), smooth_images(2).requires_grad_()
    made = warp(images)
    assert made.shape == (2, 3, 1, *SIZE)
    assert warp.target.batch_shape == (2, 3)
    points = torch.rand(2, 3, 5, 2, dtype=torch.float64) * 100
    moved, valid = warp.transform_points(points)
    bounds = warp.transform_boxes(many.detach()[:, :, None])[0]
    place = ct.views.crop_place(warp)
    for b in range(2):
        one = ct.views.look_at(camera if count is None else camera[b], many[b], SIZE)
        torch.testing.assert_close(made[b], one(images[b : b + 1]), rtol=0, atol=1e-9)
        torch.testing.assert_close(place[b], ct.views.crop_place(one))
        torch.testing.assert_close(warp.valid_mask()[b], one.valid_mask())
        torch.testing.assert_close(warp.grid()[b], one.grid())
        for i, (got, want) in enumerate(zip((moved, valid), one.transform_points(points[b]), strict=True)):
            torch.testing.assert_close(got[b], want, msg=str(i))
        torch.testing.assert_close(bounds[b], one.transform_boxes(many.detach()[b][:, None])[0])
        torch.testing.assert_close(warp.transform_rays(points.new_ones(2, 3, 3))[b], one.rotation.sum(-1))
    assert torch.autograd.grad(made.sum(), (many, images))[0].abs().max() > 0
    back = warp.inverse()
    assert back(made).shape == (2, 3, 1, 120, 160)
    again = back.transform_points(moved)[0]
    torch.testing.assert_close(again[valid], points[valid])
    assert warp.detach()(images[:1].detach()).shape == (2, 3, 1, *SIZE)
    assert warp.detach()(images.detach().movedim(1, -1).numpy()).shape == (2, 3, *SIZE, 1)


def test_options_that_change_after_use_count():
    warp, images = ct.views.look_at(fisheye(), boxes()[:, None], SIZE), smooth_images(2)
    warp(images)
    fresh = ct.views.look_at(fisheye(), boxes()[:, None], SIZE)
    for each in (warp, fresh):
        each.mode, each.fill = "nearest", (7.0,)
    torch.testing.assert_close(warp(images), fresh(images), rtol=0, atol=0)


def test_no_crops_of_some_images():
    warp = ct.views.look_at(fisheye(), boxes().new_zeros(2, 0, 4), SIZE)
    for images in (smooth_images(2), smooth_images(1), smooth_images(2)[:, None].expand(-1, 0, -1, -1, -1)):
        assert warp(images).shape == (2, 0, 1, *SIZE)
    assert warp.inverse()(warp(smooth_images(2))).shape == (2, 0, 1, 120, 160)
    assert warp.valid_mask().shape == (2, 0, 1, *SIZE)
    assert warp.transform_points(boxes().new_zeros(2, 0, 5, 2))[0].shape == (2, 0, 5, 2)
    assert ct.views.crop_place(warp).shape == (2, 0, 5)


def test_shapes_that_could_be_misread_are_refused():
    many = torch.stack((boxes(), boxes() + 7, boxes()), 1)
    warp = ct.views.look_at(fisheye(), many, SIZE)
    each = smooth_images(2)[:, None].expand(-1, 3, -1, -1, -1)  # frames, with a box of their own
    torch.testing.assert_close(warp(each), warp(smooth_images(2)), rtol=0, atol=1e-9)
    for images in (smooth_images(3), smooth_images(6), smooth_images(1)[0], each[:, :2], each[None]):
        with pytest.raises(ValueError, match=r"images must be \(2, C, H, W\), or \(2, 3, C, H, W\)"):
            warp(images)
    with pytest.raises(ValueError, match=r"pixels must be \(2, 3, \.\.\.\).*expand\(-1, 3"):
        warp.transform_points(torch.zeros(2, 5, 2))
    many[1, 2] = float("nan")
    with pytest.raises(ValueError, match=r"boxes\[1, 2\]"):
        ct.views.look_at(fisheye(), many, SIZE)
    for count in (1, 3):
        with pytest.raises(ValueError, match="one for each camera"):
            ct.views.look_at(fisheye().expand(count), boxes(), SIZE)


def test_the_place_of_a_crop():
    camera = fisheye()
    warp = ct.views.look_at(camera, boxes(), SIZE)
    place = ct.views.crop_place(warp)
    rays = camera.unproject((boxes()[:, :2] + boxes()[:, 2:]) / 2)[0]
    focal = warp.target.intrinsics[:, :1]
    torch.testing.assert_close(place, torch.cat((rays, 32 / 2 / focal, 24 / 2 / focal), -1))
    plain = ct.Warp(camera, camera.crop(20, 30, 24, 32))
    middle = camera.unproject(torch.tensor([45.5, 31.5]).double())[0]
    torch.testing.assert_close(ct.views.crop_place(plain)[:3], middle)
    with pytest.raises(TypeError, match="must be a Warp"):
        ct.views.crop_place(camera)


def test_a_box_on_the_first_pixel_is_looked_at():
    rim = torch.tensor([-30.0, -20.0, 0.2, 0.3], dtype=torch.float64)
    middle, _ = ct.views.look_at(fisheye(), rim, SIZE, margin=0.0).transform_points((rim[:2] + rim[2:]) / 2)
    torch.testing.assert_close(middle, torch.tensor([15.5, 11.5], dtype=torch.float64))


def test_where_a_side_has_no_ray_its_tangent_is_0():
    lens = ct.KannalaBrandt([8.0, 10.0, 3.5, 11.5], image_size=SIZE).double().requires_grad_(False)
    seen = lens.unproject(torch.tensor([[-0.5, 11.5], [31.5, 11.5]], dtype=torch.float64))[1]
    assert seen.tolist() == [True, False]  # to the right the angle is more than pi
    place = ct.views.crop_place(ct.Warp(fisheye(), lens))
    assert place[3] == 0
    assert place[4] > 0
