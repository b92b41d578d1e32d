"""The validator: what any engine must say of simple grasps, and that its levels say the same."""

import inspect
import re
import threading
import time
from dataclasses import replace

import mujoco
import numpy as np
import pytest
import trimesh

from graspd.exchange.inputs import load_case
from graspd.service.model.errors import InputError, MeshError, TaskCancelled
from graspd.service.model.matter import MASS_KG
from graspd.worker.control import postures
from graspd.worker.engines.mujoco_warnings import is_invalid
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext, measure_rows
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.objects.convex import union_volume
from graspd.worker.simulation.environment import Obstacle
from graspd.worker.validation import decomposition, model, protocol
from graspd.worker.validation.decomposition import ConvexPieces, decompose
from graspd.worker.validation.displacement import GRAVITY, STEPS, TIMESTEP_S, simulated_displacement_cm
from graspd.worker.validation.key import LEVEL_MOVES, MOVES, Level, verdict_key
from graspd.worker.validation.model import MujocoOptions, build_scene, interpolate_postures, scene_of
from graspd.worker.validation.protocol import HOLD_S, MAX_DISPLACEMENT_M, MAX_ROTATION, Outcome, Rollout, Test
from graspd.worker.validation.validator import validate
from tests.worker.models import object_from_mesh, on_one_dof, two_finger_hand
from tests.worker.quality import helpers
from tests.worker.quality.helpers import BOX, CONTACT, FAR, PADS, WHOLE, grasp_of, many_grasps, placed_data, posture

SHORT_PADS, PLATES = helpers.pad_hand(), helpers.plate_hand()
TABLE = Obstacle.half_space((0, 0, 1), -0.3)
THUMB = ("joint_12.0", "joint_13.0", "joint_14.0", "joint_15.0")


def test_a_pressed_box_is_held_and_a_free_one_falls() -> None:
    verdict = validate(PADS, BOX, grasp_of(), level="dexgraspbench", pieces=WHOLE)
    assert verdict.reasons == ["held"] and verdict.success.tolist() == [1]
    assert (verdict.outcome == Outcome.HELD).all()
    verdict = validate(PADS, BOX, grasp_of(contact=posture(((0, 0, -0.5), (0.0, 0.0)))), pieces=WHOLE)
    assert verdict.reasons == ["displaced under +x"]
    verdict = validate(PADS, BOX, grasp_of(contact=posture(((0, 0, 0), (0.068, 0.067)))), pieces=WHOLE)
    assert verdict.penetration_depth_mm[0] == pytest.approx(3.0, abs=0.01)


def test_the_box_slips_at_friction_0_04_and_holds_at_0_06() -> None:
    # Two pads of 10 N give 0.8 N of friction against a push of 1 N across; along their normals they need none.
    scene = build_scene(PADS, BOX, WHOLE, MujocoOptions(friction=(0.04, 0.001)))
    rollout = Test(scene).dexgraspbench(grasp_of(), 0)
    assert rollout.outcomes[:3] == [Outcome.HELD, Outcome.HELD, Outcome.DISPLACED]
    # 1.2 N of friction against 1 N.
    scene = build_scene(PADS, BOX, WHOLE, MujocoOptions(friction=(0.06, 0.001)))
    assert Test(scene).dexgraspbench(grasp_of(), 0).success


@pytest.mark.parametrize("level", ["dexgraspbench", "standard", "fast"])
def test_penetration_counts_at_pregrasp_where_simulation_starts(level: str) -> None:
    deep, clear = posture(((0, 0, 0), (0.08, 0.08))), posture(((0, 0, 0), (0.06, 0.06)))
    from_outside = GraspSet(deep, clear, deep, np.full(1, np.nan))
    from_inside = GraspSet(clear, deep, clear, np.full(1, np.nan))
    verdicts = [validate(PADS, BOX, g, level=level, pieces=WHOLE) for g in (from_outside, from_inside)]
    assert verdicts[0].penetration_depth_mm[0] > 10
    assert [v.reasons for v in verdicts] == [["held"], ["penetration"]]


