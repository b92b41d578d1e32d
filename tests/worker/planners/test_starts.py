"""Starts of free hands and starts across an object: pairs of opposite points, and hands that hold between them."""

from dataclasses import replace

import numpy as np
import pytest
import trimesh

from benchmarks.integrators.hands import ring_hand
from graspd.commands.synth import _format_summary
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.transforms import apply, quat_from_matrix, quat_rotate
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.files.synthesis import synthesize_grasps
from graspd.worker.grasps import Posture
from graspd.worker.hands.flat_pinches import flat_pinches
from graspd.worker.hands.jaws import fingertip_pad, least_fingertip_width, pads_of
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.pinch_postures import pinch_postures_of
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import PlanRequest, fitting_pairs, synthesize
from graspd.worker.planners.fast_graspd import antipodal_starts, starts
from graspd.worker.planners.fast_graspd.antipodal_starts import (
    Openings,
    crossings_of,
    narrow_reason,
    place_antipodal_hands,
    select_draws,
)
from graspd.worker.planners.fast_graspd.candidates import posture_of
from graspd.worker.planners.fast_graspd.pairs import pair_of
from graspd.worker.planners.fast_graspd.scene_starts import REACHING, clear_scene_starts, free_directions, obstruction
from graspd.worker.planners.fast_graspd.starts import CLEAR, NO_PLACE, RETREATS, clear_starts, start_generator
from graspd.worker.simulation.data import HandState
from graspd.worker.simulation.environment import Environment, Obstacle, Scenes
from graspd.worker.simulation.model import Model
from graspd.worker.simulation.obstacles import MARGIN_M, DeviceObstacles, body_clearance
from tests.worker.hands.urdfs import gripper
from tests.worker.models import object_from_mesh
from tests.worker.simulation.rigs import ball

#: A box that an Allegro hand spans in one direction only, and half of its width there [m].
SIDES = (0.1, 0.24, 0.24)
HALF = SIDES[0] / 2
BLOCK = object_from_path("block", face_error_m=1e-3)
CUBE = object_from_mesh(trimesh.creation.box((0.06, 0.06, 0.06)))
DRAFT = FIDELITIES["draft"]
UP = np.array([0.0, 0, 1])
SIZE = np.array([0.05, 0.06, 0.08])
BOX = object_from_mesh(trimesh.creation.box(SIZE))
UPRIGHT = (1.0, 0.0, 0.0, 0.0)


def draft_model(hand, obj, scenes: tuple[Environment, ...] = ()) -> Model:
    pair = pair_of(hand, obj, DRAFT, "cpu")
    obstacles = DeviceObstacles.create(hand, scenes, obj.centre_of_mass, "cpu") if scenes else None
    return pair.model(pair.coarse, obstacles)


def model_of(sides: tuple[float, float, float]) -> Model:
    return draft_model(hand_from_path("allegro"), object_from_mesh(trimesh.creation.box(sides)))


@pytest.fixture(scope="module")
def model() -> Model:
    return model_of(SIDES)


def starts_of(model: Model, count: int, each: int) -> tuple[HandState, np.ndarray]:
    return clear_starts(model, [start_generator(3, 0, i, k) for i in range(count) for k in range(each)], each=each)


def spans(model: Model, state: HandState) -> np.ndarray:
    """(n,) whether pads of fingertips are on both sides of the thin direction of the box."""
    hand = model.hand.model
    posture = posture_of(hand, model.obj.model, state)
    pose = body_poses(hand, posture.hand_pose, posture.joint_positions)[:, list(hand.fingertips)]
    pads = np.array([fingertip_pad(hand, tip).centre for tip in hand.fingertips])
    x = (quat_rotate(pose[..., 3:], pads) + pose[..., :3])[..., 0] - model.obj.model.centre_of_mass[0]
    return (x.min(axis=1) < -HALF) & (x.max(axis=1) > HALF)


def test_every_second_start_has_fingers_on_both_sides_of_a_box(model: Model) -> None:
    state, _ = starts_of(model, 24, 4)
    looking, reaching = spans(model, state).reshape(24, 2, 2).mean(axis=(0, 1))
    # 0.71 against 0.33: a palm that looks at a random place stands at an edge by chance.
    assert reaching > looking + 0.2


