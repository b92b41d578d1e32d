"""Lifts, the short lift and the short pushes on a gripper of two plates and a box that stands on a table.

The trial of candidates is the test of the validator itself, which is then not done again.
"""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from graspd.service.model.errors import InputError
from graspd.service.model.matter import ACCELERATION
from graspd.service.model.transforms import quat_from_axis_angle, quat_multiply, quat_rotate
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet, Posture, join_grasp_sets
from graspd.worker.scenes import rollout as rollouts
from graspd.worker.scenes.rollout import BEST, FALLS, TOUCHES, hold_rollout, lift_rollout, scene_verdicts
from graspd.worker.simulation.environment import Neighbour, Obstacle, PlacedGrasps
from graspd.worker.simulation.obstacles import obstacle_clearance
from graspd.worker.validation import prescreening
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.lift import RISING, RISING_S, Lift, LiftOutcome
from graspd.worker.validation.lifting import KnownLifts, LiftLevel, lift_key, validate_lifts
from graspd.worker.validation.model import FRICTION, HARD, MujocoOptions, build_scene
from graspd.worker.validation.prescreening import PHYSICS, SLIPS, ShortTests
from graspd.worker.validation.protocol import MAX_DISPLACEMENT_M, STAGE_S, Test
from graspd.worker.validation.robust import validate_robustness
from graspd.worker.validation.validator import KnownRollouts, validate
from graspd.worker.validation.variant import (
    Models,
    Variant,
    VariantLift,
    displace_grasp,
    object_motion,
    restrict_to_support,
)
from tests.worker.models import object_from_mesh
from tests.worker.quality.helpers import pad_hand, posture

HALF, HEIGHT = 0.03, 0.05
HAND = pad_hand()
BOX = object_from_mesh(trimesh.creation.box((2 * HALF, 0.04, HEIGHT)))
WHOLE = ConvexPieces((BOX.hull_vertices,), 1.0, 0.0, "box")
#: The hand's base is at -z of the object: the box stands on its head, so that the hand comes from above.
UPSIDE_DOWN = np.array([[0, 0, HEIGHT / 2, 0, 1, 0, 0.0]])
PLACED = PlacedGrasps((Obstacle.half_space([0, 0, 1], 0.0),), UPSIDE_DOWN, np.zeros(1, int))
#: Joint value at which the pads touch.
TOUCH = 0.065
#: Squeeze [m] whose two normal forces F = kp d hold a pull of 1 N by friction: 2 mu F = 1 N; the same for the pulls.
NEWTON = 1 / (2 * PHYSICS.friction[0]) / float(HAND.stiffness[0])
LEAST, LEAST_PUSHED = prescreening.HANGS_WHOLE * NEWTON, prescreening.PULL * NEWTON
#: The same of what hangs at half the friction.
LEAST_AT_HALF = 2 * prescreening.HANGS * NEWTON
#: Of a push towards a corner what two pads must hold by friction, across their normals; the rest one of them carries.
ACROSS = float(np.sqrt(2.0 / 3.0))
LIFTED, TOUCHED, FELL = 1, 3, 5


def grasp(squeeze: float, way: np.ndarray | None = None) -> GraspSet:
    """Pads 5 mm open, in touch, then commanded `squeeze` [m] past the touch; the hand comes straight from above."""
    open_, touch, press = (posture(((0.0, 0.0, 0.0), (q, q))) for q in (TOUCH - 0.005, TOUCH, TOUCH + squeeze))
    approach = np.repeat(open_.hand_pose[:, None], 6, axis=1)
    approach[..., :3] += np.linspace(0.1, 0, 6)[:, None] * (np.array([0, 0, -1.0]) if way is None else way)
    lift = Posture(press.hand_pose - np.array([0, 0, 0.1, 0, 0, 0, 0]), press.joint_positions)
    found = GraspSet(touch, open_, press, np.full(1, np.nan))
    return replace(found, approach=approach, coming=open_.joint_positions, lift=lift)


def placed(count: int) -> PlacedGrasps:
    return replace(PLACED, index=np.zeros(count, int))