def test_the_engine_has_the_numbers_of_hand_and_object() -> None:
    model = build_scene(PADS, BOX, WHOLE, MujocoOptions()).model
    fingers = [int(model.joint(f"joint{b}").dofadr[0]) for b in PADS.joint_body]
    assert model.dof_damping[fingers] == pytest.approx(0.02 * PADS.stiffness) and not model.dof_armature.any()
    assert not model.dof_frictionloss.any()
    assert [model.body(f"body{b}").mass[0] for b in range(3)] == pytest.approx(PADS.masses)
    body = model.body("object")
    assert body.mass[0] == pytest.approx(MASS_KG)
    assert sorted(body.inertia) == pytest.approx(sorted(MASS_KG * np.linalg.eigvalsh(BOX.inertia)), rel=1e-6)
    hand = two_finger_hand()
    model = build_scene(hand, BOX, WHOLE, MujocoOptions()).model
    assert model.joint("joint1").range == pytest.approx([hand.lower[0], hand.upper[0]])


@pytest.mark.parametrize(("jaws", "contacts"), [(False, 2), (True, 8)], ids=["hand", "gripper"])
def test_a_pair_of_pieces_has_one_contact_but_between_jaws(jaws: bool, contacts: int, monkeypatch) -> None:
    if not jaws:
        monkeypatch.setattr(model, "jaws_of", lambda hand: None)
    scene = build_scene(helpers.plate_hand(), BOX, WHOLE, MujocoOptions())
    data = placed_data(scene, CONTACT.joint_positions[0] + 1e-3, CONTACT.hand_pose[0])
    # A plate's face lies flat on the box: with multi-contact each of the two has four points.
    assert len(data.contact.dist) == contacts


def test_displacement_is_that_of_the_mesh_s_own_frame() -> None:
    mesh = trimesh.creation.box((0.06, 0.04, 0.05))
    mesh.apply_translation([0.3, 0, 0])
    far = object_from_mesh(mesh)
    scene = build_scene(PADS, far, ConvexPieces((far.hull_vertices,), 1.0, 0.0, "far"), MujocoOptions())
    test = Test(scene)
    scene.set_posture(test.data, FAR, np.zeros(2))
    assert test._object_motion() == (pytest.approx(0, abs=1e-12), 0)
    angle = 0.2
    turned = [np.cos(angle / 2), 0, 0, np.sin(angle / 2)]
    test.data.qpos[scene.object_qpos + 3 : scene.object_qpos + 7] = turned
    # Turned about its centre the box stays; the mesh's origin, 0.3 m away, does not.
    assert test._object_motion() == (pytest.approx(2 * 0.3 * np.sin(angle / 2)), pytest.approx(angle))


def test_the_root_turns_at_an_even_rate_between_two_postures() -> None:
    half = np.array([[0.0, 0, 0, 1, 0, 0, 0], [0.0, 0, 0, 0, 0, 0, 1.0]])
    a, b = (Posture(row[None], np.zeros((1, 2))) for row in half)
    turns = [2 * np.arctan2(*interpolate_postures(a, b, 0, share)[0][[6, 3]]) for share in (0.1, 0.5, 0.9)]
    assert turns == pytest.approx([0.1 * np.pi, 0.5 * np.pi, 0.9 * np.pi])


def test_push_from_the_saved_state_is_a_push_after_closing_anew() -> None:
    grasps, test = many_grasps(), Test(build_scene(PADS, BOX, WHOLE, MujocoOptions()))
    ends = []
    for anew in (False, True):
        test._close(grasps, 3)
        test._save()
        test._push(0)
        test._run(0.4)
        if anew:
            test._close(grasps, 3)
        else:
            test._restore()
        test._push(2)
        test._run(0.4)
        ends.append(test.data.qpos.copy())
    assert np.array_equal(*ends)


@pytest.mark.parametrize("level", ["standard", "fast"])
def test_cheaper_levels_say_what_the_letter_says(level: str) -> None:
    grasps = many_grasps()
    dexgraspbench = validate(PADS, BOX, grasps, level="dexgraspbench", pieces=WHOLE)
    cheap = validate(PADS, BOX, grasps, level=level, pieces=WHOLE)
    assert 0 < dexgraspbench.success.sum() < len(grasps), "the set must hold both kinds"
    assert cheap.success.tolist() == dexgraspbench.success.tolist() and cheap.steps < 0.5 * dexgraspbench.steps


