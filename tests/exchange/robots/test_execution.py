"""The way of a grasp: free of the object, in the frame that was asked for, within the limits of the joints."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import trimesh

from graspd.exchange.inputs import load_case
from graspd.exchange.robots import execution
from graspd.exchange.robots.execution import (
    POSTURES,
    Executions,
    build_executions,
    straight_paths,
    time_motions,
    tool_frame,
)
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import IDENTITY_POSE, apply, compose, invert, slerp
from graspd.service.store.shards import read_shard
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.model import MujocoOptions, build_scene
from graspd.worker.validation.protocol import Test as Rollout
from tests.worker.models import object_from_mesh, two_finger_hand
from tests.worker.quality.helpers import grasp_set, posture

TOOL = tool_frame(None, "palm", {})
LINKS = {"palm": (0, IDENTITY_POSE), "tcp": (0, np.array([0, 0, 0.1, 1, 0, 0, 0.0])), "tip": (2, IDENTITY_POSE)}


def of_shard(file: Path) -> Executions:
    case = load_case(file)
    given = {"rows": np.arange(len(case.grasps)), "placed": case.placed, "tool": TOOL}
    quality = {"valid": read_shard(file, kind="base")["quality/valid"]}
    return build_executions(case.hand, case.obj, case.grasps, **given, quality=quality)


@pytest.fixture(scope="module")
def free(free_shard: Path) -> Executions:
    return of_shard(free_shard)


def test_a_free_grasp_is_reached_and_left_over_ten_centimetres(free: Executions) -> None:
    for start, end in (("standoff", "arrival"), ("squeeze", "lift")):
        way = free.postures[end].hand_pose[:, :3] - free.postures[start].hand_pose[:, :3]
        assert (np.linalg.norm(way, axis=1) >= 0.1 - 1e-9).all()


def test_open_hand_touches_nothing_of_a_free_object_on_its_way(free: Executions) -> None:
    """MuJoCo is the oracle: its convex pieces of the object stand out from the surface by up to 2 mm."""
    rollout = Rollout(build_scene(free.hand, free.obj, decompose(free.obj), MujocoOptions()))
    assert len(free) >= 4
    for start, end in (("standoff", "arrival"), ("arrival", "pregrasp")):
        a, b = free.postures[start], free.postures[end]
        for row in range(len(free)):
            for share in np.linspace(0, 1, 21):
                place = (1 - share) * a.hand_pose[row, :3] + share * b.hand_pose[row, :3]
                turn = slerp(a.hand_pose[row, 3:], b.hand_pose[row, 3:], float(share))
                joints = (1 - share) * a.joint_positions[row] + share * b.joint_positions[row]
                rollout._set_posture(np.concatenate([place, turn]), joints)
                mujoco.mj_forward(rollout.scene.model, rollout.data)
                assert rollout.penetration()[0] < 0.002


def test_grasps_without_a_free_way_are_left_out_none_is_refused() -> None:
    hand = two_finger_hand()
    shell = trimesh.creation.icosphere(subdivisions=3, radius=0.12)
    inner = trimesh.creation.icosphere(subdivisions=3, radius=0.105)
    inner.invert()
    ball = object_from_mesh(trimesh.util.concatenate([shell, inner]))
    caught = grasp_set(posture(((0.0, 0, 0), (0.0, 0.0))))
    with pytest.raises(InputError, match="free of the object"):
        build_executions(hand, ball, caught, rows=np.zeros(1, int), placed=None, tool=TOOL, quality={})


def test_in_scene_ways_of_shard_are_kept_in_frame_of_the_scene(table_shard: Path) -> None:
    shard, on_table = read_shard(table_shard, kind="base"), of_shard(table_shard)
    at = shard["scene/object_pose"][shard["grasp/scene_index"]]
    np.testing.assert_array_equal(on_table.object_pose, at)
    back = compose(invert(at), on_table.postures["standoff"].hand_pose)
    np.testing.assert_allclose(back[:, :3], shard["grasp/approach"][:, 0, :3], atol=1e-12)
    rise = on_table.postures["lift"].hand_pose[:, :3] - on_table.postures["squeeze"].hand_pose[:, :3]
    np.testing.assert_allclose(rise, np.tile([0, 0, 0.1], (len(on_table), 1)), atol=1e-9)
    assert on_table.frame == "scene"
    part = on_table.postures["grasp"]
    bodies = body_poses(on_table.hand, part.hand_pose, part.joint_positions)
    assert (bodies[:, :, 2] > -0.01).all(), "below the table"


def test_the_tool_frame_is_a_link_or_a_pose(free: Executions) -> None:
    root = free.postures["grasp"].hand_pose
    for text in ("tcp", "0 0 0.1 1 0 0 0", "0,0,0.1,1,0,0,0"):
        found = replace(free, tool=tool_frame(text, "palm", LINKS))
        np.testing.assert_allclose(found.tool_pose("grasp")[:, :3], apply(root, np.array([0, 0, 0.1])), atol=1e-12)
    assert tool_frame("palm", "palm", LINKS).name == "palm"
    rounded = execution.parse_pose("0 0 0 0.7071 0 0 0.7071", "--base")
    assert np.linalg.norm(rounded[3:]) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("tcpp", "did you mean 'tcp'"),
        ("wrist", "no link 'wrist'"),
        ("tip", "moves with a finger"),
        ("0 0 0.1", "seven numbers"),
        ("0 0 0 1 1 0 0", "length 1.41"),
        ("0 0 0 nan 0 0 0", "seven numbers"),
    ],
)
def test_a_tool_frame_that_is_none_is_refused_in_a_line(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        tool_frame(text, "palm", LINKS)


@pytest.mark.parametrize("speed", [0.2, 1.0])
def test_trajectories_stay_within_limits_and_reach_every_posture(free: Executions, speed: float) -> None:
    velocity = np.linspace(0.3, 2.0, len(free.hand.joint_names))
    for row in range(len(free)):
        found = time_motions(straight_paths(free, row), free.hand.joint_names, velocity, speed=speed)
        step = np.diff(found.time)
        assert (step > 0).all()
        # Secants of a motion are no steeper than its steepest tangent; 1e-9: rounding.
        assert (np.abs(np.diff(found.joints, axis=0)) / step[:, None] <= speed * velocity * (1 + 1e-9)).all()
        along = np.linalg.norm(np.diff(found.hand_pose[:, :3], axis=0), axis=1) / step
        assert along.max() <= speed * execution.HAND_M_S * (1 + 1e-9) and not found.velocity[[0, -1]].any()
        ends = [0] + [k for k in range(len(step)) if found.phase[k] != found.phase[k + 1]] + [len(step)]
        ends = sorted(set(ends) - {0}) if len(ends) > len(POSTURES) else ends
        for posture_name, k in zip(POSTURES, ends, strict=True):
            joints = free.postures[posture_name].joint_positions[row]
            np.testing.assert_allclose(found.joints[k], joints, atol=1e-9, err_msg=posture_name)


def test_limits_are_those_of_the_hand_or_assumed(free: Executions) -> None:
    hand = replace(free.hand, velocity=np.concatenate([[3.0], np.zeros(free.hand.dofs - 1)]))
    found = execution.velocity_limits(hand)
    leads = hand.dof[hand.joint_body] == 0
    np.testing.assert_allclose(found.velocity[leads], 3.0 * np.abs(hand.multiplier[hand.joint_body][leads]))
    assert (found.velocity[~leads] == execution.ASSUMED_RAD_S).all()
    assert set(found.assumed) == {name for name, led in zip(hand.joint_names, leads, strict=True) if not led}
