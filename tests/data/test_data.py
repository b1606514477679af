"""Samples by their keys: draws, batches of arrays and WebDataset's samples are the same however they are divided."""

import json
import pickle
from functools import partial

import numpy as np
import pytest
import torch
import webdataset as wds
from cameras import fisheye
from torch.utils.data import DataLoader, Dataset

import camtorch as ct
import camtorch.augment.numpy

SIZE = (24, 32)
camera = partial(fisheye, SIZE, 0.56)


def augmentation(**options):
    options = {"yaw": 8, "pitch": 8, "roll": 10, "p": 0.8, "min_filled": 0.9, "camera": camera()} | options
    return ct.augment.RandomCamera(**options)


def rows(count=4, ragged=False):
    rng = np.random.default_rng(0)
    return [
        {
            "path": f"day/{i}.jpg",
            "image": rng.integers(0, 255, (*SIZE, 3), np.uint8),
            "mask": rng.integers(0, 3, SIZE),
            "keypoints": rng.uniform(2, 20, (i % 4 if ragged else 3, 2)).astype(np.float32),
            "boxes": rng.uniform([2, 2, 10, 10], [10, 10, 20, 20], (1, 4)),
            "gaze": np.float32([0.1, 0, -1]),
            "head_pose": np.eye(4, dtype=np.float32),
            "label": i,
        }
        for i in range(count)
    ]


def column(values):
    if len({(np.shape(value), np.asarray(value).dtype.name) for value in values}) == 1:
        return np.stack(values)
    result = np.empty(len(values), object)
    for i, value in enumerate(values):
        result[i] = value
    return result


def batch(some):
    return {name: column([row[name] for row in some]) for name in some[0]}


def apart(columns):
    return [{name: column[i] for name, column in columns.items()} for i in range(len(columns["path"]))]


def assert_same(found, expected):
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert np.asarray(found[name]).dtype == np.asarray(value).dtype, name
        np.testing.assert_array_equal(found[name], value, err_msg=name)


def test_a_key_says_what_is_drawn_on_every_machine():
    draw = ct.augment.RandomMount().draw(1, ct.data.generator(("day/3.jpg", 1), seed=7, epoch=2))
    # pinned: what was drawn for a data set is to be drawn again by the next version
    assert [round(float(value), 9) for value in draw.values()] == [1.0, -0.135368969, 5.922456888, -0.341305659, 1.0]
    same = [5, np.int64(5), np.array(5), torch.tensor(5)]
    assert len({ct.data.generator(key).initial_seed() for key in same}) == 1
    others = [5, "5", (5,), (5, 0), (0, 5), 6]
    seeds = [ct.data.generator(key, seed=s, epoch=e).initial_seed() for key in others for s in (0, 1) for e in (0, 1)]
    assert len(set(seeds)) == len(seeds)
    for key in (0.5, None, b"5", True, (), ("a", None), np.arange(2)):
        with pytest.raises(TypeError, match="generator: key must identify a sample"):
            ct.data.generator(key)
    for numbers in ({"seed": -1}, {"epoch": 1 << 63}):
        with pytest.raises(ValueError, match=r"must be 0 or more, and below 2 to the 63rd; got"):
            ct.data.generator(0, **numbers)


def test_a_batch_is_drawn_as_one_by_one():
    first = ct.data.Seeded(augmentation(), seed=3)
    first.set_epoch(1)
    augment = pickle.loads(pickle.dumps(first))  # as in another process
    assert (augment.seed, augment.epoch) == (3, 1)
    assert torch.equal(augment.draw([1])["yaw"], first.draw([1])["yaw"])
    keys = torch.tensor([4, 2, 9])
    whole = augment.draw(keys)
    for i, key in enumerate(keys):
        for name, value in augment.augmentation.draw(1, augment.generator(key)).items():
            assert torch.equal(whole[name][i], value[0]), name
    images = torch.rand(3, 1, *SIZE)
    moved = augment({"image": images}, key=keys)
    single = augment(image=images[1], key=2)
    torch.testing.assert_close(moved["image"][1], single["image"], rtol=0, atol=1e-4)
    assert augment.draw([])["yaw"].shape == (0,)
    with pytest.raises(ValueError, match=r"key must be a list, one for each of 3 samples; got 2"):
        augment(image=images, key=2)
    with pytest.raises(ValueError, match="same_on_batch must be False"):
        ct.data.Seeded(augmentation(same_on_batch=True))
    with pytest.raises(TypeError, match="Seeded: augmentation must be an Augmentation"):
        ct.data.Seeded(ct.Dewarp(camera()))
    with pytest.raises(TypeError, match="key must be a single one"):
        ct.data.Seeded(camtorch.augment.numpy.Transform(augmentation()))(image=images.numpy(), key=[1, 2, 3])


