"""Proposal network in PyTorch; `baselines.learned.network` runs the trained network without PyTorch.

The object's points in one picture become one feature. Conditional on this feature, a flow maps noise to grasps, so each
cloud can have any number of different proposals (conditional flow matching, Lipman et al. 2023).
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn.functional import relu, silu

#: Unit of lengths in the network's input [m].
UNIT_M = 0.1
_FREQUENCIES = 4


class Proposer(nn.Module):
    """Encoder of point clouds, and velocity of the flow from noise to grasps."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.encoder = nn.ModuleDict(
            {"0": nn.Linear(7, 64), "1": nn.Linear(64, 128), "2": nn.Linear(128, 256), "out": nn.Linear(256, 256)}
        )
        given = size + 2 * _FREQUENCIES + 256 + 2
        blocks = {str(k): nn.ModuleDict({"a": nn.Linear(512, 512), "b": nn.Linear(512, 512)}) for k in range(2)}
        self.flow = nn.ModuleDict({"in": nn.Linear(given, 512), **blocks, "out": nn.Linear(512, size)})

    def seen(self, points: torch.Tensor, height: torch.Tensor) -> torch.Tensor:
        """Encode points (B, P, 7) and the anchors' heights (B,) above the table [m] as features (B, 257)."""
        each = points
        for name in ("0", "1", "2"):
            each = relu(self.encoder[name](each))
        feature = relu(self.encoder["out"](each.max(dim=1).values))
        return torch.cat([feature, height[:, None] / UNIT_M], dim=1)

    def velocity(self, x: torch.Tensor, time: torch.Tensor, seen: torch.Tensor, label: torch.Tensor) -> torch.Tensor:
        """Return velocities (N, D) from x (N, D), time (N,), features (N, 257) and label (N,)."""
        turns = 2 * torch.pi * time[:, None] * 2.0 ** torch.arange(_FREQUENCIES)
        h = silu(self.flow["in"](torch.cat([x, turns.sin(), turns.cos(), seen, label[:, None]], dim=1)))
        for name in ("0", "1"):
            block = self.flow[name]
            h = h + block["b"](silu(block["a"](h)))
        return self.flow["out"](h)
