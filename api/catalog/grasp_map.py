"""Similarity of grasps by features of pose and contact, and a map of them."""

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.index.views import GraspView
from graspd.service.model.metrics import GraspType
from graspd.service.model.transforms import Floats, quat_rotate
from graspd.service.store.shards import Shard

_DIGITS: Final = 6


def features(grasps: Sequence[GraspView], shards: Sequence[Shard]) -> Floats:
    """Return features (N, F) of grasps in their base shards, in groups of zero mean and unit variance.
    Groups: position of the hand's root, its orientation (two axes), joints if all hands have the same, digits in
    contact, type."""
    rows = list(zip(shards, (one.row for one in grasps), strict=True))
    pose = np.array([shard["grasp/hand_pose"][row] for shard, row in rows], float)
    digits = np.array([int(one.digits or 0) for one in grasps])[:, None] >> np.arange(_DIGITS) & 1
    kinds = np.array([one.grasp_type or 0 for one in grasps])[:, None] == np.array(GraspType)
    groups = [pose[:, :3], np.hstack([quat_rotate(pose[:, 3:], np.eye(3)[k]) for k in (0, 2)]), digits, kinds]
    if len({str(shard.attributes.get("joint_names")) for shard in shards}) == 1:
        groups.append(np.array([shard["grasp/joint_positions"][row] for shard, row in rows], float))
    centred = [np.asarray(group - group.mean(axis=0), float) for group in (np.asarray(one, float) for one in groups)]
    return np.hstack([one / max(float(np.sqrt((one**2).sum(axis=1).mean())), 1e-9) for one in centred])


def principal_components(values: Floats) -> Floats:
    """Return the coordinates (N, 2) of centred features (N, F) on their first two principal components."""
    left, sizes, axes = np.linalg.svd(values, full_matrices=False)
    # The sign of a component is arbitrary; its largest coefficient is positive.
    signs = np.sign(axes[np.arange(len(axes)), np.abs(axes).argmax(axis=1)])
    found = np.zeros((len(values), 2))
    found[:, : len(sizes)] = (left * sizes * signs)[:, :2]
    return found


def nearest(values: Floats, row: int, count: int) -> NDArray[np.intp]:
    """Return the rows of the `count` features (N, F) nearest to those of a row, nearest first, without it."""
    order = np.argsort(np.linalg.norm(values - values[row], axis=1), kind="stable")
    return order[order != row][:count]