class Images(Dataset):
    def __init__(self):
        self.augment = ct.data.Seeded(augmentation(), seed=1)

    def __len__(self):
        return 6

    def __getitem__(self, index):
        moved = self.augment(image=torch.linspace(0, 1, 768).reshape(1, *SIZE), key=index)
        return {"image": moved["image"], "index": index}


@pytest.mark.filterwarnings("ignore:.*fork.*:DeprecationWarning")
def test_workers_that_persist_hear_of_the_epoch():
    if "fork" not in torch.multiprocessing.get_all_start_methods():
        pytest.skip("this system cannot fork")
    data = Images()
    options = {"num_workers": 2, "multiprocessing_context": "fork", "persistent_workers": True}
    loader = DataLoader(data, batch_size=2, shuffle=True, **options)
    epochs = []
    for epoch in (0, 1, 0):
        data.augment.set_epoch(epoch)
        found = {int(i): image for b in loader for i, image in zip(b["index"], b["image"], strict=True)}
        assert all(torch.equal(found[i], data[i]["image"]) for i in range(len(data)))
        epochs.append(torch.stack([found[i] for i in range(len(data))]))
    assert torch.equal(epochs[0], epochs[2])
    assert not torch.equal(epochs[0], epochs[1])


@pytest.mark.parametrize("ragged", [False, True])
def test_rows_are_the_same_in_every_batch(ragged):
    some = rows(ragged=ragged)
    function = ct.data.MapBatches(augmentation(), key="path", seed=4, epoch=1)
    whole = function(batch(some))
    assert whole["image"].dtype == np.uint8
    assert whole["image"].shape == (len(some), *SIZE, 3)
    assert whole["mask"].dtype == np.int64
    assert whole["boxes"].dtype == np.float64
    assert (whole["keypoints"].dtype == object) == ragged
    assert whole["label"].tolist() == list(range(len(some)))
    for size in (1, 3):
        order = np.random.default_rng(size).permutation(len(some))
        for start in range(0, len(some), size):
            part = [some[i] for i in order[start : start + size]]
            for moved, i in zip(apart(function(batch(part))), order[start : start + size], strict=True):
                assert_same(moved, apart(whole)[i])
    transform = camtorch.augment.numpy.Transform(augmentation())
    for moved, row in zip(apart(whole), some, strict=True):
        fields = {name: row[name] for name in row.keys() - {"path", "label"}}
        alone = transform(fields, generator=ct.data.generator(row["path"], seed=4, epoch=1))
        new = alone.pop("camera")
        assert_same({name: moved[name] for name in alone}, alone)
        assert ct.data.from_columns(moved).intrinsics.tolist() == new.intrinsics.tolist()
    function.set_epoch(2)
    assert not np.array_equal(function(batch(some))["rotation"], whole["rotation"])


def test_rows_have_cameras_of_their_own():
    cameras = [camera(), ct.Pinhole.from_fov(70, image_size=SIZE).double(), camera(dtype=torch.float64)]
    some = [row | ct.data.to_columns(one) for row, one in zip(rows(3), cameras, strict=True)]
    moved = ct.data.MapBatches(augmentation(camera=None), key=["path", "label"], seed=1)(batch(some))
    for i, (row, one) in enumerate(zip(some, cameras, strict=True)):
        assert ct.data.from_columns(row).intrinsics.dtype == one.intrinsics.dtype
        generator = ct.data.generator((row["path"], i), seed=1)
        alone = augmentation(camera=one.requires_grad_(False))(gaze=torch.from_numpy(row["gaze"]), generator=generator)
        now = ct.data.from_columns({name: values[i] for name, values in moved.items()})
        assert type(now) is type(one)
        assert torch.equal(now.intrinsics, alone["camera"].intrinsics)
        assert torch.equal(now.distortion, alone["camera"].distortion)
        assert moved["gaze"][i].tolist() == alone["gaze"].tolist()
    listed = ct.data.from_columns(moved)
    assert [type(one) for one in listed] == [type(one) for one in cameras]
    columns = ct.data.to_columns(ct.augment.collate([camera(), camera()]))
    assert tuple(ct.data.from_columns(columns).batch_shape) == (2,)


