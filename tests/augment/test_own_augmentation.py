"""An augmentation of one's own, as anybody would write it."""

import pickle
from types import MappingProxyType

import pytest
import torch

import camtorch as ct
import camtorch.augment.kornia
import camtorch.augment.numpy

SIZE = (48, 64)


def camera():
    return ct.KannalaBrandt([40.0, 40.0, 31.5, 23.5], [0.02, 0.0, 0.0, 0.0], image_size=SIZE).requires_grad_(False)


class Nearer(ct.augment.Augmentation):
    def __init__(self, zoom=(1.0, 2.0), **options):
        super().__init__({"zoom": ct.augment.Range(*zoom)}, **options)

    def new_camera(self, source, values):
        one = torch.ones_like(values["zoom"])
        scale = torch.stack((values["zoom"], values["zoom"], one, one), -1)
        return source.replace(intrinsics=source.intrinsics * scale), None


class Upright(ct.augment.Augmentation):
    """A camera that leans is set upright, and looks up or down."""

    def __init__(self, lean: float, **options):
        super().__init__({"pitch": ct.augment.Range(-20, 20)}, **options)
        self.lean = lean

    def new_camera(self, source, values):
        zero = torch.zeros_like(values["pitch"])
        return source, ct.augment.mount_rotation(zero, values["pitch"], zero + self.lean)


def test_the_example_zooms_all_that_a_sample_holds():
    nearer = Nearer(zoom=(2.0, 2.0), camera=camera(), valid_mask=True)
    points = torch.tensor([[[31.5, 23.5], [36.5, 23.5], [60.0, 40.0]]])
    out = nearer(image=torch.rand(1, 3, *SIZE), keypoints=points, gaze=torch.tensor([[0.0, 0.0, -1.0]]))
    torch.testing.assert_close(out["keypoints"][0, :2], torch.tensor([[31.5, 23.5], [41.5, 23.5]]), atol=1e-3, rtol=0)
    assert out["keypoints_valid"].tolist() == [[True, True, False]]
    assert out["gaze"].tolist() == [[0.0, 0.0, -1.0]]
    assert out["image_valid"].all()
    torch.testing.assert_close(nearer.inverse(out)["keypoints"], points, atol=1e-3, rtol=0)
    assert "zoom=(2, 2), p=1.0" in repr(nearer)


def test_one_s_own_has_all_that_others_have():
    upright = Upright(30.0, camera=camera(), p=0.5, min_filled=0.8)
    draw, points = upright.draw(6, torch.Generator().manual_seed(0)), torch.rand(6, 4, 2) * 40
    out, applied = upright(image=torch.rand(6, 1, *SIZE), keypoints=points, draw=draw), draw["apply"]
    assert torch.equal(out["keypoints"][~applied], points[~applied])
    assert (out["rotation"][applied, 0, 0] < 0.99).all()
    again = pickle.loads(pickle.dumps(upright))(keypoints=points, draw=draw)
    assert torch.equal(again["keypoints"], out["keypoints"])
    cameras = [camera(), ct.Pinhole([50.0, 50.0, 31.5, 23.5], image_size=SIZE).requires_grad_(False)] * 3
    listed = upright(keypoints=points, camera=cameras, draw=draw)
    assert [type(c) for c in listed["camera"]] == [type(c) for c in cameras]
    assert ct.augment.numpy.Transform(upright)(image=torch.rand(*SIZE).numpy())["image"].shape == SIZE
    assert ct.augment.kornia.CameraAugmentation(upright)(torch.rand(2, 1, *SIZE)).shape == (2, 1, *SIZE)


def test_what_it_gets_wrong_is_told():
    with pytest.raises(ValueError, match=r"Range: low and high must be finite, with low <= high; got 2, 1"):
        ct.augment.Range(2, 1)
    with pytest.raises(NotImplementedError):
        ct.augment.Augmentation(camera=camera())(keypoints=torch.zeros(1, 2))


