"""The scripts: what they measure can fail, what they learn from is labelled truly, and each writes its figure."""

import json
import math
import re
from pathlib import Path

import detect_faces
import dewarp_room
import driver_monitoring
import fisheye_depth
import numpy as np
import predict_camera
import pytest
import real_faces
import robot_cameras
import stereo_room
import surround_view
import torch
import train_faces
from boards import FOLDER, ov_plane
from PIL import Image
from scenes import cabin, crops, driver, faces, walls
from scenes.cabin import CLASSES, LANDMARKS, random_drivers, render_classes
from scenes.faces import NAMES, SIDE, Photographs, Samples

import camtorch as ct


def is_a_figure(path):
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).std() > 20


def test_a_wrong_camera_is_noticed():
    camera = ct.augment.PRESETS["dms90"].camera().double().requires_grad_(False).resize(80, 125)
    found = dewarp_room.study(camera, 76, samples=2)
    assert found.bends[0] > 0.3
    assert max(found.bends[1], found.keypoint_error) < 1e-6
    wrong = type(camera)(camera.intrinsics, 0.5 * camera.distortion, image_size=camera.image_size)
    again = ct.Dewarp(wrong, fov=76, image_size=(270, 360), rotation=dewarp_room.TILT.T).requires_grad_(False)
    off = (again(found.seen[None])[0] - found.truth)[:, found.valid].square().mean()
    assert found.psnr + 10 * math.log10(float(off)) > 3


@pytest.mark.slow
def test_dewarped_is_what_the_target_would_have_seen(tmp_path, capsys):
    studies = dewarp_room.main(str(tmp_path / "room.png"), height=240, samples=2)
    assert is_a_figure(tmp_path / "room.png")
    assert [line.split()[0] for line in capsys.readouterr().out.splitlines()[1:]] == list(dewarp_room.LENSES)
    for study in studies.values():
        assert study.valid.float().mean() > 0.9
        assert study.psnr > 25
        assert len(study.keypoints) >= 12


def test_a_head_is_found_by_landmarks(tmp_path, capsys, monkeypatch):
    found = json.loads((Path(__file__).parents[1] / "files" / "detected_faces.json").read_text())["photograph"]["dlib"]
    points = torch.tensor([found]).float()
    fields = {"keypoints": points, "boxes": torch.cat((points.amin(1), points.amax(1)), -1)}
    monkeypatch.setitem(detect_faces.DETECTORS, "dlib", (lambda image: fields, "ibug68"))
    photo = detect_faces.__file__.replace("detect_faces.py", "photographs/astronaut.jpg")
    study = detect_faces.main(photo, str(tmp_path / "faces.png"), "dlib", fov=20)
    assert is_a_figure(tmp_path / "faces.png")
    assert capsys.readouterr().out.startswith("a face 130 cm away: pitch -13, yaw -1, roll 3 degrees")
    eyes = study.normalised["keypoints"][0, 36:48].unflatten(0, (2, 6)).mean(1)  # level, at the same height
    torch.testing.assert_close(eyes, torch.tensor([[76.0, 80.0], [146.0, 80.0]]), atol=4, rtol=0)


def test_a_face_behind_a_fisheye_is_found_once():
    def find(image):
        rows, columns = (image[0] > 128).nonzero().float().unbind(-1)
        points = torch.stack((columns, rows), -1)
        faces = torch.stack((points.amin(0), points.amax(0)))[None] if len(points) else torch.zeros(0, 2, 2)
        return {"keypoints": faces, "boxes": faces.flatten(1)}

    image = torch.zeros(3, 480, 640, dtype=torch.uint8)
    image[:, 200:240, 460:500] = 255
    lens = ct.KannalaBrandt.from_fov(180, image_size=(480, 640)).requires_grad_(False)
    (face,) = detect_faces.detect(image, find, lens)["keypoints"]
    torch.testing.assert_close(face.mean(0), torch.tensor([479.5, 219.5]), atol=2, rtol=0)