def test_a_warp_of_one_camera_for_all_rows():
    learns = ct.KannalaBrandt(camera().intrinsics, camera().distortion.clone(), image_size=SIZE)
    dewarp = ct.Dewarp(learns, rotation=ct.augment.mount_rotation(*torch.tensor([10.0, 0, 0])))
    some = rows()
    moved = ct.data.MapBatches(dewarp)(batch(some))
    images = torch.from_numpy(batch(some)["image"]).permute(0, 3, 1, 2)
    assert np.array_equal(moved["image"], dewarp(images).permute(0, 2, 3, 1).numpy())
    assert np.array_equal(moved["rotation"][0], dewarp.rotation.numpy())
    turned = moved["head_pose"][0][:3, :3]
    np.testing.assert_allclose(turned, dewarp.rotation, atol=1e-6)
    assert (moved["camera_model"] == "pinhole").all()

    shutter = ct.RollingShutter(0.03, torch.tensor([0.5, 6.0, 1.0], requires_grad=True) * 1)
    target = ct.Pinhole([18.0, 18.0, 15.5, 11.5], image_size=SIZE)
    warp = ct.ShutterWarp(camera(), target, shutter=shutter)
    some = batch(rows())
    moved = pickle.loads(pickle.dumps(ct.data.MapBatches(warp)))(some)
    expected, _ = warp.transform_points(torch.from_numpy(some["keypoints"]))
    np.testing.assert_array_equal(moved["keypoints"], expected.detach().numpy().astype(np.float32))
    images = torch.from_numpy(some["image"]).permute(0, 3, 1, 2)
    assert np.array_equal(moved["image"], warp(images).permute(0, 2, 3, 1).detach().numpy())
    assert not np.array_equal(moved["image"], ct.data.MapBatches(ct.Warp(camera(), target))(some)["image"])


def test_columns_as_engines_hand_them_over():
    some = rows(3)
    whole = batch(some)
    for array in whole.values():
        array.setflags(write=False)
    function = ct.data.MapBatches(augmentation(fields={"score": "keep"}), key="path", fields={"nose": "keypoints"})
    expected = function(whole)
    nested = np.empty(3, object)  # lists in lists, as Arrow has them
    for i, row in enumerate(some):
        nested[i] = np.empty(3, object)
        for j, point in enumerate(row["keypoints"]):
            nested[i][j] = point
    given = whole | {"keypoints": nested, "path": list(whole["path"]), "none": [None] * 3, "camera": ["left"] * 3}
    given["nose"], given["score"] = whole["keypoints"], np.ones((3, 2))
    found = function(given)
    assert np.array_equal(found["image"], expected["image"])
    assert np.array_equal(found["score"], given["score"])
    for i in range(3):
        assert np.array_equal(found["keypoints"][i], expected["keypoints"][i])
        assert np.array_equal(found["nose"][i], expected["keypoints"][i])
        assert np.array_equal(found["nose_valid"][i], expected["keypoints_valid"][i])
    empty = function({name: values[:0] for name, values in whole.items()})
    assert {name: len(values) for name, values in empty.items()} == dict.fromkeys(whole, 0)


def test_wrong_batches_are_told():
    function = ct.data.MapBatches(augmentation(), key="path")
    some = batch(rows(2))
    for change, message in (
        ({"label": [1]}, "all columns must have as many rows"),
        ({"image": some["image"][:, :12]}, r"sample 'day/0.jpg': RandomCamera: image must be of .* got \(12, 32\)"),
        ({"score": np.ones((2, 3))}, "'score' must have a kind"),
        ({"camera_intrinsics": np.ones((2, 4))}, r"the camera must have model; got none. ct.data.to_columns makes all"),
        ({"camera_intrinsics": np.ones((2, 4)), "camera_model": ["x"] * 2}, "one of brown_conrady, .*; got 'x'"),
    ):
        with pytest.raises(ValueError, match=message):
            function({name: some[name] for name in ("path", "image")} | change)
    with pytest.raises(ValueError, match="must have the column 'path'; got image"):
        function({"image": some["image"]})
    with pytest.raises(TypeError, match='as of batch_format="numpy"; got list'):
        function([1])
    with pytest.raises(ValueError, match='key must name the column that identifies a row, as in key="path"'):
        ct.data.MapBatches(augmentation())
    ground = ct.BirdsEye(camera(), ct.Extrinsics([2.0, 0, 0], [0, 0, 2.0]), x=(-1, 1), y=(1, 3), resolution=0.1)
    linear, says = torch.nn.Linear(1, 1), "transform must be an augmentation or a Warp; got Linear"
    for transform, message in ((linear, says), (ground, "must move labels too; got BirdsEye")):
        with pytest.raises(TypeError, match=message):
            ct.data.MapBatches(transform)


def write_shards(folder, some, count):
    paths = [folder / f"{count}-{i}.tar" for i in range(count)]
    for i, path in enumerate(paths):
        with wds.TarWriter(str(path)) as tar:
            for row in some[i::count]:
                labels = {name: row[name].tolist() for name in ("keypoints", "boxes", "gaze", "head_pose")}
                labels |= {"name": "somebody", "keypoints_valid": [True, False, True]}
                entries = {"__key__": row["path"].removesuffix(".jpg"), "png": row["image"], "json": labels}
                tar.write(entries | {"mask.png": row["mask"].astype(np.uint8), "cls": row["label"]})
    return [str(path) for path in paths]


