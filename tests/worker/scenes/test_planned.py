"""Grasps planned in a scene or moved into one: poses, trajectories, clearances by MuJoCo and by all corners."""

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import resolve_fidelity
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.transforms import IDENTITY_POSE, apply, compose, invert, quat_from_axis_angle
from graspd.service.store.shards import read_shard
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.generation import validated_grasps
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import ConvexPiece, HandModel
from graspd.worker.hands.primitives import tessellate
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import synthesize
from graspd.worker.planners.fast_graspd.candidates import posture_of
from graspd.worker.planners.fast_graspd.pairs import pair_of
from graspd.worker.planners.fast_graspd.scene_starts import clear_scene_starts, free_directions
from graspd.worker.planners.fast_graspd.starts import CLEAR, start_generator
from graspd.worker.planners.port import PlanRequest
from graspd.worker.scenes import Neighbours, drop_together
from graspd.worker.scenes.clearance import MARGIN_M, Rejection, approach_postures, transfer_grasps
from graspd.worker.scenes.kinds import supports_of
from graspd.worker.scenes.neighbours import FARTHEST_M, neighbour_clearance
from graspd.worker.scenes.placement import merge_pieces, scenes_of
from graspd.worker.scenes.rollout import scene_verdicts
from graspd.worker.scenes.trajectory import plan_trajectory
from graspd.worker.simulation.environment import STANDOFF_M, PlacedGrasps, Scenes
from graspd.worker.simulation.mounting import choose_wrist
from graspd.worker.simulation.obstacles import DeviceObstacles
from tests.worker.commands_run import graspd, refused
from tests.worker.hands.urdfs import gripper
from tests.worker.models import object_from_mesh, on_tables, two_finger_hand, unit_vectors
from tests.worker.simulation.test_surroundings import mujoco_distances, mujoco_room, parted

#: What a draft's finish may lack of a distance that it aims at exactly [m].
DRAFT_M = 5e-4
QUICK = resolve_fidelity("draft").model_copy(update={"starts": 2})
BLOCK = object_from_path("block", face_error_m=QUICK.face_error_m)
TABLE = {"kind": "half_space"}
UPRIGHT = (1.0, 0, 0, 0)


@pytest.fixture(scope="module")
def planned():
    hand, placed = hand_from_path("barrett"), on_tables(BLOCK).placed(np.arange(8) % 2)
    return hand, BLOCK, placed, synthesize(hand, BLOCK, PlanRequest(count=8, fidelity=QUICK, seed=4, placed=placed))


def test_every_grasp_is_clear_of_the_table_by_mujocos_distances(planned) -> None:
    hand, _, placed, grasps = planned
    tips, rest = parted(hand)
    for number, scene in enumerate(placed.scenes):
        mine = grasps.grasp.take(np.flatnonzero(placed.index == number))
        assert mujoco_distances(rest, mine, scene.obstacles[0]).min() >= MARGIN_M
        # They may touch the table. A draft's few steps of finish leave less than this to fix; then none is clear.
        assert mujoco_distances(tips, mine, scene.obstacles[0]).min() >= -DRAFT_M


def test_fingertips_keep_what_the_scene_says_and_no_less() -> None:
    hand = hand_from_path("barrett")
    supports = tuple(replace(one, tips_m=-0.001) for one in supports_of(SceneSpec(kind="table")))
    # A thin slice of the block sticks out of the table: what holds it must reach down to there.
    sunk = np.array([[0, 0, float(-BLOCK.vertices[:, 2].max()) + 0.012, 1, 0, 0, 0]])
    placed = PlacedGrasps(supports, sunk, np.zeros(12, int))
    found = synthesize(hand, BLOCK, PlanRequest(count=12, fidelity=QUICK, seed=4, placed=placed)).grasp
    tips, rest = parted(hand)
    table = placed.scenes[0].obstacles[0]
    lowest = mujoco_distances(tips, found, table)
    assert lowest.min() >= -0.001 - DRAFT_M
    assert lowest.min() < 0.001, "no fingertip came down to the table"
    assert mujoco_distances(rest, found, table).min() >= MARGIN_M


