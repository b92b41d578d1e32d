"""Training of the proposal network, with the same number of steps for every source."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from numpy.typing import NDArray

from examples.train_grasp_predictor.network import UNIT_M, Proposer
from examples.train_grasp_predictor.samples import Sight, TrainedModel, each_scene

#: Clouds per step, points per cloud, and grasps per cloud.
BATCH: Final = 24
SHOWN: Final = 160
GRASPS: Final = 8
#: Weights of position, rotation, approach, and joints at grasp, pregrasp and squeeze in the loss.
COUNTS: Final = (8.0, 4.0, 1.0, 1.0, 0.2, 0.5)
#: Standard deviation of additional noise of points [m].
JITTER_M: Final = 0.001
#: Lower limit of the standard deviations of row entries; constant entries would have 0.
_LEAST: Final = 1e-3


@dataclass(frozen=True)
class Trained:
    """Trained network with the normalisation of its rows."""

    network: Proposer
    mean: NDArray[np.float32]
    """(D,) of the training rows, with positions relative to the cloud's anchor."""
    std: NDArray[np.float32]
    loss: float
    """Mean over the last tenth of the steps."""


@dataclass(frozen=True)
class TrainingData:
    """Tensors of all pictures of scenes with grasps."""

    points: torch.Tensor
    """(V, P, 3) relative to the anchor [m]."""
    normals: torch.Tensor
    height: torch.Tensor
    """(V,) height of the anchor above the table [m]."""
    rows: list[torch.Tensor]
    """(K, D) of each picture, with positions relative to its anchor."""
    label: list[torch.Tensor]
    weight: list[torch.Tensor]

    @classmethod
    def of(cls, seen: Sequence[Sight], taught: Sequence[TrainedModel]) -> TrainingData:
        """Create tensors of the pictures of scenes with grasps."""
        of_scene = {scene: (part, which) for part in taught for scene, which in each_scene(part)}
        kept = [sight for sight in seen if sight.scene in of_scene]
        rows, label, weight = [], [], []
        for sight in kept:
            part, which = of_scene[sight.scene]
            own = part.rows[which].copy()
            own[:, :3] -= sight.anchor
            rows.append(_tensor(own))
            label.append(_tensor(part.label[which]))
            weight.append(_tensor(part.weight[which]))
        points = np.stack([sight.points - sight.anchor for sight in kept])
        normals = np.stack([sight.normals for sight in kept])
        height = np.array([sight.anchor[2] for sight in kept])
        return cls(_tensor(points), _tensor(normals), _tensor(height), rows, label, weight)

    def __len__(self) -> int:
        return len(self.rows)


def train(lessons: TrainingData, *, steps: int, seed: int, rate: float = 1e-3) -> Trained:
    """Train a network on `steps` batches.

    In each batch, clouds and their grasps are rotated about the vertical; points are drawn at random and get noise.
    """
    torch.manual_seed(seed)
    everything = torch.cat([_turned_rows(rows, _angles(len(rows))) for rows in lessons.rows for _ in range(4)])
    mean, std = everything.mean(0), everything.std(0).clamp_min(_LEAST)
    weights, network = _weights(everything.shape[1]), Proposer(everything.shape[1])
    optimiser = torch.optim.AdamW(network.parameters(), lr=rate, weight_decay=1e-4)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=rate, total_steps=steps)
    late: list[float] = []
    for step in range(steps):
        clouds, height, rows, label = _batch(lessons)
        x_1 = (rows - mean) / std
        x_0, time = torch.randn_like(x_1), torch.rand(len(x_1))
        x = (1 - time[:, None]) * x_0 + time[:, None] * x_1
        seen = network.seen(clouds, height).repeat_interleave(GRASPS, dim=0)
        value = ((network.velocity(x, time, seen, label) - (x_1 - x_0)).square() * weights).mean()
        optimiser.zero_grad()
        value.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        schedule.step()
        if step >= 0.9 * steps:
            late.append(float(value.detach()))
    return Trained(network.eval(), mean.numpy(), std.numpy(), sum(late) / max(1, len(late)))


def _weights(size: int) -> torch.Tensor:
    """Return the weights (D,) of the entries of a row, with mean 1."""
    joints = (size - 12) // 3
    parts = zip(COUNTS, (3, 6, 3, joints, joints, joints), strict=True)
    weights = torch.cat([torch.full((length,), count) for count, length in parts])
    return weights / weights.mean()


def _batch(lessons: TrainingData) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor, torch.Tensor]:
    """Draw points (B, P, 7), heights (B,), rows (B G, D) and labels (B G,)."""
    chosen = torch.randint(len(lessons), (BATCH,))
    angle = _angles(BATCH)
    some = torch.randint(lessons.points.shape[1], (BATCH, SHOWN))
    points, normals = (part[chosen[:, None], some] for part in (lessons.points, lessons.normals))
    points = turned(points, angle[:, None]) + JITTER_M * torch.randn(BATCH, SHOWN, 3)
    # The anchor is the mean of all points, which differs slightly from the mean of the drawn points.
    above = (points[..., 2] + lessons.height[chosen, None])[..., None] / UNIT_M
    clouds = torch.cat([points / UNIT_M, turned(normals, angle[:, None]), above], dim=2)
    rows, label = [], []
    for view, turn in zip(chosen.tolist(), angle, strict=True):
        drawn = torch.multinomial(lessons.weight[view], GRASPS, replacement=True)
        rows.append(_turned_rows(lessons.rows[view][drawn], turn.expand(GRASPS)))
        label.append(lessons.label[view][drawn])
    return clouds, lessons.height[chosen], torch.cat(rows), torch.cat(label)


def turned(vectors: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Rotate vectors (..., 3) about the vertical by angles (...) [rad]."""
    c, s = angle.cos(), angle.sin()
    x, y, z = vectors.unbind(-1)
    return torch.stack([c * x - s * y, s * x + c * y, z.expand_as(x)], dim=-1)


def _turned_rows(rows: torch.Tensor, angle: torch.Tensor) -> torch.Tensor:
    """Rotate each row (K, D) about the vertical by its angle (K,) [rad]."""
    vectors = rows[:, :12].reshape(len(rows), 4, 3)
    return torch.cat([turned(vectors, angle[:, None]).reshape(len(rows), 12), rows[:, 12:]], dim=1)


def _angles(count: int) -> torch.Tensor:
    return 2 * torch.pi * torch.rand(count)


def _tensor(values: NDArray[np.float64]) -> torch.Tensor:
    return torch.from_numpy(np.asarray(values, np.float32))