def lift_test() -> Lift:
    return Lift(build_scene(HAND, BOX, WHOLE, MujocoOptions(), PLACED.supports), PLACED)


@pytest.mark.parametrize("level", ["dexgraspbench", "lift"])
def test_a_firm_squeeze_lifts_the_box_and_none_leaves_it(level: str) -> None:
    test = lift_test()
    firm, none = (getattr(test, level)(grasp(squeeze), 0) for squeeze in (0.05, -0.005))
    assert (firm.outcome, none.outcome) == (LiftOutcome.LIFTED, LiftOutcome.NOT_LIFTED) and firm.margin < 0.5


def test_a_lift_ends_where_its_object_is_lost() -> None:
    test = lift_test()
    lost, held = (test.lift(grasp(squeeze), 0) for squeeze in (-0.01, 0.05))
    assert test.lift(grasp(0.05), 0) == held, "nothing stays of the lift before"
    # Half of the rise takes the hand 5 cm away from a box that stays.
    rise = RISING * RISING_S / MujocoOptions().timestep
    assert lost.steps < held.steps - 0.3 * rise


def test_a_hand_that_comes_through_box_or_table_has_touched_them() -> None:
    test, through = lift_test(), grasp(0.05, np.array([1.0, 0, 0]))
    assert test.lift(through, 0).outcome is LiftOutcome.TOUCHED_ON_THE_WAY
    assert test.lift(grasp(0.05, np.array([0, 0, 1.0])), 0).outcome is LiftOutcome.TOUCHED_ON_THE_WAY
    # The DexGraspBench protocol does not look at the way.
    assert test.dexgraspbench(through, 0).outcome is LiftOutcome.LIFTED


@pytest.mark.parametrize(("tips_m", "touched"), [(None, True), (0.0, True), (-0.0005, True), (-0.001, False)])
def test_fingertips_press_into_the_table_as_deep_as_it_says(tips_m: float | None, touched: bool) -> None:
    """A way that ends with the pads 0.8 mm in the table."""
    placed = replace(PLACED, supports=(replace(PLACED.supports[0], tips_m=tips_m),))
    given = grasp(0.05)
    down = obstacle_clearance(HAND, given.grasp, PLACED.scenes)[0] + 0.0008
    for part in (given.grasp.hand_pose, given.pregrasp.hand_pose, given.squeeze.hand_pose, given.approach[0]):
        part[:, 2] += down
    found = Lift(build_scene(HAND, BOX, WHOLE, MujocoOptions(), placed.supports), placed).lift(given, 0)
    assert (found.outcome is LiftOutcome.TOUCHED_ON_THE_WAY) == touched


def test_a_box_with_its_origin_elsewhere_is_lifted_alike() -> None:
    away = np.array([0.02, 0.01, HEIGHT])
    moved_to = trimesh.transformations.translation_matrix(away)
    box = object_from_mesh(trimesh.creation.box((2 * HALF, 0.04, HEIGHT), moved_to))
    pose = PLACED.object_pose.copy()
    pose[:, :3] -= quat_rotate(pose[:, 3:], away)
    placed = PlacedGrasps(PLACED.supports, pose, PLACED.index)
    scene = build_scene(
        HAND, box, ConvexPieces((box.hull_vertices,), 1.0, 0.0, "box"), MujocoOptions(), placed.supports
    )
    test, given = Lift(scene, placed), grasp(0.05)
    for part in (given.grasp, given.pregrasp, given.squeeze, given.lift):
        part.hand_pose[:, :3] += away
    given.approach[..., :3] += away
    # Where the object is follows its mesh's origin, which a turn moves more where it is farther from the centre.
    assert test.lift(given, 0).margin == pytest.approx(lift_test().lift(grasp(0.05), 0).margin, abs=0.02)
    # Nobody near: what stands on a table keeps standing for a second. A contact gives by 0.1 mm.
    test._set_up_scene(given, 0)
    test._set_posture(given.grasp.hand_pose[0] - [0, 0, 1, 0, 0, 0, 0], given.coming[0])
    test._run(1.0)
    moved, turned = test._object_motion()
    assert moved < 5e-4 and turned < 1e-3