def least_room(hand, way, grasps, row: int, scene) -> float:
    """Least distance of a hand from the obstacles on its whole way, by MuJoCo, at a hundred postures [m]."""
    one, wide = grasps.take(slice(row, row + 1)), way.open[row : row + 1]
    coming = approach_postures(Posture(way.approach[row, -1:], wide), Posture(way.approach[row, :1], wide), 40)
    closing = approach_postures(one.grasp, one.pregrasp, 30)
    lifting = Posture(np.repeat(one.grasp.hand_pose, 30, axis=0), np.repeat(one.grasp.joint_positions, 30, axis=0))
    lifting.hand_pose[:, :3] += np.linspace(0, 0.1, 30)[:, None] * scene.up
    parts, table = (coming, closing, lifting), scene.obstacles[0]
    beside = [mujoco_distances(hand, part, solid).min() for part in parts for solid in scene.obstacles[1:]]
    return min([mujoco_room(hand, part, table).min() for part in parts] + beside)


@pytest.mark.parametrize("case", ["planned", "planned_beside"])
def test_the_whole_way_is_as_clear_as_it_says(case: str, request: pytest.FixtureRequest) -> None:
    hand, obj, placed, grasps = request.getfixturevalue(case)
    way = plan_trajectory(hand, obj, grasps, placed)
    assert way.clear.any()
    for row in np.flatnonzero(way.clear)[:4]:
        # Postures between those that were looked at may be nearer by what a finger's arc deviates from its chord.
        assert least_room(hand, way, grasps, row, placed.scenes[placed.index[row]]) >= MARGIN_M - 5e-4
        assert np.linalg.norm(way.approach[row, 0, :3] - way.approach[row, -1, :3]) == pytest.approx(STANDOFF_M)


def test_a_grasp_does_not_depend_on_the_scenes_of_the_others(planned) -> None:
    hand, obj, placed, grasps = planned
    alone = PlacedGrasps(placed.supports, placed.object_pose, placed.index[:3])
    found = synthesize(hand, obj, PlanRequest(count=3, fidelity=QUICK, seed=4, placed=alone))
    assert np.array_equal(found.grasp.hand_pose, grasps.grasp.hand_pose[:3])


@pytest.mark.parametrize(
    ("wish", "beside"), [("--scenes 2 -n 3 --budget 8", []), ("--scenes 1 -n 4 --want candidates --with mug", ["mug"])]
)
def test_synth_in_a_scene_counts_lifts_as_evaluate_does(wish: str, beside: list[str], tmp_path) -> None:
    out = tmp_path / "g.h5"
    said = graspd(f"synth --hand barrett --object block --scene table --fidelity draft {wish} -o", out)
    assert {"scene", "scenes", "lift_hard_share"} <= set(said) and said["lift_share"] <= said["clear_share"]
    shard = read_shard(out, kind="base")
    valid = shard["quality/valid"] == 1
    assert (shard["quality/success"][valid] == 1).all() and (shard["quality/clearance_m"][valid] >= MARGIN_M).all()
    assert valid.sum() == said["valid"] and (valid.all() or beside)
    assert shard.attributes.get("neighbours", []) == beside
    assert not beside or shard["scene/neighbour_pose"].shape == (1, 1, 7)
    assert [one["object"] for one in json.loads(str(shard.attributes["scene"]))["neighbours"]] == beside
    told = graspd("evaluate --protocol lift", out)
    assert told["clear_share"] == (said["clear_share"] if beside else 1.0)
    held = {one["row"] for one in told["verdicts"] if one["held"] and one["clear"]}
    assert held == set(np.flatnonzero(np.asarray(shard["quality/success"]) == 1).tolist())


def test_what_is_of_free_objects_only_is_refused_in_scenes(tmp_path) -> None:
    out, pair = tmp_path / "g.h5", "--hand barrett --object block -o"
    graspd(f"synth -n 1 --want candidates --validation none --fidelity draft {pair}", out)
    assert "synth --scene" in refused("evaluate --protocol lift", out)
    assert "free objects only" in refused(f"synth --scene table --method dfc {pair}", out)


def cube(side: float = 0.05, name: str = "cube"):
    return object_from_mesh(trimesh.creation.box((side, side, side)), name)


