"""Network that predicts from an object's point cloud whether a hand lifts the object.

Inputs are object points relative to the hand, hand points with their distances from the object, and heights above the
table. The network extends the evaluator of 6-DOF GraspNet (Mousavian et al., ICCV 2019) to hands with joints.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import nn
from torch.nn.functional import binary_cross_entropy_with_logits

from examples.train_grasp_predictor.network import UNIT_M
from examples.train_grasp_predictor.samples import Floats, Sight
from graspd.baselines.learned.network import Proposals
from graspd.service.model.transforms import apply, quat_rotate, quat_to_matrix
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.surface import sample_surface

#: Points of the hand, and of the object, in one input.
HAND_POINTS: Final = 96
SHOWN: Final = 160
#: Upper limit of distances in the input, and their unit [m].
_FAR_M, _NEAR_M = 0.06, 0.05
#: Training steps, hands per step, and noise of points [m].
STEPS: Final = 1500
BATCH: Final = 64
JITTER_M: Final = 0.001
#: Point sets per picture, over which scores are averaged; hands per forward pass.
LOOKS: Final = 2
_TOGETHER: Final = 64


@dataclass(frozen=True)
class Hands:
    """N hands as input of the evaluator, in the table frame."""

    points: torch.Tensor
    """(N, 2, H, 3) surface points at grasp and squeeze [m]."""
    normals: torch.Tensor
    """(N, 2, H, 3)"""
    place: torch.Tensor
    """(N, 3) position of the root link [m]."""
    rotation: torch.Tensor
    """(N, 3, 3) rotation of the root link."""

    @classmethod
    def of(cls, hand: HandModel, hands: Proposals) -> Hands:
        surface = sample_surface(hand, HAND_POINTS)
        points, normals = [], []
        for joints in (hands.joints, hands.squeeze):
            bodies = body_poses(hand, hands.hand_pose, joints)[:, surface.body]
            points.append(apply(bodies, surface.position))
            normals.append(quat_rotate(bodies[..., 3:], np.broadcast_to(surface.normal, points[-1].shape)))
        pose = hands.hand_pose
        return cls(
            _tensor(np.stack(points, axis=1)),
            _tensor(np.stack(normals, axis=1)),
            _tensor(pose[:, :3]),
            _tensor(quat_to_matrix(pose[:, 3:])),
        )

    def __len__(self) -> int:
        return len(self.place)

    def take(self, which: Any) -> Hands:
        return Hands(*(part[which] for part in vars(self).values()))

    def turned_back(self, vectors: torch.Tensor) -> torch.Tensor:
        """Rotate vectors (N, ..., 3) from the table frame to the frame of the root link."""
        return torch.einsum("nji,n...j->n...i", self.rotation, vectors)


@dataclass(frozen=True)
class Attempts:
    """Hands executed for some pictures, and their outcomes."""

    points: torch.Tensor
    """(V, P, 3) object points of each picture, in the table frame [m]."""
    normals: torch.Tensor
    """(V, P, 3)"""
    picture: torch.Tensor
    """(N,) index of each hand's picture."""
    hands: Hands
    lifted: torch.Tensor
    """(N,) 0 or 1."""

    @classmethod
    def of(cls, hand: HandModel, seen: list[Sight], hands: list[Proposals], lifted: NDArray[np.bool_]) -> Attempts:
        """Create attempts from the hands of each picture; `lifted` has one value per hand, in the same order."""
        picture = np.repeat(np.arange(len(seen)), [len(one) for one in hands])
        parts = (np.concatenate([np.asarray(getattr(one, name)) for one in hands]) for name in vars(hands[0]))
        points, normals = (
            _tensor(np.stack([getattr(sight, what) for sight in seen])) for what in ("points", "normals")
        )
        return cls(points, normals, torch.from_numpy(picture), Hands.of(hand, Proposals(*parts)), _tensor(lifted))

    def and_those(self, others: Attempts) -> Attempts:
        """Return these attempts followed by others."""
        hands = Hands(
            *(
                torch.cat([part, more])
                for part, more in zip(vars(self.hands).values(), vars(others.hands).values(), strict=True)
            )
        )
        return Attempts(
            torch.cat([self.points, others.points]),
            torch.cat([self.normals, others.normals]),
            torch.cat([self.picture, others.picture + len(self.points)]),
            hands,
            torch.cat([self.lifted, others.lifted]),
        )

    def __len__(self) -> int:
        return len(self.lifted)