def test_moved_faces_are_those_of_opencv_and_the_page_has_the_numbers():
    pytest.importorskip("cv2")
    image = torch.rand(3, 16, 16, generator=torch.Generator().manual_seed(0)).mul(255)
    image = torch.nn.functional.interpolate(image[None], size=real_faces.SIZE, mode="bicubic")[0].clamp(0, 255).byte()
    head = ct.Extrinsics([0.0, 0.0, 0.1], [0.0, 0.0, 0.6]).detach()
    points = real_faces.CAMERA.project(head(ct.augment.face_points(real_faces.LANDMARKS)))[0].float()
    sample = {"image": image, "keypoints": points, "head_pose": head.matrix(), "camera": real_faces.CAMERA}
    states = {name: real_faces.move(sample | {"rotation": torch.eye(3)}, s) for name, s in real_faces.MOVES.items()}
    for *before, moved in states.values():
        other, labels = real_faces.by_opencv([*before, moved])
        assert (labels - moved["keypoints"]).norm(dim=1).max() < 3e-4
        assert (other.int() - moved["image"].int()).abs().float().mean() < 0.2
        assert (real_faces.similar(sample, moved)[1] - moved["keypoints"]).norm(dim=1).max() < 5
    result = real_faces.measure(states["mount"][:1], lambda image: points, draws=1)
    assert result["fisheye and back"]["camtorch"][0] < 1e-4
    assert result["mount, then normalised"]["across mounts"][0] < 1e-3
    page = (Path(real_faces.__file__).parents[1] / "docs/guides/real-faces.md").read_text()
    assert set(real_faces.table(json.loads(real_faces.NUMBERS.read_text()))) <= set(page.splitlines())


@pytest.mark.slow
def test_the_room_is_measured(tmp_path):
    pytest.importorskip("cv2")
    for study in stereo_room.main(str(tmp_path / "pair.png"), 500, 2).values():
        assert study.share > 0.85
        assert study.median < 0.018
    assert is_a_figure(tmp_path / "pair.png")
    # the measurement must be able to fail: a baseline that is 3 % off
    pose = stereo_room.POSE
    wrong = ct.Extrinsics(pose.rotation, 1.03 * pose.translation).requires_grad_(False)
    seen = stereo_room.photographs(500, 2)
    assert stereo_room.study(*seen, "perspective", (110, 100), wrong).median > 0.024


@pytest.mark.slow
def test_the_car_park_comes_back(tmp_path):
    study = surround_view.study((160, 256), 0.05, 1)
    assert study.valid.double().mean() > 0.95
    assert study.error < 4
    # as it does not where it is shifted by two pixels
    off, shifted = ((truth - study.above)[:, study.valid] for truth in (study.truth, study.truth.roll(2, 1)))
    assert shifted.square().mean() > off.square().mean()
    surround_view.draw(study, str(tmp_path / "above.png"))
    assert is_a_figure(tmp_path / "above.png")


def test_an_episode_is_what_the_robot_would_have_seen(tmp_path, monkeypatch):
    simulated, robot, name = robot_cameras.SIMULATED, robot_cameras.ROBOT.resize(90, 120), robot_cameras.WRIST
    robot_cameras.save_cameras(tmp_path, {name: robot.requires_grad_(False)})
    robot = robot_cameras.load_cameras(tmp_path)[name].requires_grad_(False)
    found = robot_cameras.study(simulated, robot, 2, 2)
    assert found.valid.float().mean() > 0.95
    assert found.error < 12
    # one draw for an episode, whatever else is in the batch; another for another episode
    augment = robot_cameras.as_robot(simulated, robot, 6)
    images = found.simulated[[0, 1, 1, 0]].unflatten(0, (2, 2))
    batch = {name: images, "action": torch.rand(2, 9, 7), "task": ["a", "b"]}
    moved = augment({**batch, f"{name}_is_pad": torch.zeros(2, 2, dtype=torch.bool)}, key=torch.tensor([4, 17]))
    assert torch.equal(moved[name][1], found.drawn.flip(0))
    assert (moved[name][0] - found.drawn).abs().max() > 0.1
    assert all(moved[key] is batch[key] for key in ("action", "task"))
    monkeypatch.setitem(robot_cameras.MOUNT, "roll", robot_cameras.MOUNT["roll"] + 1)  # degree
    wrong = robot_cameras.as_robot(simulated, robot)({name: found.simulated}, key=[1, 1])[name]
    assert 255 * (wrong - found.truth)[..., found.valid].square().mean().sqrt() > 2 * found.error
    robot_cameras.draw(found, str(tmp_path / "robot.png"))
    assert is_a_figure(tmp_path / "robot.png")


