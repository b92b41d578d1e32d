"""Sets of grasps of one hand on one object: output of planners, input of quality, scenes and shards."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from graspd.service.model.transforms import Floats

Columns = Mapping[str, NDArray[Any]]
#: The only quality column of a base shard that does not have one row per grasp.
THRESHOLDS: Final = "quality/thresholds_m"
#: Columns of grasps in scenes; either all of them are present or none.
_IN_SCENES: Final = ("scene_index", "approach", "approach_joint_positions", "lift")
#: Postures of every `GraspSet`, and its arrays that exist only in scenes, with one row per grasp.
_POSTURES: Final = ("grasp", "pregrasp", "squeeze")
_ARRAYS: Final = ("approach", "coming", "scene", "wrist")

#: Grid step of positions [m]. Doubles represent its multiples exactly up to 8,388 km. Grasps on the grid therefore move
#: to the frame of a file and back with identical bits.
GRID_M: Final = 2.0**-30


def round_to_grid(positions: ArrayLike) -> Floats:
    return np.rint(np.asarray(positions, float) / GRID_M) * GRID_M


def move_poses(pose: ArrayLike, by: ArrayLike) -> Floats:
    """Move poses (..., 7) by a vector (3,) in their parent's frame, and round positions to the grid."""
    pose = np.array(pose, float)
    pose[..., :3] = round_to_grid(pose[..., :3] + np.asarray(by, float))
    return pose


@dataclass
class Posture:
    """N hand postures in the object frame."""

    hand_pose: Floats
    """(N, 7) pose of the hand's root link in the object frame: x y z, then quaternion w x y z."""
    joint_positions: Floats
    """(N, J) positions of all moving joints in `HandModel.joint_names` order [rad or m]."""

    def __len__(self) -> int:
        return len(self.hand_pose)

    def take(self, rows: NDArray[np.intp] | slice) -> Posture:
        return Posture(np.asarray(self.hand_pose, float)[rows], np.asarray(self.joint_positions, float)[rows])

    def moved(self, by: ArrayLike) -> Posture:
        return Posture(move_poses(self.hand_pose, by), self.joint_positions)

    @classmethod
    def from_columns(cls, columns: Columns, name: str = "grasp") -> Posture:
        """Return the postures called `name` (grasp, pregrasp or squeeze) of a base shard."""
        pose, joints = (np.asarray(columns[f"{name}/{what}"], float) for what in ("hand_pose", "joint_positions"))
        return cls(pose, joints)


