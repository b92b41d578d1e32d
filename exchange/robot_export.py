"""Export of a shard's grasps with their trajectories in the format of a robot or simulator."""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from graspd.exchange.inputs import load_case
from graspd.exchange.plan import ExportOptions, ExportSummary
from graspd.exchange.robots.bundle import Bundle, Carrier
from graspd.service.model.errors import InputError
from graspd.service.store.shards import Shard, read_shard
from graspd.worker.episodes.execution import (
    ASSUMED_M_S,
    ASSUMED_RAD_S,
    Executions,
    VelocityLimits,
    build_executions,
    straight_paths,
    time_motions,
    tool_frame,
    velocity_limits,
)
from graspd.worker.episodes.reach import BUILTIN_ARMS, HandDescription, ReachSearch, read_description
from graspd.worker.episodes.robots import read_robot
from graspd.worker.files.provenance import hand_files_of_shard
from graspd.worker.files.subsets import select_grasps
from graspd.worker.rendering.sheets import best_rows as best_of
from graspd.worker.rendering.sheets import metric_at_threshold
from graspd.worker.validation.decomposition import decompose


def export_grasps(source: Path, format_: str, wishes: ExportOptions, folder: Path) -> ExportSummary:
    """Write grasps of a base shard in the format of a robot or its simulator.
    Raises InputError: options contradict each other, or no grasp can be executed."""
    if not 0 < wishes.speed <= 1:
        raise InputError(f"--speed is {wishes.speed:g}; give a share of the velocity limits above 0 and at most 1")
    if wishes.arm is None and (wishes.mount or wishes.base or wishes.mount_pose):
        raise InputError("--mount, --mount-pose and --base need an arm: --arm ARM.urdf")
    shard = read_shard(source, kind="base")
    files = hand_files_of_shard(shard, wishes.hand)
    description = read_description(files.files, files.options)
    written = ExportSummary({})
    found = _plan_executions(source, shard, description, wishes, written)
    limits = velocity_limits(found.hand)
    written.notes += _assumptions(limits)
    if wishes.arm is None:
        found = found.take(np.arange(len(found))[: wishes.best or None])
        names, velocity = found.hand.joint_names, limits.velocity
        trajectories = [
            time_motions(straight_paths(found, row), names, velocity, speed=wishes.speed) for row in range(len(found))
        ]
        bundle = Bundle(found, trajectories, description)
    else:
        bundle = _plan_for_arm(found, description, limits, wishes, written)
    paths = _write(bundle, format_, folder, files.files)
    written.counts |= {"grasps": len(bundle.found), "files": len(paths)}
    return written


def _plan_for_arm(
    found: Executions,
    description: HandDescription,
    limits: VelocityLimits,
    wishes: ExportOptions,
    written: ExportSummary,
) -> Bundle:
    # Poses of an arm from a file have no default but the identity.
    pose = None if wishes.arm in BUILTIN_ARMS else "0 0 0 1 0 0 0"
    poses = {"mount_pose": wishes.mount_pose or pose, "base": wishes.base or pose}
    robot = read_robot(found.hand, wishes.arm, mount=wishes.mount, **poses)
    arm, base = robot.arm, robot.base
    assert arm is not None
    reach = ReachSearch(arm, base, found, decompose(found.obj))
    reached = reach.search_all(wishes.best)
    why = ", ".join(f"{count} {reason}" for reason, count in reached.refused.most_common(3))
    if not reached.rows:
        raise InputError(
            f"the arm {arm.model.name} reaches none of {reached.candidates} grasps ({why}); place it elsewhere: --base"
        )
    written.counts |= {
        "candidates": reached.candidates,
        "reach_share": round(len(reached.rows) / max(1, reached.candidates), 4),
        "refused": dict(reached.refused),
    }
    if reached.refused:
        written.notes.append(f"the arm can execute {len(reached.rows)} of {reached.candidates} grasps; left out: {why}")
    of_arm = velocity_limits(arm.model)
    written.notes += _assumptions(of_arm)
    names = (*arm.model.joint_names, *found.hand.joint_names)
    velocity = np.concatenate([of_arm.velocity, limits.velocity])
    trajectories = [time_motions(paths, names, velocity, speed=wishes.speed) for paths in reached.paths]
    kept = found.take(np.array(reached.rows, np.intp))
    return Bundle(kept, trajectories, description, Carrier(arm, base, reach.world, reached.paths))


def _plan_executions(
    source: Path, shard: Shard, description: HandDescription, wishes: ExportOptions, written: ExportSummary
) -> Executions:
    case = load_case(source, hand=wishes.hand, obj=wishes.obj)
    mask, word = select_grasps(shard, unvalidated=wishes.unvalidated, every=wishes.every)
    rows = best_of(shard.arrays, len(mask), mask) if wishes.best else np.flatnonzero(mask)
    tool = tool_frame(wishes.tool, case.hand.root_link, description.links)
    grasps, placed = case.grasps.take(rows), None if case.placed is None else case.placed.take(rows)
    valid = np.asarray(shard.arrays["quality/valid"])
    success = np.asarray(shard.arrays.get("quality/success", np.full(len(valid), -1)))
    epsilon = metric_at_threshold(shard.arrays, "quality/epsilon")
    quality: dict[str, NDArray[Any]] = {"valid": valid[rows], "success": success[rows], "epsilon": epsilon[rows]}
    found = build_executions(case.hand, case.obj, grasps, rows=rows, tool=tool, quality=quality, placed=placed)
    if lost := len(rows) - len(found):
        written.notes.append(f"{lost} of {len(rows)} {word} are left out: no straight approach of 10 cm is free")
    return found


def _assumptions(limits: VelocityLimits) -> list[str]:
    if not limits.assumed:
        return []
    names = ", ".join(limits.assumed[:3]) + (", ..." if len(limits.assumed) > 3 else "")
    return [
        f"{len(limits.assumed)} joints have no velocity limit ({names}): {ASSUMED_RAD_S:g} rad/s and {ASSUMED_M_S:g} "
        "m/s were assumed"
    ]


def _write(bundle: Bundle, format_: str, folder: Path, hand_files: dict[str, bytes]) -> list[Path]:
    from graspd.exchange.robots import moveit, mujoco_scene, posed_meshes, tables

    if format_ in ("moveit", "urdf+yaml"):
        return moveit.write(bundle, folder, hand_files)
    writers = {
        "csv": tables.write_tables,
        "isaac": tables.write_isaac,
        "glb": posed_meshes.write_glb,
        "usd": posed_meshes.write_usd,
        "mujoco": mujoco_scene.write,
    }
    return writers[format_](bundle, folder)
