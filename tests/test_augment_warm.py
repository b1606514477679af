"""How many files a warm call of an augmentation leads its reader through."""

import pytest
import torch
from test_warm_calls import entered

import camtorch as ct

# of all of camtorch: what a warp between two such cameras enters, and the augmentation's own
# among them `_portable`, whose functions do here what torch's do, `_dtypes` where torch samples, and `warp/panorama`,
# which says whether the source goes all the way round
MOST = {"webcam": 28, "dms130": 28, None: 22}
OWN = 4


@pytest.mark.parametrize("like", MOST)
def test_a_warm_call_is_a_short_way(like):
    camera = ct.Pinhole([80.0, 80.0, 79.5, 59.5], image_size=(120, 160)).requires_grad_(False)
    augmentation = ct.augment.RandomCamera(like, camera=camera, min_filled=0)
    sample = {"image": torch.rand(2, 3, 120, 160), "keypoints": torch.rand(2, 5, 2) * 100, "gaze": torch.rand(2, 3)}
    augmentation(sample)
    files = {path for path, _ in entered(augmentation, sample)}
    assert len([path for path in files if path.startswith("augment/")]) <= OWN, sorted(files)
    assert len(files) <= MOST[like], sorted(files)
