"""Label files of data sets, made here as their authors describe them, come out as samples that augmentations take."""

import json
import pickle
import re
import shutil
from pathlib import PureWindowsPath

import numpy as np
import pytest
import torch
from PIL import Image
from torch.utils.data import DataLoader

import camtorch as ct
from camtorch.augment.landmarks import LANDMARKS
from camtorch.data import labels

SIZE = (24, 32)
IMAGE = np.random.default_rng(0).integers(0, 255, (*SIZE, 3), np.uint8)


def picture(path, array=IMAGE):
    path.parent.mkdir(parents=True, exist_ok=True)
    Image.fromarray(array).save(path)
    return path


def points(count, seed=1):
    return np.random.default_rng(seed).uniform(2, 20, (count, 2)).round(3)


def text(path, *lines):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text("".join(f"{line}\n" for line in lines))
    return path


def row(*values):
    return " ".join(str(value) for value in np.concatenate([np.ravel(v) for v in values]).tolist())


# -- a data set of each format: what is read, and what comes out


def wflw(root):
    for name in ("0--Parade/a.png", "1--Car/b.png"):
        picture(root / "WFLW_images" / name)
    names = "0--Parade/a.png", "1--Car/b.png"
    lines = [f"{row(points(98, i))} 3 4 20 21 0 0 1 0 0 {i} {name}" for i, name in enumerate(names)]
    labels = root / "WFLW_annotations" / "list_98pt_rect_attr_train_test" / "list_98pt_rect_attr_train.txt"
    return text(labels, *lines), {"keypoints": points(98, 0), "boxes": [[3, 4, 20, 21]]}


def pts(root):
    for i in range(2):
        picture(root / f"indoor_{i}.png")
        text(root / f"indoor_{i}.pts", "version: 1", "n_points:  68", "{", *map(row, points(68, i) + 1), "}")
    return root, {"keypoints": points(68, 0)}


def mat(root):
    io = pytest.importorskip("scipy.io")
    for i in range(2):
        picture(root / f"AFW_{i}.png")
        pose = np.array([[0.3, -0.5, 0.2, 9, 8, 7, 1e-3]])
        content = {"pt2d": points(68, i).T + 1, "Pose_Para": pose, "Exp_Para": np.ones(29), "Illum_Para": [[1, 2]]}
        io.savemat(root / f"AFW_{i}.mat", {"name": "a text", **content}, do_compression=bool(i))
    return root, {"keypoints": points(68, 0)}


def coco(root):
    picture(root / "train2017" / "a.png")
    entry = {"id": 7, "file_name": "a.png", "width": 32, "height": 24, "license": 1}
    person = {"id": 1, "image_id": 7, "category_id": 1, "bbox": [2, 3, 10, 12], "iscrowd": 0, "area": 5.5}
    body = np.column_stack([points(17), np.arange(17) % 3])
    person |= {"keypoints": body.ravel().tolist(), "segmentation": [[1, 2, 3, 4, 5, 6]], "caption": 'a "[{ \\ é'}
    second = {"id": 2, "image_id": 7, "category_id": 1, "bbox": [0, 0, 1, 1], "gaze": [0, 0, -1]}
    names = ["nose", *(f"{side}_{part}" for part in "abcdefgh" for side in ("left", "right"))]
    content = {
        "info": {"year": 2017, "x": {"y": [{}]}},
        "images": [entry],
        "annotations": [person, second],
        "categories": [{"id": 1, "name": "person", "keypoints": names, "skeleton": [[1, 2]]}],
    }
    path = root / "annotations" / "person_keypoints_train2017.json"
    path.parent.mkdir()
    path.write_text(json.dumps(content, ensure_ascii=False, indent=1), encoding="utf-8")
    boxes, valid = [[1.5, 2.5, 11.5, 14.5]], np.arange(17) % 3 > 0
    return path, {"keypoints": points(17), "keypoints_valid": valid, "boxes": boxes}