def test_starts_do_not_depend_on_others_and_draws_go_on(model: Model) -> None:
    reaching = antipodal_starts.ReachSampling.of(model)
    seeds, first, retreats = np.arange(8, dtype=np.int32), np.zeros(8, np.int32), np.array(RETREATS)
    found, number = reaching.starts(seeds, first, retreats)
    for i in (0, 3, 7):
        alone, draw = reaching.starts(seeds[i : i + 1], first[:1], retreats)
        assert draw[0] == number[i]
        for name in ("pivot", "rotation", "q"):
            np.testing.assert_array_equal(getattr(alone, name)[0], getattr(found, name)[i])
    # Draws go on where the last one ended.
    again, same = reaching.starts(seeds, number, retreats)
    later, after = reaching.starts(seeds, number + 1, retreats)
    np.testing.assert_array_equal(same, number)
    np.testing.assert_array_equal(again.pivot, found.pivot)
    more = after >= 0
    assert more.any() and (after > number)[more].all()
    assert not (later.pivot == found.pivot)[more].all(axis=1).any()


def test_what_is_too_wide_all_over_is_looked_at_only() -> None:
    wide = model_of((0.25, 0.25, 0.25))
    assert antipodal_starts.ReachSampling.of(wide) is None
    looking, _ = starts_of(wide, 2, 2)
    alone = [start_generator(3, 0, i, k) for i in range(2) for k in range(2)]
    np.testing.assert_array_equal(looking.pivot, clear_starts(wide, alone)[0].pivot)


@pytest.mark.parametrize("side", [0.01, 0.2])
def test_all_starts_reach_around_what_pads_cannot_hold(side: float) -> None:
    model = model_of((side, side, side))
    assert antipodal_starts.ReachSampling.of(model).only
    _, depth = starts_of(model, 16, 2)
    assert (depth <= CLEAR).mean() > 0.9


def test_draws_are_those_of_each_generator_alone_and_look_at_the_object() -> None:
    hand, obj = hand_from_path("allegro"), object_from_path("mug")
    pair, seeds = starts._Pair(hand, obj), range(64)
    state, way = starts.draw_starts(pair, [start_generator(7, 0, i, 0) for i in seeds])
    np.testing.assert_allclose(quat_rotate(state.rotation, hand.palm.approach), way, atol=1e-12)
    # From a palm the surface is as far away as the gap says, straight ahead.
    near, far = (state.pivot + gap * way + pair.centre for gap in starts.GAP)
    mesh = trimesh.Trimesh(obj.vertices, obj.faces)
    assert max(mesh.nearest.on_surface((near + far) / 2)[1]) <= (starts.GAP[1] - starts.GAP[0]) / 2 + 1e-9
    for i in seeds[::16]:
        alone, _ = starts.draw_starts(pair, [start_generator(7, 0, i, 0)])
        np.testing.assert_array_equal(alone.pivot[0], state.pivot[i])
        np.testing.assert_array_equal(alone.q[0], state.q[i])


@pytest.fixture(scope="module")
def ring():
    return ring_hand(6)


def test_a_ring_of_six_has_a_place_only_when_it_opens(ring) -> None:
    model, generators = draft_model(ring, CUBE), [start_generator(5, 0, i, 0) for i in range(4)]
    state, depth = clear_starts(model, generators)
    assert (depth > NO_PLACE).all()
    opened = starts.open_further(model, generators, state, depth, np.array([True, True, True, False]))
    assert opened.tolist() == [1, 1, 1, 0] and (depth[:3] <= CLEAR).all() and depth[3] > NO_PLACE
    closed = ring.closing > 0
    assert (state.q[:3, closed].mean(axis=1) < ring.preshape[closed].mean()).all()


def test_an_object_that_no_ring_of_fingers_takes_in_is_told(ring) -> None:
    wide = draft_model(ring, object_from_mesh(trimesh.creation.box((0.2, 0.2, 0.2))))
    with pytest.raises(InputError, match="check the object's units"):
        starts.sample_starts(wide, seed=5, batch=0, indices=range(1), each=1)