def file_scene(*places: tuple[float, float, float], target: tuple[float, float, float] = (0, 0, 0.025)) -> SceneSpec:
    beside = [{"object": "cube", "pose": (*place, *UPRIGHT)} for place in places]
    return SceneSpec(kind="file", supports=(TABLE,), target=(*target, *UPRIGHT), neighbours=beside)


def test_neighbours_stand_where_the_file_says() -> None:
    places = [(0.1, 0, 0.025), (0, -0.2, 0.025)]
    scenes, poses = scenes_of(file_scene(*places), cube(), [cube(), cube()], count=2, seed=0)
    np.testing.assert_allclose(poses["scene/neighbour_pose"][1, :, :3], places)
    placed = scenes.placed(np.zeros(1, int))
    np.testing.assert_allclose(placed.relative_neighbour_poses(0)[0, :3], [0.1, 0, 0])
    box = placed.scenes[0].obstacles[1]
    np.testing.assert_allclose(box.distance(np.array([0.05, 0.0, 0.0])), 0.025, atol=1e-9)


@pytest.mark.parametrize(
    ("places", "words"),
    [
        ([(0.03, 0, 0.025)], "cube and cube overlap by 20.0 mm in scene 0"),
        ([(0.1, 0, 0.025), (0.12, 0, 0.025)], "overlap by 30.0 mm"),
        ([(0.1, 0, 0.0)], "is 25.0 mm deep in support 0"),
    ],
)
def test_things_that_stand_in_one_another_are_refused(places, words: str) -> None:
    with pytest.raises(InputError, match=words):
        scenes_of(file_scene(*places), cube(), [cube()] * len(places), count=1, seed=0)


def test_hulls_are_joined_where_that_fills_least() -> None:
    """Eight cubes in a row and one apart: the row becomes one piece."""
    corners = np.asarray(trimesh.creation.box((0.01, 0.01, 0.01)).vertices)
    row = [corners + np.array([0.01 * k, 0, 0]) for k in range(8)]
    pieces = merge_pieces([*row, corners + np.array([0.09, 0, 0.02])], most=2)
    assert sorted(round(float(np.ptp(piece[:, 0])), 3) for piece in pieces) == [0.01, 0.08]


@pytest.fixture(scope="module")
def planned_beside():
    hand = hand_from_path("barrett")
    post, wall = object_from_mesh(trimesh.creation.box((0.03, 0.03, 0.2)), "post"), cube(0.06, "low")
    places = {"post": (0.085, 0, 0.1), "low": (-0.09, 0.03, 0.03)}
    beside = [{"object": name, "pose": (*place, *UPRIGHT)} for name, place in places.items()]
    target = (0, 0, float(-BLOCK.vertices[:, 2].min()), *UPRIGHT)
    spec = SceneSpec(kind="file", supports=(TABLE,), target=target, neighbours=beside)
    placed = scenes_of(spec, BLOCK, [post, wall], count=1, seed=0)[0].placed(np.zeros(8, int))
    return hand, BLOCK, placed, synthesize(hand, BLOCK, PlanRequest(count=8, fidelity=QUICK, seed=4, placed=placed))


@pytest.mark.parametrize(
    ("args", "words"), [("--scene table" + 9 * " --with mug", "at most 8"), ("--shake", "choose a scene")]
)
def test_what_cannot_stand_beside_an_object_is_told_in_one_line(tmp_path, args: str, words: str) -> None:
    said = refused(f"synth --hand barrett --object block {args} -o", tmp_path / "g.h5")
    assert words in said and "Traceback" not in said


def test_a_gripper_lifts_a_box_from_a_table() -> None:
    hand, box = gripper(), object_from_mesh(trimesh.creation.box((0.03, 0.04, 0.06)))
    wanted = JobOptions(scene="table", fidelity="draft", want="candidates", grasps=4, seed=2)
    found = validated_grasps(hand, box, wanted, count=4, scenes=on_tables(box), run=ExecutionContext(threads=1))
    # A box between flat pads is the plainest of tasks: hardly a grasp may miss it.
    assert found.shares["lift_share"] >= 0.75


