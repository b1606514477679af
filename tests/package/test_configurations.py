"""What builds, holds and stores our modules in others' frameworks, with the libraries themselves."""

import json
import operator

import pytest
import torch
from torch import nn

import camtorch as ct

jsonargparse = pytest.importorskip("jsonargparse")
hydra = pytest.importorskip("hydra.utils")
safetensors = pytest.importorskip("safetensors.torch")
hub = pytest.importorskip("huggingface_hub")

CAMERA = ct.KannalaBrandt([60.0, 60, 31.5, 23.5], [0.1, 0.02, 0.003, 0.001], image_size=(48, 64))
SAMPLE = {
    "image": torch.rand(3, 48, 64, generator=torch.Generator().manual_seed(0)),
    "depth": torch.full((1, 48, 64), 2.0),
    "keypoints": torch.tensor([[20.0, 15.0]]).repeat(17, 1) + torch.arange(17.0)[:, None],
    "boxes": torch.tensor([[20.0, 10.0, 40.0, 30.0]]),
    "gaze": torch.tensor([0.0, 0.6, 0.8]),
    "head_pose": torch.eye(4).index_put((torch.tensor(2), torch.tensor(3)), torch.tensor(0.6)),
}


class Node(tuple):
    """(path, keywords): what is built, `camtorch.augment.RandomMount` of its options."""


def node(path, /, **options):
    return Node((f"camtorch.{path}", options))


FILE, NUMBERS = node("Camera.load", path="camera.json"), node("KannalaBrandt", intrinsics=[60, 60, 0, 0])
PARTS = [node("augment.RandomMount", yaw=3, camera=FILE, valid_mask=True), node("augment.Resize", size=30)]
CASES = [
    node("augment.RandomMount", yaw=5, roll=[-3, 3], shift=[0.1, [0, 0.1], 0], camera=FILE, fill=[0.1, 0.2, 0.3]),
    node("augment.RandomMount", fov=[60, 70], image_size=[30, 40], vignetting=0.3, min_filled=0.5, camera=FILE),
    node("augment.RandomLens", like="dms130", fov="source", camera=FILE, fields={"gaze": "keep"}),
    node("augment.RandomLens", like=NUMBERS, fov=50, camera=node("Camera.from_dict", d=CAMERA.to_dict())),
    node("augment.RandomCamera", like="real", fov=[50, 60], cos4=0.3, chromatic=0.01, p=0.9, camera=FILE),
    node("augment.RandomShutter", readout=0.03, rates=[-30, 30], direction="up", camera=FILE),
    node("augment.BoxCrop", image_size=[32, 32], margin=0.4, zoom=[0.9, 1.1], camera=FILE),
    node("augment.FaceNormalizer", focal=100, distance=0.6, axis=[30, 31], image_size=[64, 64], camera=FILE),
    node("augment.HorizontalFlip", landmarks="coco17", p=0.9),
    node("augment.VerticalFlip", landmarks={"keypoints": [[0, 1], [2, 3]]}, p=1),
    node("augment.Resize", size=[30, 40], mode="nearest"),
    node("augment.RandomResizedCrop", size=30, scale=[0.5, 1]),
    node("augment.RandomCrop", size=20),
    node("augment.CenterCrop", size=[20, 30], padding_mode="border"),
    node("augment.Pad", padding=[1, 2]),
    node("augment.Rotate90", times=[0, 2], step=2),
    node("augment.Compose", augmentations=[node("augment.Compose", augmentations=PARTS), node("augment.VerticalFlip")]),
]


def made(value, make):
    if isinstance(value, list):
        return [made(item, make) for item in value]
    if not isinstance(value, Node):
        return value
    return make(value[0], {name: made(option, make) for name, option in value[1].items()})


def by_hand(path, options):
    return operator.attrgetter(path.removeprefix("camtorch."))(ct)(**options)


def by_jsonargparse(case):
    parser = jsonargparse.ArgumentParser(exit_on_error=False)
    parser.add_argument("--transform", type=ct.augment.Augmentation | ct.augment.FaceNormalizer)
    spec = made(case, lambda path, options: {"class_path": path, "init_args": options})
    return parser.instantiate(parser.parse_string(json.dumps({"transform": spec}))).transform


def by_hydra(case):
    return hydra.instantiate(made(case, lambda path, options: {"_target_": path, **options}))