def test_a_pyramid_has_no_sides_for_a_gripper() -> None:
    pyramid = trimesh.convex.convex_hull([[0, 0, 0], [0.05, 0.05, 0], [0.05, 0, 0.05], [0, 0.05, 0.05]])
    with pytest.raises(InputError, match="no two opposite sides"):
        fitting_pairs(gripper(), object_from_mesh(pyramid))


def test_a_hand_that_has_a_place_keeps_it() -> None:
    model, generators = draft_model(hand_from_path("barrett"), CUBE), [start_generator(5, 0, i, 0) for i in range(4)]
    state, depth = clear_starts(model, generators)
    before = state.pivot.copy(), state.rotation.copy(), state.q.copy()
    assert not starts.open_further(model, generators, state, depth, np.ones(4, bool)).any()
    for was, now in zip(before, (state.pivot, state.rotation, state.q), strict=True):
        np.testing.assert_array_equal(was, now)


def test_a_grasp_that_opened_does_not_depend_on_its_batch(ring) -> None:
    many, few = (
        synthesize(ring, CUBE, PlanRequest(count, DRAFT, seed=3), ExecutionContext(threads=threads)).grasp
        for count, threads in ((5, 3), (2, 1))
    )
    np.testing.assert_array_equal(many.hand_pose[:2], few.hand_pose)
    np.testing.assert_array_equal(many.joint_positions[:2], few.joint_positions)


def lying(obj) -> Environment:
    return Environment((Obstacle.half_space(UP, float(obj.vertices[:, 2].min())),), UP)


def on_its_table(obj) -> Scenes:
    return Scenes(lying(obj).obstacles, np.array([[0.0, 0, 0, 1, 0, 0, 0]]))


@pytest.fixture(scope="module")
def barrett():
    return hand_from_path("barrett")


def test_pairs_of_a_ball_are_its_chords_within_the_cones() -> None:
    obj = ball()
    pairs = crossings_of(obj)
    off = np.linalg.norm(pairs.middle - obj.centre_of_mass, axis=1)
    radius = np.hypot(0.5 * pairs.width, off)
    assert radius.max() - radius.min() < 0.05 * obj.radius  # a mesh of flat faces
    assert radius == pytest.approx(obj.radius, rel=0.05)
    # A chord at an angle t to the normals is 2 r cos t long; normals of faces are off by a few degrees.
    assert (0.5 * pairs.width / obj.radius).min() > antipodal_starts.ACROSS - 0.06
    assert max(np.linalg.norm(end - obj.centre_of_mass, axis=1).max() for end in pairs.ends()) <= obj.radius + 1e-9


def test_what_a_hand_cannot_span_or_reach_is_told(barrett) -> None:
    known = pinch_postures_of(barrett)
    assert Openings.of(known, BLOCK, lying(BLOCK)).within_reach
    deep = Environment((Obstacle.half_space(UP, float(BLOCK.vertices[:, 2].max()) + 0.01),), UP)
    assert not Openings.of(known, BLOCK, deep).within_reach
    wide = replace(BLOCK, vertices=10 * BLOCK.vertices, centre_of_mass=10 * BLOCK.centre_of_mass)
    opening = Openings.of(known, wide, lying(wide))
    assert not opening.within_reach and not len(opening.sums)


def test_hands_reach_across_what_lies_flat_from_above(barrett) -> None:
    flat = object_from_mesh(trimesh.creation.box([0.06, 0.06, 0.01]))
    scene, standing = lying(flat), Environment((Obstacle.half_space([1.0, 0, 0], -0.03),), np.array([1.0, 0, 0]))
    opening = Openings.in_scene(barrett, flat, scene)
    assert len(opening.known) == len(flat_pinches(barrett, 0.01)) > 0
    assert len(Openings.in_scene(barrett, flat, standing).known) == len(pinch_postures_of(barrett))
    found = place_antipodal_hands(
        barrett, flat, opening, np.random.default_rng(1).random((60, 6)), free_directions(scene, flat)
    )
    line = np.einsum("nij,nj->ni", found.turn, opening.known.axis[found.posture])
    assert np.abs(line @ UP).max() < 1e-6 and (found.away @ UP).min() > 0.6