def beside(place: tuple[float, float], size: tuple[float, float, float], mass: float = 0.1) -> Lift:
    other = object_from_mesh(trimesh.creation.box(size)).with_mass(mass=mass)
    neighbour = Neighbour(other, (other.hull_vertices,), (), 0.0)
    pose = np.array([[[*place, size[2] / 2, 1.0, 0, 0, 0]]])
    placed = replace(PLACED, neighbours=(neighbour,), neighbour_pose=pose)
    return Lift(build_scene(HAND, BOX, WHOLE, MujocoOptions(), placed.supports, placed.neighbours), placed)


def test_a_neighbour_counts_only_where_the_hand_comes_through_it() -> None:
    rollout = beside((0.0, 0.3), (0.05, 0.05, 0.1)).lift(grasp(0.05), 0)
    assert rollout.outcome is LiftOutcome.LIFTED
    assert rollout.margin == pytest.approx(lift_test().lift(grasp(0.05), 0).margin, abs=0.02)
    coming = grasp(0.05, np.array([0, 1.0, 0]))
    size = (0.2, 0.02, 0.2)
    assert beside((0.0, -0.09), size).lift(coming, 0).outcome is LiftOutcome.TOUCHED_ON_THE_WAY
    assert beside((0.0, 0.09), size).lift(coming, 0).outcome is LiftOutcome.LIFTED


def test_neighbour_has_its_own_mass_which_moves_the_key_of_lifts() -> None:
    light, heavy = (beside((0.0, 0.3), (0.05, 0.05, 0.1), mass) for mass in (0.05, 2.0))
    for test, mass in ((light, 0.05), (heavy, 2.0)):
        test._set_up_scene(grasp(0.05), 0)
        (free,) = test.scene.neighbours
        assert free.mass == pytest.approx(mass)
        assert np.linalg.norm(test.data.xfrc_applied[free.body]) == pytest.approx(ACCELERATION * mass)
    keys = [lift_key(HAND, BOX, test.placed, "lift", False, pieces=WHOLE) for test in (light, heavy)]
    assert keys[0] != keys[1]


def test_a_neighbour_that_leans_or_slides_has_moved() -> None:
    test = beside((0.0, 0.3), (0.05, 0.05, 0.1))
    test._set_up_scene(grasp(0.05), 0)
    free = test.scene.neighbours[0]
    turned = np.array([np.cos(np.radians(8)), np.sin(np.radians(8)), 0, 0])
    test.data.qpos[free.qpos + 3 : free.qpos + 7] = quat_multiply(test._beside[0][3:], turned)
    assert test._neighbours_moved()
    test._set_up_scene(grasp(0.05), 0)
    about = np.array([np.cos(0.5), 0, 0, np.sin(0.5)])
    test.data.qpos[free.qpos + 3 : free.qpos + 7] = quat_multiply(test._beside[0][3:], about)
    assert not test._neighbours_moved()
    test.data.qpos[free.qpos] += 0.021
    assert test._neighbours_moved()


def scores(*squeezes: float, threads: int = 1) -> np.ndarray:
    grasps = join_grasp_sets([grasp(squeeze) for squeeze in squeezes])
    return ShortTests(HAND, BOX, lambda: WHOLE, threads=threads).scores(grasps, placed(len(squeezes)))


def test_the_box_falls_by_what_friction_does_not_carry() -> None:
    nobody, weak, firm = np.subtract(scores(-0.005, 0.9 * LEAST, 1.05 * LEAST), SLIPS)
    # How far it falls from rest until a stage's end finds it gone, over 5 cm.
    fall = 0.5 * prescreening.HANGS_WHOLE * ACCELERATION * (STAGE_S * np.arange(1, 10)) ** 2 / MAX_DISPLACEMENT_M
    assert nobody == pytest.approx(float(fall[fall >= prescreening.GONE][0]), rel=0.05)
    # What slips slowly is less than 5 cm down when the test ends, and would be farther in 2 s.
    assert weak > prescreening.GONE and 0.0 <= firm < 0.05


