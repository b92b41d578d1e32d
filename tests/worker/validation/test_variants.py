"""Variants of the validator's model: what each axis changes in the engine, and nothing else."""

from __future__ import annotations

import copy
import dataclasses

import mujoco
import numpy as np
import pytest
import trimesh

from graspd.service.model.matter import MASS_KG
from graspd.service.model.metrics import Axis
from graspd.service.model.transforms import apply
from graspd.worker.control.postures import pregrasp, squeeze
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.primitives import tessellate, volume
from graspd.worker.validation import model
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.model import MujocoOptions
from graspd.worker.validation.protocol import STAGES, Test
from graspd.worker.validation.refit import fits_of, grown, refitted
from graspd.worker.validation.validator import validate
from graspd.worker.validation.variant import NOMINAL, SHAPES, Variant, axes_of, draw
from graspd.worker.validation.varied import Models, VariantTest, seen
from tests.worker.models import object_from_mesh, piece, two_finger_hand
from tests.worker.quality.helpers import pad_hand, plate_hand, posture

BOX = object_from_mesh(trimesh.creation.box((0.06, 0.04, 0.05)))
WHOLE = ConvexPieces((BOX.hull_vertices,), 1.0, 0.0, "box")
PADS = dataclasses.replace(pad_hand(), upper=np.full(2, 0.2))
RNG = np.random.default_rng(11)


def many_grasps(force: float = 20.0) -> GraspSet:
    """Pads that hold the box ever nearer to its edge, from firm to none at all."""
    contact = posture(*[((0, 0, z), (0.065, 0.065)) for z in np.linspace(0.0, 0.055, 8)])
    return GraspSet(
        contact, pregrasp(PADS, BOX, contact), squeeze(PADS, BOX, contact, total_normal_force=force), np.full(8, np.nan)
    )


def models(hand: HandModel = PADS, friction: tuple[float, float] = (0.6, 0.02)) -> Models:
    return Models(hand, BOX, WHOLE, MujocoOptions(friction=friction))


def finger(kind: str) -> HandModel:
    """Plates of one kind that look at the box along x."""
    size = {
        "box": (0.05, 0.05, 0.01),
        "cylinder": (0.02, 0.01),
        "capsule": (0.01, 0.03),
        "sphere": (0.012,),
        "hull": (),
    }
    base = plate_hand()
    if kind == "hull":
        vertices, faces = tessellate("box", (0.05, 0.05, 0.01))
    else:
        vertices, faces = tessellate(kind, size[kind])
    solid = trimesh.Trimesh(vertices, faces, process=False)
    pieces = tuple(piece(body, solid, kind, size[kind], (0, 0, 0)) for body in (1, 2))
    return dataclasses.replace(base, digest=f"{kind:0>32}", pieces=(base.pieces[0], *pieces))


def gap(around: Models, variant: Variant) -> float:
    """Distance in the engine of the first finger from the box [m]."""
    scene = around.scene(variant)
    data = mujoco.MjData(scene.model)
    scene.place(data, np.array([0, 0, 0, 1.0, 0, 0, 0]), np.array([0.03, 0.03]))
    mujoco.mj_forward(scene.model, data)
    ours, theirs = scene.model.geom("hand1").id, scene.model.geom("object-0").id
    return float(mujoco.mj_geomDistance(scene.model, data, ours, theirs, 1.0, None))


@pytest.mark.parametrize("kind", ["box", "cylinder", "capsule", "sphere", "hull"])
def test_shapes_grow_by_a_millimetre_in_the_engine(kind: str, monkeypatch: pytest.MonkeyPatch) -> None:
    # Whether plates are a gripper's jaws takes a search and moves no distance.
    monkeypatch.setattr(model, "jaws_of", lambda hand: None)
    around = models(finger(kind))
    own = gap(around, NOMINAL)
    for by in (1e-3, -1e-3):
        # The engine's distances are good to its tolerance of 1e-6; corners of meshes are single precision.
        assert own - gap(around, Variant(grown_m=by)) == pytest.approx(by, abs=3e-6)


@pytest.mark.parametrize("by", [2e-3, -1e-3])
def test_a_hull_grows_like_its_sum_with_a_ball_along_its_normals(by: float) -> None:
    solid = trimesh.convex.convex_hull(RNG.normal(size=(40, 3)) * 0.02)
    other = grown(piece(0, solid, "hull", (), (0, 0, 0)), by)
    reach = (other.vertices @ solid.face_normals.T).max(axis=0) - (solid.vertices @ solid.face_normals.T).max(axis=0)
    # A small side may be swallowed by its neighbours where the solid shrinks: then it lies farther back.
    assert reach.max() == pytest.approx(by, abs=1e-9)
    assert np.median(reach) == pytest.approx(by, abs=1e-9)
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
        assert np.ptp(grown(thin, -1e-3).vertices, axis=0)[2] == pytest.approx(5e-4, rel=1e-3)