def test_hands_hold_the_middle_and_come_from_a_free_way(barrett) -> None:
    rng = np.random.default_rng(0)
    opening, known = Openings.of(pinch_postures_of(barrett), BLOCK, lying(BLOCK)), pinch_postures_of(barrett)
    uniform = rng.random((40, 6))
    uniform[:, 5] = 0.0
    found = place_antipodal_hands(barrett, BLOCK, opening, uniform, np.array([[0.0, 0, 1]]))
    # Without noise the dofs are those of one of the known postures, whose middle lies in that of a pair.
    assert np.array_equal(found.q(barrett, np.zeros((40, barrett.dofs))), known.q[found.posture])
    rotation = quat_from_matrix(found.turn)
    middle = found.pivot + BLOCK.centre_of_mass
    middle = middle + quat_rotate(rotation, known.middle[found.posture] - barrett.palm.centre)
    gap = np.linalg.norm(middle[:, None] - opening.pairs.middle[None], axis=-1).min(axis=1)
    assert gap == pytest.approx(0.0, abs=1e-9)
    level = np.abs(quat_rotate(rotation, known.axis[found.posture])[:, 2]) < 0.5
    # Across a level line a hand can come as the way says, up to how squarely its palm looks.
    assert (found.away[level, 2] > 0.3).all()


def hindered(hand, obj, scenes: Scenes, height: float, share: float) -> float:
    """Merit lost by a hand so far above an object, palm down, its fingers closed by a share of their range."""
    placed = scenes.placed(np.zeros(1, int))
    model = draft_model(hand, obj, placed.scenes)
    at = np.array([[0, 0, float(obj.vertices[:, 2].max()) - obj.centre_of_mass[2] + height]])
    q = np.where(hand.closing > 0, hand.lower + share * hand.span, hand.upper - share * hand.span)
    # The palm looks along its z axis: turned about x it looks down.
    return float(obstruction(model, HandState(at, np.array([[0.0, 1.0, 0.0, 0.0]]), q[None]), placed)[0])


def test_a_hand_around_an_edge_or_below_a_board_is_hindered(barrett) -> None:
    table = on_its_table(BLOCK)
    assert hindered(barrett, BLOCK, table, 0.15, 0.1) == 0.0
    assert hindered(barrett, BLOCK, table, 0.03, 1.0) > 0.1
    top = float(BLOCK.vertices[:, 2].max())
    for room_m, low in ((0.06, True), (0.30, False)):
        # The palm is 15 cm above the block, the board `room_m` above the palm; the hand's back is some cm thick.
        board = Obstacle.box([0, 0, top + 0.15 + room_m + 0.25, 1, 0, 0, 0], [1.0, 1.0, 0.5])
        below = replace(table, supports=(*table.supports, board))
        assert (hindered(barrett, BLOCK, below, 0.15, 0.1) > 0.1) == low


def test_how_far_pair_is_beside_pads_of_a_hand_that_was_moved(barrett) -> None:
    opening = Openings.of(pinch_postures_of(barrett), BLOCK, lying(BLOCK))
    uniform, ways = np.random.default_rng(0).random((30, 6)), np.array([[0.0, 0, 1]])
    found = place_antipodal_hands(barrett, BLOCK, opening, uniform, ways)
    assert found.deep.min() >= 0.0 and found.deep.max() > 0.02
    # Back by as much as it is deep, or less: what lies between palm and pads lies between the fingers.
    for share in (0.0, 0.5, 1.0):
        assert found.pad_distance(share * found.deep[:, None] * found.away) == pytest.approx(0.0, abs=1e-12)
    assert found.pad_distance((found.deep + 0.03)[:, None] * found.away) == pytest.approx(0.03)
    aside = np.cross(found.away, [1.0, 0, 0])
    aside *= 0.02 / np.linalg.norm(aside, axis=1, keepdims=True)
    assert found.pad_distance(aside) == pytest.approx(0.02)
    several = found.pad_distance(np.stack([aside, 2 * aside], axis=1))
    assert several == pytest.approx(np.tile([0.02, 0.04], (30, 1)))


