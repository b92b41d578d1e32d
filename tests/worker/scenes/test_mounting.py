"""Forearms in scenes: a hand whose forearm would be in something is no start, has no way, and is not valid."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from graspd.service.model.fidelity import resolve_fidelity
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.transforms import IDENTITY_POSE, apply, compose
from graspd.worker.execution_context import DEFAULT_CONTEXT
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import ConvexPiece, HandModel
from graspd.worker.hands.primitives import tessellate
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import synthesize
from graspd.worker.planners.fast_graspd.candidates import posture_of
from graspd.worker.planners.fast_graspd.pairs import pair_of
from graspd.worker.planners.fast_graspd.scene_starts import clear_scene_starts, free_ways
from graspd.worker.planners.fast_graspd.starts import CLEAR, start_generator
from graspd.worker.planners.port import PlanRequest
from graspd.worker.scenes.clearance import MARGIN_M, transfer
from graspd.worker.scenes.kinds import rest_poses, supports_of
from graspd.worker.scenes.rollout import scene_verdicts
from graspd.worker.scenes.trajectory import plan_way
from graspd.worker.simulation.environment import Scenes
from graspd.worker.simulation.mounting import mounting_room
from graspd.worker.simulation.obstacles import DeviceObstacles

QUICK = resolve_fidelity("draft").model_copy(update={"starts": 2})


@pytest.fixture(scope="module")
def shadow(shared_data: Path) -> HandModel:
    hand = hand_from_path(shared_data / "hands" / "shadow" / "shadow_hand_right.urdf")
    assert hand.mounting is not None
    return hand


@pytest.fixture(scope="module")
def block() -> ObjectModel:
    return object_from_path("block", face_error_m=QUICK.face_error_m)


@pytest.fixture(scope="module")
def table(block: ObjectModel) -> Scenes:
    spec = SceneSpec(kind="table")
    return Scenes(supports_of(spec), rest_poses(spec, block, count=2, seed=1)["scene/object_pose"])


@pytest.fixture(scope="module")
def planned(shadow: HandModel, block: ObjectModel, table: Scenes) -> GraspSet:
    placed = table.placed(np.arange(8) % 2)
    found = synthesize(shadow, block, PlanRequest(count=8, fidelity=QUICK, seed=4, placed=placed))
    return replace(found, scene=placed.index)


def lowest(mounting: HandModel, poses: np.ndarray, wrist: np.ndarray) -> float:
    """Of the mounting's vertices, root poses (P, 7) in the frame of the table."""
    bodies = body_poses(mounting, poses, np.tile(wrist, (len(poses), 1)))
    return min(float(apply(bodies[:, p.body, None], p.vertices)[..., 2].min()) for p in mounting.pieces)


def test_starts_keep_the_forearm_off_the_table(shared_data: Path, block: ObjectModel, table: Scenes) -> None:
    # A wrist that is held bent forwards: behind a palm that faces down the forearm is lowest.
    held = {"root": "palm", "fix": {"WRJ1": 0.48, "WRJ2": 0.0}}
    shadow = hand_from_path(shared_data / "hands" / "shadow" / "shadow_hand_right.urdf", held)
    placed, each = table.placed(np.arange(16) % 2), 4
    obstacles = DeviceObstacles.create(shadow, placed.scenes, block.centre_of_mass, "cpu")
    model = pair_of(shadow, block, QUICK, "cpu", in_scenes=True)
    coarse = model.model(model.coarse, obstacles)
    generators = [start_generator(3, 0, i, k) for i in range(16) for k in range(each)]
    ways = [free_ways(scene, block) for scene in placed.scenes]
    state, depth = clear_scene_starts(coarse, generators, each=each, placed=placed, ways=ways)
    clear = np.flatnonzero(depth <= CLEAR)
    assert len(clear) > 40
    poses = posture_of(shadow, block, state).hand_pose[clear][:, None]
    _, room = mounting_room(shadow, poses, placed.scenes, np.repeat(placed.index, each)[clear])
    assert room.min() >= MARGIN_M