@dataclass
class GraspSet:
    """N grasps with the postures before and after contact and the planner's loss."""

    grasp: Posture
    pregrasp: Posture
    squeeze: Posture
    stability_loss: Floats
    """(N,) L_stable of the planner; nan where the planner has none."""
    seconds: float = 0.0
    info: dict[str, object] = field(default_factory=dict)
    """Records of the planner: loss curves, iteration counts. JSON values only."""
    approach: Floats | None = None
    """(N, W, 7) hand poses from standoff to pregrasp, with joint positions `coming`; only in scenes."""
    coming: Floats | None = None
    """(N, J) joint positions of the open hand on its approach; only in scenes."""
    scene: NDArray[np.intp] | None = None
    """(N,) number of each grasp's scene; only in scenes."""
    lift: Posture | None = None
    """N squeeze postures moved up against gravity; only in scenes."""
    wrist: Floats | None = None
    """(N, K) wrist angles above the hand's root, in the order of `HandModel.mounting.joint_names` [rad].
    Only in scenes, for hands with a wrist."""
    attempts: int = 0
    """Number of starts for the whole set, retries included; 0 if not reported."""

    def __len__(self) -> int:
        return len(self.grasp)

    @property
    def is_finite(self) -> NDArray[np.bool_]:
        """(N,) whether all numbers of a grasp's postures are finite."""
        parts = (self.grasp, self.pregrasp, self.squeeze)
        rows = np.concatenate([array for part in parts for array in (part.hand_pose, part.joint_positions)], axis=1)
        return np.asarray(np.isfinite(rows).all(axis=1))

    def take(self, rows: NDArray[np.intp] | slice) -> GraspSet:
        """Return some of the grasps, in the order of `rows`; the planner's info still covers the whole set."""
        changed: dict[str, Any] = {}
        for name in (*_POSTURES, "lift", "stability_loss", *_ARRAYS):
            if (part := getattr(self, name)) is not None:
                changed[name] = part.take(rows) if isinstance(part, Posture) else np.asarray(part)[rows]
        return replace(self, **changed, attempts=0)

    def moved(self, by: ArrayLike) -> GraspSet:
        """Return the grasps and trajectories moved by a vector (3,) [m], to a frame with another origin."""
        postures = {name: getattr(self, name).moved(by) for name in _POSTURES}
        approach = None if self.approach is None else move_poses(self.approach, by)
        return replace(self, **postures, approach=approach, lift=None if self.lift is None else self.lift.moved(by))

    def to_columns(self) -> dict[str, NDArray[Any]]:
        """Return the posture columns of a base shard; the planner's loss belongs to the quality table."""
        parts = {"grasp": self.grasp, "pregrasp": self.pregrasp, "squeeze": self.squeeze}
        columns: dict[str, NDArray[Any]] = {f"{name}/hand_pose": part.hand_pose for name, part in parts.items()}
        columns |= {f"{name}/joint_positions": part.joint_positions for name, part in parts.items()}
        if self.scene is None or self.approach is None or self.coming is None or self.lift is None:
            return columns
        if self.wrist is not None:
            columns["grasp/wrist_positions"] = self.wrist
        return columns | {
            "grasp/scene_index": self.scene,
            "grasp/approach": self.approach,
            "grasp/approach_joint_positions": self.coming,
            "grasp/lift": self.lift.hand_pose,
        }

    @classmethod
    def from_columns(cls, columns: Columns) -> GraspSet:
        """Load the grasps from the columns of a base shard."""
        grasp, pregrasp, squeeze = (Posture.from_columns(columns, name) for name in ("grasp", "pregrasp", "squeeze"))
        found = cls(grasp, pregrasp, squeeze, np.asarray(columns["quality/stability_loss"], float))
        if all(f"grasp/{name}" in columns for name in _IN_SCENES):
            found.scene = np.asarray(columns["grasp/scene_index"], np.intp)
            found.approach = np.asarray(columns["grasp/approach"], float)
            found.coming = np.asarray(columns["grasp/approach_joint_positions"], float)
            raised = np.asarray(columns["grasp/lift"], float)
            found.lift = Posture(raised, np.array(found.squeeze.joint_positions))
            if "grasp/wrist_positions" in columns:
                found.wrist = np.asarray(columns["grasp/wrist_positions"], float)
        return found


def join_grasp_sets(sets: Sequence[GraspSet]) -> GraspSet:
    """Join several sets of one hand on one object; the first set provides the info."""
    whole: dict[str, Any] = {"seconds": sum(one.seconds for one in sets), "info": dict(sets[0].info)}
    for name in (*_POSTURES, "lift", "stability_loss", *_ARRAYS):
        parts = [getattr(one, name) for one in sets]
        if all(part is not None for part in parts):
            whole[name] = _join_postures(parts) if isinstance(parts[0], Posture) else np.concatenate(parts)
    return GraspSet(**whole)


def join_columns(parts: Sequence[Columns]) -> dict[str, NDArray[Any]]:
    """Join base columns of several sets; all sets have the same thresholds."""
    return {
        path: parts[0][path] if path == THRESHOLDS else np.concatenate([part[path] for part in parts])
        for path in parts[0]
    }


def _join_postures(parts: Sequence[Posture]) -> Posture:
    return Posture(
        np.concatenate([part.hand_pose for part in parts]), np.concatenate([part.joint_positions for part in parts])
    )