@pytest.fixture(scope="module")
def shadow(shared_data) -> HandModel:
    return hand_from_path(shared_data / "hands" / "shadow" / "shadow_hand_right.urdf")


@pytest.fixture(scope="module")
def table() -> Scenes:
    return on_tables(BLOCK)


@pytest.fixture(scope="module")
def mounted(shadow: HandModel, table: Scenes) -> GraspSet:
    placed = table.placed(np.arange(8) % 2)
    found = synthesize(shadow, BLOCK, PlanRequest(count=8, fidelity=QUICK, seed=4, placed=placed))
    return replace(found, scene=placed.index)


def lowest(mounting: HandModel, poses: np.ndarray, wrist: np.ndarray) -> float:
    """Of the mounting's vertices, root poses (P, 7) in the frame of the table."""
    bodies = body_poses(mounting, poses, np.tile(wrist, (len(poses), 1)))
    return min(float(apply(bodies[:, p.body, None], p.vertices)[..., 2].min()) for p in mounting.pieces)


def test_starts_keep_the_forearm_off_the_table(shared_data, table: Scenes) -> None:
    # A wrist that is held bent forwards: behind a palm that faces down the forearm is lowest.
    held = {"root": "palm", "fix": {"WRJ1": 0.48, "WRJ2": 0.0}}
    shadow = hand_from_path(shared_data / "hands" / "shadow" / "shadow_hand_right.urdf", held)
    placed, each = table.placed(np.arange(16) % 2), 4
    obstacles = DeviceObstacles.create(shadow, placed.scenes, BLOCK.centre_of_mass, "cpu")
    model = pair_of(shadow, BLOCK, QUICK, "cpu", in_scenes=True)
    coarse = model.model(model.coarse, obstacles)
    generators = [start_generator(3, 0, i, k) for i in range(16) for k in range(each)]
    ways = [free_directions(scene, BLOCK) for scene in placed.scenes]
    state, depth = clear_scene_starts(coarse, generators, each=each, placed=placed, ways=ways)
    clear = np.flatnonzero(depth <= CLEAR)
    assert len(clear) > 40
    poses = posture_of(shadow, BLOCK, state).hand_pose[clear][:, None]
    _, room = choose_wrist(shadow, poses, placed.scenes, np.repeat(placed.index, each)[clear])
    assert room.min() >= MARGIN_M


def test_the_wrist_is_bent_no_farther_than_the_table_asks(shadow: HandModel, table: Scenes) -> None:
    # The fingers point up, away from the table, and the forearm down: no angle of the wrist helps.
    upright = np.array([0.0, 0, 0.1, 1, 0, 0, 0])
    # The palm faces down and the forearm lies level, 40 mm high: thicker than that, it is clear when the wrist bends.
    level = np.array([0.0, 0, 0.04, 0.7071067811865476, 0.7071067811865476, 0, 0])
    scene = replace(table.placed(np.zeros(1, int)).scenes[0], obstacles=table.supports, up=np.array([0.0, 0, 1]))
    high = np.array([*level[:2], 0.24, *level[3:]])
    wrist, room = choose_wrist(shadow, np.stack([upright, level, high])[:, None], [scene])
    assert room[0] < 0 < MARGIN_M <= room[1] < room[2]
    assert not wrist[2].any() and wrist[1] == pytest.approx([0.5 * shadow.mounting.lower[0], 0.0])
    assert lowest(shadow.mounting, level[None], wrist[1]) == pytest.approx(room[1], abs=1e-3)
    assert lowest(shadow.mounting, level[None], np.zeros(2)) < MARGIN_M


def test_valid_grasps_have_their_forearm_above_the_table(shadow: HandModel, table: Scenes, mounted) -> None:
    found, columns = scene_verdicts(shadow, BLOCK, mounted, table, level="lift", pieces=None, run=DEFAULT_CONTEXT)
    assert found.wrist.shape == (8, 2)
    clear = np.flatnonzero(columns["quality/clearance_m"] >= MARGIN_M)
    assert len(clear) > 3
    for row in clear:
        way = [*found.approach[row], found.grasp.hand_pose[row], found.lift.hand_pose[row]]
        in_scene = compose(table.object_pose[found.scene[row]], np.array(way))
        assert lowest(shadow.mounting, in_scene, found.wrist[row]) >= MARGIN_M - 1e-6
    again = GraspSet.from_columns({**found.to_columns(), "quality/stability_loss": found.stability_loss})
    assert np.array_equal(again.wrist, found.wrist)


