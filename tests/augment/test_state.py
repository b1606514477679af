"""The state of augmentations: results follow each public attribute, calls leave no trace, and warnings come once."""

import ast
import copy
import functools
import inspect
import io
import pickle
from pathlib import Path

import numpy as np
import pytest
import torch
from cameras import slow_unless
from torch import nn

import camtorch as ct
import camtorch.augment.kornia
import camtorch.augment.numpy
from camtorch.values.arguments import TOLD

A = ct.augment
SIZE = (48, 64)


def camera(degrees=70, model=ct.Pinhole, size=SIZE):
    return model.from_fov(degrees, image_size=size).requires_grad_(False)


LIKE_OTHERWISE = ct.BrownConrady([50.0, 50, 31.5, 23.5], [-0.1, 0.02, 0.0, 0.0], image_size=SIZE)
LIKE = ct.KannalaBrandt([50.0, 50, 31.5, 23.5], [-0.1, 0.02, 0.0, 0.0], image_size=SIZE)


def first(one):
    """The name of the first range."""
    return next(iter(one.ranges))


KINDS = {
    "RandomMount": (A.RandomMount, {"min_filled": 0}),
    "RandomLens": (A.RandomLens, {"min_filled": 0}),
    "RandomLens of a like": (A.RandomLens, {"like": LIKE, "fov": "source", "min_filled": 0}),
    "RandomCamera": (A.RandomCamera, {"like": "dms60", "fov": (50, 60), "min_filled": 0.5}),
    "RandomCamera of real lenses": (A.RandomCamera, {"like": "real", "min_filled": 0}),
    "RandomShutter": (A.RandomShutter, {"readout": 0.02, "rates": 90}),
    "BoxCrop": (A.BoxCrop, {"image_size": (32, 40), "yaw": 5, "zoom": 0.1}),
    "RandomResizedCrop": (A.RandomResizedCrop, {"size": (30, 40)}),
    "RandomCrop": (A.RandomCrop, {"size": (30, 40)}),
    "CenterCrop": (A.CenterCrop, {"size": (30, 40)}),
    "Resize": (A.Resize, {"size": 20}),
    "Pad": (A.Pad, {"padding": (1, 2, 3, 4)}),
    "Rotate90": (A.Rotate90, {"times": (0, 2), "step": 2}),
    "HorizontalFlip": (A.HorizontalFlip, {}),
    "VerticalFlip": (A.VerticalFlip, {}),
    "FaceNormalizer": (A.FaceNormalizer, {"distance": 0.6}),
    "Compose": (A.Compose, {"augmentations": [A.HorizontalFlip(), A.RandomMount()]}),
}
TABLE = [(1, 0), (2, 3)]
VALUES = {
    "training": False,
    "camera": camera(80),
    "fields": {"more": "points"},
    "options": A.RandomMount(mode="nearest", fill=2).options,
    "antialias": True,
    "mask_fill": 5.0,
    "valid_mask": True,
    "p": 0.0,
    "same_on_batch": True,
    "min_filled": 0.9,
    "fov": None,
    "like": LIKE.replace(image_size=(96, 128)),
    "image_size": (40, 36),
    "margin": 0.5,
    "place": True,
    "crops": {"box": 1},
    "direction": "up",
    "times": (1, 1, 1),
    "padding": (4, 3, 2, 1),
    "least": (60, 70),
    "shorter": 24,
    "focal": 500.0,
    "distance": 0.8,
    "axis": (100.0, 110.0),
    "mirroring": A.HorizontalFlip(landmarks=TABLE).mirroring,
    "augmentations": nn.ModuleList([A.RandomMount(roll=(5, 9)), A.RandomLens()]),
}
"""Another valid value of each public attribute."""
LIKES, RANGED = ("RandomLens of a like", "RandomCamera"), [name for name in KINDS if name[:4] == "Rand"]
CHANGES = {
    "like of another model": (LIKES, lambda one: setattr(one, "like", LIKE_OTHERWISE)),
    "size of like": (LIKES, lambda one: setattr(one.like, "image_size", (96, 128))),
    "numbers of like": (LIKES, lambda one: one.like.distortion.data.mul_(0.5)),
    "numbers of the camera": (KINDS, lambda one: one.camera.intrinsics.data.mul_(1.1)),
    "options in place": (KINDS, lambda one: one.options.update(mode="nearest")),
    "fields in place": (KINDS, lambda one: one.fields.update(more="points")),
    "a range": (RANGED, lambda one: one.ranges.update({first(one): narrower(one.ranges[first(one)])})),
    "ranges": (RANGED, lambda one: setattr(one, "ranges", {n: narrower(r) for n, r in one.ranges.items()})),
    "order of ranges": (RANGED, lambda one: setattr(one, "ranges", dict(reversed(one.ranges.items())))),
    "order of ranges in place": (RANGED, lambda one: one.ranges.update({first(one): one.ranges.pop(first(one))})),
    "one more range": (LIKES, lambda one: one.ranges.update(zoom=A.Range(1.2, 1.3))),
    "a range of a part": (["Compose"], lambda one: one.augmentations[1].ranges.update(yaw=A.Range(20, 30))),
    "p of a part": (["Compose"], lambda one: setattr(one.augmentations[0], "p", 0.9)),
    "a table of a part": (["Compose"], lambda one: setattr(one.augmentations[0], "mirroring", VALUES["mirroring"])),
    "one more part": (["Compose"], lambda one: one.augmentations.append(A.VerticalFlip(p=1))),
    "another part": (["Compose"], lambda one: one.augmentations.__setitem__(1, A.RandomLens(LIKE, fov="source"))),
}
"""Changes of more than one attribute, or in place: for which augmentations, and how."""