def test_hard_holds_no_more_and_threads_change_nothing() -> None:
    grasps = many_grasps()
    normal, hard = (validate(PADS, BOX, grasps, hard=h, pieces=WHOLE) for h in (False, True))
    assert (hard.success <= normal.success).all() and normal.key != hard.key
    one, two = (validate(PADS, BOX, many_grasps(), pieces=WHOLE, run=ExecutionContext(threads=n)) for n in (1, 2))
    assert np.array_equal(one.margin, two.margin) and one.key == two.key


def test_progress_is_told_by_one_thread_and_counts_every_grasp() -> None:
    told, alone, overlaps = [], threading.Lock(), 0

    def progress(done: float, total: float, message: str) -> None:
        nonlocal overlaps
        if not alone.acquire(blocking=False):
            overlaps += 1
            return
        told.append(done)
        time.sleep(0.02)  # long enough for another thread to come in, if it may
        alone.release()

    validate(PADS, BOX, many_grasps(), level="fast", pieces=WHOLE, run=ExecutionContext(threads=4, progress=progress))
    assert overlaps == 0 and told == list(range(1, len(many_grasps()) + 1))


def test_terms_depend_not_on_grasps_but_on_everything_else(monkeypatch: pytest.MonkeyPatch) -> None:
    terms = verdict_key(PADS, BOX, "dexgraspbench", False, pieces=WHOLE)
    found = [validate(PADS, BOX, grasp_of(force=force), level="dexgraspbench", pieces=WHOLE) for force in (10.0, 20.0)]
    assert [verdicts.terms for verdicts in found] == [terms, terms] and found[0].key != found[1].key
    heavier = replace(PADS, masses=PADS.masses * 2)
    others = {
        terms,
        verdict_key(PADS, BOX, "dexgraspbench", True, pieces=WHOLE),
        verdict_key(PADS, BOX, "fast", False, pieces=WHOLE),
        verdict_key(heavier, BOX, "dexgraspbench", False, pieces=WHOLE),
        verdict_key(PADS, BOX, "dexgraspbench", False, pieces=replace(WHOLE, digest="other")),
    }
    for constant in ("control.postures.TOTAL_NORMAL_FORCE", "validation.protocol.HOLD_S", "validation.model.FRICTION"):
        with monkeypatch.context() as patch:
            patch.setattr(f"graspd.worker.{constant}", 1.5)
            others.add(verdict_key(PADS, BOX, "dexgraspbench", False, pieces=WHOLE))
    assert len(others) == 8


def test_a_constant_moves_the_keys_of_the_levels_that_it_moves(monkeypatch: pytest.MonkeyPatch) -> None:
    def terms() -> list[str]:
        levels: tuple[Level, ...] = ("dexgraspbench", "standard", "fast")
        return [verdict_key(PADS, BOX, level, False, pieces=WHOLE) for level in levels]

    before = terms()
    monkeypatch.setattr(protocol, "UNRELATED", 7, raising=False)
    monkeypatch.setattr(postures, "ROOM_M", 5)
    assert terms() == before
    monkeypatch.setattr(protocol, "FAST_BAND", (0.2, 4.0))
    assert [a == b for a, b in zip(before, terms(), strict=True)] == [True, True, False]