@pytest.mark.parametrize(("name", "least"), [("cube", 0.7), ("ring", 0.45)])
def test_depths_of_views_are_joined_to_one_percent(name, least, tmp_path):
    camera = fisheye_depth.CAMERA.resize(120, 120).requires_grad_(False)
    views = ct.views.cube(camera) if name == "cube" else ct.views.ring(camera, 5, fov=100)
    found = fisheye_depth.study(views, samples=1)
    assert found.off.quantile(0.999) < 0.01
    assert found.share > least
    points = fisheye_depth.MOUNT(found.points) + torch.tensor([0.4, 0.1, 0.6])  # where the camera stands in the room
    beyond = torch.maximum(torch.tensor(walls.LOW) - points, points - torch.tensor(walls.HIGH))
    assert beyond.max() < 0.05
    assert (beyond.amax(-1).abs() < 0.02).double().mean() > 0.7  # most see a wall
    # of a network that answers by what it sees, here by the distances in an image; depths along z are none
    slant, seen = views.view.rays()[0][..., 2], found.truth.nan_to_num(9, 9).clamp(max=9)[None, None]
    for network, is_right in ((lambda images: images * slant, True), (lambda images: images, False)):
        distance, valid = fisheye_depth.distances(network, views, seen)
        off = ((distance - seen).abs() / seen)[valid].quantile(0.6)
        assert (off < 0.01) == is_right
    fisheye_depth.draw(found, str(tmp_path / "depth.png"))
    assert is_a_figure(tmp_path / "depth.png")


@pytest.mark.slow
def test_a_few_steps_bring_rays_nearer_to_those_of_unseen_cameras(tmp_path):
    result = predict_camera.run(steps=60, tests=60, around=4, seed=1)
    assert bool(result.found.rays()[1].all())
    assert ct.losses.rays(result.found, result.truth) < ct.losses.rays(result.prior, result.truth)
    predict_camera.draw(result, str(tmp_path / "camera.png"))
    assert is_a_figure(tmp_path / "camera.png")