@pytest.mark.parametrize(
    ("kind", "size"), [("box", (0.02, 0.03, 0.05)), ("cylinder", (0.01, 0.06)), ("capsule", (0.012, 0.03)),
                       ("cylinder", (0.03, 0.01))],
)  # fmt: skip
def test_the_primitive_nearest_to_the_hull_of_a_primitive_is_that_primitive(kind: str, size: tuple[float, ...]) -> None:
    vertices, faces = tessellate(kind, size)
    turned = apply(np.array([0.01, 0.02, 0.03, *(np.array([1, 2, 3, 4]) / np.sqrt(30))]), vertices)
    hulls = piece(0, trimesh.Trimesh(turned, faces, process=False), "hull", (), (0, 0, 0))
    found = refitted(dataclasses.replace(two_finger_hand(), pieces=(hulls,)), "primitive").pieces[0]
    assert found.kind == kind
    # Tessellations lie inside the round ones: 32 corners lose 0.6 % of a circle's area.
    assert sorted(found.size) == pytest.approx(sorted(size), rel=0.01)
    assert volume(found.kind, found.size, found.vertices, found.faces) == pytest.approx(
        volume("hull", (), turned, faces), rel=0.01
    )


def test_fits_that_change_nothing_are_not_offered() -> None:
    hand = two_finger_hand()
    ball = dataclasses.replace(hand, pieces=tuple(p for p in hand.pieces if p.kind == "sphere"))
    assert fits_of(ball) == frozenset()
    assert "hull" in fits_of(hand), "a finger has a shaft and a tip"
    assert len(refitted(hand, "hull").pieces) == 3
    assert refitted(ball, "capsule") is ball


def test_the_nominal_variant_has_the_verdicts_of_the_judge_bit_for_bit() -> None:
    grasps = many_grasps()
    verdicts = validate(PADS, BOX, grasps, pieces=WHOLE)
    found = [models().standard(grasps, row, NOMINAL) for row in range(len(grasps))]
    assert [rollout.success for rollout in found] == (verdicts.success == 1).tolist()
    assert [rollout.margin for rollout in found] == verdicts.margin.tolist()
    assert {True, False} == set((verdicts.success == 1).tolist())


def test_a_variant_leaves_the_nominal_model_as_it_was() -> None:
    around = models()
    before = copy.copy(around.scene(NOMINAL).model)
    for axis in axes_of(PADS):
        around.scene(draw(axis, PADS, np.random.default_rng(1)))
    after = around.scene(NOMINAL).model
    for name in ("dof_damping", "dof_armature", "actuator_gainprm", "geom_friction", "body_mass", "geom_size"):
        assert np.array_equal(getattr(before, name), getattr(after, name)), name


def test_numbers_reach_the_engine() -> None:
    around = models()
    own = around.scene(NOMINAL).model
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


def test_a_heavier_object_is_pushed_by_its_weight() -> None:
    around, away = models(), posture(((0, 0, -0.5), (0.0, 0.0)))
    grasps = GraspSet(away, away, away, np.full(1, np.nan))
    moved = []
    for variant in (NOMINAL, Variant(mass=2.0)):
        test = VariantTest(around.scene(variant), variant, None)
        test._close(grasps, 0)
        test._push(2)
        test._run(0.1)
        moved.append(test._offset()[1])
    # The same acceleration of 10 m/s^2, half a step of velocity added by the implicit step.
    assert moved == pytest.approx([0.5 * 10 * 0.1 * (0.1 + 0.004)] * 2, rel=1e-6)


def test_the_centre_of_mass_moves_and_the_object_stays() -> None:
    shift = (0.003, -0.002, 0.001)
    scene = models().scene(Variant(centre_m=shift))
    data = mujoco.MjData(scene.model)
    scene.place(data, np.array([0, 0, -0.5, 1.0, 0, 0, 0]), np.zeros(2))
    mujoco.mj_forward(scene.model, data)
    assert data.xipos[scene.object_body] == pytest.approx(BOX.centre_of_mass + shift, abs=1e-9)
    assert data.geom("object-0").xpos == pytest.approx(BOX.centre_of_mass, abs=1e-7)
    test = Test(scene)
    scene.place(test.data, np.array([0, 0, -0.5, 1.0, 0, 0, 0]), np.zeros(2))
    assert test._offset() == pytest.approx([0, 0, 0], abs=1e-12), "the mesh's frame is where it was"


def test_an_object_that_stands_off_is_met_by_a_hand_that_stands_off_the_other_way() -> None:
    grasps = many_grasps()
    shift, turn = (0.001, -0.002, 0.0005), (0.0, 0.0, 0.03)
    moved = seen(BOX, grasps, 3, Variant(object_shift_m=shift))
    assert moved.pregrasp.hand_pose[0, :3] == pytest.approx(grasps.pregrasp.hand_pose[3, :3] - shift)
    turned = seen(BOX, grasps, 3, Variant(object_turn=turn)).grasp.hand_pose[0]
    arm = grasps.grasp.hand_pose[3, :3] - BOX.centre_of_mass
    back = np.array([[np.cos(0.03), np.sin(0.03), 0], [-np.sin(0.03), np.cos(0.03), 0], [0, 0, 1]])
    assert turned[:3] == pytest.approx(BOX.centre_of_mass + back @ arm, abs=1e-12)
    assert 2 * np.arccos(turned[3]) == pytest.approx(0.03, rel=1e-6)
    assert np.array_equal(moved.squeeze.joint_positions[0], grasps.squeeze.joint_positions[3])