def test_every_constant_is_said_to_move_verdicts_or_not() -> None:
    # A new constant belongs in key.py, or here if no verdict depends on it.
    # These move lifts (lifting.py has them), short tests, or the choice of grasps.
    still = "postures.ROOM_M postures.WIDE model.TOUCH_ROUNDING_M protocol.STILL protocol.LOST postures.STANDS_OFF_M "
    still += "postures.BEYOND_M postures.CLOSING_STEPS postures.CLOSED_M "
    # These move pregrasps, which are validated; the object, which is in the key; and the bounds of masses
    # and friction.
    still += "postures.RAISE_LOOKS postures.RAISE_OPEN_M postures.RAISE_CLOSING_M postures.HIGHEST_RAISE_M "
    still += "matter.MASS_KG matter.FRICTION matter.MOST_KG matter.MOST_FRICTION"
    tables = [MOVES, *LEVEL_MOVES.values()]
    named = {_called(part, name) for table in tables for part, names in table.items() for name in names}
    # Constants of a module are those that it assigns.
    assigned = {part: re.findall(r"^(_?[A-Z][A-Z0-9_]*)\b[^=\n]*=", inspect.getsource(part), re.M) for part in MOVES}
    assert {_called(part, name) for part, names in assigned.items() for name in names} == named | {*still.split()}


def _called(module, name: str) -> str:
    return f"{module.__name__.rpartition('.')[2]}.{name}"


def test_forward_kinematics_agree_with_ours() -> None:
    hand = two_finger_hand()
    pose, joints = np.array([0.1, 0.2, -0.3, 0.5, -0.5, 0.5, 0.5]), np.array([0.4, -0.2])
    data = placed_data(build_scene(hand, BOX, WHOLE, MujocoOptions()), joints, pose)
    ours = body_poses(hand, pose, joints)[0]
    for b in range(hand.bodies):
        assert data.body(f"body{b}").xpos == pytest.approx(ours[b, :3], abs=1e-12)
        assert abs(float(data.body(f"body{b}").xquat @ ours[b, 3:])) == pytest.approx(1.0, abs=1e-12)


def test_coupled_joints_stay_coupled_while_moving() -> None:
    hand = on_one_dof(PADS, 0.5, 0.01)
    scene = build_scene(hand, BOX, WHOLE, MujocoOptions())
    assert scene.model.nu == 1
    data = placed_data(scene, hand.expand(np.array([0.0])))
    scene.command(data, FAR, hand.expand(np.array([0.06])))
    mujoco.mj_step(scene.model, data, nstep=500)
    joints = data.qpos[scene.joint_qpos]
    assert joints[0] == pytest.approx(0.06, abs=1e-5)
    assert joints[1] == pytest.approx(0.5 * joints[0] + 0.01, abs=1e-4)


def test_actuators_never_exceed_the_effort() -> None:
    scene = build_scene(replace(PADS, effort=np.array([2.0, 3.0])), BOX, WHOLE, MujocoOptions())
    data = placed_data(scene, CONTACT.joint_positions[0], CONTACT.hand_pose[0])
    scene.command(data, CONTACT.hand_pose[0], CONTACT.joint_positions[0] + 0.08)
    mujoco.mj_step(scene.model, data, nstep=5)
    assert data.actuator_force == pytest.approx([2.0, 3.0])


def test_unknown_levels_are_refused_and_cancelled_validator_stops() -> None:
    with pytest.raises(InputError, match="dexgraspbench, standard, fast"):
        validate(PADS, BOX, grasp_of(), level="quick", pieces=WHOLE)
    with pytest.raises(TaskCancelled):
        validate(PADS, BOX, grasp_of(), pieces=WHOLE, run=ExecutionContext(cancelled=lambda: True))


def test_a_convex_object_is_one_piece_and_an_l_is_cut_and_kept(tmp_path) -> None:
    pieces = decompose(BOX, cache=tmp_path)
    assert len(pieces) == 1 and pieces.volume_ratio == pytest.approx(1.0, abs=1e-6)
    parts = [trimesh.creation.box((0.1, 0.02, 0.02)), trimesh.creation.box((0.02, 0.1, 0.02))]
    parts[1].apply_translation([0.04, 0.04, 0])
    pieces = decompose(object_from_mesh(trimesh.boolean.union(parts, engine="manifold")), cache=tmp_path)
    assert 2 <= len(pieces) <= 4 and pieces.volume_ratio == pytest.approx(1.0, abs=0.05)
    assert len(list(tmp_path.glob("*.npz"))) == 2
    cube = np.asarray(trimesh.creation.box((0.02, 0.02, 0.02)).vertices)
    assert union_volume((cube, cube + np.array([0.01, 0, 0]))) == pytest.approx(12e-6, rel=1e-5)


