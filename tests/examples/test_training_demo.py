import numpy as np
import pytest
import torch
from PIL import Image
from scenes import cabin, training, training_data
from scenes.faces import LENSES, NAMES, SIDE, SIZE, TRAINING_SETS, Photographs, Samples

from camtorch.cli.main import main


@pytest.fixture(scope="module")
def drivers() -> cabin.Drivers:
    return cabin.random_drivers(10, torch.Generator().manual_seed(0))


@pytest.fixture(scope="module")
def seen(drivers) -> Photographs:
    camera = training_data.teacher()
    return Photographs(torch.rand(len(drivers), 3, *SIZE), training_data._points(drivers), drivers.gaze, camera)


def learned_from(name: str, seen: Photographs, seed: int = 1) -> Samples:
    torch.manual_seed(seed)
    return training_data.augmentation(name, seen)(torch.arange(len(seen.image)), torch.Generator().manual_seed(seed))


def looking(rays: torch.Tensor, pixels: torch.Tensor) -> torch.Tensor:
    """Unit rays of pixels (B, N, 2) between those of an image's corners (B, 4, 3): of faces, within a degree."""
    x, y = (pixels / (SIDE - 1))[..., None].unbind(-2)
    corners = rays[:, None]
    mixed = (1 - y) * ((1 - x) * corners[..., 0, :] + x * corners[..., 1, :]) + y * (
        (1 - x) * corners[..., 2, :] + x * corners[..., 3, :]
    )
    return torch.nn.functional.normalize(mixed, dim=-1)


@pytest.mark.parametrize("name", ["plain", "camtorch"])
def test_landmarks_learned_from_lie_where_the_cut_looks(name, seen, drivers):
    samples = learned_from(name, seen)
    whole = samples.weight > 0
    assert whole.double().mean() > 0.4
    # all turn alike: gaze, and rays of landmarks
    there = torch.nn.functional.normalize(drivers.landmarks()[:, [cabin.LANDMARKS.index(n) for n in NAMES]], dim=-1)
    cosines = (there * drivers.gaze[:, None]).sum(-1).float()
    found = (looking(samples.rays, samples.keypoints) * samples.gaze[:, None]).sum(-1)
    assert (cosines - found)[whole].abs().max() < 0.03
    inside = (samples.keypoints > -1) & (samples.keypoints < SIDE)
    assert bool(inside[whole].all())


def test_affine_turns_gaze_with_the_image(seen):
    plain, turned = (learned_from(name, seen) for name in ("plain", "affine"))
    torch.testing.assert_close(turned.gaze.norm(dim=-1), torch.ones(len(turned)))
    torch.testing.assert_close(turned.gaze[:, 2], plain.gaze[:, 2])
    assert (turned.gaze - plain.gaze).abs().max() > 0.05
    # a line through the face and the projection of gaze turn by the same angle, but for shear
    lines = [s.keypoints[:, 7] - s.keypoints[:, :4].mean(1) for s in (plain, turned)]
    before, after = (torch.atan2(line[:, 1], line[:, 0]) for line in lines)
    gaze = [torch.atan2(s.gaze[:, 1], s.gaze[:, 0]) for s in (plain, turned)]
    apart = torch.remainder((after - before) - (gaze[1] - gaze[0]) + torch.pi, 2 * torch.pi) - torch.pi
    assert apart.abs().max() < 0.25


@pytest.mark.parametrize("test", ["seen", pytest.param("mounts", marks=pytest.mark.slow), "shutter"])
def test_labels_of_tests_are_where_the_cameras_see_them(test, drivers, monkeypatch):
    """Green dots on the landmarks, which the camera sees while it turns, are found where the labels say."""
    render = cabin.render

    def dotted(camera, some, rotation):
        dots = some.landmarks()[:, [cabin.LANDMARKS.index("nose_tip")]]
        return render(camera, some, rotation, samples=1, dots=dots, dot_radius=0.006)

    monkeypatch.setattr(cabin, "render", dotted)
    samples = training_data.faces_of(drivers, test, torch.Generator().manual_seed(3))
    assert bool((samples.weight == 1).all())
    green = (samples.image[:, 1] == 1) & (samples.image[:, 0] == 0)
    rows = torch.arange(SIDE, dtype=torch.float32)
    for image, keypoints in zip(green, samples.keypoints, strict=True):
        at = torch.stack(((image * rows).sum() / image.sum(), (image * rows[:, None]).sum() / image.sum()))
        assert (at - keypoints[NAMES.index("nose_tip")]).norm() < 0.6


def test_test_lenses_are_of_several_models():
    cameras = [training_data.lens(name) for name in LENSES]
    assert {camera.image_size for camera in cameras} == {SIZE}
    assert len({camera.key for camera in cameras}) == 3
    widths = [float(torch.rad2deg(camera.field_of_view[0])) for camera in cameras]
    assert min(widths) < 75
    assert max(widths) > 140


@pytest.mark.slow
def test_learning_lowers_the_loss(seen):
    torch.manual_seed(0)
    losses = training.train(training.Network(True), 10, training_data.augmentation("plain", seen), 30, 12)
    assert len(losses) == 30
    assert sum(losses[-5:]) < 0.7 * sum(losses[:5])


@pytest.mark.slow
def test_a_small_run_by_the_command_line(tmp_path, monkeypatch, capsys):
    threads, state = torch.get_num_threads(), torch.get_rng_state()
    kept = []
    whole = training.run

    def small(report):
        kept.append(whole(report, images=8, tests=6, steps=3, seed=2))
        return kept[-1]

    monkeypatch.setattr(training, "run", small)
    for _ in range(2):
        assert main(["demo", "training", "-o", str(tmp_path / "training.png"), "--force"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert all(any(line.startswith(title) for line in lines) for title in TRAINING_SETS.values())
    assert [result.training_set for result in kept[0]] == list(TRAINING_SETS)
    for first, again in zip(*kept, strict=True):
        assert first.curves == again.curves
        assert bool(torch.isfinite(first.found[0]).all())
        assert torch.equal(first.found[1], again.found[1])
    with Image.open(tmp_path / "training.png") as image:
        assert np.asarray(image).std() > 30
    assert torch.get_num_threads() == threads
    assert torch.equal(torch.get_rng_state(), state)