def test_half_friction_needs_twice_the_squeeze_unless_beaten() -> None:
    grasps = join_grasp_sets([grasp(share * LEAST_AT_HALF) for share in (0.9, 1.1, 0.9)])
    found = ShortTests(HAND, BOX, lambda: WHOLE).scores(grasps, placed(3), np.array([1.5, 1.5, np.inf]))
    assert found[0] == 1.5 and found[1] < 0.05 and SLIPS <= found[2] < SLIPS + 0.05


def test_pads_that_start_in_the_box_are_no_candidates() -> None:
    deep = grasp(0.05)
    deep.pregrasp.joint_positions[:] += 0.02
    assert ShortTests(HAND, BOX, lambda: WHOLE).scores(deep, PLACED) == [prescreening.DEEP]
    assert ShortTests(HAND, BOX, lambda: WHOLE).scores(deep, None) == [prescreening.DEEP]


def test_threads_and_the_other_grasps_change_no_score() -> None:
    squeezes = (0.02, -0.005, 0.05)
    assert np.array_equal(scores(*squeezes, threads=3), scores(*squeezes))
    for score in (scores, pushed):
        assert np.array_equal(score(*squeezes)[1:2], score(squeezes[1]))


def pushed(*squeezes: float) -> np.ndarray:
    return ShortTests(HAND, BOX, lambda: WHOLE).scores(join_grasp_sets([grasp(squeeze) for squeeze in squeezes]), None)


def test_free_box_is_pushed_away_the_less_the_firmer_it_is_held() -> None:
    found = pushed(*(np.array([-0.2, 0.3, 0.6, 0.9, 1.2, 2.4]) * ACROSS * LEAST_PUSHED))
    # Pads that hardly touch turn the box as they are brushed: it is lost either way.
    assert (np.diff(found[1:]) < 0).all()
    # Nothing holds it, or less than a third of what is needed: at the whole friction as well.
    assert (found[:2] >= SLIPS + 1.0).all()
    # Twice the squeeze that holds at the whole friction holds at half of it; pads and their drives give a little.
    assert found[-1] < 0.2


def test_pushes_that_cannot_beat_a_score_end_early() -> None:
    rollout, squeeze = ShortTests(HAND, BOX, lambda: WHOLE).scores, ACROSS * LEAST_PUSHED
    hands = join_grasp_sets([grasp(0.8 * squeeze), grasp(2.4 * squeeze)])
    slips, holds = rollout(hands, None)
    assert holds < 1.0 < SLIPS + 1.0 < slips
    # Only half friction would beat a grasp that holds at full friction.
    assert rollout(hands, None, np.array([1.9, 1.1 * holds])).tolist() == [np.inf, holds]
    assert rollout(hands, None, np.array([2.0, 0.9 * holds]))[0] == slips
    assert rollout(hands, None, np.array([2.0, 0.9 * holds]))[1] >= 0.9 * holds


def test_a_free_box_that_nothing_holds_flies_as_far_as_pushed() -> None:
    seconds = round(STAGE_S * prescreening.PUSHED / PHYSICS.timestep) * PHYSICS.timestep
    freely = 0.5 * prescreening.PULL * ACCELERATION * seconds**2 / MAX_DISPLACEMENT_M
    # Along the pads' normals they are in its way; it turns where it meets one.
    assert pushed(-0.02)[0] - SLIPS >= 0.95 * ACROSS * freely


#: From a pull that slips even at the nominal friction to one that holds at half of it, and one that comes from below.
SQUEEZES = (0.0005, 0.009, 0.012, 0.015, 0.02, 0.05)
MANY = join_grasp_sets([*(grasp(one) for one in SQUEEZES), grasp(0.05, np.array([0, 0, 1.0]))])
WHERE = placed(len(MANY))


def models(friction: tuple[float, float] = FRICTION) -> Models:
    return Models(HAND, BOX, WHOLE, MujocoOptions(friction=friction), PLACED.supports)


@pytest.mark.parametrize("level", ["dexgraspbench", "lift"])
def test_nominal_model_has_verdicts_of_the_lift_test_bit_for_bit(level: str) -> None:
    verdicts = validate_lifts(HAND, BOX, MANY, WHERE, level=level, pieces=WHOLE)  # type: ignore[arg-type]
    published = level == "dexgraspbench"
    found = [models().lift(MANY, row, WHERE, Variant(), dexgraspbench=published) for row in range(len(MANY))]
    assert [rollout.outcome for rollout in found] == verdicts.outcome.tolist()
    assert [rollout.margin for rollout in found] == verdicts.margin.tolist()
    assert {0, 1} == set(verdicts.success.tolist())