def moved_shards(paths, **options):
    read = wds.autodecode.imagehandler("l8")
    handlers = [wds.handle_extension("mask.png", lambda data: np.asarray(read("png", data)))]
    shards = wds.WebDataset(paths, shardshuffle=False, empty_check=False).decode(*handlers, "rgb8")
    function = ct.data.MapSamples(augmentation(**options), seed=2)
    return {sample["__key__"]: sample for sample in shards.map(function)}


# webdataset leaves that to the collector
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
def test_shards_are_the_same_however_they_are_divided(tmp_path):
    some = rows()
    whole, parts = (moved_shards(write_shards(tmp_path, some, count)) for count in (1, 3))
    assert whole.keys() == parts.keys()
    transform = camtorch.augment.numpy.Transform(augmentation())
    for row in some:
        key = row["path"].removesuffix(".jpg")
        sample = whole[key]
        assert {name for name in sample if not name.startswith("__")} == {"png", "mask.png", "json", "cls"}
        fields = {name: row[name] for name in ("image", "mask", "gaze", "head_pose")}
        fields["keypoints"] = row["keypoints"].astype(np.float64)
        alone = transform(fields, generator=ct.data.generator(key, seed=2))
        assert np.array_equal(sample["png"], alone["image"])
        assert np.array_equal(sample["mask.png"], alone["mask"])
        assert sample["mask.png"].ndim == 2
        assert sample["json"]["keypoints"] == alone["keypoints"].tolist()
        assert sample["json"]["keypoints_valid"] == (alone["keypoints_valid"] & [True, False, True]).tolist()
        assert np.array_equal(sample["png"], parts[key]["png"])
        assert json.dumps(sample["json"]) == json.dumps(parts[key]["json"])
        assert sample["json"]["name"] == "somebody"


@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
def test_what_comes_out_is_written_and_read_again(tmp_path):
    (path,) = write_shards(tmp_path, rows(2), 1)
    moved = moved_shards([path], valid_mask=True)
    with wds.TarWriter(str(tmp_path / "new.tar")) as tar:
        for sample in moved.values():
            tar.write(sample)
    back = {s["__key__"]: s for s in wds.WebDataset(str(tmp_path / "new.tar"), shardshuffle=False).decode("rgb8")}
    for key, sample in moved.items():
        assert np.array_equal(back[key]["png"], sample["png"])
        assert np.array_equal(back[key]["image_valid.npy"], sample["image_valid.npy"])
        assert back[key]["json"] == sample["json"]
        entries = {"__key__": key, "png": sample["png"], "json": sample["json"]}
        again = ct.data.MapSamples(augmentation(camera=None))(entries)
        assert again["json"]["camera"]["model"] == "kannala_brandt"


def test_wrong_samples_are_told():
    function = ct.data.MapSamples(augmentation())
    sample = {"__key__": "a", "jpg": rows(1)[0]["image"], "json": {}}
    for change, message in (
        ({"jpg": b"JFIF"}, r'jpg must be decoded; got bytes. Add .decode\("rgb8"\) before .map'),
        ({"jpg": torch.zeros(3, *SIZE)}, "jpg must be a numpy array; got Tensor"),
        ({"json": b"{}"}, "json must be an object of labels; got bytes. Add .decode"),
        ({"left.png": sample["jpg"][..., 0]}, "left.png must have a kind; got none. Pass fields={'left.png': KIND}"),
        ({"left.png": sample["jpg"]}, "'left' must have a kind, .* fields={'left': KIND}"),
        ({"png": sample["jpg"]}, "png and jpg both hold image"),
        ({"json": {"keypoints": [[1, 2], [3]]}}, "keypoints must be numbers in lists of one length"),
        ({"json": {"keypoints": [[10**400, 2]]}}, "keypoints must be numbers in lists of one length"),
        ({"json": {"scores": [0.5]}}, "'scores' must have a kind"),
        ({"json": {"camera": {"model": "pinhole"}}}, "the camera must have intrinsics"),
    ):
        with pytest.raises((TypeError, ValueError), match=message):
            function(sample | change)
    with pytest.raises(ValueError, match="must have '__key__'; got jpg"):
        function({"jpg": sample["jpg"]})
    with pytest.raises(TypeError, match=r"must be a dict of entries, before .to_tuple; got tuple"):
        function(("jpg",))
    function = ct.data.MapSamples(augmentation(), fields={"nose": "keypoints"})
    none = {name: [] for name in ("keypoints", "polygons", "gaze", "points", "pitch_yaw")}
    empty = function(sample | {"json": {**none, "boxes": None, "nose": []}})
    assert {name: empty["json"][name] for name in (*none, "boxes")} == {**none, "boxes": None}
