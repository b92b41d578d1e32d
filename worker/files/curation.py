"""Subsets of datasets: balanced over types, approach directions or resting faces, or most different."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import InputError, choices_text
from graspd.service.model.transforms import quat_conjugate, quat_rotate
from graspd.service.store import validity
from graspd.service.store.shards import Shard
from graspd.worker.files.provenance import hand_of_shard
from graspd.worker.grasps import Posture
from graspd.worker.quality.diversity import distinct_mask, hand_points, select_farthest

#: Categories over which grasps can be balanced.
KINDS: Final = ("type", "direction", "face")
_COLUMNS: Final = {"type": "quality/grasp_type", "direction": "quality/approach_cell"}
#: Least cosine between the down directions of two scenes, in the object frame, that belong to one face: 20 degrees.
_SAME_FACE: Final = float(np.cos(np.radians(20)))


@dataclass(frozen=True)
class Balance:
    """Balanced selection; a `Chooser` of `worker.files.subsets` for the shards of one hand and object."""

    by: Sequence[str]
    at_most: int = 0  # largest number per category; 0 for the median number over the categories
    min_distance: float = 0.0  # least distance of two selected grasps [m], see `worker.quality.diversity`; 0 for any
    seed: int = 0
    hand: str | None = None  # the hand's file if the shards do not lead to it; only distances need it
    spread: int = 0  # number of most different grasps per category, instead of `at_most` random ones; 0 for none

    def __post_init__(self) -> None:
        if unknown := [one for one in self.by if one not in KINDS]:
            choices = choices_text(unknown[0], KINDS)
            raise InputError(f"grasps cannot be balanced by {unknown[0]!r}; choose from {choices}")
        if self.spread and self.at_most:
            raise InputError("spread and at_most exclude each other: both limit the grasps per kind")
        if not self.by and not self.spread:
            raise InputError(f"choose categories to balance: {', '.join(KINDS)}")

    def __call__(self, shards: list[Shard]) -> list[NDArray[np.bool_]]:
        """Return masks of selected grasps: valid, limited per category, random or most different.
        The seed also draws the first of the most different grasps.
        Raises InputError: a shard lacks the category."""
        kinds = self._kinds(shards)
        wanted = np.concatenate([validity.valid_mask(shard.arrays) for shard in shards])
        if self.min_distance > 0 and wanted.any():
            wanted[np.flatnonzero(wanted)[~distinct_mask(self._points(shards, wanted), self.min_distance)]] = False
        _, kind = np.unique(kinds, axis=0, return_inverse=True)
        counts = np.bincount(kind.ravel()[wanted])
        limit = self.at_most or int(np.median(counts[counts > 0])) if wanted.any() else 0
        points = self._points(shards, wanted) if self.spread and wanted.any() else np.zeros(0)
        order = np.random.default_rng(self.seed).permutation(len(kinds))
        chosen = np.zeros(len(kinds), bool)
        for number in range(len(counts)):
            mine = order[(kind.ravel()[order] == number) & wanted[order]]
            if self.spread and len(mine):
                mine = mine[select_farthest(points[np.searchsorted(np.flatnonzero(wanted), mine)], self.spread)]
            chosen[mine[: self.spread or limit]] = True
        return np.split(chosen, np.cumsum([len(shard["quality/valid"]) for shard in shards])[:-1])

    def _kinds(self, shards: list[Shard]) -> NDArray[np.int64]:
        columns = [np.zeros(sum(len(shard["quality/valid"]) for shard in shards), np.int64)]
        for name in self.by:
            if name == "face":
                columns.append(face_numbers(np.concatenate([_down_directions(shard) for shard in shards])))
                continue
            if old := [shard for shard in shards if _COLUMNS[name] not in shard.arrays]:
                raise InputError(f"{old[0].path} does not record the {name} of its grasps: an older graspd made it")
            columns.append(np.concatenate([np.asarray(shard[_COLUMNS[name]], np.int64) for shard in shards]))
        return np.stack(columns, axis=1)

    def _points(self, shards: list[Shard], wanted: NDArray[np.bool_]) -> NDArray[np.float64]:
        hand = hand_of_shard(shards[0], self.hand)
        parts = [Posture.from_columns(shard.arrays) for shard in shards]
        pose = np.concatenate([part.hand_pose for part in parts])[wanted]
        joints = np.concatenate([part.joint_positions for part in parts])[wanted]
        return hand_points(hand, Posture(pose, joints))


def _down_directions(shard: Shard) -> NDArray[np.float64]:
    """Return the down direction (N, 3) in the scene of each grasp, object frame; zero for free objects."""
    if "grasp/scene_index" not in shard.arrays:
        return np.zeros((len(shard["quality/valid"]), 3))
    poses = np.asarray(shard["scene/object_pose"], float)
    down = quat_rotate(quat_conjugate(poses[:, 3:]), np.array([0.0, 0, -1.0]))
    return np.asarray(down[np.asarray(shard["grasp/scene_index"], np.intp)])


def face_numbers(down: NDArray[np.float64]) -> NDArray[np.int64]:
    """Number the faces (N,) of down directions (N, 3); a face covers 20 degrees about its first direction."""
    seen = np.zeros((0, 3))
    found = np.full(len(down), -1, np.int64)
    for row in np.flatnonzero(np.linalg.norm(down, axis=1) > 0):
        near = np.flatnonzero(seen @ down[row] > _SAME_FACE)
        if not len(near):
            seen, near = np.concatenate([seen, down[row][None]]), np.array([len(seen)])
        found[row] = near[0]
    return found