def test_half_the_friction_is_the_hard_lift() -> None:
    # The hard protocol takes a tenth of the torsional coefficient where the axis keeps the two in proportion.
    around = models((FRICTION[0], FRICTION[1] * HARD[1] / HARD[0]))
    found = [around.lift(MANY, row, WHERE, Variant(friction=HARD[0])) for row in range(len(MANY))]
    hard = validate_lifts(HAND, BOX, MANY, WHERE, hard=True, pieces=WHOLE)
    assert [rollout.outcome for rollout in found] == hard.outcome.tolist()
    assert [rollout.margin for rollout in found] == hard.margin.tolist()
    assert 0 < hard.success.sum() < validate_lifts(HAND, BOX, MANY, WHERE, pieces=WHOLE).success.sum()


def test_a_heavier_object_weighs_more_and_takes_more_to_lift() -> None:
    test = VariantLift(models().scene(Variant(mass=2.0)), PLACED, Variant(mass=2.0), None)
    test._set_up_scene(MANY, 0)
    weight = test.data.xfrc_applied[test.scene.object_body, :3]
    assert weight == pytest.approx(2.0 * test.scene.push_force * np.array([0, 0, 1.0]))
    lifted = [models().lift(MANY, 2, WHERE, Variant(mass=mass)).success for mass in (1.0, 2.0)]
    assert lifted == [True, False]


def test_an_object_that_stands_off_slides_and_the_hand_stays() -> None:
    up = WHERE.scenes[0].up
    variant = restrict_to_support(Variant(object_shift_m=(0.001, -0.0015, 0.0005), object_turn=(0.01, 0.0, 0.02)), up)
    assert np.array(variant.object_shift_m) @ up == pytest.approx(0.0, abs=1e-12)
    assert variant.object_shift_m[:2] == (0.001, -0.0015)
    assert np.cross(variant.object_turn, up) == pytest.approx([0, 0, 0], abs=1e-12)
    assert np.linalg.norm(variant.object_turn) == pytest.approx(0.02)
    one, motion = displace_grasp(BOX, MANY, 5, variant), object_motion(BOX, variant)
    # Hand, seen from where the object stands, and from where it was thought to be: the same place in the world.
    pregrasps = one.pregrasp.hand_pose[0], MANY.pregrasp.hand_pose[5]
    for now, thought in (pregrasps, (one.approach[0, 0], MANY.approach[5, 0])):
        assert motion[:3] + quat_rotate(motion[3:], now[:3]) == pytest.approx(thought[:3], abs=1e-12)
    turn = quat_from_axis_angle(up, np.array(0.02 * np.sign(np.array(variant.object_turn) @ up)))
    assert abs(float(motion[3:] @ turn)) == pytest.approx(1.0)
    assert models().lift(MANY, 5, WHERE, variant).success


def test_neighbours_stand_beside_the_object_in_every_model() -> None:
    placed = beside((0.0, 0.1), (0.03, 0.03, 0.05)).placed
    around = Models(HAND, BOX, WHOLE, MujocoOptions(), placed.supports, placed.neighbours)
    assert all(
        around.scene(one).neighbours for one in (Variant(), Variant(grown_m=1e-3), Variant(centre_m=(0, 1e-3, 0)))
    )
    found = around.lift(grasp(0.05), 0, placed, Variant(object_shift_m=(0.001, 0, 0)))
    assert found.outcome is LiftOutcome.LIFTED


def test_a_lift_needs_a_scene_and_a_way_of_each_grasp() -> None:
    without, few = replace(MANY, approach=None), WHERE.take(slice(0, 2))
    for grasps, where, level in ((MANY, few, "lift"), (without, WHERE, "lift"), (MANY, WHERE, "no")):
        with pytest.raises(InputError):
            validate_robustness(HAND, BOX, grasps, placed=where, level=level, pieces=WHOLE)  # type: ignore[arg-type]