def narrower(interval):
    return A.Range(interval.low / 2 + interval.middle / 2, interval.middle, interval.size)


def made(name, **changes):
    kind, options = KINDS[name]
    if name == "Compose":
        options = {"augmentations": [A.HorizontalFlip(), A.RandomMount(min_filled=0)]}
    return kind(**{"camera": camera(), "fields": {"more": "keep"}, **options, **changes})


@functools.cache
def sample(count=None):
    torch.manual_seed(0)
    fields = {
        "image": torch.randint(256, (3, *SIZE), dtype=torch.uint8),
        "mask": torch.randint(9, SIZE),
        "keypoints": torch.rand(3, 2) * 40,
        "boxes": torch.tensor([[10.0, 12, 30, 36], [20, 8, 44, 30]]),
        "gaze": torch.tensor([0.1, 0.2, -0.97]),
        "rvec": torch.tensor([0.1, 0.2, 0.0]),
        "tvec": torch.tensor([0.0, 0.05, 0.7]),
        "more": torch.rand(4, 3) + 0.5,
    }
    return fields if count is None else {name: torch.stack([value] * count) for name, value in fields.items()}


def results(one, counts=(None, 2, None)):
    """What an augmentation makes of a sample, of a batch, of the sample again, and back; or the error."""
    found = []
    for given in map(sample, counts):
        torch.manual_seed(1)
        try:
            out = one(given)
            parts = [out, {k: v for k, v in one.inverse(out).items() if k != "rotation"}]
        except ValueError as error:
            parts = [{"error": str(error)}]
        found += [plain(value) for part in parts for value in sorted(part.items())]
    return found


def plain(item):
    name, value = item
    if isinstance(value, ct.Camera):
        return name, type(value).__name__, value.image_size, value.intrinsics.tolist(), value.distortion.tolist()
    return name, value.numpy().tobytes() if isinstance(value, torch.Tensor) else value


def attributes(one):
    """Names of all that is public and can be set."""
    kept = {n: v for owner in type(one).__mro__ for n, v in vars(owner).items() if isinstance(v, property)}
    names = {*vars(one), *one._modules, "antialias"} - {n for n, v in kept.items() if v.fset is None} - {"ranges"}
    return sorted(name for name in names if name[0] != "_")


ATTRIBUTES = [(name, attribute) for name in KINDS for attribute in attributes(made(name))]
EDITS = [(name, change) for change, (names, _) in CHANGES.items() for name in names]


def one_of_each(cases):
    """Cases (name, change), slow but for the first of each change among augmentations that differ most."""
    most = [case for case in cases if case[0] in ("RandomLens of a like", "BoxCrop", "Compose")]
    quick = {change: name for name, change in reversed(most)}
    return slow_unless(lambda case: quick.get(case[1]) == case[0], cases)


