"""Input of the writers of robot formats, and functions that these writers share."""

import pathlib
from dataclasses import dataclass
from typing import Any

import numpy as np
import yaml

from graspd.exchange.plan import plain_name, prim_names
from graspd.service.model.transforms import Floats, compose, invert
from graspd.worker.episodes.execution import Executions, Path, RobotTrajectory
from graspd.worker.episodes.reach import Arm, ArmScene, HandDescription


@dataclass(frozen=True)
class Carrier:
    """The arm that carries the hand, its base, and its motions."""

    arm: Arm
    base: Floats  # (7,) pose of the base in the frame of the grasps
    world: ArmScene
    paths: list[list[Path]]  # motions of each grasp; joints are the arm's, then the hand's


@dataclass(frozen=True)
class Bundle:
    """Grasps with their trajectories, ready to be written."""

    found: Executions
    trajectories: list[RobotTrajectory]  # one per grasp; joints are the arm's, if there is one, then the hand's
    description: HandDescription
    carrier: Carrier | None = None

    @property
    def frame(self) -> str:
        """Name of the frame of written poses: the arm's base, the scene, or the object."""
        if self.carrier is not None:
            return self.carrier.arm.model.root_link
        return "scene" if self.found.placed is not None else plain_name(self.found.obj.name)

    def to_frame(self, pose: Floats) -> Floats:
        """Return poses (..., 7) in the frame `frame`."""
        return np.asarray(pose, float) if self.carrier is None else compose(invert(self.carrier.base), pose)

    def tool_in_frame(self, root_pose: Floats) -> Floats:
        """Return poses (..., 7) of the tool frame in the frame `frame`, from those of the hand's root link."""
        return self.to_frame(compose(root_pose, self.found.tool.pose))

    @property
    def prims(self) -> tuple[str, str]:
        """Names of the object's and the hand's prims below `/World`; neither is `scene`."""
        _, thing, hand = prim_names(["scene", self.found.obj.name, self.found.hand.name])
        return thing, hand

    def grasp_name(self, row: int) -> str:
        return f"grasp_{self.found.rows[row]:04}"

    @property
    def commanded_joints(self) -> list[int]:
        """Columns of the hand's commanded joints: those that the URDF does not couple to others."""
        names = self.found.hand.joint_names
        return [k for k, name in enumerate(names) if name not in self.description.mimics]


class _DumperWithoutAnchors(getattr(yaml, "CSafeDumper", yaml.SafeDumper)):  # type: ignore[misc]
    """YAML without anchors, which some readers of messages do not support."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def dump_yaml(file: pathlib.Path, value: Any) -> pathlib.Path:
    """Write a value as YAML, in the order of its keys."""
    file.write_text(yaml.dump(value, Dumper=_DumperWithoutAnchors, sort_keys=False, default_flow_style=None, width=120))
    return file


def rounded_numbers(values: Any) -> list[float]:
    """Return floats rounded to nine decimals (nm, nrad), without negative zeros."""
    return [round(float(value), 9) + 0.0 for value in np.ravel(values)]
