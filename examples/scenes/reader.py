"""A small network that reads faces: where landmarks are, and which way the eyes look."""

import torch
import torch.nn.functional as F  # noqa: N812 (torch's own name for it)
from torch import Tensor, nn

from scenes.faces import NAMES, SIDE, Samples


class Network(nn.Module):
    """Samples of faces to keypoints (B, N, 2) and unit gazes (B, 3); perhaps it is told where faces are."""

    def __init__(self, with_rays: bool) -> None:
        super().__init__()
        layers: list[nn.Module] = []
        channels = (3, 16, 32, 32, 48, 64, 64)
        for inputs, outputs, stride in zip(channels, channels[1:], (2, 2, 1, 2, 1, 2), strict=False):
            layers += [nn.Conv2d(inputs, outputs, 3, stride, 1, bias=False), nn.GroupNorm(4, outputs), nn.ReLU()]
        self.see = nn.Sequential(*layers, nn.Flatten(), nn.Linear(64 * (SIDE // 16) ** 2, 128), nn.ReLU())
        self.keypoints = nn.Linear(128, 2 * len(NAMES))
        self.gaze = nn.Sequential(nn.Linear(128 + 12, 64), nn.ReLU(), nn.Linear(64, 3))
        self.with_rays = with_rays

    def forward(self, samples: Samples) -> tuple[Tensor, Tensor]:
        """Keypoints and gaze."""
        seen = self.see((samples.image - 0.5).contiguous(memory_format=torch.channels_last))
        keypoints = 20 * self.keypoints(seen).unflatten(1, (len(NAMES), 2)) + (SIDE - 1) / 2
        gaze = self.gaze(torch.cat((seen, samples.rays.flatten(1) * self.with_rays), 1))
        return keypoints, F.normalize(gaze - gaze.new_tensor([0.0, 0.0, 1.0]), dim=-1)


def loss_of(found: tuple[Tensor, Tensor], samples: Samples) -> Tensor:
    """How far off keypoints and gaze are found: a radian costs as much as 40 pixels."""
    keypoints, gaze = found
    off = F.smooth_l1_loss(keypoints, samples.keypoints, reduction="none", beta=2.0).sum(-1).mean(-1)
    off = off + 40 * (gaze - samples.gaze).norm(dim=-1)
    mean: Tensor = (off * samples.weight).sum() / samples.weight.sum().clamp(min=1)
    return mean


@torch.no_grad()
def medians(network: Network, test: Samples) -> list[float]:
    """How far keypoints are off, as a part of the distance between the eyes, and gaze, in degrees."""
    keypoints, gaze = network(test)
    eyes = (test.keypoints[:, :2].mean(1) - test.keypoints[:, 2:4].mean(1)).norm(dim=-1, keepdim=True)
    share = (keypoints - test.keypoints).norm(dim=-1) / eyes
    degrees = torch.rad2deg(2 * torch.asin((gaze - test.gaze).norm(dim=-1).clamp(max=2) / 2))
    return [round(float(share.median()), 5), round(float(degrees.median()), 3)]