def test_shell_that_convex_pieces_fill_in_is_refused_with_reason(tmp_path, monkeypatch) -> None:
    # Even the most pieces allowed stand more than 2 mm away from the inner wall, but they take a minute.
    monkeypatch.setattr(decomposition, "THRESHOLDS", ())
    shell = trimesh.creation.icosphere(subdivisions=2, radius=0.15)
    inner = trimesh.creation.icosphere(subdivisions=2, radius=0.1495)
    hollow = object_from_mesh(trimesh.boolean.difference([shell, inner], engine="manifold"), "bubble")
    with pytest.raises(MeshError, match=r"bubble: its .* convex pieces have"):
        decompose(hollow, cache=tmp_path)


class Exploding(Test):
    def _push(self, direction: int) -> None:
        super()._push(direction)
        self.data.qvel[0] = np.inf


@pytest.mark.parametrize("level", ["dexgraspbench", "standard"])
def test_a_blown_up_push_is_not_held_and_spoils_no_other_grasp(level: str, tmp_path, monkeypatch) -> None:
    monkeypatch.chdir(tmp_path)
    test = Exploding(build_scene(PADS, BOX, WHOLE, MujocoOptions()))
    rollout = getattr(test, level)(grasp_of(), 0)
    assert rollout.outcomes[0] is Outcome.DIVERGED and not rollout.success
    # What the guard is for: after MuJoCo's reset the object stands where it began.
    assert test._object_motion()[0] < 0.05 and is_invalid(test.data)
    test.set_up(grasp_of(), 0)
    assert not is_invalid(test.data)
    assert list(tmp_path.iterdir()) == [], "MuJoCo's warnings go to no file"


def test_a_screen_that_blew_up_asks_the_certificate(monkeypatch: pytest.MonkeyPatch) -> None:
    """The coarse physics are less stable: that they fail says nothing of the grasp."""
    push = Test._push

    def poisoned(self: Test, direction: int) -> None:
        push(self, direction)
        if self.scene.physics.root == "fixed":
            self.data.qvel[0] = np.inf

    monkeypatch.setattr(Test, "_push", poisoned)
    assert validate(PADS, BOX, grasp_of(), level="fast", pieces=WHOLE).success.tolist() == [1]


def test_a_displacement_that_is_no_number_is_told_as_none(monkeypatch: pytest.MonkeyPatch) -> None:
    step = mujoco.mj_step

    def poisoned(model: object, data: mujoco.MjData, nstep: int) -> None:
        data.qvel[0] = np.nan
        step(model, data, nstep=nstep)

    monkeypatch.setattr(mujoco, "mj_step", poisoned)
    assert np.isnan(simulated_displacement_cm(PADS, BOX, grasp_of().grasp, pieces=WHOLE)[0])


class Scripted(Test):
    """A push in which displacement and rotation, over their limits, follow functions of time [s]."""

    def __init__(self, moved, turned) -> None:
        self._moved, self._turned, self.elapsed = moved, turned, 0.0
        self.data = mujoco.MjData(mujoco.MjSpec().compile())

    def _run(self, seconds: float) -> None:
        self.elapsed += seconds

    def _object_displacement(self) -> np.ndarray:
        return np.array([MAX_DISPLACEMENT_M * self._moved(self.elapsed), 0.0, 0.0])

    def _object_motion(self) -> tuple[float, float]:
        return float(np.linalg.norm(self._object_displacement())), MAX_ROTATION * self._turned(self.elapsed)


def still(time: float) -> float:
    return 0.0


def creeping(share: float):
    """At a rate that would reach so much of the limit in 2 s, and ten times as fast from half a second on."""
    rate = share / HOLD_S
    return lambda time: rate * (min(time, 0.5) + 10.0 * max(0.0, time - 0.5))