def vcd(root):
    picture(root / "gA" / "face.png")
    intrinsics = {"width_px": 32, "height_px": 24, "camera_matrix": [30, 0, 16, 0, 0, 31, 12, 0, 0, 0, 1, 0]}
    stream = {"type": "camera", "uri": "gA/face.png", "stream_properties": {"intrinsics_pinhole": intrinsics}}
    face = {"bbox": [{"name": "shape", "val": [10, 11, 4, 6]}], "point2d": [{"name": "chin", "val": [3.5, 4.5]}]}
    other = {"bbox": [{"name": "shape", "val": [1, 1, 1, 1], "coordinate_system": "body_camera"}]}
    root_object = {
        "metadata": {"schema_version": "1.0.0"},
        "streams": {"face_camera": stream},
        "objects": {"0": {"name": "3", "type": "driver"}, "1": {"name": "", "type": "phone"}},
        "actions": {"4": {"name": "", "type": "gaze_zone/front"}},
        "frames": {
            "10": {"actions": {"4": {}}},
            "2": {"objects": {"0": {"object_data": face}, "1": {"object_data": other}}, "actions": {"4": {}}},
        },
    }
    path = root / "gA_1_s1_ann.json"
    path.write_text(json.dumps({"openlabel": root_object}))
    return path, {"boxes": [[8, 8, 12, 14]], "keypoints": [[3.5, 4.5]]}


SETS = {"wflw": wflw, "300w": pts, "300w_lp": mat, "coco": coco, "vcd": vcd}
TABLES = {"wflw": "wflw98", "300w": "ibug68", "300w_lp": "ibug68", "coco": "coco17"}


@pytest.fixture(params=SETS)
def dataset(request, tmp_path):
    # images are looked for up to three folders above, where another one of that name may lie
    folder = tmp_path / "one" / "of" / "three"
    folder.mkdir(parents=True)
    path, expected = SETS[request.param](folder)
    return request.param, path, expected


def test_samples_are_what_the_file_says(dataset):
    name, path, expected = dataset
    samples = ct.data.read(path)
    assert samples.format == name == ct.data.read(str(path), name).format
    assert (len(samples), samples.landmarks) == (len(list(samples)), TABLES.get(name)) == (2, TABLES.get(name))
    for field, value in ({"image": IMAGE.transpose(2, 0, 1)} | expected).items():
        found = samples[0][field]
        torch.testing.assert_close(found.double(), torch.as_tensor(np.array(value)).double(), rtol=0, atol=1e-5)
    assert samples[-1].keys() == samples[1].keys()
    for beyond in (2, -3):
        with pytest.raises(IndexError):
            samples[beyond]
    assert name in repr(samples)


def test_an_editor_of_windows_does_not_change_samples(dataset):
    name, path, expected = dataset
    for file in path.rglob("*.pts") if path.is_dir() else [path]:
        file.write_bytes(b"\xef\xbb\xbf" + file.read_bytes().replace(b"\n", b"\r\n"))
    test_samples_are_what_the_file_says((name, path, expected))


@pytest.mark.parametrize("name", [r"..\a.png", r"C:\a.png", "C:a.png", r"\a.png", "/a.png", "../a.png"])
def test_no_name_leads_out_of_a_folder_of_windows(name, tmp_path, monkeypatch):
    monkeypatch.setattr(labels, "PurePath", PureWindowsPath)
    path = text(tmp_path / "list.txt", f"{row(points(98))} {name}")
    with pytest.raises(ValueError, match="file name must lie within the folder of images"):
        ct.data.read(path)[0]


def test_augmentations_take_samples_and_mirror_them_twice_into_themselves(dataset):
    samples = ct.data.read(dataset[1])
    sample = samples[0]
    camera = sample.get("camera") or ct.Pinhole.from_fov(60, image_size=sample["image"].shape[1:])
    turned = ct.augment.RandomMount(yaw=1, min_filled=0.9, camera=camera)(sample)
    assert turned["image"].shape == sample["image"].shape
    flip = ct.augment.HorizontalFlip(p=1.0, landmarks=samples.landmarks)
    back = flip(flip(sample))
    for field in {"image", "keypoints", "boxes", "head_pose"} & sample.keys():
        torch.testing.assert_close(back[field], sample[field], atol=1e-4, rtol=0)


def test_loaders_take_samples_in_workers(dataset):
    samples = pickle.loads(pickle.dumps(ct.data.read(dataset[1])))
    loader = DataLoader(samples, batch_size=1, num_workers=2, collate_fn=list)
    for (one,), other in zip(loader, samples, strict=True):
        assert torch.equal(one["image"], other["image"])


