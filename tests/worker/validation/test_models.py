"""Grasps validated in models around the nominal one, and in another model of their hand."""

import copy
import dataclasses
import json

import mujoco
import numpy as np
import pytest
import trimesh

from benchmarks.foreign import with_our_shapes, with_their_shapes
from benchmarks.hand_matching import match_hands
from benchmarks.second_hand import transfer_drives, transfer_grasps, validate_twice
from graspd.service.model.errors import TaskCancelled
from graspd.service.model.matter import MASS_KG
from graspd.service.model.metrics import PerturbedParameter
from graspd.service.model.transforms import IDENTITY_POSE, apply
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import Drag, HandModel
from graspd.worker.hands.primitives import tessellate, volume
from graspd.worker.hands.tendons import Tendon
from graspd.worker.validation import model
from graspd.worker.validation import robust as robustness
from graspd.worker.validation import variant as variants
from graspd.worker.validation.key import verdict_key
from graspd.worker.validation.model import MujocoOptions, Scene, build_scene
from graspd.worker.validation.prefilter.prefilter import prefilter_key_terms
from graspd.worker.validation.protocol import STAGES, Outcome, Rollout, Test
from graspd.worker.validation.refit import applicable_fits, offset_piece, refit_hand
from graspd.worker.validation.robust import Robustness, draw_models, required_model_count, validate_robustness
from graspd.worker.validation.validator import validate
from graspd.worker.validation.variant import (
    Models,
    Variant,
    VariantTest,
    axes_of,
    displace_grasp,
    draw_variant,
    replace_coupling,
)
from tests.studies.test_evaluation import HAND as PADS_HAND
from tests.studies.test_evaluation import plates_case
from tests.worker.hands.mjcfs import CLAW
from tests.worker.hands.test_mjcf import load
from tests.worker.models import on_one_dof, piece, two_finger_hand
from tests.worker.quality.helpers import BOX, FAR, PADS, WHOLE, many_grasps, placed_data, plate_hand, posture

RNG = np.random.default_rng(11)


def by_luck(monkeypatch: pytest.MonkeyPatch, odds: float = 0.7) -> None:
    """Verdicts that follow from the grasp and the variant as a coin does."""

    def standard(self: Models, grasps: GraspSet, row: int, variant: Variant) -> Rollout:
        words = np.frombuffer(repr((variant, grasps.grasp.hand_pose[row].tolist())).encode(), np.uint8)
        if np.random.default_rng(words.tolist()).random() < odds:
            return Rollout([Outcome.HELD] * 6)
        return Rollout().fail(Outcome.DISPLACED)

    monkeypatch.setattr(Models, "standard", standard)


def test_in_models_that_are_all_same_grasp_holds_in_all_or_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(robustness, "draw_variant", lambda axis, hand, rng: Variant())
    grasps = many_grasps()
    found = validate_robustness(PADS, BOX, grasps, models=3, pieces=WHOLE)
    verdicts = validate(PADS, BOX, grasps, pieces=WHOLE)
    assert found.share.tolist() == verdicts.success.tolist() and {0.0, 1.0} == set(found.share)
    assert ((found.weakest == PerturbedParameter.NONE) == (verdicts.success == 1)).all()


def test_only_what_holds_in_the_nominal_model_is_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    by_luck(monkeypatch)
    held = np.array([1, 0, 1, -1, 0, 1, 1, 1])
    found = validate_robustness(PADS, BOX, many_grasps(), held=held, models=4, pieces=WHOLE)
    assert (np.isfinite(found.share) == (held == 1)).all() and (
        found.weakest[held != 1] == PerturbedParameter.NONE
    ).all()


@pytest.mark.parametrize("models", [1, 8])
@pytest.mark.parametrize("wanted", [0.25, 0.75, 0.9])
def test_judging_that_ends_early_says_of_the_share_what_all_say(monkeypatch, models: int, wanted: float) -> None:
    by_luck(monkeypatch)
    grasps = many_grasps(24)
    whole = validate_robustness(PADS, BOX, grasps, models=models, pieces=WHOLE)
    early = validate_robustness(PADS, BOX, grasps, models=models, wanted=wanted, pieces=WHOLE)
    assert ((early.share >= wanted - 1e-9) == (whole.share >= wanted - 1e-9)).all()
    reached = whole.share >= wanted - 1e-9
    # What is told of a share is a bound on its right side.
    assert (early.share[reached] <= whole.share[reached]).all()
    assert (early.share[~reached] >= whole.share[~reached]).all()
    validated = early.held >= 0
    assert (early.held[validated] == whole.held[validated]).all()
    assert models == 1 or validated.sum() < whole.held.size


