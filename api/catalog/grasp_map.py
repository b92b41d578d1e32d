"""Similarity of grasps by features of pose and contact, and a map of them: the first two principal components."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.index.views import GraspView
from graspd.service.model.metrics import GraspType
from graspd.service.model.transforms import quat_rotate
from graspd.service.store.shards import Shard

Floats = NDArray[np.float64]
_DIGITS: Final = 6
_TYPES: Final = tuple(GraspType)
#: Spread below which a feature counts as constant.
_STILL: Final = 1e-6


def features(grasps: Sequence[GraspView], shards: Sequence[Shard]) -> Floats:
    """Return standardised features (N, F) of grasps in their base shards.
    Groups of equal weight: position of the hand's root relative to the mean, its orientation (two axes), joints if all
    hands have the same, digits in contact, and type."""
    poses = np.array([shard["grasp/hand_pose"][one.row] for one, shard in zip(grasps, shards, strict=True)], float)
    axes = [quat_rotate(poses[:, 3:], np.eye(3)[k]) for k in (0, 2)]
    groups = [poses[:, :3], np.concatenate(axes, axis=1)]
    if len({str(shard.attributes.get("joint_names")) for shard in shards}) == 1:
        groups.append(
            np.array([file["grasp/joint_positions"][one.row] for one, file in zip(grasps, shards, strict=True)], float)
        )
    digits = np.array([one.digits or 0 for one in grasps], int)
    groups.append((digits[:, None] >> np.arange(_DIGITS) & 1).astype(float))
    groups.append(np.array([[one.grasp_type == kind for kind in _TYPES] for one in grasps], float))
    return np.concatenate([_standardised(group) for group in groups], axis=1)


def _standardised(group: Floats) -> Floats:
    """Return a group (N, C) with zero mean and unit total variance; zero if it is constant."""
    centred = group - group.mean(axis=0)
    spread = float(np.sqrt((centred**2).mean(axis=0).sum()))
    return centred / spread if spread > _STILL else np.zeros_like(centred)


def principal_components(values: Floats) -> tuple[Floats, Floats]:
    """Return coordinates (N, 2) on the first two principal components, and their shares (2,) of the variance."""
    if not values.any():
        return np.zeros((len(values), 2)), np.zeros(2)
    left, sizes, axes = np.linalg.svd(values, full_matrices=False)
    # The sign of a component is arbitrary; its largest coefficient is positive.
    signs = np.sign(axes[np.arange(len(axes)), np.abs(axes).argmax(axis=1)])
    found, share = np.zeros((len(values), 2)), np.zeros(2)
    kept = min(2, len(sizes))
    found[:, :kept] = (left * sizes * signs)[:, :kept]
    share[:kept] = (sizes**2 / (sizes**2).sum())[:kept]
    return found, share


def nearest(values: Floats, row: int, count: int) -> NDArray[np.intp]:
    """Return the rows of the `count` features (N, F) nearest to those of a row, nearest first, without it."""
    order = np.argsort(np.linalg.norm(values - values[row], axis=1), kind="stable")
    return order[order != row][:count]
