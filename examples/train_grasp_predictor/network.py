"""A small convolutional network that proposes several grasps with scores, and the loss that lets them differ.

An object has many grasps; a network with one answer would give their mean, which is none. With several answers only
the nearest to each shown grasp learns from it (Rupprecht et al., Learning in an Uncertain World, ICCV 2017), and the
scores learn how often each of them is the nearest.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Final

import torch
from torch import nn
from torch.nn.functional import cross_entropy

#: Differences that count as one: position [m], rotation columns, joints [rad].
SCALES: Final = (0.03, 0.3, 0.3)
#: Share of the loss that goes to all proposals, so that none is left behind.
RELAXED: Final = 0.05


class Predictor(nn.Module):
    """(B, 5, 64, 64) -> grasps (B, P, 9 + J) and logits of their scores (B, P)."""

    def __init__(self, joints: int, proposals: int = 16, width: int = 32) -> None:
        super().__init__()
        self.proposals, self.size = proposals, 9 + joints
        sizes = [5, width, 2 * width, 4 * width, 4 * width]
        blocks: list[nn.Module] = []
        for before, after in pairwise(sizes):
            blocks += [nn.Conv2d(before, after, 3, stride=2, padding=1), nn.GroupNorm(8, after), nn.ReLU()]
        self.encoder = nn.Sequential(*blocks, nn.Flatten(), nn.Linear(4 * width * 16, 256), nn.ReLU())
        self.head = nn.Linear(256, proposals * (self.size + 1))

    def forward(self, image: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        out = self.head(self.encoder(image)).view(len(image), self.proposals, self.size + 1)
        return torch.cat([0.1 * out[..., :3], out[..., 3:-1]], dim=-1), out[..., -1]


def distances(proposed: torch.Tensor, shown: torch.Tensor) -> torch.Tensor:
    """(B, P, G) squared distance of proposals (B, P, 9 + J) from shown grasps (B, G, 9 + J), in units of `SCALES`."""
    difference = proposed[:, :, None] - shown[:, None]
    parts = difference[..., :3], difference[..., 3:9], difference[..., 9:]
    return torch.stack([(part / scale).square().mean(-1) for part, scale in zip(parts, SCALES, strict=True)]).sum(0)


def loss(proposed: torch.Tensor, logits: torch.Tensor, shown: torch.Tensor) -> torch.Tensor:
    """Mean over the shown grasps of the nearest proposal's distance, and of the surprise that it is that one."""
    apart = distances(proposed, shown)
    nearest, which = apart.min(dim=1)
    each = (1 - RELAXED) * nearest.mean() + RELAXED * apart.mean()
    spread = logits[:, None].expand(-1, which.shape[1], -1)
    return each + 0.1 * cross_entropy(spread.reshape(-1, logits.shape[1]), which.reshape(-1))