@pytest.mark.parametrize("tips_m", [None, 0.0])
def test_outlines_tell_how_far_a_hand_must_rise(barrett, tips_m) -> None:
    opening = Openings.of(pinch_postures_of(barrett), BLOCK, lying(BLOCK))
    uniform, ways = np.random.default_rng(0).random((60, 6)), np.array([[0.0, 0, 1], [0.6, 0, 0.8]])
    table = replace(lying(BLOCK).obstacles[0], tips_m=tips_m)
    scene = Environment((table,), UP)
    found = place_antipodal_hands(barrett, BLOCK, opening, uniform, ways)
    centre = found.pivot + BLOCK.centre_of_mass
    known = pinch_postures_of(barrett).q
    outlines, again, few = (antipodal_starts.posture_outlines(barrett, q) for q in (known, known.copy(), known[:3]))
    assert outlines is again and len(few.points) == 3
    told = outlines.missing_clearance(found.posture, found.turn, centre, scene, room=0.006)
    root = centre - np.einsum("nij,j->ni", found.turn, barrett.palm.centre)
    q = found.q(barrett, np.zeros((60, barrett.dofs)))
    posture = Posture(np.concatenate([root, quat_from_matrix(found.turn)], axis=1), barrett.expand(q))
    room = body_clearance(barrett, posture, [Environment((replace(table, tips_m=None),), UP)])
    tip = np.isin(np.arange(barrett.bodies), barrett.fingertips)
    wanted = np.where(tip & (tips_m is not None), 0.0, MARGIN_M) + 0.006
    lack = np.maximum(0.0, (wanted - room).max(axis=1))
    # Points of the hand itself: never more than it lacks. 26 degrees beside a direction in which a point is outermost,
    # a tenth of the hand's 18 cm may stand out farther.
    assert (told <= lack + 1e-9).all() and (lack > 0.02).any()
    assert (lack - told).max() < 0.018 and (lack - told).mean() < 0.002


def test_draws_that_need_not_rise_come_first_in_their_order(barrett) -> None:
    scene = lying(BLOCK)
    opening = Openings.of(pinch_postures_of(barrett), BLOCK, scene)
    uniform, ways = np.random.default_rng(1).random((5, 40, 6)), free_directions(scene, BLOCK)
    order, off = select_draws(barrett, BLOCK, opening, uniform, ways, scene, room=0.006, keep=40)
    assert np.array_equal(np.sort(order, axis=1), np.tile(np.arange(40), (5, 1)))
    near = off <= antipodal_starts.NEAR_M
    assert near.any() and not near.all()
    for places, offs, alike in zip(order, off, near, strict=True):
        assert (np.diff(places[alike]) > 0).all()
        assert (np.diff(offs[~alike]) >= 0).all() and alike[: alike.sum()].all()
    few, least = select_draws(barrett, BLOCK, opening, uniform[3:4], ways, scene, room=0.006, keep=7)
    assert np.array_equal(few[0], order[3, :7]) and np.array_equal(least[0], off[3, :7])


def test_what_lies_flat_is_between_the_fingers_at_the_start(barrett) -> None:
    scale = np.array([1.0, 0.6, 0.4])
    thin = replace(BLOCK, vertices=BLOCK.vertices * scale, centre_of_mass=BLOCK.centre_of_mass * scale, digest="7" * 64)
    thin = replace(thin, hull_vertices=BLOCK.hull_vertices * scale)
    (table,) = lying(thin).obstacles
    placed = Scenes((replace(table, tips_m=0.0),), on_its_table(thin).object_pose).placed(np.zeros(4, int))
    model = draft_model(barrett, thin, placed.scenes)
    ways = [free_directions(placed.scenes[0], thin)]
    generators = [start_generator(0, 0, i, k) for i in range(4) for k in range(REACHING)]
    state, depth = clear_scene_starts(model, generators, each=REACHING, placed=placed, ways=ways)
    assert (depth <= CLEAR).mean() > 0.9
    posture = posture_of(barrett, thin, state)
    bodies = body_poses(barrett, posture.hand_pose, posture.joint_positions)
    pads = np.stack([apply(bodies[:, p.body], p.centre) for p in pads_of(barrett)], axis=1)
    # Barrett's third finger stands against the other two.
    first, others = pads[:, 2], pads[:, :2].mean(axis=1)
    line = first[:, None] + np.linspace(0, 1, 41)[:, None] * (others - first)[:, None]
    low, high = thin.vertices.min(axis=0), thin.vertices.max(axis=0)
    between = ((line > low - 0.01) & (line < high + 0.01)).all(axis=-1).any(axis=1)
    assert between.mean() > 0.7