@pytest.mark.parametrize(("name", "attribute"), one_of_each(ATTRIBUTES))
def test_results_follow_each_attribute(name, attribute):
    value = VALUES[attribute] if attribute != "crops" or name == "BoxCrop" else {}
    used, new = made(name), made(name)
    results(used)
    if attribute == "like" and name == "RandomCamera of real lenses":
        with pytest.raises(ValueError, match="like must stay None"):
            used.like = value
        return
    for one in (used, new):
        setattr(one, attribute, value)
    found = results(used)
    assert found == results(new)
    # these attributes are parts of what the argument of their name says
    parts = {"fov": "fov" in getattr(used, "ranges", ()), "image_size": name == "FaceNormalizer", "times": True}
    if attribute in inspect.signature(KINDS[name][0]).parameters and not parts.get(attribute, attribute == "options"):
        alone = results(made(name, **{attribute: value}), counts=[None])
        assert found[: len(alone)] == alone


@pytest.mark.parametrize(("name", "change"), one_of_each(EDITS))
def test_results_follow_changes(name, change):
    used, new = made(name), made(name)
    results(used)
    for one in (used, new):
        CHANGES[change][1](one)
    found = results(used)
    assert found == results(new)
    assert change != "like of another model" or found == results(made(name, like=LIKE_OTHERWISE))


def test_values_that_are_set_later_are_checked():
    lens = made("RandomLens")
    for attribute, value, text in (
        ("fov", (60, 90), r"fov must be None or 'source', once it is made; got \(60, 90\). Set ranges\['fov'\]"),
        ("like", "fisheye9", "like must be a Camera, 'real', a preset"),
        ("like", "kannala_brandt", "like must have an image_size, or fov be given"),
        ("antialias", 3, "antialias must be"),
    ):
        with pytest.raises((TypeError, ValueError), match=text):
            setattr(lens, attribute, value)
    with pytest.raises(TypeError, match="does not support item assignment"):
        made("Compose").ranges["1.yaw"] = A.Range(0, 1)


@pytest.mark.parametrize("attribute", ["camera", "like"])
def test_replays_of_kornia_follow_their_cameras(attribute):
    """The change of params that were drawn before is made anew."""
    lens = camtorch.augment.kornia.RandomLens(camera(), LIKE, fov="source", min_filled=0)
    params = lens.forward_parameters(torch.Size((2, 3, *SIZE)))
    found = []
    for value in (LIKE, LIKE_OTHERWISE):
        setattr(lens if attribute == "camera" else lens.augmentation, attribute, value)
        found.append(lens.change(params if attribute == "like" else lens.forward_parameters((2, 3, *SIZE))))
    sides = [[change.source, change.target][attribute == "like"] for change in found]
    assert [type(side) for side in sides] == [ct.KannalaBrandt, ct.BrownConrady]


def project_once_unusable(one):
    numbers = one.intrinsics.data.clone()
    one.intrinsics.data[0] = -1
    one.project(torch.rand(5, 3))
    one.intrinsics.data.copy_(numbers)


OBJECTS = {
    **{name: (lambda name=name: made(name), results) for name in KINDS},
    "Seeded": (
        lambda: ct.data.Seeded(made("RandomMount"), seed=3),
        lambda one: (one(sample(), key=1), one(sample(2), key=[1, 2])),
    ),
    "numpy": (
        lambda: camtorch.augment.numpy.Transform(made("RandomLens")),
        lambda one: [one(image=np.zeros((*SIZE, 3), np.uint8), gaze=np.zeros(3)) for _ in range(2)],
    ),
    "warns": (lambda: A.RandomCamera("dms130", camera=camera()), results),
    "Dewarp": (
        lambda: ct.Dewarp(LIKE),
        lambda one: (one(torch.rand(2, 3, *SIZE)), one.grid(), one.valid_mask(), one.transform_points([[3.0, 4.0]])),
    ),
    "Warp": (
        lambda: ct.Warp(camera(), LIKE, mode="bicubic"),
        lambda one: (one(np.zeros((*SIZE, 3), np.uint8)), one.inverse(), one.to(torch.float64), one.to(torch.float32)),
    ),
    "Mixed": (
        lambda: ct.Mixed([LIKE, LIKE_OTHERWISE]),
        lambda one: (one.project(torch.rand(2, 5, 3)), one.unproject(torch.rand(2, 5, 2)), one.fov),
    ),
    "CameraHead": (
        lambda: ct.CameraHead(8, "kannala_brandt", image_size=SIZE),
        lambda one: one(torch.rand(2, 8)).project(torch.rand(2, 5, 3)),
    ),
    **{
        model: (
            lambda model=model: ct.MODELS[model].from_fov(80, image_size=SIZE),
            lambda one: (one.project(torch.rand(5, 3)), one.unproject(torch.rand(5, 2)), one.rays(), one.fov),
        )
        for model in ("pinhole", "brown_conrady", "fisheye624", "equirectangular")
    },
    "unusable": (lambda: ct.Pinhole([50.0, 50, 31.5, 23.5]), project_once_unusable),
}