@pytest.mark.parametrize(
    ("moved", "turned", "outcome", "seconds"),
    [
        (still, still, Outcome.HELD, 0.08),
        (creeping(0.3), creeping(0.3), Outcome.HELD, 0.08),
        (creeping(0.5), still, Outcome.DISPLACED, None),
        (still, creeping(0.5), Outcome.ROTATED, None),
        (still, lambda time: 0.7, Outcome.HELD, 0.08),
        (still, lambda time: 0.9, Outcome.HELD, HOLD_S),
    ],
)
def test_a_push_ends_once_it_is_decided(moved, turned, outcome: Outcome, seconds: float | None) -> None:
    push = Scripted(moved, turned)
    assert push._hold(Rollout()) is outcome
    assert seconds is None or push.elapsed == pytest.approx(seconds)


def test_a_model_is_compiled_once_for_all_that_moves_a_verdict() -> None:
    own = (SHORT_PADS, BOX, WHOLE, MujocoOptions())
    assert scene_of(*own) is scene_of(SHORT_PADS, replace(BOX, name="another name"), WHOLE, MujocoOptions())
    assert scene_of(*own, [TABLE]) is scene_of(*own, (TABLE,))
    others = [
        (PLATES, BOX, WHOLE, MujocoOptions()),
        (SHORT_PADS, replace(BOX, inertia=2 * BOX.inertia), WHOLE, MujocoOptions()),
        (SHORT_PADS, BOX, ConvexPieces((1.01 * BOX.hull_vertices,), 1.0, 0.0, "box"), MujocoOptions()),
        (SHORT_PADS, BOX, WHOLE, MujocoOptions().hardened()),
        (*own, [TABLE]),
    ]
    assert all(scene_of(*other) is not scene_of(*own) for other in others)


def test_displacement_is_free_fall_without_hand_and_none_at_rest() -> None:
    away = posture(((0, 0, 1.0), (0.0, 0.0)))
    # Symplectic Euler: the sum of n steps of growing velocity.
    fall = GRAVITY * TIMESTEP_S**2 * STEPS * (STEPS + 1) / 2
    assert simulated_displacement_cm(PLATES, BOX, away, pieces=WHOLE)[0] == pytest.approx(100 * fall, rel=1e-6)
    # The hand turned so that its left plate's upper face lies under the box, at z = -0.025.
    turn = np.array([np.sqrt(0.5), 0, -np.sqrt(0.5), 0])
    under = Posture(np.array([[0, 0, -0.03 - 0.1, *turn]]), np.zeros((1, 2)))
    assert simulated_displacement_cm(PLATES, BOX, under, pieces=WHOLE)[0] < 0.05
    rows = posture(((0, 0, 0), (0.0655, 0.0655)), ((0, 0, 0), (0.05, 0.05)))
    held, loose = simulated_displacement_cm(PLATES, BOX, rows, pieces=WHOLE)
    assert held < 1.0 < 10.0 < loose


def test_a_published_grasp_without_its_thumb_is_refused(shared_data) -> None:
    case = load_case(shared_data / "reference_grasps" / "frogger_allegro" / "056_tennis_ball.json")
    some = case.grasps.take(np.arange(3))
    thumb = np.array([name in THUMB for name in case.hand.joint_names])
    away = some.pregrasp.joint_positions - 0.3

    def opened(posture: Posture) -> Posture:
        return Posture(posture.hand_pose, np.where(thumb, away, posture.joint_positions))

    without = GraspSet(opened(some.grasp), opened(some.pregrasp), opened(some.squeeze), some.stability_loss)
    whole, found = (validate(case.hand, case.obj, grasps) for grasps in (some, without))
    assert whole.success.all() and not found.success.any()
    assert all(reason.startswith(("rotated", "displaced", "lost")) for reason in found.reasons)


def test_measured_tests_held_grasps_by_row_and_may_be_stopped() -> None:
    held = np.array([False, True, False, True])
    found = measure_rows(4, held, lambda: 10.0, lambda test, row: test + row, run=DEFAULT_CONTEXT, name="test")
    np.testing.assert_array_equal(found, [np.nan, 11.0, np.nan, 13.0])
    run = ExecutionContext(threads=1, cancelled=lambda: True)
    with pytest.raises(TaskCancelled):
        measure_rows(2, None, lambda: None, lambda *_: 0.0, run=run, name="test")