class Evaluator(nn.Module):
    """Network for the logit of a lift, for N hands and N point clouds."""

    def __init__(self, hand: HandModel) -> None:
        super().__init__()
        body = torch.from_numpy(np.array(sample_surface(hand, HAND_POINTS).body)).long()
        self.register_buffer("body", nn.functional.one_hot(body).float())
        self.of_hand = _points(int(self.body.shape[1]) + 14)
        self.of_object = _points(9)
        self.verdict = nn.Sequential(
            nn.Linear(512, 128),
            nn.ReLU(),
            nn.Dropout(0.3),
            nn.Linear(128, 64),
            nn.ReLU(),
            nn.Dropout(0.2),
            nn.Linear(64, 1),
        )

    def forward(self, points: torch.Tensor, normals: torch.Tensor, hands: Hands) -> torch.Tensor:
        """Return logits (N,) from object points and normals (N, P, 3)."""
        near, gaps = [], []
        for which in (0, 1):
            own, out = hands.points[:, which], hands.normals[:, which]
            apart = torch.cdist(own, points)
            distance, index = apart.min(dim=2)
            where = index[..., None].expand(-1, -1, 3)
            beside, facing = torch.gather(points, 1, where), torch.gather(normals, 1, where)
            depth = ((own - beside) * facing).sum(-1).clamp(-_NEAR_M, _NEAR_M)
            near += [_far(distance), depth / _NEAR_M, (facing * out).sum(-1), own[..., 2] / UNIT_M]
            gaps.append(_far(apart.min(dim=1).values))
        place = hands.place[:, None]
        own, out = hands.points[:, 0], hands.normals[:, 0]
        told = [self.body.expand(len(hands), -1, -1), hands.turned_back(own - place) / UNIT_M, hands.turned_back(out)]
        of_hand = self.of_hand(torch.cat([*told, torch.stack(near, dim=-1)], dim=-1))
        seen = [hands.turned_back(points - place) / UNIT_M, hands.turned_back(normals), points[..., 2:] / UNIT_M]
        of_object = self.of_object(torch.cat([*seen, torch.stack(gaps, dim=-1)], dim=-1))
        pooled = [pool for part in (of_hand, of_object) for pool in (part.max(dim=1).values, part.mean(dim=1))]
        return self.verdict(torch.cat(pooled, dim=1))[:, 0]


class Ensemble(nn.Module):
    """Mean of independently trained evaluators.
    Refinement tends to hands that one evaluator overrates, but other evaluators rarely have the same error."""

    def __init__(self, members: Iterable[nn.Module]) -> None:
        super().__init__()
        self.members = nn.ModuleList(members)

    def forward(self, points: torch.Tensor, normals: torch.Tensor, hands: Hands) -> torch.Tensor:
        """Return mean logits (N,)."""
        return torch.stack([member(points, normals, hands) for member in self.members]).mean(dim=0)


def learned(hand: HandModel, tries: Attempts, *, seed: int, steps: int = STEPS, rate: float = 2e-3) -> Evaluator:
    """Train an evaluator on `steps` batches of attempts."""
    torch.manual_seed(seed)
    evaluator = Evaluator(hand)
    optimiser = torch.optim.AdamW(evaluator.parameters(), lr=rate, weight_decay=1e-2)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, max_lr=rate, total_steps=steps)
    for _ in range(steps):
        drawn = torch.randint(len(tries), (BATCH,))
        points, normals = _looked(tries.points, tries.normals, tries.picture[drawn])
        points = points + JITTER_M * torch.randn_like(points)
        loss = binary_cross_entropy_with_logits(
            evaluator(points, normals, tries.hands.take(drawn)), tries.lifted[drawn]
        )
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
        schedule.step()
    return evaluator.eval()


def scores(evaluator: nn.Module, hand: HandModel, sight: Sight, hands: Proposals) -> Floats:
    """Return logits (N,) of hands for one picture, from fixed points of the picture."""
    found, seen = np.zeros(len(hands)), Hands.of(hand, hands)
    points, normals = _tensor(sight.points), _tensor(sight.normals)
    with torch.no_grad():
        for look in range(LOOKS):
            part = slice(look * SHOWN, (look + 1) * SHOWN)
            for first in range(0, len(hands), _TOGETHER):
                rows = slice(first, first + _TOGETHER)
                some = seen.take(rows)
                shown = (each[part].expand(len(some), -1, -1) for each in (points, normals))
                found[rows] += evaluator(*shown, some).numpy() / LOOKS
    return found


def _points(into: int) -> nn.Sequential:
    """Return a network that maps each point separately."""
    return nn.Sequential(nn.Linear(into, 64), nn.ReLU(), nn.Linear(64, 128), nn.ReLU(), nn.Linear(128, 128))


def _far(distance: torch.Tensor) -> torch.Tensor:
    return distance.clamp(max=_FAR_M) / _NEAR_M


def _looked(points: torch.Tensor, normals: torch.Tensor, which: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """Draw `SHOWN` points of each picture, with normals."""
    some = torch.randint(points.shape[1], (len(which), SHOWN))
    return points[which[:, None], some], normals[which[:, None], some]


def _tensor(values: Any) -> torch.Tensor:
    return torch.from_numpy(np.asarray(values, np.float32))