def as_tensor(kind, numbers, dtype, shape, learns):
    value = torch.tensor(numbers, dtype=dtype).reshape(shape)
    return kind(value, learns) if kind is nn.Parameter else value.requires_grad_(learns)


@pytest.mark.parametrize("name", ["ranges\nSpans", "landmarks\nTable", "landmarks\nMirroring"])
def test_what_used_augmentations_of_0_4_0_hold_is_loaded(name):
    assert pickle.loads(b"\x80\x02ccamtorch.augment.%b\n)\x81}X\x01\x00\x00\x00nK\x01sb." % name.encode()).n == 1


class ByNumbers(pickle.Pickler):
    """Pickles tensors by their numbers, as the caches of Hugging Face do, and not by the place of their memory."""

    def reducer_override(self, value):
        if not isinstance(value, torch.Tensor):
            return NotImplemented
        numbers = value.detach().flatten().tolist()
        return as_tensor, (type(value), numbers, value.dtype, tuple(value.shape), value.requires_grad)


def dumped(value):
    stream = io.BytesIO()
    ByNumbers(stream).dump(value)
    return stream.getvalue()


@pytest.mark.filterwarnings("ignore::UserWarning")
@pytest.mark.parametrize("name", OBJECTS)
def test_a_call_leaves_no_trace_in_a_pickle(name):
    make, use = OBJECTS[name]
    one = make()
    before = dumped(pickle.loads(dumped(one)))
    for _ in range(2):
        use(one)
    again = pickle.loads(dumped(one))
    assert dumped(again) == before
    assert getattr(again, "last", None) is None


POINTS = torch.rand(478, 2, generator=torch.Generator().manual_seed(0)) * 40 + 2
STRIP = camera(size=(SIZE[0], 3 * SIZE[1])).crop(0, 0, *SIZE)  # its axis lies off the image
WARNINGS = {
    "fov": ("tell_of_narrow_images", lambda: A.RandomLens("kannala_brandt", fov=(120, 140), min_filled=0.9), {}),
    "fov of a preset": ("tell_of_narrow_images", lambda: A.RandomCamera("dms130", fov=(120, 140), min_filled=0.9), {}),
    "fov of real lenses": ("tell_of_narrow_images", lambda: A.RandomLens("real", fov=(120, 140), min_filled=0.9), {}),
    "min_filled": ("warn_of_unfilled", lambda: A.RandomCamera("dms130", yaw=1, pitch=1, roll=1, min_filled=0.9), {}),
    "empty": ("warn_if_empty", lambda: A.RandomCamera("dms130"), {}),
    "empty, in a chain": ("warn_if_empty", lambda: A.Compose([A.VerticalFlip(), A.RandomCamera("dms130")]), {}),
    "fov, in a chain": (
        "tell_of_narrow_images",
        lambda: A.Compose([A.HorizontalFlip(), A.RandomLens("kannala_brandt", fov=(120, 140), min_filled=0.9)]),
        {},
    ),
    "landmarks": ("order", lambda: A.HorizontalFlip(p=1), {"keypoints": POINTS}),
    "not seen": ("warn_of_numbers", A.Resize, {"keypoints": torch.tensor([[3.0, 4], [-1, -1]])}),
    "of a larger image": ("warn_of_numbers", A.Resize, {"keypoints": 9 * POINTS[:9]}),
    "parts": ("warn_of_numbers", A.Resize, {"keypoints": POINTS[:5] / 64}),
    "boxes of parts": ("warn_of_numbers", A.Resize, {"boxes": torch.tensor([[0.1, 0.2, 0.3, 0.4]])}),
    "a detector's points": (
        "warn_of_numbers",
        A.Resize,
        {"landmarks": torch.rand(5, 3) * 0.9 * torch.tensor([1, 1, -1])},
    ),
}
"""By what is wrong: the function that warns, and what makes it."""
FORMS = {
    "single": lambda fields: fields,
    "batch of one": lambda fields: {name: value[None] for name, value in fields.items()},
    "batch of four": lambda fields: {name: torch.stack([value] * 4) for name, value in fields.items()},
    "numpy": lambda fields: {name: value.numpy() for name, value in fields.items()},
}