@pytest.fixture(scope="module")
def drivers() -> cabin.Drivers:
    return cabin.random_drivers(10, torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def seen(drivers) -> Photographs:
    return faces.photograph(faces.teacher(), drivers)


def looks_true(samples: Samples, drivers: cabin.Drivers) -> None:
    """Landmarks lie as far from the gaze, by angle, as they do before the camera: whatever turned, all turned."""
    whole, normalize = samples.weight > 0, torch.nn.functional.normalize
    assert whole.double().mean() > 0.4
    there = normalize(faces.points_of(drivers)[:, : len(NAMES)], dim=-1)
    cosines = (there * drivers.gaze[:, None]).sum(-1).float()
    # rays between those of the image's corners: of faces, within a degree
    x, y = (samples.keypoints / (SIDE - 1))[..., None].unbind(-2)
    a, b, c, d = samples.rays[:, None].unbind(2)
    rays = normalize((1 - y) * ((1 - x) * a + x * b) + y * ((1 - x) * c + x * d), dim=-1)
    assert (cosines - (rays * samples.gaze[:, None]).sum(-1))[whole].abs().max() < 0.03
    assert bool(((samples.keypoints > -1) & (samples.keypoints < SIDE))[whole].all())


@pytest.mark.parametrize("crop", [crops.plain, crops.with_camtorch, crops.with_box_crop, crops.as_taken])
def test_labels_learned_from_are_true(crop, seen, drivers):
    samples, again = (crop(seen, torch.Generator().manual_seed(1)) for _ in range(2))
    looks_true(samples, drivers)
    assert all(torch.equal(*pair) for pair in zip(samples, again, strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("crop", [crops.plain_crops, crops.box_crops])
def test_labels_of_tests_are_true(crop, drivers):
    drivers = drivers[:5]
    lens, generator = faces.lens("aria"), torch.Generator().manual_seed(3)
    mounts = faces.mounts(lens, drivers, generator)
    still, rolling = (crop(faces.photograph(lens, drivers, mounts, r * torch.ones(5, 3))) for r in (0, faces.RATE))
    looks_true(still, drivers)
    assert torch.equal(still.rays, rolling.rays)
    assert 0.5 < (still.keypoints - rolling.keypoints).abs().max() < 10


@pytest.mark.slow
def test_a_small_run_goes_on_where_it_ended(tmp_path, monkeypatch):
    monkeypatch.setattr(train_faces, "VIEWS", dict.fromkeys(train_faces.VIEWS, 1))
    small = {"own": 10, "one": 5, "count": 5, "steps": 1, "workers": 0}
    files = tmp_path / "faces.json", tmp_path / "faces.pt"
    first = train_faces.run(*files, **small, seeds=1)
    assert first == json.loads(files[0].read_text())
    numbers = first["results"].pop("0")
    assert list(numbers) == list(train_faces.CONTESTANTS)
    assert all(list(tests) == list(train_faces.TESTS) for tests in numbers.values())
    del numbers["plain"]
    files[0].write_text(json.dumps(first | {"results": {"0": numbers}}))
    trained = []
    monkeypatch.setattr(train_faces, "train", lambda *job: trained.append(job) or numbers["camtorch"])
    kept = train_faces.run(*files, **small, seeds=1)
    assert [job[0] for job in trained] == [train_faces.CONTESTANTS["plain"]]
    assert kept["results"]["0"] == numbers | {"plain": numbers["camtorch"]}
    train_faces.draw(kept, tmp_path / "faces.png")
    assert is_a_figure(tmp_path / "faces.png")
    with pytest.raises(ValueError, match="must be of the same settings"):
        train_faces.run(*files, **small | {"steps": 2})


def test_the_page_has_the_numbers_of_the_file():
    page = Path(train_faces.__file__).parents[1] / "docs" / "guides" / "case-study.md"
    table = train_faces.table(json.loads(train_faces.NUMBERS.read_text()))
    first, rest = page.read_text().split("<details")
    assert table in rest
    rows = [line.strip("| ").split(" | ") for line in re.findall(r"^\| \d.*$", first, re.M)]
    assert len(rows) == 6
    for title, *cells in rows:
        full = [line for line in table.splitlines() if re.match(rf"\| {title}(; 4,000 steps.*)? \|", line)][-1]
        assert " | ".join(cells) == " | ".join(full.strip("| ").split(" | ")[i] for i in (1, 3, 6)), title


@pytest.fixture(scope="module")
def drivers_of_a_fisheye():
    camera = ct.KannalaBrandt.from_fov(130, image_size=(60, 80)).requires_grad_(False)
    return camera, driver_monitoring.rendered(6, camera, torch.Generator().manual_seed(0))


@pytest.mark.parametrize("way", driver_monitoring.WAYS)
def test_both_crops_have_true_labels(way, drivers_of_a_fisheye):
    """Landmarks lie as far from the gaze, by angle, as they do in the camera's image, and the box is in the middle."""
    camera, data = drivers_of_a_fisheye
    before = (camera.unproject(data["keypoints"])[0] * data["gaze"][:, None]).sum(-1)
    crop = driver_monitoring.WAYS[way]({**data, "camera": camera}, jitter=0.0)
    assert crop["image"].shape == (6, 3, SIDE, SIDE)
    if way == "look_at":
        after = (crop["camera"].unproject(crop["keypoints"])[0] * crop["gaze"][:, None]).sum(-1)
        torch.testing.assert_close(after, before, atol=1e-4, rtol=0)
        assert not torch.equal(crop["gaze"], data["gaze"])
    assert bool(((crop["keypoints"] > -1) & (crop["keypoints"] < SIDE)).all())
    assert (crop["keypoints"].mean(1) - SIDE / 2).abs().max() < SIDE / 4


@pytest.mark.slow
def test_a_small_run_measures_both_crops(tmp_path, monkeypatch):
    monkeypatch.setattr(driver_monitoring, "SIZE", (60, 80))
    found = driver_monitoring.run(images=8, count=60, steps=2)
    assert found.keys() == {"landmarks", "gaze", "head"}
    assert all(list(ways) == list(driver_monitoring.CROPS) for ways in found.values())
    driver_monitoring.draw(found, str(tmp_path / "drivers.png"))
    assert is_a_figure(tmp_path / "drivers.png")


@pytest.mark.parametrize("name", driver_monitoring.MOUNTS)
def test_regions_and_shares_are_those_of_the_car_by_each_mount(name):
    camera_from_car = driver_monitoring.camera_from_car(driver_monitoring.MOUNTS[name][0])
    driver, above = camera_from_car(torch.tensor([[0.0, 0, 0], [0, 0, 0.1]]).double())
    torch.testing.assert_close(driver[:2], torch.zeros(2).double())  # in the middle, and upright
    assert 0.4 < driver[2] < 1.2
    assert above[1] < 0
    regions, pose = driver_monitoring.Regions(), camera_from_car.matrix()
    middles = torch.stack([corners.mean(0) for corners in regions.corners])
    eyes = 0.02 * torch.randn(len(middles), 3, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    turn = pose[:3, :3].T
    found = regions.region_of((middles - eyes) @ turn, camera_from_car(eyes), pose)
    assert torch.equal(found, regions.region_of(middles - eyes, eyes))
    # what stands in front of the windscreen's middle is met first
    assert [regions.names[i] for i in found.tolist()] == [*regions.names[:-1]]
    assert regions.region_of(torch.tensor([[-1.0, 0, 0], [math.nan, 0, 1]]), torch.zeros(3)).tolist() == [-1, -1]
    gaze = torch.tensor([[0.7, -0.7, 0.0], [0.7, -0.7, 0], [1.0, 0, 0]])  # 45 degrees to the right, and ahead
    straight = torch.tensor([[0.0, 0, -1], [1, 0, 0], [0, -1, 0]])  # the nose points along -z of the head
    half = math.sqrt(0.5)
    turned = torch.tensor([[half, half, 0], [-half, half, 0], [0, 0, 1]]) @ straight
    heads = torch.stack((turned, straight, straight)).double()
    share = driver_monitoring.head_share(gaze.double() @ turn, turn.T @ heads, pose)
    torch.testing.assert_close(share, torch.tensor([1.0, 0, 0]).double(), atol=1e-6, rtol=0)


PHOTOGRAPHS = Path(__file__).parents[2] / "examples" / "photographs"


def test_the_calibration_fits_the_photograph():
    camera = ct.load(PHOTOGRAPHS / "fisheye.yml").camera.requires_grad_(False)
    with Image.open(PHOTOGRAPHS / "fisheye.jpg") as image:
        assert image.size == (camera.width, camera.height)
    views = [view["image"] for view in json.loads((FOLDER / "ov_plane.json").read_text())["train"]]
    train = ov_plane("train")
    seen = torch.tensor([1279, 799]) - train.image_points[views.index("br0_cam01-2020-05-07-14-00-30")]  # upright
    _, rms, valid = ct.solve_pnp(camera, train.object_points, seen)
    assert valid
    assert rms < 0.6
    # columns of the board lie on straight lines once it is dewarped, and do not before
    straight, on_image = ct.Dewarp(camera).transform_points(seen)

    def bend(pixels):
        columns = zip(pixels.view(22, 22, 2).transpose(0, 1), on_image.view(22, 22).T, strict=True)
        lines = [column[use] for column, use in columns if use.sum() > 5]
        return max(float(torch.linalg.svdvals(line - line.mean(0))[1]) / len(line) ** 0.5 for line in lines)

    assert bend(straight) < 1
    assert bend(seen) > 10


def test_landmarks_are_on_the_surface_that_is_seen():
    drivers = random_drivers(4, torch.Generator().manual_seed(3), spread=0.4)
    front = ["right_eye_inner", "left_eye_inner", "nose_tip", "mouth_top", "mouth_bottom", "mouth_left", "mouth_right"]
    points = drivers.landmarks()[..., [LANDMARKS.index(name) for name in front], :].float()
    local = (points - drivers.pose[:, None, :3, 3].float()) @ drivers.pose[:, :3, :3].float()
    shape = driver.Shape._make(c[:, None].float() for c in driver.shape_of(drivers.looks))
    assert driver.skin(tuple(local.unbind(-1)), shape).abs().max() < 5e-4
    camera = ct.Pinhole([80.0, 80.0, 39.5, 39.5], image_size=(80, 80)).requires_grad_(False)
    classes, at = render_classes(camera, drivers)[:, 0], camera.project(points)[0].round().long()
    kinds = torch.stack([c[p[:, 1], p[:, 0]] for c, p in zip(classes, at, strict=True)])
    assert bool(((kinds == CLASSES.index("skin")) | (kinds == CLASSES.index("eye"))).all())
    for low, marks in zip(camera.project(drivers.face_box_points())[0], camera.project(points)[0], strict=True):
        assert bool(((marks > low.amin(0) - 1) & (marks < low.amax(0) + 1)).all())
