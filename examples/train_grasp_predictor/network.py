"""The proposal network in PyTorch: what `baselines.learned.network` reads and runs without it.

Points of an object seen by one camera become one feature; a flow carries noise to grasps that go with it, so a cloud
gets as many different proposals as one likes (conditional flow matching, Lipman et al. 2023).
"""

from __future__ import annotations

import torch
from torch import nn
from torch.nn.functional import relu, silu

#: Unit of lengths in the network's input [m].
UNIT_M = 0.1
_FREQUENCIES = 4


class Proposer(nn.Module):
    """A velocity for each of G half-made grasps of each of B clouds."""

    def __init__(self, size: int) -> None:
        super().__init__()
        self.encoder = nn.ModuleDict(
            {"0": nn.Linear(7, 64), "1": nn.Linear(64, 128), "2": nn.Linear(128, 256), "out": nn.Linear(256, 256)}
        )
        given = size + 2 * _FREQUENCIES + 256 + 2
        blocks = {str(k): nn.ModuleDict({"a": nn.Linear(512, 512), "b": nn.Linear(512, 512)}) for k in range(2)}
        self.flow = nn.ModuleDict({"in": nn.Linear(given, 512), **blocks, "out": nn.Linear(512, size)})

    def seen(self, points: torch.Tensor, height: torch.Tensor) -> torch.Tensor:
        """(B, 257) of points (B, P, 7) and of how high above the table their mean is (B,) [m]."""
        each = points
        for name in ("0", "1", "2"):
            each = relu(self.encoder[name](each))
        feature = relu(self.encoder["out"](each.max(dim=1).values))
        return torch.cat([feature, height[:, None] / UNIT_M], dim=1)

    def velocity(self, x: torch.Tensor, time: torch.Tensor, seen: torch.Tensor, label: torch.Tensor) -> torch.Tensor:
        """(N, D) from x (N, D), time (N,), what is seen (N, 257) and label (N,)."""
        turns = 2 * torch.pi * time[:, None] * 2.0 ** torch.arange(_FREQUENCIES)
        h = silu(self.flow["in"](torch.cat([x, turns.sin(), turns.cos(), seen, label[:, None]], dim=1)))
        for name in ("0", "1"):
            block = self.flow[name]
            h = h + block["b"](silu(block["a"](h)))
        return self.flow["out"](h)