def moved(transform, sample=SAMPLE):
    torch.manual_seed(0)
    return {**transform(sample), "camera": None} if transform.camera is not None else transform(sample)


@pytest.fixture(autouse=True)
def file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    ct.save(CAMERA, "camera.json")


@pytest.mark.parametrize("case", CASES, ids=[path for path, _ in CASES])
def test_configurations_and_tensordicts_are_as_by_hand(case):
    tensordict = pytest.importorskip("tensordict")
    transform, batch = made(case, by_hand), {name: value[None] for name, value in SAMPLE.items()}
    alone = moved(transform)
    for got, want in (
        (moved(by_jsonargparse(case)), alone),
        (moved(by_hydra(case)), alone),
        (moved(transform, tensordict.TensorDict(SAMPLE)), alone),
        (moved(transform, tensordict.TensorDict(batch, batch_size=[1])), moved(transform, batch)),
    ):
        assert got.keys() == want.keys()
        assert all(torch.equal(got[name], value) for name, value in want.items() if isinstance(value, torch.Tensor))


def test_a_default_of_a_real_lens_is_not_drawn():
    assert by_jsonargparse(node("augment.RandomCamera", like="real")).ranges.keys().isdisjoint({"focal", "crop"})


def test_an_unknown_key_is_named_with_those_that_are_known():
    for name, has in (("RandomMount", "yaw"), ("RandomLens", "distortion"), ("FaceNormalizer", "axis")):
        wrong = node(f"augment.{name}", crop=[0.9, 1])
        with pytest.raises(Exception, match=rf"{name}: unknown keyword 'crop'; .*nown are .*{has}"):
            by_hydra(wrong)
        with pytest.raises(jsonargparse.ArgumentError, match="crop"):
            by_jsonargparse(wrong)


class Head(ct.CameraHead, hub.PyTorchModelHubMixin):
    """A head in the hub by itself."""


class Network(nn.Module, hub.PyTorchModelHubMixin):
    """A network of someone who uses a head and a warp."""

    def __init__(self, features: int, image_size: list, camera: dict):
        super().__init__()
        camera = ct.Camera.from_dict(camera)
        self.head = ct.CameraHead(features, camera, image_size=image_size)
        self.dewarp = ct.Warp(camera, camera)

    def forward(self, features):
        return self.head(features)


@pytest.mark.parametrize(
    "network",
    [
        lambda: Head(8, "kannala_brandt", image_size=[480, 640], fov=[60, 120], fixed=["cx"]),
        lambda: Network(8, [48, 64], CAMERA.to_dict()),
    ],
)
def test_a_network_of_the_hub_is_saved_and_loaded(network, tmp_path):
    network = network()
    nn.init.normal_(getattr(network, "head", network).linear.weight)
    network.save_pretrained(tmp_path / "hub")
    back = type(network).from_pretrained(tmp_path / "hub")
    features = torch.rand(3, 8)
    for name in CAMERA.tensor_names:
        assert torch.equal(getattr(back(features), name), getattr(network(features), name))


MODULES = {
    "Warp of one camera": lambda: ct.Warp(CAMERA, CAMERA),
    "ShutterWarp of its values": lambda: ct.ShutterWarp(CAMERA, CAMERA.detach()),
    "Mixed": lambda: ct.Mixed([CAMERA, CAMERA, ct.Pinhole([60.0, 60, 31, 23], image_size=(48, 64))]),
    "Rig": lambda: ct.Rig({"left": CAMERA, "right": CAMERA}),
    "Compose": lambda: made(CASES[-1], by_hand),
    "network": lambda: nn.Sequential(ct.Warp(CAMERA.expand(3), CAMERA), nn.Conv2d(3, 3, 1)),
}


@pytest.mark.parametrize("make", MODULES.values(), ids=MODULES)
def test_safetensors_takes_the_state_of_every_module(make, tmp_path):
    module = make()
    safetensors.save_file(module.state_dict(), tmp_path / "state.safetensors")
    state = safetensors.load_file(tmp_path / "state.safetensors")
    assert state.keys() == module.state_dict().keys()
    assert all(torch.equal(state[name], value) for name, value in module.state_dict().items())
    module.load_state_dict(state)
    kept = module.state_dict(keep_vars=True)
    assert all(value is kept[name] for name, value in module.named_parameters(remove_duplicate=False))