def test_images_may_lie_elsewhere_and_are_opened_when_their_sample_is_asked_for(dataset, tmp_path):
    _, path, _ = dataset
    elsewhere = tmp_path / "elsewhere"
    elsewhere.mkdir()
    alone = shutil.copy(next(path.glob("*_0.*[tm]*")) if path.is_dir() else path, elsewhere)
    samples = ct.data.read(alone, images=tmp_path / "one" / "of" / "three")
    assert torch.equal(samples[0]["image"], ct.data.read(path)[0]["image"])
    with pytest.raises(ValueError, match="elsewhere"):
        ct.data.read(path, images=elsewhere)[0]
    with pytest.raises(FileNotFoundError, match="images must be a folder"):
        ct.data.read(path, images=tmp_path / "none")
    for image in tmp_path.rglob("*.png"):
        image.unlink()
    with pytest.raises(ValueError, match="must be in"):
        samples[0]


# -- what the formats have of their own


def test_wflw_attributes_and_lists_without_boxes(tmp_path):
    path, _ = wflw(tmp_path)
    names = ("pose", "expression", "illumination", "make_up", "occlusion", "blur")
    assert ct.data.read(path)[1]["attributes"] == dict(zip(names, (0, 0, 1, 0, 0, 1), strict=True))
    short = text(tmp_path / "list_98pt_test.txt", f"{row(points(98))} 0--Parade/a.png")
    sample = ct.data.read(short)[0]
    assert sample["keypoints"].shape == (98, 2)
    assert "boxes" not in sample


@pytest.mark.parametrize(("pitch", "yaw", "roll"), [(0, 0, 0), (0.4, 0, 0), (0, 0.5, 0), (0, 0, 0.3), (0.2, -0.7, 0.4)])
def test_head_pose_points_the_nose_where_pose_para_says(pitch, yaw, roll, tmp_path):
    io = pytest.importorskip("scipy.io")
    picture(tmp_path / "a.png")
    points = {"pt2d": np.ones((2, 21)), "pt3d_68": np.ones((3, 68)) * 5}  # as AFLW2000
    io.savemat(tmp_path / "a.mat", {**points, "Pose_Para": [[pitch, yaw, roll, 1, 2, 3, 0.1]]})
    sample = ct.data.read(tmp_path / "a.mat")[0]
    assert sample["keypoints"].tolist() == [[4, 4]] * 68
    # 3DDFA's own matrices, in its frame, y up and z out of the image
    c, s = np.cos, np.sin
    x = np.array([[1, 0, 0], [0, c(pitch), s(pitch)], [0, -s(pitch), c(pitch)]])
    y = np.array([[c(yaw), 0, -s(yaw)], [0, 1, 0], [s(yaw), 0, c(yaw)]])
    z = np.array([[c(roll), s(roll), 0], [-s(roll), c(roll), 0], [0, 0, 1]])
    turned = np.diag([1, -1, -1])
    np.testing.assert_allclose(sample["head_pose"][:3, :3], turned @ x @ y @ z @ turned, atol=1e-6)
    if roll == 0:
        nose = sample["head_pose"][:3, :3] @ torch.tensor([0.0, 0, -1])
        torch.testing.assert_close(ct.augment.to_pitch_yaw(nose), torch.tensor([pitch, yaw]).float())


def changed(path, change):
    """A file of JSON with its content changed in place."""
    content = json.loads(path.read_text(encoding="utf-8"))
    change(content)
    path.write_text(json.dumps(content, indent=1))
    return path


def test_coco_reads_cameras_and_other_fields(tmp_path):
    camera = ct.Pinhole.from_fov(70, image_size=SIZE)
    parts = {name.removeprefix("camera_"): value for name, value in ct.data.to_columns(camera).items()}
    parts = {k: v if isinstance(v, str) else v.tolist() for k, v in parts.items()}
    sample = ct.data.read(changed(coco(tmp_path)[0], lambda content: content["images"][0].update(camera=parts)))[1]
    torch.testing.assert_close(sample["camera"].intrinsics.float(), camera.intrinsics.detach())
    assert sample["gaze"].tolist() == [0, 0, -1]
    assert "keypoints" not in sample


FIVE = ["left_eye", "right_eye", "nose", "right_ear", "left_ear"]