@pytest.mark.parametrize("form", FORMS)
@pytest.mark.parametrize("name", WARNINGS)
def test_a_first_sample_of_any_form_warns_once(name, form):
    where, make, more = WARNINGS[name]
    image = torch.zeros(*SIZE, 3) if form == "numpy" else torch.zeros(3, *SIZE)
    fields = FORMS[form]({"image": image, **more})
    for is_error in (True, False):
        TOLD.clear()
        augment = make(20) if make is A.Resize else make()
        augment.camera = STRIP if name == "min_filled" else camera()
        call = camtorch.augment.numpy.Transform(augment) if form == "numpy" else augment
        if is_error:
            with pytest.raises(UserWarning) as raised:
                call(**fields)
            assert where in [entry.name for entry in raised.traceback]
        else:
            with pytest.warns(UserWarning, match=": ") as told:
                call(**fields)
            assert len(told) == 1
            call(**fields)  # warnings are errors here: none comes again


def test_every_warning_of_samples_is_in_the_table():
    found = set()
    for path in Path(A.__file__).parent.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and path.name != "ranges.py" and node.name != "__init__":
                calls = [ast.unparse(one) for one in ast.walk(node) if isinstance(one, ast.Call)]
                told = [call for call in calls if call.startswith("warn(") and "FutureWarning" not in call]
                found |= {node.name} if told else set()
    assert found == {where for where, _, _ in WARNINGS.values()}


def test_parts_of_a_chain_that_are_added_later_count():
    chain = A.Compose([A.HorizontalFlip(p=1)])
    fields = {"image": torch.zeros(3, *SIZE), "keypoints": torch.tensor([[10.0, 20], [50, 20]])}
    chain(fields)
    chain.augmentations[0] = A.HorizontalFlip(p=1, landmarks=[(0, 1)])
    assert chain(fields)["keypoints"].tolist() == [[13.0, 20], [53, 20]]
    chain.augmentations.append(A.RandomMount())
    with pytest.raises(ValueError, match="must have a camera"):
        chain(fields)
    chain.augmentations.append(A.RandomMount(yaw=(80, 80)))
    with pytest.warns(UserWarning, match="of the new images"):
        chain({**fields, "camera": camera()})


def test_replays_of_kornia_follow_ranges():
    lens = camtorch.augment.kornia.RandomLens(camera(), "kannala_brandt", fov=(80, 100), distortion=0.1, min_filled=0)
    lens(torch.rand(2, 3, *SIZE))
    params = lens._params
    lens.augmentation.ranges["fov"] = A.Range(110, 130)  # by which coefficients are measured
    new = copy.deepcopy(lens)
    assert torch.equal(lens.change(params).target.distortion, new.change(params).target.distortion)


def test_replays_of_kornia_follow_the_order_of_parts():
    flips = A.HorizontalFlip(p=0.5), A.VerticalFlip(p=0.5)
    adapter = copy.deepcopy(camtorch.augment.kornia.CameraAugmentation(A.Compose(flips), camera(), p=1))
    images = torch.rand(6, 3, *SIZE)
    adapter(images)
    params, parts = adapter._params, adapter.augmentation.augmentations
    parts[0], parts[1] = parts[1], parts[0]
    new = camtorch.augment.kornia.CameraAugmentation(A.Compose(flips[::-1]), camera(), p=1)
    assert torch.equal(adapter(images, params=params), new(images, params=params))