def beside_walls(gap: float, axes: tuple[int, ...]) -> Environment:
    """The box on a table, with a wall as high as itself beside it along +x, +y or both [m]."""
    found = [Obstacle.half_space(UP, -0.5 * SIZE[2])]
    for axis in axes:
        centre, size = np.zeros(3), np.full(3, 0.4)
        centre[axis], size[axis] = 0.5 * SIZE[axis] + gap + 0.01, 0.02
        found.append(Obstacle.box((*centre, *UPRIGHT), size))
    return Environment(tuple(found), UP)


def test_a_gap_is_named_with_the_fingertip_that_does_not_fit(barrett) -> None:
    told = narrow_reason(barrett, BOX, [beside_walls(0.008, (0, 1))])
    assert "about 8 mm" in told and f"{1e3 * least_fingertip_width(barrett):.0f} mm" in told
    # One of several scenes that has room is enough, and so is one axis that is free.
    assert narrow_reason(barrett, BOX, [beside_walls(0.008, (0, 1)), beside_walls(0.03, (0, 1))]) is None
    assert narrow_reason(barrett, BOX, [beside_walls(0.008, (0,))]) is None
    assert narrow_reason(barrett, BOX, [beside_walls(0.008, ())]) is None


def test_what_is_too_wide_is_told(barrett) -> None:
    large = object_from_mesh(trimesh.creation.box([0.4, 0.4, 0.4]))
    table = Environment((Obstacle.half_space(UP, -0.2),), UP)
    assert f"opens to {1e3 * pinch_postures_of(barrett).widest:.0f} mm" in str(narrow_reason(barrett, large, [table]))


def test_a_ball_beside_a_pair_keeps_its_distance_from_a_wall() -> None:
    pairs, gap, width = crossings_of(BOX), 0.03, 0.02
    right = pairs.ends()[1][:, 0] > 0.5 * SIZE[0] - 1e-6
    across = right & (pairs.axis[:, 0] > 0.999)
    assert across.any()
    room = antipodal_starts.end_clearance(pairs, beside_walls(gap, (0,)), width)
    assert room[across] == pytest.approx(gap - width, abs=1e-4)
    assert np.isinf(antipodal_starts.end_clearance(pairs, beside_walls(gap, ()), width)).all()


def test_pairs_with_room_for_fingertips_are_drawn_more_often(barrett) -> None:
    scene, known = beside_walls(0.008, (0,)), pinch_postures_of(barrett)

    def share(tip: float) -> float:
        opening = Openings.of(known, BOX, scene, tip=tip)
        chance = np.diff(opening.sums, prepend=0.0)
        return float(chance[np.abs(opening.pairs.axis[:, 1]) > 0.9].sum())

    assert share(least_fingertip_width(barrett)) > 0.85 > share(0.0)


def test_candidate_grasps_none_of_which_is_valid_come_with_the_reason(tmp_path) -> None:
    sheet = tmp_path / "sheet.stl"
    trimesh.creation.box([0.08, 0.08, 0.004]).export(sheet)
    place, request = SceneSpec(kind="table"), JobOptions(want="candidates", grasps=1, fidelity="draft", scene="table")
    found = synthesize_grasps("allegro", str(sheet), request, place=place, scenes=1).summary()
    assert (found["grasps"], found["valid"], found["reason"]) == (1, 0, None)
    assert "is 4 mm high" in found["narrow"] and _format_summary({"file": "g.h5", **found}).endswith(found["narrow"])