@pytest.mark.parametrize(("names", "pairs"), [([*map(str, range(68))], LANDMARKS["ibug68"]), (FIVE, [(0, 1), (4, 3)])])
def test_coco_tables_of_other_keypoints(names, pairs, tmp_path):
    path = changed(coco(tmp_path)[0], lambda content: content["categories"][0].update(keypoints=names))
    table = ct.data.read(path).landmarks
    table = LANDMARKS[table] if isinstance(table, str) else table
    assert table == pairs if len(names) > 5 else {*map(frozenset, table)} == {*map(frozenset, pairs)}


def test_frames_of_each_camera_by_their_shift(tmp_path):
    av = pytest.importorskip("av")
    path, _ = vcd(tmp_path)
    for name in ("face.mp4", "body.mp4"):
        with av.open(str(tmp_path / name), "w") as container:
            stream = container.add_stream("mpeg4", rate=25)
            stream.width, stream.height, stream.pix_fmt = 32, 32, "yuv420p"
            for i in range(30):
                frame = av.VideoFrame.from_ndarray(np.full((32, 32, 3), 8 * i, np.uint8), format="rgb24")
                container.mux(stream.encode(frame))
            container.mux(stream.encode())
    content = json.loads(path.read_text())
    content["openlabel"]["streams"] = {
        "face_camera": {"type": "camera", "uri": "gone/face.mp4", "stream_properties": {"sync": {"frame_shift": 0}}},
        "body_camera": {"type": "camera", "uri": "body.mp4", "stream_properties": {"sync": {"frame_shift": -4}}},
        "lidar": {"type": "lidar"},
    }
    path.write_text(json.dumps(content))
    samples = ct.data.read(path)
    order = [(frame, f"{name}_camera") for frame in (2, 10) for name in ("face", "body")]
    assert [(one["frame"], one["stream"]) for one in samples] == order
    # the body's camera began four frames before the face's, and so did the numbers
    grey = [float(one["image"].float().mean()) for one in samples if one["frame"] == 10]
    assert grey == pytest.approx([8 * 6, 8 * 10], abs=4)
    assert [one["actions"] for one in samples] == [["gaze_zone/front"]] * 4
    assert samples[1]["box_names"] == ["driver/shape", "phone/shape"]
    # in frame 2 the face's had not begun; in frame 31 the body's has ended
    assert ["image" in one for one in samples] == [False, True, True, True]
    content["openlabel"]["frames"]["31"] = {}
    path.write_text(json.dumps(content))
    assert ["image" in one for one in ct.data.read(path)][-2:] == [True, False]


# -- files that are not what they should be


def message(path, index=0, format=None):
    with pytest.raises(ValueError, match=re.escape(path.name)) as caught:
        ct.data.read(path, format)[index]
    return str(caught.value)


WFLW = [
    (lambda s: "\n".join([s[0], "", s[1][:700]]), 1, ", line 3: must be 207 words, 98 points, a box"),
    (lambda s: "\n".join([s[0], "nan " + s[1].partition(" ")[2]]), 1, ", line 2: points must be 98 x 2 finite numbers"),
    (lambda s: s[0].replace(" 0 0 1 0 0 0 ", " 0 0 2 0 0 0 "), 0, ", line 1: attributes must be 0 or 1"),
    (lambda s: s[0].replace("0--Parade", "../x"), 0, "within the folder of images"),
    (lambda s: s[0].replace("0--Parade", 999 * "x"), 0, "line 1: file 'xxx"),
    (lambda s: s[0].encode("utf-16"), 0, "line 1: not text in UTF-8"),
]
PTS = [
    (lambda s: s[:300], "the file is cut short"),
    (lambda s: s.replace("{\n", "{\n1 2\n"), "line 72: must have 68 points; got 69"),
    (lambda s: s.replace("{\n", "{\n1 2 3\n"), "line 4: a point must be 2 finite numbers"),
    (lambda s: "", "line 1: must be version: 1"),
    (lambda s: s.encode() + b"\xe9", "not text in UTF-8"),
]


