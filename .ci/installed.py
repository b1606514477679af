"""What camtorch is for, done by an installed one with its dependencies and nothing else: `package.py` runs this."""

import importlib
import pkgutil
import subprocess
import sys
import warnings
from pathlib import Path

FISHEYE = (
    "%YAML:1.0\n---\nimage_width: 96\nimage_height: 64\nfisheye_model: 1\n"
    "K: [28, 0, 47, 0, 28, 32, 0, 0, 1]\nD: [-0.02, 0.004, -0.003, 0.0006]\n"
)
OPTIONAL = {"camtorch.augment.albumentations": "albumentations", "camtorch.augment.torchvision": "torchvision"}


def camtorch(*words: str) -> tuple[int, str, str]:
    """The status of the command as it was installed, and what it prints, on stdout and stderr."""
    done = subprocess.run(["camtorch", *words], capture_output=True, text=True)
    return done.returncode, done.stdout, done.stderr


def use(native: bool) -> None:
    """A camera from a file, its images and labels, a lens by name."""
    import torch

    import camtorch as ct
    from camtorch.native.library import native_available

    assert Path(ct.__file__).is_relative_to(sys.prefix), ct.__file__
    assert native_available() == native
    torch.manual_seed(0)
    camera = ct.load("camera.yml").camera
    image = torch.rand(1, 3, 64, 96)
    dewarp = ct.Dewarp(camera)
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        assert dewarp(image).shape == (1, 3, 64, 96)
    assert ["compiled library is not built" in str(one.message) for one in caught] == [True] * (not native)
    pixels, valid = dewarp.transform_points(torch.tensor([[47.0, 32.0]]))
    assert valid.all()
    assert dewarp.target.contains(pixels).all()
    sample = ct.augment.RandomMount(yaw=10.0, camera=camera)(image=image, keypoints=torch.tensor([[[47.0, 32.0]]]))
    assert sample["image"].isfinite().all()
    assert not torch.equal(sample["keypoints"], torch.tensor([[[47.0, 32.0]]]))
    assert len(ct.lenses.search()) > 9000
    assert ct.lenses.find("GoPro HERO9 wide").image_size


def look() -> None:
    """Every module is there; those for libraries that are not say which one they lack."""
    import camtorch

    for module in pkgutil.walk_packages(camtorch.__path__, "camtorch."):
        if module.name == "camtorch.__main__":  # it runs the command
            continue
        try:
            importlib.import_module(module.name)
        except ImportError as error:
            if OPTIONAL.get(module.name, "\n") not in str(error):
                raise


def command(native: bool) -> str:
    """What `camtorch --version` says, when another command does its work, and one says what it lacks."""
    from PIL import Image

    Image.new("RGB", (96, 64), "red").save("photo.jpg")
    status, told, error = camtorch("dewarp", "photo.jpg", "--camera", "camera.yml", "-o", "out.png")
    assert (status, error.count("\n")) == (0, not native), error  # a note, without the library
    assert "kannala_brandt dewarped to perspective" in told
    with Image.open("out.png") as image:
        assert image.size == (96, 64)
    status, _, error = camtorch("show", "camera.yml", "-o", "plot.png")
    assert (status, error.count("\n")) == (2, 1), error
    assert ".[plot]" in error, error
    assert {path.name for path in Path().iterdir()} == {"camera.yml", "photo.jpg", "out.png"}
    status, told, error = camtorch("--version")
    assert (status, error) == (0, ""), error
    assert ("CAMTORCH_NATIVE=0 when it was installed" in told) != native, told
    return told


if __name__ == "__main__":
    Path("camera.yml").write_text(FISHEYE)
    sampler = sys.argv[1] == "native"
    use(sampler)
    look()
    print(command(sampler))
