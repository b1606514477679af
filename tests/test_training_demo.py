import numpy as np
import pytest
import torch
from PIL import Image

from camtorch.cli.main import main
from camtorch.demo import cabin, training, training_data
from camtorch.demo.training_data import PLANNED, TRAINING_SETS, Samples


@pytest.fixture(scope="module")
def seen() -> Samples:
    drivers = cabin.random_drivers(12, torch.Generator().manual_seed(0))
    return training_data.photograph(training_data.cameras()[0], drivers)


def learned_from(name: str, seen: Samples, seed: int = 1) -> Samples:
    torch.manual_seed(seed)
    return training_data.augmentation(name, *training_data.cameras())(seen, torch.Generator().manual_seed(seed))


def test_labels_learned_from_are_where_their_cameras_see_them(seen):
    for images in (seen, learned_from("camtorch", seen)):
        pixels, valid = images.camera.project(images.points)
        assert bool(valid.all())
        assert (pixels - images.keypoints).abs().max() < 0.1
        assert images.seen.float().mean() > 0.9


def test_the_planned_mount_puts_drivers_into_the_middle_of_the_fisheye():
    like = training_data.cameras()[1]
    drivers = cabin.random_drivers(3, spread=0)
    images = training_data.photograph(like, drivers, PLANNED)
    middle = images.keypoints.mean((0, 1))
    assert (middle - torch.tensor([47.5, 39.5])).abs().max() < 4
    assert bool(images.seen.all())


def test_both_augmentations_turn_and_scale_alike(seen):
    # else one of them would be at a disadvantage
    across = {}
    for name in ("camtorch", "affine"):
        keypoints = torch.cat([learned_from(name, seen, seed).keypoints for seed in range(8)])
        eyes = keypoints[:, 2:4].mean(1) - keypoints[:, :2].mean(1)
        before = seen.keypoints[:, 2:4].mean(1) - seen.keypoints[:, :2].mean(1)
        scale = eyes.norm(dim=-1) / before.norm(dim=-1).repeat(8)
        turn = torch.atan2(eyes[:, 1], eyes[:, 0]) - torch.atan2(before[:, 1], before[:, 0]).repeat(8)
        points = torch.cat([learned_from(name, seen, seed).points for seed in range(8)])
        across[name] = scale.mean(), torch.rad2deg(turn).mean(), keypoints.mean((0, 1)), points.mean((0, 1))
    (scale, turn, place, point), (flat_scale, flat_turn, flat_place, flat_point) = across.values()
    assert abs(scale / flat_scale - 1) < 0.15
    assert abs(turn - flat_turn) < 15
    assert (place - flat_place).norm() < 8
    assert (point - flat_point).norm() < 0.03


@pytest.mark.slow
def test_learning_lowers_the_loss(seen):
    torch.manual_seed(0)
    network = training.Network(seen.camera.image_size)
    losses = training.train(network, seen, lambda p, generator: p, 30, 12)
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
        assert first.losses == again.losses
        assert bool(torch.isfinite(first.pixels).all())
        assert torch.equal(first.metres, again.metres)
    with Image.open(tmp_path / "training.png") as image:
        assert np.asarray(image).std() > 30
    assert torch.get_num_threads() == threads
    assert torch.equal(torch.get_rng_state(), state)