def test_faults_in_text_name_file_and_line(tmp_path):
    path, _ = wflw(tmp_path)
    lines = path.read_text().splitlines()
    for change, index, told in WFLW:
        content = change(lines)
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        assert told in message(path, index, "wflw")
        assert index == 0 or ct.data.read(path)[0]["keypoints"].shape == (98, 2)
    path.write_bytes(b"")
    assert len(ct.data.read(path, "wflw")) == 0
    face = pts(tmp_path / "300w")[0] / "indoor_0.pts"
    whole = face.read_text()
    for change, told in PTS:
        content = change(whole)
        face.write_bytes(content if isinstance(content, bytes) else content.encode())
        assert told in message(face)


def test_faults_in_json_name_file_and_place(tmp_path):
    path, _ = coco(tmp_path)
    whole = path.read_text(encoding="utf-8")
    for change, told in (
        ({"image_id": 8}, "image_id must be that of an image; got 8"),
        ({"image_id": "7"}, "image_id must be that of an image; got '7'"),
        ({"bbox": [1, 2, 3]}, "bbox must be 1 x 4 finite numbers"),
        ({"keypoints": [1, 2]}, "keypoints must be N x 3 finite numbers"),
        ({"keypoints": [None] * 51}, "keypoints must be N x 3 finite numbers"),
        ({"gaze": [0, True, 0]}, "gaze must be finite numbers"),
    ):
        path.write_text(whole, encoding="utf-8")
        changed(path, lambda content, change=change: content["annotations"][0].update(change))
        assert f"annotations[0]: {told}" in message(path)
    for content, told in ((whole[:-400], "no whole JSON: "), ('{"images": [1], "annotations": []}', "not as COCO")):
        path.write_text(content, encoding="utf-8")
        assert told in message(path)
    path, _ = vcd(tmp_path)
    whole = path.read_text()
    for old, new, told in (
        ("[10, 11, 4, 6]", "[10, 11, 4]", "frames.2.objects.0: bbox must be 1 x 4 finite"),
        ("[10, 11, 4, 6]", '[10, 11, 4, "a"]', "bbox must be 1 x 4 finite numbers"),
        ('"val": [10', '"value": [10', "frames.2: not as OpenLABEL has it: 'val'"),
        ("[30, 0, 16, 0, ", "[30, 0, 16, ", "intrinsics_pinhole: cannot reshape"),
        ('"frames"', '"frame"', "not as OpenLABEL has it: 'frames'"),
        ('"10": {', '"ten": {', "not as OpenLABEL has it: invalid literal"),
        (whole[-40:], "", "no whole JSON: "),
    ):
        path.write_text(whole.replace(old, new))
        assert told in message(path)


def test_faults_in_arrays_name_the_file(tmp_path):
    io = pytest.importorskip("scipy.io")
    path = mat(tmp_path / "lp")[0] / "AFW_0.mat"
    whole, pose = path.read_bytes(), np.ones((1, 7))
    for content in (whole[:300], whole[:100], b"", b"x" * 500):
        path.write_bytes(content)
        message(path)
    for arrays, told in (
        ({"pt2d": np.ones((2, 21)), "Pose_Para": pose}, "pt2d (2, 68) or pt3d_68 (3, 68), and"),
        ({"pt2d": np.ones((2, 68))}, "Pose_Para (1, 7); got"),
        ({"pt2d": np.full((2, 68), np.nan), "Pose_Para": pose}, "points must be 68 x 2 finite numbers"),
    ):
        io.savemat(path, arrays)
        assert told in message(path)


def test_a_format_that_is_not_seen_is_an_error_that_lists_them(tmp_path):
    unknown, unseen = text(tmp_path / "unknown.json", "{}"), r"format must be one of coco, wflw, 300w.* no known format"
    (tmp_path / "empty").mkdir()
    pts(tmp_path / "both")
    (tmp_path / "both" / "a.mat").touch()
    for arguments, error, told in (
        ((tmp_path / "nowhere",), FileNotFoundError, "path must exist"),
        ((unknown,), ValueError, unseen),
        ((tmp_path / "empty",), ValueError, unseen),
        ((tmp_path / "both",), ValueError, "seems to be of 300w and 300w_lp; got none"),
        ((tmp_path / "both", "coco"), ValueError, "must be a file for coco"),
    ):
        with pytest.raises(error, match=told):
            ct.data.read(*arguments)
    assert len(ct.data.read(tmp_path / "both", "300w")) == 2