def test_a_grasp_with_its_mounting_in_the_table_is_not_clear(shadow: HandModel, table, mounted) -> None:
    bare = plan_trajectory(replace(shadow, mounting=None), BLOCK, mounted, table.placed(mounted.scene))
    assert bare.clear.any() and bare.wrist.shape == (8, 0)
    # A mounting as large as this reaches down to the table from anywhere.
    vertices, faces = tessellate("sphere", (1.0,))
    ball = ConvexPiece(2, "sphere", (1.0,), IDENTITY_POSE, vertices, faces, "forearm")
    hand = replace(shadow, mounting=replace(shadow.mounting, pieces=(ball,)))
    _, columns = scene_verdicts(hand, BLOCK, mounted, table, level="lift", pieces=None, run=DEFAULT_CONTEXT)
    assert (columns["quality/success"] == -1).all()


def test_free_grasps_do_not_depend_on_the_mounting(shadow: HandModel) -> None:
    wanted = PlanRequest(count=2, fidelity=QUICK, seed=4)
    ours, bare = (synthesize(hand, BLOCK, wanted) for hand in (shadow, replace(shadow, mounting=None)))
    for one, other in ((ours.grasp, bare.grasp), (ours.pregrasp, bare.pregrasp), (ours.squeeze, bare.squeeze)):
        assert np.array_equal(one.hand_pose, other.hand_pose)
        assert np.array_equal(one.joint_positions, other.joint_positions)
    assert "grasp/wrist_positions" not in ours.to_columns()


def test_grasps_carried_over_keep_their_forearms_off_the_table(shadow: HandModel, table: Scenes, mounted) -> None:
    hands = (shadow, replace(shadow, mounting=None))
    ours, bare = (transfer_grasps(hand, mounted.grasp, mounted.pregrasp, table.object_pose) for hand in hands)
    assert "grasp/wrist_positions" not in bare and ours["grasp/wrist_positions"].shape == (16, 2)
    postures = zip(ours["grasp/hand_pose"], ours["grasp/wrist_positions"], strict=True)
    height = [lowest(shadow.mounting, pose[None], wrist) for pose, wrist in postures]
    expected = np.minimum(bare["grasp/contact_table_clearance_m"], height)
    np.testing.assert_allclose(ours["grasp/contact_table_clearance_m"], expected, atol=1e-4)
    assert (ours["grasp/valid"] <= bare["grasp/valid"]).all() and (expected[ours["grasp/valid"] == 1] > 0).all()


HAND = two_finger_hand()
#: Tessellations lie inside round pieces by r (1 - cos(pi / 48)), and a sphere of 642 corners by 0.4 % of r.
TESSELLATION_M = 6e-5
IDENTITY = np.array([[0.0, 0, 0, 1, 0, 0, 0]])
#: MuJoCo stores meshes in float32 and its GJK stops at 1e-6 of the size.
ENGINE_M = 5e-6
DOWN = np.concatenate([[0, 0, 0.25], quat_from_axis_angle(np.array([1.0, 0, 0]), np.asarray(np.pi))])


def postures(rng: np.random.Generator, count: int) -> Posture:
    pose = np.concatenate([rng.uniform(-0.1, 0.3, (count, 3)), unit_vectors(rng, count, 4)], 1)
    return Posture(pose, rng.uniform(-0.3, 1, (count, 2)))


def lowest_vertex(posture: Posture, object_pose: np.ndarray) -> np.ndarray:
    """Lowest corner of all tessellated pieces in the table frame, by brute force."""
    bodies = compose(object_pose, body_poses(HAND, posture.hand_pose, posture.joint_positions))
    return np.min([apply(bodies[:, p.body][:, None], p.vertices)[..., 2].min(axis=1) for p in HAND.pieces], axis=0)