def test_a_hand_is_off_in_its_own_frame() -> None:
    grasps = many_grasps()
    quarter = np.array([np.sqrt(0.5), 0, 0, np.sqrt(0.5)])
    for part in (grasps.grasp, grasps.pregrasp, grasps.squeeze):
        part.hand_pose[:, 3:] = quarter
    off = seen(BOX, grasps, 2, Variant(hand_shift_m=(0.002, 0, 0)))
    assert off.grasp.hand_pose[0, :3] - grasps.grasp.hand_pose[2, :3] == pytest.approx([0, 0.002, 0], abs=1e-12)


def test_fingers_that_close_one_after_another_end_together() -> None:
    grasps, around = many_grasps(), models()
    variant = Variant(lags=(0.0, 0.25))
    plain = list(VariantTest(around.scene(NOMINAL), NOMINAL, None)._way(grasps, 0))
    late = list(VariantTest(around.scene(variant), variant, around._lags(variant))._way(grasps, 0))
    assert len(late) == len(plain) == 2 * STAGES
    assert late[-1][1] == pytest.approx(grasps.squeeze.joint_positions[0])
    assert all(a[0] == pytest.approx(b[0]) for a, b in zip(plain, late, strict=True)), "the root comes as before"
    start = grasps.pregrasp.joint_positions[0]
    still = [joints[1] for _, joints in late[: 2 * STAGES // 4]]
    assert still == pytest.approx([start[1]] * len(still)), "the second finger waits a quarter of the time"
    assert late[0][1][0] != pytest.approx(start[0]), "the first one does not"


def test_less_friction_holds_no_more() -> None:
    grasps = many_grasps(force=6.0)
    around = models(friction=(0.3, 0.01))
    shares = [
        np.mean([around.standard(grasps, row, Variant(friction=factor)).success for row in range(len(grasps))])
        for factor in (0.1, 0.5, 1.0, 3.0)
    ]
    assert shares == sorted(shares)
    assert shares[0] < shares[-1]


def test_only_coupled_hands_vary_in_couplings() -> None:
    single = two_finger_hand()
    assert Axis.COUPLINGS not in axes_of(single)
    coupled = one_drive()
    assert Axis.COUPLINGS in axes_of(coupled)


def one_drive() -> HandModel:
    """Two fingers on one dof."""
    return dataclasses.replace(
        two_finger_hand(),
        digest="1" * 32,
        dof=np.array([-1, 0, 0], np.int32),
        dof_names=("both",),
        lower=np.full(1, -0.3),
        upper=np.full(1, 1.2),
        effort=np.ones(1),
        stiffness=np.full(1, 10.0),
        preshape=np.zeros(1),
        closing=np.ones(1),
    )


def test_a_compliant_coupling_gives_way_under_load() -> None:
    apart = []
    around = models(one_drive())
    for variant in (NOMINAL, Variant(coupling="compliant")):
        scene = around.scene(variant)
        data = mujoco.MjData(scene.model)
        scene.place(data, np.array([0, 0, -0.5, 1.0, 0, 0, 0]), np.zeros(2))
        data.qfrc_applied[scene.model.joint("joint2").dofadr[0]] = 0.5
        mujoco.mj_step(scene.model, data, nstep=200)
        apart.append(abs(float(data.joint("joint2").qpos[0] - data.joint("joint1").qpos[0])))
    assert apart[1] > 2 * apart[0] > 0


@pytest.mark.parametrize("axis", [axis for axis in Axis if axis is not Axis.NONE])
def test_a_draw_stays_in_the_range_of_its_axis(axis: Axis) -> None:
    rng = np.random.default_rng(5)
    hand = one_drive() if axis is Axis.COUPLINGS else PADS
    drawn = [draw(axis, hand, rng) for _ in range(60)]
    for one in drawn:
        assert 0.5 <= min(one.gain, one.damping, one.mass) <= max(one.gain, one.damping, one.mass) <= 2
        assert 0.4 - 1e-9 <= 0.6 * one.friction <= 0.8 + 1e-9
        assert np.linalg.norm(one.centre_m) <= 5e-3 and np.linalg.norm(one.object_shift_m) <= 2e-3
        assert np.linalg.norm(one.object_turn) <= np.radians(2) and np.linalg.norm(one.hand_shift_m) <= 2e-3
        assert (one.fit, one.grown_m) in (*SHAPES, ("own", 0.0))
    assert len({repr(one) for one in drawn}) > (0 if axis is Axis.COUPLINGS else 1)