@pytest.mark.parametrize(("old", "new"), [("single", "camera"), ("several", "camera"), ("single_rotation", "rotation")])
def test_names_of_a_change_before_0_6_work_and_name_their_successors(old, new):
    new, batched = f"{new}_for_sample", old == "several"
    augment = ct.augment.RandomMount(yaw=10, camera=ct.Pinhole([80.0, 80.0, 31.5, 23.5], image_size=(48, 64)))
    augment(image=torch.zeros(3, 48, 64))
    with pytest.warns(FutureWarning, match=rf"Change\.{old} is now Change\.{new}\({batched}\); 0\.7 removes"):
        given = getattr(augment.last, old)
    expected = getattr(augment.last, new)(batched)
    assert torch.equal(getattr(given, "intrinsics", given), getattr(expected, "intrinsics", expected))


def test_errors_within_a_change_are_told_as_they_are():
    change = ct.augment.RandomMount().change(camera(), ct.augment.RandomMount().draw(2))
    change.parts[0].camera = None
    with pytest.raises(AttributeError, match="'NoneType' object has no attribute 'expand'"):
        _ = change.source


class Facing(ct.augment.Augmentation):
    """A pinhole camera that looks at a box of the sample."""

    crops = MappingProxyType({"box": 0})

    def new_camera(self, source, values):
        crop = ct.views.look_at(source, values["box"], (24, 24))
        return crop.target, crop.rotation


def test_boxes_of_a_sample_come_only_with_it():
    boxes = torch.tensor([[20.0, 15.0, 40.0, 35.0]])
    out = Facing(camera=camera())(image=torch.rand(3, *SIZE), boxes=boxes)  # whose new images nothing looks at before
    assert out["image"].shape == (3, 24, 24)


@pytest.mark.parametrize("name", ["box", "crop"])  # of which the second is a range's, too, in other augmentations
def test_boxes_of_a_draw(name):
    class Follows(Facing):
        crops = MappingProxyType({name: 0})

        def new_camera(self, source, values):
            return super().new_camera(source, {"box": values[name]})

    boxes = torch.tensor([[[20.0, 15.0, 40.0, 35.0]]])
    augment = Follows(camera=camera())
    sample = {"image": torch.rand(1, 3, *SIZE), "boxes": boxes}
    replayed = augment(sample, draw=augment.with_boxes(augment.draw(1), boxes))
    assert torch.equal(replayed["image"], augment(sample)["image"])


def test_a_face_normalizer_draws_nothing():
    transform = ct.augment.numpy.Transform(ct.augment.FaceNormalizer(camera=camera()))
    with pytest.raises(TypeError, match="draw and generator must be None for a FaceNormalizer"):
        transform(image=torch.rand(*SIZE).numpy(), generator=torch.Generator())


class Aimed(ct.augment.Augmentation):
    """A camera that turns by an angle which is learnt."""

    def __init__(self, **options):
        super().__init__({"share": ct.augment.Range(0.9, 1.1)}, **options)
        self.angle = torch.nn.Parameter(torch.tensor(3.0))

    def new_camera(self, source, values):
        yaw, none = values["share"] * self.angle, 0 * values["share"]
        return source, ct.augment.mount_rotation(yaw, none, none)


@pytest.mark.parametrize("following", [False, True], ids=["first", "last"])
@pytest.mark.parametrize("lead", [(), (2,)], ids=["one", "batch"])
def test_in_a_chain_gradients_reach_a_rotation_that_is_learnt(following, lead):
    mount, aimed = ct.augment.RandomMount(min_filled=0), Aimed(min_filled=0)
    camera = ct.Pinhole([60.0, 60, 39.5, 29.5], image_size=(60, 80)).requires_grad_(False)
    chain = ct.augment.Compose([mount, aimed] if following else [aimed, mount], camera=camera)
    fields = {"image": torch.rand(*lead, 3, 60, 80), "gaze": torch.randn(*lead, 3)}
    fields["keypoints"] = 20 * torch.rand(*lead, 4, 2)
    moved = chain(fields)
    for name in (*fields, "rotation"):
        (slope,) = torch.autograd.grad(moved[name].sum(), aimed.angle, retain_graph=True)
        assert slope != 0, name