def test_clearance_agrees_with_all_corners_of_all_pieces_on_way():
    rng = np.random.default_rng(0)
    grasp, pregrasp = postures(rng, 5), postures(rng, 5)
    scenes = postures(rng, 3).hand_pose
    found = transfer_grasps(HAND, grasp, pregrasp, scenes)["grasp/table_clearance_m"].reshape(3, 5)
    path = approach_postures(grasp, pregrasp)
    expected = np.array([lowest_vertex(path, scene).reshape(5, -1).min(axis=1) for scene in scenes])
    assert np.all(found <= expected + 1e-12)
    np.testing.assert_allclose(found, expected, atol=TESSELLATION_M)


def test_transferred_poses_are_base_poses_seen_from_the_table():
    rng = np.random.default_rng(1)
    grasp, scenes = postures(rng, 4), postures(rng, 2).hand_pose
    result = transfer_grasps(HAND, grasp, grasp, scenes)
    assert result["grasp/scene_index"].tolist() == [0] * 4 + [1] * 4
    assert result["grasp/base_index"].tolist() == [0, 1, 2, 3] * 2
    back = compose(invert(scenes[result["grasp/scene_index"]]), result["grasp/hand_pose"])
    points = rng.normal(size=(8, 3))
    base = grasp.hand_pose[result["grasp/base_index"]]
    np.testing.assert_allclose(apply(back, points), apply(base, points), atol=1e-12)


@pytest.mark.parametrize(("gap", "valid"), [(MARGIN_M + 1e-6, 1), (MARGIN_M - 1e-6, 0)])
def test_a_grasp_is_valid_from_the_stated_margin_on(gap, valid):
    # Palm up: the lowest point is the bottom of the palm box, 0.03 below the root.
    posture = Posture(np.array([[0, 0, 0.03 + gap, 1, 0, 0, 0]]), np.zeros((1, 2)))
    assert transfer_grasps(HAND, posture, posture, IDENTITY)["grasp/valid"].tolist() == [valid]


def test_a_hand_that_sweeps_through_the_table_is_caught():
    """Fingers point sideways at both ends and straight down half-way."""
    y = np.array([0.0, 1, 0])
    start, end = (np.concatenate([[0, 0, 0.075], quat_from_axis_angle(y, np.asarray(np.pi + a))]) for a in (-1.4, 1.4))
    pregrasp, grasp = Posture(start[None], np.zeros((1, 2))), Posture(end[None], np.zeros((1, 2)))
    at_ends = min(lowest_vertex(p, IDENTITY[0])[0] for p in (pregrasp, grasp))
    result = transfer_grasps(HAND, grasp, pregrasp, IDENTITY)
    assert at_ends > MARGIN_M
    # Pointing straight down the tips reach 0.079 below the root.
    assert result["grasp/table_clearance_m"][0] <= 0.075 - 0.079 and result["grasp/valid"][0] == 0
    assert result["grasp/contact_table_clearance_m"][0] == pytest.approx(lowest_vertex(grasp, IDENTITY[0])[0], abs=1e-4)
    assert result["grasp/rejection"][0] == Rejection.TABLE_ON_APPROACH
    on_table = Posture(np.array([[0, 0, 0.0, 1, 0, 0, 0]]), np.zeros((1, 2)))
    assert transfer_grasps(HAND, on_table, pregrasp, IDENTITY)["grasp/rejection"][0] == Rejection.TABLE_AT_CONTACT


def test_many_grasps_give_what_each_gives_alone():
    rng = np.random.default_rng(2)
    grasp, scenes = postures(rng, 130), postures(rng, 1).hand_pose
    together = transfer_grasps(HAND, grasp, grasp, scenes)["grasp/table_clearance_m"]
    for k in (0, 64, 129):
        one = grasp.take(slice(k, k + 1))
        assert transfer_grasps(HAND, one, one, scenes)["grasp/table_clearance_m"] == pytest.approx(
            together[[k]], abs=1e-12
        )