def test_no_model_is_validated_after_the_share_is_sure(monkeypatch: pytest.MonkeyPatch) -> None:
    by_luck(monkeypatch, odds=0.0)
    found = validate_robustness(PADS, BOX, many_grasps(), models=8, wanted=0.9, pieces=WHOLE)
    assert ((found.held >= 0).sum(axis=1) == 1).all()
    by_luck(monkeypatch, odds=1.0)
    found = validate_robustness(PADS, BOX, many_grasps(), models=8, wanted=0.5, pieces=WHOLE)
    assert ((found.held >= 0).sum(axis=1) == 4).all() and (found.share == 0.5).all()


def test_the_weakest_axis_is_that_of_the_first_model_that_fails() -> None:
    held = np.array([[1, 0, 0], [1, 1, 1], [0, -1, -1], [-1, -1, -1]], np.int8)
    found = Robustness(held, np.array([[1, 4, 5], [2, 3, 4], [7, 0, 0], [0, 0, 0]], np.uint8), 0.9, 0.0)
    assert found.weakest.tolist() == [4, 0, 7, 0]
    assert found.by_axis() == {
        PerturbedParameter.SHAPES: (1, 1),
        PerturbedParameter.JOINTS: (1, 1),
        PerturbedParameter.COUPLINGS: (1, 1),
        PerturbedParameter.FRICTION: (1, 2),
        PerturbedParameter.MASS: (0, 1),
        PerturbedParameter.POSE: (0, 1),
    }


@pytest.mark.parametrize(
    ("wanted", "models", "least"), [(0.9, 8, 8), (0.75, 8, 6), (0.9, 10, 9), (1.0, 3, 3), (0.1, 4, 1)]
)
def test_so_many_models_make_a_share(wanted: float, models: int, least: int) -> None:
    assert required_model_count(wanted, models) == least


def test_models_of_a_grasp_are_its_own_and_the_nominal_one_is_validated_alike() -> None:
    grasps = many_grasps()
    turned = grasps.take(np.arange(len(grasps))[::-1])
    assert draw_models(PADS, grasps, 2, 8, 5) == draw_models(PADS, turned, len(grasps) - 3, 8, 5)
    assert draw_models(PADS, grasps, 2, 8, 5) == draw_models(PADS, grasps, 2, 16, 5)[:8]
    others = [draw_models(PADS, grasps, 2, 8, 6), draw_models(PADS, grasps, 3, 8, 5)]
    assert draw_models(PADS, grasps, 2, 8, 5) not in others
    axes = [axis for axis, _ in draw_models(PADS, grasps, 0, 8, 0)]
    assert sorted(axes) == sorted(axes_of(PADS)) and len(axes) == 8
    verdicts = validate(PADS, BOX, grasps, pieces=WHOLE)
    found = [models().standard(grasps, row, Variant()) for row in range(len(grasps))]
    assert [rollout.success for rollout in found] == (verdicts.success == 1).tolist()
    assert [rollout.margin for rollout in found] == verdicts.margin.tolist()
    assert {True, False} == set((verdicts.success == 1).tolist())


def test_it_stops_when_it_is_told_to() -> None:
    with pytest.raises(TaskCancelled):
        validate_robustness(PADS, BOX, many_grasps(), pieces=WHOLE, run=ExecutionContext(cancelled=lambda: True))


def models(hand: HandModel = PADS, friction: tuple[float, float] = (0.6, 0.02)) -> Models:
    return Models(hand, BOX, WHOLE, MujocoOptions(friction=friction))


def finger(kind: str) -> HandModel:
    """Plates of one kind that look at the box along x."""
    sizes = {"cylinder": (0.02, 0.01), "capsule": (0.01, 0.03), "sphere": (0.012,)}
    base, size = plate_hand(), sizes.get(kind, (0.05, 0.05, 0.01))
    solid = trimesh.Trimesh(*tessellate("box" if kind == "hull" else kind, size), process=False)
    pieces = tuple(piece(body, solid, kind, () if kind == "hull" else size, (0, 0, 0)) for body in (1, 2))
    return dataclasses.replace(base, digest=f"{kind:0>32}", pieces=(base.pieces[0], *pieces))


