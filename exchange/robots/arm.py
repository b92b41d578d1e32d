"""An arm that carries a hand: its joints up to the hand's mount, frames and couplings."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from graspd.service.model.digests import digest_files
from graspd.service.model.errors import InputError
from graspd.service.model.states import AssetKind
from graspd.service.model.transforms import Floats
from graspd.worker.hands.collisions import resting_neighbours
from graspd.worker.hands.load import HandSource, body_model, files_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.options import HandOptions
from graspd.worker.hands.robot import FREE, MOVING, chain_to
from graspd.worker.hands.tree import build_tree


@dataclass(frozen=True)
class Arm:
    """The chain of an arm with all its links but those below the mount."""

    model: HandModel
    """Bodies, joints, limits and convex pieces; it has no palm and no fingers."""
    mount: str
    mount_body: int
    mount_pose: Floats
    """(7,) mount link in its body's frame."""
    hand_pose: Floats
    """(7,) hand's root link in the mount link."""


def read_arm(path: str | Path, mount: str, hand_pose: Floats) -> Arm:
    """Read the arm of a URDF, its folder or a ZIP.

    Links below the mount, such as a gripper, are omitted. Joints that do not lead to it are fixed at zero, or at the
    nearest value inside their limits.
    """
    name, files, stated = files_from_path(path)
    source = HandSource.read(files, stated, name=name, digest=digest_files(AssetKind.HAND, files))
    robot = source.robot
    if mount not in robot.links:
        near = ", ".join(list(robot.links)[-6:])
        raise InputError(f"the arm {name} has no link {mount[:80]!r} to mount a hand on; its last links: {near}")
    chain = {joint.name: joint.type for joint in chain_to(robot, mount)}
    moving = {name for name, kind in chain.items() if kind in MOVING}
    if not moving:
        raise InputError(f"no joint of the arm {name} moves the link {mount!r}; name the link behind its last joint")
    chosen = HandOptions(
        file=source.main,
        xacro=source.options.xacro,
        root=robot.root,
        drop=tuple(joint.child for joint in robot.joints.values() if joint.parent == mount),
        fix={
            joint.name: float(np.clip(0.0, joint.lower, joint.upper))
            for joint in robot.joints.values()
            if joint.name not in moving and joint.type != "fixed" and (joint.name not in chain or joint.type in FREE)
        },
    )
    tree = build_tree(robot, chosen)
    model = body_model(replace(source, options=chosen), tree)
    model = replace(model, neighbours=resting_neighbours(model))
    body, pose = tree.links[mount]
    return Arm(model, mount, body, np.asarray(pose, float), hand_pose)


@dataclass(frozen=True)
class Description:
    """Links and joints of a hand."""

    links: Mapping[str, tuple[int, Floats]]
    """Each link below the root: its body, and its pose (7,) in the body's frame."""
    mimics: frozenset[str]
    """Joints that the description couples to others: its readers move them by themselves."""


def describe(files: Mapping[str, bytes], options: Mapping[str, Any] | None = None) -> Description:
    """Return the description of a hand's files; see `load_hand`."""
    source = HandSource.read(files, options)
    robot, tree = source.robot, build_tree(source.robot, source.options)
    return Description(
        dict(tree.links), frozenset(name for name in tree.joint_names if robot.joints[name].mimic is not None)
    )