def test_no_grasps_are_empty_too_many_are_refused() -> None:
    none = Posture(np.zeros((0, 7)), np.zeros((0, 2)))
    result = transfer_grasps(HAND, none, none, IDENTITY)
    assert result["grasp/hand_pose"].shape == (0, 7) and result["grasp/valid"].shape == (0,)
    rng = np.random.default_rng(3)
    with pytest.raises(InputError, match="2 grasps come with 1 pregrasps"):
        transfer_grasps(HAND, postures(rng, 2), postures(rng, 1), IDENTITY)
    with pytest.raises(InputError, match="1 to 8"):
        drop_together(box(0.05, 0.05, 0.05), [box(0.02, 0.02, 0.02)] * 9, count=1, seed=0)


def box(*size: float):
    return object_from_mesh(trimesh.creation.box(size), "box" + "x".join(map(str, size)))


@pytest.mark.parametrize("height", [0.1, 0.18])
def test_clearance_from_a_box_is_the_gap_or_the_depth(height):
    # Tips end 0.25 - 0.079 above the table, over the box below them or in it.
    neighbours = Neighbours([box(0.3, 0.3, height)], np.array([[[0, 0, height / 2, 1.0, 0, 0, 0]]]))
    found = neighbour_clearance(HAND, Posture(DOWN[None], np.zeros((1, 2))), IDENTITY, neighbours)
    assert found[0, 0] == pytest.approx(0.25 - 0.079 - height, abs=ENGINE_M)


def test_clearance_is_a_capped_lower_bound_of_corner_distances():
    rng = np.random.default_rng(0)
    block = box(0.04, 0.05, 0.06)
    posture, poses = postures(rng, 12), np.array([[[0.15, 0.1, 0.03, 1.0, 0, 0, 0]]])
    found = neighbour_clearance(HAND, posture, IDENTITY, Neighbours([block], poses))[0]
    points, _ = trimesh.sample.sample_surface_even(trimesh.Trimesh(block.vertices, block.faces), 800, seed=0)
    surface = apply(poses[0, 0], points)
    bodies = compose(IDENTITY, body_poses(HAND, posture.hand_pose, posture.joint_positions))
    for k in range(12):
        corners = np.concatenate([apply(bodies[k, p.body], p.vertices) for p in HAND.pieces])
        nearest = np.linalg.norm(corners[:, None] - surface, axis=-1).min()
        assert found[k] <= min(nearest, FARTHEST_M) + ENGINE_M
    assert (found == FARTHEST_M).any() and (found < FARTHEST_M).any()


def test_grasp_that_neighbour_blocks_is_rejected_with_the_reason():
    low = np.array([[0, 0, 0.2, *DOWN[3:]]])
    high = np.array([[0, 0, 0.3, *DOWN[3:]]])
    still = np.zeros((1, 2))
    tower = box(0.02, 0.02, 0.15)

    def reason(grasp: np.ndarray, pregrasp: np.ndarray, place: list[float]) -> tuple[int, int]:
        neighbours = Neighbours([tower], np.array([[[*place, 1.0, 0, 0, 0]]]))
        result = transfer_grasps(HAND, Posture(grasp, still), Posture(pregrasp, still), IDENTITY, neighbours)
        return int(result["grasp/rejection"][0]), int(result["grasp/valid"][0])

    assert reason(low, high, [0.3, 0, 0.075]) == (Rejection.NONE, 1)
    assert reason(low, high, [0.04, 0, 0.075]) == (Rejection.NEIGHBOUR_AT_CONTACT, 0)
    # The hand comes from the side, through the tower.
    aside = low + np.array([0.2, 0, 0, 0, 0, 0, 0])
    assert reason(low, aside, [0.12, 0, 0.075]) == (Rejection.NEIGHBOUR_ON_APPROACH, 0)


def test_the_table_comes_before_the_neighbours_among_the_reasons():
    into_table = np.array([[0, 0, 0.05, *DOWN[3:]]])
    tower = Neighbours([box(0.02, 0.02, 0.15)], np.array([[[0.04, 0, 0.075, 1.0, 0, 0, 0]]]))
    posture = Posture(into_table, np.zeros((1, 2)))
    assert transfer_grasps(HAND, posture, posture, IDENTITY, tower)["grasp/rejection"][0] == Rejection.TABLE_AT_CONTACT