def gap(around: Models, variant: Variant) -> float:
    """Distance in the engine of the first finger from the box [m]."""
    scene = around.scene(variant)
    data = placed_data(scene, np.array([0.03, 0.03]), IDENTITY_POSE)
    ours, theirs = scene.model.geom("hand1").id, scene.model.geom("object-0").id
    return float(mujoco.mj_geomDistance(scene.model, data, ours, theirs, 1.0, None))


@pytest.mark.parametrize("kind", ["box", "cylinder", "capsule", "sphere", "hull"])
def test_shapes_grow_by_a_millimetre_in_the_engine(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # Whether plates are a gripper's jaws takes a search and moves no distance.
    monkeypatch.setattr(model, "jaws_of", lambda hand: None)
    around = models(finger(kind))
    own = gap(around, Variant())
    for by in (1e-3, -1e-3):
        # The engine's distances are good to its tolerance of 1e-6; corners of meshes are single precision.
        assert own - gap(around, Variant(grown_m=by)) == pytest.approx(by, abs=3e-6)


@pytest.mark.parametrize("by", [2e-3, -1e-3])
def test_a_hull_grows_like_its_sum_with_a_ball_along_its_normals(by: float) -> None:
    solid = trimesh.convex.convex_hull(RNG.normal(size=(40, 3)) * 0.02)
    other = offset_piece(piece(0, solid, "hull", (), (0, 0, 0)), by)
    reach = (other.vertices @ solid.face_normals.T).max(axis=0) - (solid.vertices @ solid.face_normals.T).max(axis=0)
    # A small side may be swallowed by its neighbours where the solid shrinks: then it lies farther back.
    assert (reach.max(), np.median(reach)) == pytest.approx((by, by), abs=1e-9)
    if by > 0:
        ball = trimesh.creation.icosphere(subdivisions=2, radius=by).vertices
        whole = (solid.vertices[:, None] + ball[None]).reshape(-1, 3)
        planes = trimesh.convex.convex_hull(other.vertices)
        above = ((whole @ planes.face_normals.T) - (planes.triangles_center * planes.face_normals).sum(axis=1)).max()
        assert above <= 1e-9, "the offset solid holds the sum"


def test_a_thin_shape_does_not_vanish_when_it_shrinks() -> None:
    for kind, size in (("box", (0.02, 0.02, 0.001)), ("cylinder", (0.02, 0.001)), ("hull", ())):
        vertices, faces = tessellate("box" if kind == "hull" else kind, size or (0.02, 0.02, 0.001))
        thin = piece(0, trimesh.Trimesh(vertices, faces, process=False), kind, size, (0, 0, 0))
        # Half of its thickness stays.
        assert np.ptp(offset_piece(thin, -1e-3).vertices, axis=0)[2] == pytest.approx(5e-4, rel=1e-3)


@pytest.mark.parametrize(
    ("kind", "size"), [("box", (0.02, 0.03, 0.05)), ("cylinder", (0.01, 0.06)), ("capsule", (0.012, 0.03)),
                       ("cylinder", (0.03, 0.01))],
)  # fmt: skip
def test_the_primitive_nearest_to_the_hull_of_one_is_that_one(kind: str, size: tuple[float, ...]) -> None:
    vertices, faces = tessellate(kind, size)
    turned = apply(np.array([0.01, 0.02, 0.03, *(np.array([1, 2, 3, 4]) / np.sqrt(30))]), vertices)
    hulls = piece(0, trimesh.Trimesh(turned, faces, process=False), "hull", (), (0, 0, 0))
    found = refit_hand(dataclasses.replace(two_finger_hand(), pieces=(hulls,)), "primitive").pieces[0]
    assert found.kind == kind
    # Tessellations lie inside the round ones: 32 corners lose 0.6 % of a circle's area.
    assert sorted(found.size) == pytest.approx(sorted(size), rel=0.01)
    refit = volume(found.kind, found.size, found.vertices, found.faces)
    assert refit == pytest.approx(volume("hull", (), turned, faces), rel=0.01)


def test_fits_that_change_nothing_are_not_offered() -> None:
    hand = two_finger_hand()
    ball = dataclasses.replace(hand, pieces=tuple(p for p in hand.pieces if p.kind == "sphere"))
    assert applicable_fits(ball) == frozenset()
    assert "hull" in applicable_fits(hand), "a finger has a shaft and a tip"
    assert len(refit_hand(hand, "hull").pieces) == 3 and refit_hand(ball, "capsule") is ball


def test_variants_reach_engine_and_leave_nominal_model_as_it_was() -> None:
    around = models()
    own = around.scene(Variant()).model
    scene = around.scene(Variant(armature=3e-4, dry_friction=0.02, damping=0.5, gain=2.0, friction=0.75, mass=1.5))
    other, thing = scene.model, scene.object_body
    fingers = other.jnt_dofadr[[other.joint("joint1").id, other.joint("joint2").id]]
    assert other.dof_armature[fingers] == pytest.approx([3e-4, 3e-4])
    assert other.dof_frictionloss[fingers] == pytest.approx([0.02, 0.02])
    assert not np.delete(other.dof_armature, fingers).any(), "the root and the object have none"
    assert other.dof_damping[fingers] == pytest.approx(0.5 * own.dof_damping[fingers])
    assert other.actuator_gainprm[:, 0] == pytest.approx(2 * own.actuator_gainprm[:, 0])
    assert other.actuator_biasprm[:, 1] == pytest.approx(2 * own.actuator_biasprm[:, 1])
    assert other.geom_friction[:, :2] == pytest.approx(0.75 * own.geom_friction[:, :2])
    assert other.body_mass[thing] == pytest.approx(1.5 * MASS_KG)
    assert other.body_inertia[thing] == pytest.approx(1.5 * own.body_inertia[thing])
    # Contacts are as stiff as inverse masses say.
    assert other.body_invweight0[thing, 0] == pytest.approx(own.body_invweight0[thing, 0] / 1.5)
    before = copy.copy(around.scene(Variant()).model)
    for axis in axes_of(PADS):
        around.scene(draw_variant(axis, PADS, np.random.default_rng(1)))
    after = around.scene(Variant()).model
    for name in ("dof_damping", "dof_armature", "actuator_gainprm", "geom_friction", "body_mass", "geom_size"):
        assert np.array_equal(getattr(before, name), getattr(after, name)), name


def test_a_heavier_object_is_pushed_by_its_weight() -> None:
    around, away = models(), posture(((0, 0, -0.5), (0.0, 0.0)))
    grasps = GraspSet(away, away, away, np.full(1, np.nan))
    moved = []
    for variant in (Variant(), Variant(mass=2.0)):
        test = VariantTest(around.scene(variant), variant, None)
        test._close(grasps, 0)
        test._push(2)
        test._run(0.1)
        moved.append(test._object_displacement()[1])
    # The same acceleration of 10 m/s^2, half a step of velocity added by the implicit step.
    assert moved == pytest.approx([0.5 * 10 * 0.1 * (0.1 + 0.004)] * 2, rel=1e-6)


def test_the_centre_of_mass_moves_and_the_object_stays() -> None:
    shift = (0.003, -0.002, 0.001)
    scene = models().scene(Variant(centre_m=shift))
    data = placed_data(scene, np.zeros(2))
    assert data.xipos[scene.object_body] == pytest.approx(BOX.centre_of_mass + shift, abs=1e-9)
    assert data.geom("object-0").xpos == pytest.approx(BOX.centre_of_mass, abs=1e-7)
    test = Test(scene)
    scene.set_posture(test.data, FAR, np.zeros(2))
    assert test._object_displacement() == pytest.approx([0, 0, 0], abs=1e-12), "the mesh's frame is where it was"


def test_object_or_a_hand_that_is_off_is_met_the_other_way_round() -> None:
    grasps = many_grasps()
    shift, turn = (0.001, -0.002, 0.0005), (0.0, 0.0, 0.03)
    moved = displace_grasp(BOX, grasps, 3, Variant(object_shift_m=shift))
    assert moved.pregrasp.hand_pose[0, :3] == pytest.approx(grasps.pregrasp.hand_pose[3, :3] - shift)
    turned = displace_grasp(BOX, grasps, 3, Variant(object_turn=turn)).grasp.hand_pose[0]
    arm = grasps.grasp.hand_pose[3, :3] - BOX.centre_of_mass
    back = np.array([[np.cos(0.03), np.sin(0.03), 0], [-np.sin(0.03), np.cos(0.03), 0], [0, 0, 1]])
    assert turned[:3] == pytest.approx(BOX.centre_of_mass + back @ arm, abs=1e-12)
    assert 2 * np.arccos(turned[3]) == pytest.approx(0.03, rel=1e-6)
    assert np.array_equal(moved.squeeze.joint_positions[0], grasps.squeeze.joint_positions[3])
    quarter = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    for part in (grasps.grasp, grasps.pregrasp, grasps.squeeze):
        part.hand_pose[:, 3:] = quarter
    off = displace_grasp(BOX, grasps, 2, Variant(hand_shift_m=(0.002, 0, 0)))
    assert off.grasp.hand_pose[0, :3] - grasps.grasp.hand_pose[2, :3] == pytest.approx([0, 0.002, 0], abs=1e-12)


def test_fingers_that_close_one_after_another_end_together() -> None:
    grasps, around = many_grasps(), models()
    variant = Variant(lags=(0.0, 0.25))
    plain = list(VariantTest(around.scene(Variant()), Variant(), None)._way(grasps, 0))
    late = list(VariantTest(around.scene(variant), variant, around._lags(variant))._way(grasps, 0))
    assert len(late) == len(plain) == 2 * STAGES
    assert late[-1][1] == pytest.approx(grasps.squeeze.joint_positions[0])
    assert all(a[0] == pytest.approx(b[0]) for a, b in zip(plain, late, strict=True)), "the root comes as before"
    start = grasps.pregrasp.joint_positions[0]
    still = [joints[1] for _, joints in late[: 2 * STAGES // 4]]
    assert still == pytest.approx([start[1]] * len(still)), "the second finger waits a quarter of the time"
    assert late[0][1][0] != pytest.approx(start[0]), "the first one does not"


def test_a_compliant_coupling_gives_way_under_load() -> None:
    assert PerturbedParameter.COUPLINGS in axes_of(
        on_one_dof(two_finger_hand())
    ) and PerturbedParameter.COUPLINGS not in axes_of(two_finger_hand())
    apart = []
    around = models(on_one_dof(two_finger_hand()))
    for variant in (Variant(), Variant(coupling="compliant")):
        scene = around.scene(variant)
        data = placed_data(scene, np.zeros(2))
        data.qfrc_applied[scene.model.joint("joint2").dofadr[0]] = 0.5
        mujoco.mj_step(scene.model, data, nstep=200)
        apart.append(abs(float(data.joint("joint2").qpos[0] - data.joint("joint1").qpos[0])))
    assert apart[1] > 2 * apart[0] > 0


@pytest.mark.parametrize("axis", [axis for axis in PerturbedParameter if axis is not PerturbedParameter.NONE])
def test_a_draw_stays_in_the_range_of_its_axis(axis: PerturbedParameter) -> None:
    rng = np.random.default_rng(5)
    hand = on_one_dof(two_finger_hand()) if axis is PerturbedParameter.COUPLINGS else PADS
    drawn = [draw_variant(axis, hand, rng) for _ in range(60)]
    for one in drawn:
        assert 0.5 <= min(one.gain, one.damping, one.mass) <= max(one.gain, one.damping, one.mass) <= 2
        assert 0.4 - 1e-9 <= 0.6 * one.friction <= 0.8 + 1e-9
        assert np.linalg.norm(one.centre_m) <= 5e-3 and np.linalg.norm(one.object_shift_m) <= 2e-3
        assert np.linalg.norm(one.object_turn) <= np.radians(2) and np.linalg.norm(one.hand_shift_m) <= 2e-3
        assert (one.fit, one.grown_m) in (*variants.SHAPES, ("own", 0.0))
    assert len({repr(one) for one in drawn}) > (0 if axis is PerturbedParameter.COUPLINGS else 1)


def tied(second: float = 1.0) -> HandModel:
    hand = two_finger_hand()
    limits = {"lower": np.array([-0.3, -0.2]), "upper": np.array([1.2, 1.1]), "stiffness": np.array([10.0, 6.0])}
    return dataclasses.replace(hand, digest="2" * 32, tendons=(Tendon("both", (0, 1), (1.0, second)),), **limits)


def pressed(variant: Variant) -> tuple[float, float]:
    """Joints under 0.5 N m on the second one, commanded to 0.2 rad each."""
    scene = Models(tied(), BOX, WHOLE, MujocoOptions()).scene(variant)
    data = placed_data(scene, np.full(2, 0.2))
    data.qfrc_applied[scene.model.joint("joint2").dofadr[0]] = 0.5
    mujoco.mj_step(scene.model, data, nstep=1500)
    return float(data.joint("joint1").qpos[0]), float(data.joint("joint2").qpos[0])


def test_each_reading_moves_as_it_says() -> None:
    assert variants.couplings_of(tied()) == ("separate", "ratio")
    first, second = pressed(Variant())
    # A tendon holds the sum alone: the first joint runs to its limit, which gives some mrad, and the sum gives
    # 0.5 N m over 1 / (1 / 10 + 1 / 6) = 3.75 N m/rad.
    assert (first, second) == pytest.approx((-0.3, 0.4 + 0.5 / 3.75 + 0.3), abs=0.02)
    first, second = pressed(Variant(coupling="separate"))
    # Springs of 10 and 6 N m/rad of their own: 0.5 / 6 on the second.
    assert (first, second) == pytest.approx((0.2, 0.2 + 0.5 / 6), abs=2e-3)
    first, second = pressed(Variant(coupling="ratio"))
    # One joint of 16 N m/rad: both give 0.5 / 16, but for the coupling's own compliance.
    assert (first, second) == pytest.approx((0.2 + 0.5 / 16, 0.2 + 0.5 / 16), abs=5e-3)


def test_a_ratio_keeps_what_both_can_do() -> None:
    hand = replace_coupling(tied(), "ratio")
    assert (hand.dofs, hand.tendons) == (1, ()) and (hand.lower[0], hand.upper[0]) == (-0.2, 1.1)
    assert hand.expand(np.array([0.4])) == pytest.approx([0.4, 0.4])
    assert variants.nearest_feasible_joints(hand, np.array([[0.1, 0.5]]))[0] == pytest.approx([0.3, 0.3])
    turned = replace_coupling(tied(-1.0), "ratio")
    assert turned.expand(np.array([0.15])) == pytest.approx([0.15, -0.15])
    assert (turned.lower[0], turned.upper[0]) == (-0.3, 0.2), "the second joint turns the other way"
    hand = two_finger_hand()
    assert replace_coupling(hand, "ratio") is hand is replace_coupling(hand, "separate")
    assert variants.couplings_of(hand) == ()


def driven(hand: HandModel, begin: np.ndarray, aim: np.ndarray) -> tuple[Scene, mujoco.MjData]:
    """A hand far from everything whose dofs (D,) are driven to an aim."""
    scene = build_scene(hand, BOX, WHOLE, MujocoOptions())
    data = placed_data(scene, hand.expand(begin))
    scene.command(data, FAR, hand.expand(aim))
    return scene, data


def test_a_tendon_moves_the_sum_and_pulls_by_its_coefficients() -> None:
    hand = load(root="palm")
    bend, curl = (hand.dof_names.index(name) for name in ("left_bend", "left_curl"))
    aim = hand.preshape.copy()
    aim[[bend, curl]] = 0.5, 0.4
    scene, data = driven(hand, hand.preshape, aim)
    assert scene.model.nu == hand.dofs - 1
    mujoco.mj_step(scene.model, data, nstep=1)
    body = {name: hand.joint_body[hand.joint_names.index(name)] for name in ("left_bend", "left_curl")}
    force = [float(data.joint(f"joint{body[name]}").qfrc_actuator[0]) for name in body]
    assert force[1] == pytest.approx(0.5 * force[0])
    mujoco.mj_step(scene.model, data, nstep=1000)
    q = hand.reduce(data.qpos[scene.joint_qpos])
    # Nothing else pulls: after 4 s what is left is below a thousandth of a radian. How the joints share it is open.
    assert q[bend] + 0.5 * q[curl] == pytest.approx(0.5 + 0.5 * 0.4, abs=1e-3)
    separate = dataclasses.replace(hand, tendons=())
    dragged = dataclasses.replace(separate, drag=Drag(np.zeros(hand.bodies), np.zeros(hand.bodies)))
    keys = {verdict_key(one, BOX, "standard", False, pieces=WHOLE) for one in (hand, separate, dragged)}
    assert len(keys) == 3
    assert prefilter_key_terms(hand, "standard", ExecutionContext(prefilter="on")) == []


def test_one_joint_of_tendon_takes_what_limit_of_other_leaves() -> None:
    hand = load(root="palm")
    bend, curl, spread = (hand.dof_names.index(f"left_{name}") for name in ("bend", "curl", "spread"))
    upper = hand.upper.copy()
    upper[curl] = 0.1
    begin = hand.preshape.copy()
    begin[spread] = -0.2  # past the other finger
    aim = begin.copy()
    aim[[bend, curl]] = 0.5, 0.8
    scene, data = driven(dataclasses.replace(hand, upper=upper), begin, aim)
    mujoco.mj_step(scene.model, data, nstep=1500)
    q = hand.reduce(data.qpos[scene.joint_qpos])
    # A limit gives way to torques by less than a milliradian.
    assert q[curl] == pytest.approx(0.1, abs=1e-3)
    assert q[bend] == pytest.approx(0.5 + 0.5 * (0.8 - q[curl]), abs=1e-3)


def test_a_drive_stays_what_it_is_with_followers_or_on_a_tendon() -> None:
    text = CLAW.replace('joint="left_curl" coef="0.5"', 'joint="left_curl" coef="1"')
    tendon = load(text, root="palm")
    ratio = load(text, root="palm", tendons={}, couplings={"left_curl": {"of": "left_bend"}})
    (cord,), dof = tendon.tendons, ratio.dof_names.index("left_bend")
    # Both joints by the same angle q change the tendon's length by 2 q: its gain K is 4 K to q, its limit F is 2 F.
    forth, back = transfer_drives(match_hands(tendon, ratio)), transfer_drives(match_hands(ratio, tendon))
    assert forth.stiffness[dof] == pytest.approx(4 * cord.gain(tendon.stiffness))
    assert forth.effort[dof] == pytest.approx(2 * cord.limit(tendon.effort))
    assert 4 * cord.gain(back.stiffness) == pytest.approx(ratio.stiffness[dof])
    assert 2 * cord.limit(back.effort) == pytest.approx(ratio.effort[dof])


def test_the_same_model_gives_the_same_verdicts(tmp_path) -> None:
    both = validate_twice(plates_case(), match_hands(PADS_HAND, PADS_HAND), cache=tmp_path)
    row = both.facts()
    assert row["foreign_held"] == {"both": 2, "nominal": 0, "foreign": 0, "neither": 1}
    assert (row["agreement"], row["foreign_share"], row["fingertips_mm"]) == (1.0, 1.0, pytest.approx(0.0, abs=1e-6))
    assert both.foreign.success.tolist() == [True, True, False]
    json.dumps(row, allow_nan=False)


def test_a_model_with_other_pads_says_otherwise(tmp_path) -> None:
    # The other model's pads do not reach the object: they are 40 mm nearer to their joints.
    back, (foot, *pads) = np.array([0, 0, -0.04, 0, 0, 0, 0]), PADS_HAND.pieces
    moved = (dataclasses.replace(p, vertices=p.vertices + back[:3], pose=p.pose + back) for p in pads)
    same = match_hands(PADS_HAND, dataclasses.replace(PADS_HAND, name="shorter", pieces=(foot, *moved)))
    row = validate_twice(plates_case(), same, cache=tmp_path).facts()
    assert row["foreign_held"] == {"both": 0, "nominal": 2, "foreign": 0, "neither": 1}
    assert (row["foreign_share"], row["agreement"]) == (0.0, pytest.approx(1 / 3))
    ours_in_theirs = dataclasses.replace(same, theirs=with_our_shapes(same))
    assert validate_twice(plates_case(), ours_in_theirs, cache=tmp_path).facts()["foreign_share"] == 1.0
    theirs_in_ours = dataclasses.replace(same, theirs=with_their_shapes(same))
    assert validate_twice(plates_case(), theirs_in_ours, cache=tmp_path).facts()["foreign_share"] == 0.0


def test_joints_take_order_and_the_couplings_of_the_other_model() -> None:
    grasps = plates_case().grasps
    other = dataclasses.replace(
        PADS_HAND, joint_names=PADS_HAND.joint_names[::-1], joint_body=PADS_HAND.joint_body[::-1].copy()
    )
    moved = transfer_grasps(match_hands(PADS_HAND, other), grasps)
    assert moved.grasp.joint_positions == pytest.approx(grasps.grasp.joint_positions[:, ::-1])
    assert moved.grasp.hand_pose == pytest.approx(np.asarray(grasps.grasp.hand_pose), abs=1e-6)