SQUEEZES = (-0.005, 1.3 * LEAST, 4 * LEAST)
THREE = join_grasp_sets([grasp(squeeze) for squeeze in SQUEEZES])
THREE_PLACES = placed(3)


@pytest.fixture
def lifts(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    done: list[int] = []
    lift = Lift.lift
    monkeypatch.setattr(Lift, "lift", lambda self, grasps, row: done.append(row) or lift(self, grasps, row))
    return done


def test_what_was_validated_once_is_not_simulated_again(lifts: list[int], monkeypatch: pytest.MonkeyPatch) -> None:
    known: KnownLifts = {}
    first = validate_lifts(HAND, BOX, THREE, THREE_PLACES, pieces=WHOLE, known=known)
    again = validate_lifts(HAND, BOX, THREE, THREE_PLACES, pieces=WHOLE, known=known)
    assert len(lifts) == 3
    assert np.array_equal(first.outcome, again.outcome) and np.array_equal(first.margin, again.margin)
    rows: list[int] = []
    standard = Test.standard
    monkeypatch.setattr(Test, "standard", lambda self, given, row: rows.append(row) or standard(self, given, row))
    known: KnownRollouts = {}
    first = validate(HAND, BOX, THREE, pieces=WHOLE, known=known)
    again = validate(HAND, BOX, THREE.take(np.array([2, 0])), pieces=WHOLE, known=known)
    assert sorted(rows) == [0, 1, 2]
    assert np.array_equal(again.outcome, first.outcome[[2, 0]])
    validate(HAND, BOX, THREE, pieces=WHOLE, hard=True, known=known)
    assert len(rows) == 6


@pytest.mark.parametrize("other", ["friction", "squeeze", "scene"])
def test_a_lift_of_anything_else_is_not_known(lifts: list[int], other: str) -> None:
    known: KnownLifts = {}
    validate_lifts(HAND, BOX, THREE, THREE_PLACES, pieces=WHOLE, known=known)
    grasps, where = THREE, THREE_PLACES
    if other == "squeeze":
        grasps = join_grasp_sets([grasp(squeeze + 1e-6) for squeeze in SQUEEZES])
    if other == "scene":
        where = replace(THREE_PLACES, object_pose=PLACED.object_pose + np.array([1e-6, 0, 0, 0, 0, 0, 0]))
    validate_lifts(HAND, BOX, grasps, where, pieces=WHOLE, hard=other == "friction", known=known)
    assert len(lifts) == 6


def numbered(count: int) -> GraspSet:
    """Grasps that are told apart by their loss."""
    return replace(THREE.take(np.zeros(count, int)), stability_loss=np.arange(float(count)), scene=np.zeros(count, int))


def lift_tests(monkeypatch: pytest.MonkeyPatch, outcomes: dict[bool, list[int]]) -> list[object]:
    done: list[object] = []

    def validated(hand, obj, some, placed, *, hard=False, **_):
        rows = some.stability_loss.astype(int)
        done.append((hard, rows.tolist()))
        outcome = np.array(outcomes[hard])[rows]
        return SimpleNamespace(success=(outcome == LIFTED).astype(int), outcome=outcome, margin=np.zeros(len(rows)))

    def way(hand, obj, some, placed):
        clear, wrist = np.ones(len(some), bool), np.zeros((len(some), 0))
        seen = {
            "approach": some.approach,
            "open": some.coming,
            "lift": None,
            "least_clearance": 1.0 * clear,
            "wrist": wrist,
        }
        return SimpleNamespace(clear=clear, **seen)

    monkeypatch.setattr(rollouts, "validate_lifts", validated)
    monkeypatch.setattr(rollouts, "plan_trajectory", way)
    return done


def rollout_of(monkeypatch, scores: list[float], outcomes, beat=None, level: LiftLevel = "lift"):
    lift_tests(monkeypatch, outcomes)
    monkeypatch.setattr(ShortTests, "scores", lambda *_: np.array(scores))
    where = THREE_PLACES.take(np.zeros(len(scores), int))
    rollout = lift_rollout(HAND, BOX, lambda: WHOLE, level=level)
    return rollout(numbered(len(scores)), where, np.full(len(scores), np.inf) if beat is None else beat)


def test_a_score_is_that_of_the_lift(monkeypatch: pytest.MonkeyPatch) -> None:
    half = [LIFTED, FELL, FELL, FELL, FELL, TOUCHED, FELL]
    outcomes = {True: half, False: [LIFTED, LIFTED, FELL, LIFTED, FELL, TOUCHED, FELL]}
    found = rollout_of(monkeypatch, [0.2, 0.3, 0.4, 1.2, 1.3, 0.5, 4.0], outcomes)
    falls = SLIPS + 1.0 + FALLS * np.array([0.4, 1.0])
    assert found == pytest.approx([0.2, SLIPS, falls[0], 1.2, falls[1], 0.5 + TOUCHES, 4.0])
    assert found[0] <= BEST


def test_a_lift_at_half_the_friction_is_better_than_the_published_one(monkeypatch: pytest.MonkeyPatch) -> None:
    outcomes = {True: [LIFTED, FELL], False: [LIFTED, LIFTED]}
    assert rollout_of(monkeypatch, [0.2, 0.3], outcomes, np.array([1.5, 1.5])) == pytest.approx([0.2, 1.5])
    outcomes = {True: [LIFTED, LIFTED, FELL], False: [LIFTED, FELL, LIFTED]}
    found = rollout_of(monkeypatch, [0.2, 0.3, 0.4], outcomes, level="dexgraspbench")
    assert found == pytest.approx([0.2, SLIPS + 1.0 + FALLS * 0.3, SLIPS])
    assert rollout_of(monkeypatch, [0.3], {True: [LIFTED], False: [FELL]}) == pytest.approx([0.3]), "at level lift"


@pytest.mark.parametrize(
    ("level", "tested", "success", "hard"),
    [
        ("lift", [(True, [0, 1, 2, 3]), (False, [2, 3])], [1, 1, 1, 0], [1, 1, 0, -1]),
        ("dexgraspbench", [(False, [0, 1, 2, 3]), (True, [0, 2])], [1, 0, 1, 0], [1, -1, 0, -1]),
    ],
)
def test_no_grasp_is_lifted_that_another_lift_decides(monkeypatch, level: LiftLevel, tested, success, hard) -> None:
    done = lift_tests(monkeypatch, {True: [LIFTED, LIFTED, FELL, FELL], False: [LIFTED, FELL, LIFTED, FELL]})
    scenes = SimpleNamespace(placed=lambda _: THREE_PLACES.take(np.zeros(4, int)))
    _, columns = scene_verdicts(HAND, BOX, numbered(4), scenes, level=level, pieces=WHOLE, run=ExecutionContext())
    assert done == tested
    assert (columns["quality/success"].tolist(), columns["quality/lift_hard"].tolist()) == (success, hard)


@pytest.mark.parametrize(("verdict", "score"), [(1, 0.2), (0, SLIPS + 1.0 + FALLS * 0.2)])
def test_free_grasp_that_the_validator_drops_is_no_good_candidate(monkeypatch, verdict: int, score: float) -> None:
    monkeypatch.setattr(ShortTests, "scores", lambda *_: np.array([0.2, 4.0, 4.0]))
    monkeypatch.setattr(rollouts, "validate", lambda *_, **__: SimpleNamespace(success=np.array([verdict])))
    assert hold_rollout(HAND, BOX, lambda: WHOLE)(THREE, None).tolist() == pytest.approx([score, 4.0, 4.0])


def test_a_free_grasp_that_cannot_beat_another_is_not_validated(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ShortTests, "scores", lambda *_: np.array([0.6, 0.7, 0.8]))
    validated: list[int] = []
    held = SimpleNamespace(success=np.ones(1))
    monkeypatch.setattr(rollouts, "validate", lambda hand, obj, grasps, **_: validated.append(len(grasps)) or held)
    found = hold_rollout(HAND, BOX, lambda: WHOLE)(THREE, None, np.array([0.5, 0.7, np.inf]))
    assert (validated, found.tolist()) == ([1], [0.6, 0.7, 0.8])