def test_the_wrist_is_bent_no_farther_than_the_table_asks(shadow: HandModel, table: Scenes) -> None:
    assert shadow.mounting is not None
    # The fingers point up, away from the table, and the forearm down: no angle of the wrist helps.
    upright = np.array([0.0, 0, 0.1, 1, 0, 0, 0])
    # The palm faces down and the forearm lies level, 40 mm high: thicker than that, it is clear when the wrist bends.
    level = np.array([0.0, 0, 0.04, 0.7071067811865476, 0.7071067811865476, 0, 0])
    scene = replace(table.placed(np.zeros(1, int)).scenes[0], obstacles=table.supports, up=np.array([0.0, 0, 1]))
    high = np.array([*level[:2], 0.24, *level[3:]])
    wrist, room = mounting_room(shadow, np.stack([upright, level, high])[:, None], [scene])
    assert room[0] < 0 < MARGIN_M <= room[1] < room[2]
    assert not wrist[2].any() and wrist[1] == pytest.approx([0.5 * shadow.mounting.lower[0], 0.0])
    assert lowest(shadow.mounting, level[None], wrist[1]) == pytest.approx(room[1], abs=1e-3)
    assert lowest(shadow.mounting, level[None], np.zeros(2)) < MARGIN_M


def test_valid_grasps_have_their_forearm_above_the_table(
    shadow: HandModel, block: ObjectModel, table: Scenes, planned: GraspSet
) -> None:
    found, columns = scene_verdicts(shadow, block, planned, table, level="lift", pieces=None, run=DEFAULT_CONTEXT)
    assert found.wrist is not None and found.wrist.shape == (8, 2) and found.approach is not None
    assert shadow.mounting is not None and found.lift is not None and found.scene is not None
    clear = np.flatnonzero(columns["quality/clearance_m"] >= MARGIN_M)
    assert len(clear) > 3
    for row in clear:
        way = [*found.approach[row], found.grasp.hand_pose[row], found.lift.hand_pose[row]]
        in_scene = compose(table.object_pose[found.scene[row]], np.array(way))
        assert lowest(shadow.mounting, in_scene, found.wrist[row]) >= MARGIN_M - 1e-6
    again = GraspSet.from_columns({**found.to_columns(), "quality/stability_loss": found.stability_loss})
    assert again.wrist is not None and np.array_equal(again.wrist, found.wrist)


def test_a_grasp_with_its_mounting_in_the_table_is_not_clear(
    shadow: HandModel, block: ObjectModel, table: Scenes, planned: GraspSet
) -> None:
    assert planned.scene is not None and shadow.mounting is not None
    bare = plan_way(replace(shadow, mounting=None), block, planned, table.placed(planned.scene))
    assert bare.clear.any() and bare.wrist.shape == (8, 0)
    # A mounting as large as this reaches down to the table from anywhere.
    vertices, faces = tessellate("sphere", (1.0,))
    ball = ConvexPiece(2, "sphere", (1.0,), IDENTITY_POSE, vertices, faces, "forearm")
    everywhere = replace(shadow.mounting, pieces=(ball,))
    _, columns = scene_verdicts(
        replace(shadow, mounting=everywhere), block, planned, table, level="lift", pieces=None, run=DEFAULT_CONTEXT
    )
    assert (columns["quality/success"] == -1).all()


def test_free_grasps_do_not_depend_on_the_mounting(shadow: HandModel, block: ObjectModel) -> None:
    wanted = PlanRequest(count=2, fidelity=QUICK, seed=4)
    ours, bare = (synthesize(hand, block, wanted) for hand in (shadow, replace(shadow, mounting=None)))
    for one, other in ((ours.grasp, bare.grasp), (ours.pregrasp, bare.pregrasp), (ours.squeeze, bare.squeeze)):
        assert np.array_equal(one.hand_pose, other.hand_pose)
        assert np.array_equal(one.joint_positions, other.joint_positions)
    assert "grasp/wrist_positions" not in ours.to_columns()


def test_grasps_carried_over_keep_their_forearms_off_the_table(
    shadow: HandModel, table: Scenes, planned: GraspSet
) -> None:
    assert shadow.mounting is not None
    both = [transfer(hand, planned.grasp, planned.pregrasp, table.object_pose) for hand in (shadow, _bare(shadow))]
    ours, bare = both
    assert "grasp/wrist_positions" not in bare and ours["grasp/wrist_positions"].shape == (16, 2)
    height = [
        lowest(shadow.mounting, pose[None], wrist)
        for pose, wrist in zip(ours["grasp/hand_pose"], ours["grasp/wrist_positions"], strict=True)
    ]
    expected = np.minimum(bare["grasp/contact_table_clearance_m"], height)
    np.testing.assert_allclose(ours["grasp/contact_table_clearance_m"], expected, atol=1e-4)
    assert (ours["grasp/valid"] <= bare["grasp/valid"]).all() and (expected[ours["grasp/valid"] == 1] > 0).all()


def _bare(hand: HandModel) -> HandModel:
    return replace(hand, mounting=None)
