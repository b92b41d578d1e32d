"""Requirements on grasps, in starts, planned grasps and selection; `graspd synth`, validated as a job."""

import json
import re
import signal
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import numpy as np
import pytest
import trimesh
import warp as wp
from typer.testing import CliRunner

import graspd
from graspd.cli import build_app
from graspd.commands.synth import _format_summary
from graspd.service.cli import write_output
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import ConflictError, InputError, NotFoundError
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.grasp_types import BALANCED
from graspd.service.model.transforms import apply, quat_rotate
from graspd.service.readers import Grasps, open_shards
from graspd.service.readers.where import compile_expression
from graspd.service.store.manifests import _grasp_summaries
from graspd.service.store.shards import Shard, read_shard
from graspd.worker import generation
from graspd.worker.batched_generation import validated_batches
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.files import synthesis
from graspd.worker.files.provenance import object_of_shard
from graspd.worker.files.synthesis import synthesize_grasps
from graspd.worker.generation import validated_grasps
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.digits import Part, digit_names, finger_of_body, hand_with_digits
from graspd.worker.hands.jaws import fingertip_pad
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.planners import PlanRequest, synthesize
from graspd.worker.planners.fast_graspd import starts
from graspd.worker.planners.fast_graspd.antipodal_starts import ReachSampling, _is_within_reach, crossings_of
from graspd.worker.planners.fast_graspd.candidates import posture_of
from graspd.worker.planners.fast_graspd.pairs import pair_of
from graspd.worker.planners.fast_graspd.scene_starts import EVERY, REACHING, clear_scene_starts, free_directions
from graspd.worker.planners.fast_graspd.starts import RETREATS, _Pair, draw_starts, start_generator
from graspd.worker.planners.requirements import INNER, LEAST_SHARE, NOTHING, Requirements
from graspd.worker.quality.contact import LINK_CONTACT_M
from graspd.worker.quality.probe import probe_of
from graspd.worker.quality.table import measure
from graspd.worker.simulation.data import HandState
from graspd.worker.simulation.kernels import reaching
from graspd.worker.simulation.obstacles import DeviceObstacles
from tests.worker.commands_run import graspd as graspd_command
from tests.worker.commands_run import refused
from tests.worker.hands.urdfs import gripper
from tests.worker.models import assert_same_batch, object_from_mesh, on_tables, unit_vectors

COUNT = 8
DRAFT, TWO = FIDELITIES["draft"], ExecutionContext(threads=2)
SMALL = object_from_mesh(trimesh.creation.icosphere(subdivisions=3, radius=0.02))
#: A bar that stands on z = 0.
BAR = object_from_mesh(trimesh.creation.box((0.04, 0.04, 0.14))).place_at((0.0, 0.0, 0.07))
OBJECTS = {"ball": SMALL, "bar": BAR}
HAND = hand_from_path("allegro")
AXIS = np.array([0.0, 0.6, -0.8])
SIDE, ABOVE = "0, 0.6, -0.8, 30", "0, 0, -1, 30"


def required(obj=BAR, hand: HandModel = HAND, batch: int = 0, **options: object) -> Requirements:
    found = Requirements.of(JobOptions(**options), hand, batch, origin=obj.centre)
    found.check(hand, obj.centred)
    return found


@wp.kernel
def into_cones(given: wp.array(dtype=wp.vec3), axis: wp.vec3, cosine: float, out: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    out[i] = reaching.into_cone(given[i], axis, cosine)


@pytest.mark.parametrize("angle", [0.1, 0.5, 1.5, 3.0])
def test_uniform_directions_are_uniform_in_the_cone_of_the_kernel(angle: float) -> None:
    given = unit_vectors(np.random.default_rng(0), 4000)
    out = wp.empty(len(given), dtype=wp.vec3, device="cpu")
    inputs = [wp.array(given, dtype=wp.vec3, device="cpu"), wp.vec3(*AXIS), float(np.cos(angle))]
    wp.launch(into_cones, len(given), inputs=inputs, outputs=[out], device="cpu")
    assert np.linalg.norm(out.numpy(), axis=1) == pytest.approx(1.0, abs=1e-5)
    # Bands of equal height of a cap have equal areas.
    height = (1.0 - out.numpy() @ AXIS) / (1.0 - np.cos(angle))
    assert height.min() > -1e-4 and height.max() < 1 + 1e-4
    assert np.histogram(height, 5, (0, 1))[0] / len(given) == pytest.approx(0.2, abs=0.025)
    assert (out.numpy()[:, 0] > 0).mean() == pytest.approx(0.5, abs=0.03)


@pytest.mark.parametrize("angle", [0.2, 1.0, 2.5])
def test_directions_outside_a_cone_are_turned_inside_and_stay_apart(angle: float) -> None:
    given = np.concatenate([unit_vectors(np.random.default_rng(1), 2000), [AXIS, -AXIS]])
    found = starts.into_cone(given, AXIS, angle)
    before, after = (np.arccos(np.clip(some @ AXIS, -1, 1)) for some in (given, found))
    np.testing.assert_allclose(after, np.where(before > angle, angle * before / np.pi, before), atol=1e-7)
    np.testing.assert_allclose(found[before <= angle], given[before <= angle], atol=1e-9)
    assert np.linalg.norm(found, axis=1) == pytest.approx(1.0) and len(np.unique(found.round(6), axis=0)) > 1990


def approaches(rotation: np.ndarray) -> np.ndarray:
    return quat_rotate(rotation, HAND.palm.approach)


def test_pairs_of_a_cone_are_less_than_the_reach_below_the_top() -> None:
    obj = BAR.centred
    middle = crossings_of(obj).middle - obj.centre_of_mass
    up = np.array([0, 0, 1.0])
    for longest in (0.03, 0.06):
        inside, top = _is_within_reach(obj, middle, up, longest), np.ptp(obj.vertices[:, 2]) / 2
        # Samples of the surface stand for its top, with at most 10 mm between them.
        assert inside[middle[:, 2] > top - longest + 1e-6].all()
        assert not inside[middle[:, 2] < top - longest - 0.01].any() and 0 < inside.sum() < len(middle)
    assert _is_within_reach(obj, middle, up, 1.0).all() and _is_within_reach(obj, middle, up, 0.0).all()


def test_draws_of_the_kernel_approach_within_the_cone() -> None:
    wanted, pair = required(approach_cone=SIDE), pair_of(HAND, BAR.centred, DRAFT, "cpu")
    drawn = []
    for one in (wanted, NOTHING):
        sampling = ReachSampling.of(pair.model(pair.coarse), one)
        state, number = sampling.starts(np.arange(300, dtype=np.int32), np.zeros(300, np.int32), np.array(RETREATS))
        drawn.append((approaches(state.rotation) @ AXIS)[number >= 0])
    assert len(drawn[0]) > 30 and drawn[0].min() >= np.cos(INNER * wanted.cone) - 1e-5 and drawn[1].min() < 0.0


def draws(wanted: Requirements, obj=BAR, count: int = 200) -> tuple[ReachSampling, HandState]:
    pair = pair_of(hand := wanted.hand(HAND), obj.centred, DRAFT, "cpu")
    sampling = ReachSampling.of(pair.model(pair.coarse), wanted)
    state, number = sampling.starts(np.arange(count, dtype=np.int32), np.zeros(count, np.int32), np.array(RETREATS))
    assert hand.dofs == state.q.shape[1] and (number >= 0).mean() > 0.5
    return sampling, state[np.flatnonzero(number >= 0)]


def test_fingers_in_line_start_with_all_pads_near_the_object() -> None:
    slab, far = object_from_mesh(trimesh.creation.box((0.04, 0.16, 0.16))), {}
    for kind in ("prismatic_3_finger", "quadpod"):
        grasp = posture_of(HAND, slab.centred, draws(required(slab, type=kind), slab)[1])
        tips = body_poses(HAND, grasp.hand_pose, grasp.joint_positions)[:, list(HAND.fingertips)]
        pads = apply(tips, np.array([fingertip_pad(HAND, tip).centre for tip in HAND.fingertips]))
        far[kind] = np.linalg.norm(np.maximum(np.abs(pads) - (0.02, 0.08, 0.08), 0), axis=-1).max(axis=1)
    # A pad is at most 24 mm away (half the clearance is at most 18 mm), before noise of a few millimetres.
    assert np.median(far["prismatic_3_finger"]) < 0.03 < np.quantile(far["quadpod"], 0.2)


def test_all_hands_start_around_a_thin_region() -> None:
    # A rod with a knob on a block: the knob is as wide as the gap of a pinch, so the region is not small everywhere.
    sizes, places = ((0.06, 0.06, 0.06), (0.03, 0.01, 0.012), (0.004, 0.03, 0.012)), (0.0, 0.045, 0.062)
    parts = [trimesh.creation.box(size).apply_translation((x, 0, 0)) for size, x in zip(sizes, places, strict=True)]
    obj = object_from_mesh(trimesh.util.concatenate(parts))
    assert crossings_of(obj.centred, required(obj, touch_region="x > 0.032").region).width.max() > 0.025
    thin, state = draws(required(obj, touch_region="x > 0.032"), obj)
    assert thin.only and not draws(NOTHING, obj)[0].only and not draws(required(touch_region="z > 0.09"))[0].only
    # Palms that start towards a point of the rod are nearer than 30 mm to its middle.
    away = np.linalg.norm(state.pivot + obj.centre_of_mass - [0.045, 0, 0], axis=1)
    assert away.min() > 0.03 and np.median(away) > 0.06


@pytest.mark.parametrize("place", ["free", "table"])
def test_palms_start_before_the_region_and_within_the_cone(place: str) -> None:
    obj, free = BAR.centred, place == "free"
    wanted = required(touch_region="z > 0.11", approach_cone=SIDE if free else ABOVE)
    placed = on_tables(BAR, count=1).centred(BAR).placed(np.zeros(12, int))
    pair = pair_of(HAND, obj, DRAFT, "cpu", in_scenes=not free)
    generators = [start_generator(3, 0, i, k) for i in range(12) for k in range(EVERY)]
    if free:
        state, _ = draw_starts(_Pair(HAND, obj, wanted=wanted), generators)
    else:
        model = pair.model(pair.coarse, DeviceObstacles.create(HAND, placed.scenes, obj.centre_of_mass, "cpu"))
        ways = [wanted.retreats(free_directions(placed.scenes[0], obj), placed, 0)]
        state, _ = clear_scene_starts(model, generators, each=EVERY, placed=placed, ways=ways, wanted=wanted)
    approach, axis = approaches(state.rotation), wanted.axes(None if free else placed, 12)[0]
    assert (approach @ axis > np.cos(INNER * wanted.cone if free else wanted.cone) - 1e-6).mean() >= (
        1 if free else 0.9
    )
    # Rays from palms to single points meet the upper part of the bar; those to pairs of points pass near it.
    along = state.pivot[:, None] + np.linspace(0, 0.25, 251)[:, None] * approach[:, None]
    off = np.linalg.norm(np.maximum(np.abs(along - [0, 0, 0.055]) - [0.02, 0.02, 0.015], 0), axis=-1).min(axis=1)
    number = np.arange(len(off)) % EVERY
    assert off[free | (number >= REACHING)].max() < 1e-3 and off.max() < 0.05
    for end in crossings_of(obj, wanted.region).ends():
        assert len(end) and (end[:, 2] > 0.04 - 1e-9).all()


@cache
def planned(name: str, place: str = "free", **options: object) -> tuple[Requirements, GraspSet, dict[str, np.ndarray]]:
    """Grasps straight from the planner, without selection, and their measures."""
    obj, wanted = OBJECTS[name].centred, required(OBJECTS[name], **options)
    scenes = on_tables(OBJECTS[name], count=2).centred(OBJECTS[name]) if place == "table" else None
    placed = scenes and scenes.placed(np.arange(COUNT) % 2)
    found = synthesize(HAND, obj, PlanRequest(COUNT, DRAFT, seed=1, placed=placed, requirements=wanted), TWO)
    columns = measure(HAND, obj, found, region=wanted.region)
    if wanted.approach is not None:
        axes, approach = wanted.axes(placed, COUNT), approaches(found.grasp.hand_pose[:, 3:])
        columns["cosine"] = np.einsum("ni,ni->n", approach, axes)
    probe = probe_of(HAND, obj, hand_points=2000, object_points=3000)
    columns["touching"] = probe.body_distance(probe.measure(found.grasp)) < LINK_CONTACT_M
    return wanted, found, columns


@pytest.mark.parametrize("options", [{"type": "precision"}, {"type": "pinch"}], ids=str)
def test_planned_precision_grasps_touch_with_the_fingertips_only(options: dict[str, object]) -> None:
    tips = np.isin(np.arange(HAND.bodies), HAND.fingertips)
    touching = planned("ball", **options)[2]["touching"]
    assert not touching[:, ~tips].any() and (touching[:, tips].sum(axis=1) >= 2).all()
    assert planned("ball")[2]["touching"][:, ~tips].any(axis=1).mean() > 0.5, "without a requirement, palms touch"


@pytest.mark.parametrize("options", [{"type": "pinch"}, {"digits": ("thumb", "index")}], ids=str)
def test_unused_digits_stay_locked_and_do_not_touch(options: dict[str, object]) -> None:
    _, found, columns = planned("ball", **options)
    locked = hand_with_digits(HAND, ("thumb", "index"))
    q = HAND.reduce(found.grasp.joint_positions)
    assert ((q >= locked.lower - 1e-5) & (q <= locked.upper + 1e-5)).all()
    assert not (columns["quality/digits"] & ~0b11).any() and (planned("ball")[2]["quality/digits"] & ~0b11).any()


def test_a_fixed_hook_has_contacts_of_palm_and_four_fingers_without_the_thumb() -> None:
    shadow = hand_from_path("shadow")
    wanted = required(hand=shadow, type="fixed_hook")
    allowed, thumb = wanted.allowed(shadow).parts, digit_names(shadow).index("thumb")
    assert wanted.digits == ("index", "middle", "ring", "little") and wanted.links == 4
    assert ((allowed == Part.NONE) == (finger_of_body(shadow) == thumb)).all()


@pytest.mark.parametrize(("place", "cone"), [("free", SIDE), ("free", ABOVE), ("table", ABOVE)])
def test_planned_grasps_approach_within_the_cone(place: str, cone: str) -> None:
    wanted, _, columns = planned("bar", place, approach_cone=cone)
    assert (columns["cosine"] >= np.cos(wanted.cone)).mean() >= 0.75
    assert (columns["quality/contact_links"] >= 2).all()


@pytest.mark.parametrize("options", [{"touch_region": "z > 0.09"}, {"avoid_region": "z > 0.09"}], ids=str)
def test_planned_grasps_touch_in_the_region(options: dict[str, str]) -> None:
    wanted, found, columns = planned("bar", **options)
    assert (columns["quality/region_share"] >= LEAST_SHARE).mean() >= 0.75
    plain = planned("bar")[1]
    other = measure(HAND, BAR.centred, plain, region=wanted.region)["quality/region_share"]
    assert (other < LEAST_SHARE).mean() >= 0.5 and len(found) == COUNT
    # Candidates outside the region have no rollout: the planner's check equals the measured share.
    assert np.array_equal(wanted.fulfilled(HAND, BAR.centred, plain.grasp, None), other >= LEAST_SHARE)


def candidates(**options: object) -> JobOptions:
    return JobOptions(fidelity="draft", validation="none", rechecks=0, **options)


@pytest.mark.parametrize(
    ("options", "outcome"),
    [
        ({"type": "power", "approach_cone": "0, 0, -1, 180"}, "other_type"),
        ({"type": "palmar_pinch"}, "other_type"),
        ({"touch_region": "z > 0.02, x > 0"}, "outside_region"),
        ({"approach_cone": "0, 1, 0, 8"}, "other_approach"),
    ],
)
def test_grasps_that_fail_a_requirement_are_rejected_and_counted(options: dict[str, str], outcome: str) -> None:
    made = validated_grasps(HAND, SMALL if outcome == "other_type" else BAR, candidates(**options, budget=3), count=6)
    wanted = required(SMALL if outcome == "other_type" else BAR, **options)
    assert made.outcomes[outcome] > 0 and made.rejected["requirements"] >= made.outcomes[outcome]
    assert made.candidates == len(made.grasps) + sum(made.rejected.values())
    assert (wanted.failed(HAND, made.grasps.grasp, None, made.columns) == "").all()
    if wanted.rule is not None:
        assert (made.columns["quality/grasp_type"] == wanted.rule.kind).all()
    assert ("quality/region_share" in made.columns) == ("touch_region" in options)


def test_without_requirements_nothing_is_rejected_for_them() -> None:
    made = validated_grasps(HAND, SMALL, candidates(budget=1), count=2)
    assert "requirements" not in made.rejected and "quality/region_share" not in made.columns


@pytest.mark.parametrize(
    ("hand", "options", "message"),
    [
        ("gripper", {"type": "pinch"}, "needs 2 digits with the thumb, and .* is a gripper: choose power or precision"),
        ("gripper", {"digits": ("thumb", "index")}, "no digits to choose"),
        ("barrett", {"type": "quadpod"}, "needs 4 digits with the thumb, and barrett has 3"),
        ("allegro", {"type": "fixed_hook"}, "needs 4 digits besides the thumb, and allegro has 4"),
        ("shadow", {"type": "fixed_hook", "digits": ("thumb", "index", "middle", "ring")}, "needs 4 digits besides"),
        ("allegro", {"digits": ("thumb", "little")}, "no little"),
        ("allegro", {"type": "tripod", "digits": ("thumb", "index")}, "needs 3 digits with the thumb"),
        ("allegro", {"type": "pinch", "digits": ("index", "middle")}, "needs 2 digits with the thumb"),
        ("allegro", {"touch_region": "z > 5"}, "no surface in the region"),
        ("allegro", {"touch_region": "z > 0.1", "avoid_region": "z > 0.05"}, "no surface in the region"),
    ],
)
def test_what_cannot_be_fulfilled_is_refused_before_planning(hand, options, message, monkeypatch) -> None:
    monkeypatch.setattr(generation, "synthesize", None)
    model = gripper() if hand == "gripper" else hand_from_path(hand)
    with pytest.raises(InputError, match=message) as error:
        validated_grasps(model, BAR, candidates(**options), count=2)
    assert "\n" not in str(error.value)


def test_a_cone_that_the_table_blocks_is_refused() -> None:
    with pytest.raises(InputError, match=r"^obstacles block every approach in the cone.*angle$"):
        planned("bar", "table", approach_cone="0, 0, 1, 40")


@pytest.mark.parametrize("join", [1, 4])
def test_balanced_batches_have_the_types_in_turn_also_when_joined(join: int) -> None:
    request = candidates(type="balanced", want="candidates")
    made = validated_batches(HAND, SMALL, request, sizes=[2] * 4, join=join, run=TWO)
    for batch, one in enumerate(made):
        kind = BALANCED[batch % 3]
        assert required(batch=batch, type="balanced").type == kind
        alone = candidates(type=kind, want="candidates")
        assert_same_batch(one, validated_grasps(HAND, SMALL, alone, count=2, batch=batch, run=TWO))
    kinds = [required(hand=gripper(), batch=batch, type="balanced").type for batch in range(4)]
    assert kinds == ["power", "precision"] * 2, "a gripper has no pinch"


def test_requirements_and_contacts_are_written_and_chosen_by_expressions() -> None:
    options = candidates(type="pinch", grasps=2, touch_region="z > 0.02", budget=20)
    made = synthesize_grasps("allegro", "block", options)
    assert json.loads(made.attributes["requirements"]) == {"type": "pinch", "touch_region": "z > 0.02"}
    assert (made.arrays["quality/digits"] == 0b11).all() and (made.arrays["quality/taxonomy_type"] == 9).all()
    count = len(made.arrays["quality/valid"])
    for text, chosen in (("digits = 3 and taxonomy_type = 9 and region_share >= 0.95", count), ("digits != 3", 0)):
        assert compile_expression(text)(made.arrays, {}).sum() == chosen
    summaries = _grasp_summaries(made.arrays, made.attributes)[1]
    assert count == len(summaries) > 0 and {(one.digits, one.taxonomy_type) for one in summaries} == {(3, 9)}


DRAFT_OPTIONS = "--fidelity draft --device cpu"


def synth(out: Path, more: str, obj: str | Path = "block") -> dict:
    return graspd_command(f"synth --hand allegro -n 3 {DRAFT_OPTIONS} {more} --object", obj, "-o", out)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("synth")


@pytest.fixture(scope="module")
def validated(folder: Path) -> tuple[Path, dict]:
    return folder / "validated.h5", synth(folder / "validated.h5", "--budget 8")


@pytest.fixture(scope="module")
def unvalidated(folder: Path) -> tuple[Path, dict]:
    return folder / "unvalidated.h5", synth(folder / "unvalidated.h5", "--validation none")


@pytest.fixture(scope="module")
def own_mesh(folder: Path) -> Path:
    """A box beside a small ball, in a folder that says what it is."""
    (folder / "brick").mkdir()
    box, ball = trimesh.creation.box((0.05, 0.06, 0.07)), trimesh.creation.icosphere(radius=0.005)
    ball.apply_translation([0.1, 0, 0])
    trimesh.util.concatenate([box, ball]).export(folder / "brick" / "clean.obj")
    return folder / "brick" / "clean.obj"


@pytest.fixture(scope="module")
def of_own_mesh(folder: Path, own_mesh: Path) -> Path:
    synth(folder / "own.h5", "--validation none --keep-largest", own_mesh)
    return folder / "own.h5"


def test_grasps_called_valid_were_validated_as_in_a_job(validated: tuple[Path, dict]) -> None:
    file, said = validated
    shard = read_shard(file, kind="base")
    assert (said["grasps"], said["valid"], said["feasible"], said["validation"]) == (3, 3, 3, "standard")
    assert said["candidates"] >= 3 and shard.attributes["candidates"] == said["candidates"]
    assert (shard["quality/success"] == 1).all()
    assert shard.attributes["verdict_level"] == "standard" and "verdict_key" in shard.attributes
    assert said["reason"] is None and "reason" not in shard.attributes


def test_grasps_that_nobody_validated_are_sound_and_never_valid(unvalidated: tuple[Path, dict]) -> None:
    file, said = unvalidated
    shard = read_shard(file, kind="base")
    assert (said["grasps"], said["valid"], said["feasible"], said["validation"]) == (3, 0, 3, "none")
    assert shard.attributes["verdict_level"] == "none" and "quality/success" not in shard.arrays
    assert not shard["quality/valid"].any()
    line = _format_summary({"file": "g.h5", **said})
    assert "3 feasible of" in line and "not validated" in line and not re.search(r"\bvalid\b", line)


def test_evaluate_gives_a_verdict_of_each_grasp_that_agrees(validated: tuple) -> None:
    told = graspd_command("evaluate", validated[0])
    expected = [(str(validated[0]), row, True) for row in range(3)]
    assert [(one["file"], one["row"], one["held"]) for one in told["verdicts"]] == expected
    assert "verdicts" not in told["files"][0]


def test_readers_take_grasps_that_nobody_validated_only_when_told(validated, unvalidated: tuple) -> None:
    both = open_shards([validated[0], unvalidated[0]])
    rows = [Grasps(both, columns=["quality/epsilon"], **wish) for wish in ({}, {"unvalidated": True}, {"valid": False})]
    assert [len(found) for found in rows] == [3, 3, 6]
    assert {both.by_id(sample["shard_id"]).path for sample in rows[1]} == {unvalidated[0]}


@pytest.mark.parametrize("command", ["export --format dexgraspbench", "pictures -n 1 --size 32 --device cpu"])
def test_export_and_pictures_take_grasps_that_nobody_validated_only_when_told(unvalidated, tmp_path, command) -> None:
    assert "select them with --unvalidated" in refused(command, unvalidated[0], "-o", tmp_path / "out.png")
    assert not list(tmp_path.iterdir())
    graspd_command(f"{command} --unvalidated", unvalidated[0], "-o", tmp_path / "out.png")


@pytest.mark.parametrize("words", ["--want good", "--validation validate"])
def test_a_word_that_is_none_is_refused_before_the_files_are_read(words: str, tmp_path: Path) -> None:
    said = refused(f"synth --hand absent.urdf --object block {words} -o", tmp_path / "g.h5")
    assert f"{words.split()[0]}: must be one of" in said


def elsewhere(file: Path, folder: Path) -> Shard:
    moved = folder / "shard" / "own.h5"
    moved.parent.mkdir()
    moved.write_bytes(file.read_bytes())
    shard = read_shard(moved)
    shard.attributes["object_source"] = str(folder / "gone.obj")
    return shard


def test_a_shard_finds_its_object_in_its_own_folder(of_own_mesh: Path, own_mesh: Path, tmp_path: Path) -> None:
    shard = elsewhere(of_own_mesh, tmp_path)
    (tmp_path / "shard" / "brick").mkdir()
    (tmp_path / "shard" / "brick" / "clean.obj").write_bytes(own_mesh.read_bytes())
    assert object_of_shard(shard, None).digest == shard.attributes["object_digest"]


def test_a_file_of_the_right_name_and_another_content_is_not_taken(of_own_mesh: Path, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("GRASPD_DATA_DIR", str(tmp_path / "data"))
    shard = elsewhere(of_own_mesh, tmp_path)
    trimesh.creation.box((0.05, 0.06, 0.07)).export(tmp_path / "shard" / "clean.obj")
    with pytest.raises(NotFoundError) as caught:
        object_of_shard(shard, None)
    for place in ("gone.obj", str(tmp_path / "data"), str(tmp_path / "shard"), "--object"):
        assert place in str(caught.value)
    assert not (tmp_path / "data").exists(), "to look makes nothing"


def test_a_given_file_is_read_with_the_options_of_the_shard(of_own_mesh: Path, own_mesh: Path) -> None:
    shard = read_shard(of_own_mesh)
    assert shard.attributes["object"] == "brick", "named after its folder"
    assert object_of_shard(shard, str(own_mesh)).digest == shard.attributes["object_digest"]
    with pytest.raises(ConflictError):
        object_of_shard(shard, "mug")


def test_every_command_finds_hand_and_object_of_a_file_by_itself(of_own_mesh: Path, tmp_path: Path) -> None:
    graspd_command("scene --scenes 1", of_own_mesh, "-o", tmp_path / "s.h5")
    graspd_command("render --views 1 --width 32 --height 24 --device cpu", tmp_path / "s.h5", "-o", tmp_path / "v.h5")


def test_fewer_grasps_than_asked_are_told_with_the_reason_and_exit_code_3(folder: Path, monkeypatch) -> None:
    out = folder / "few.h5"
    monkeypatch.setattr(generation, "passes_gate", lambda columns: np.zeros(len(columns["quality/success"]), np.uint8))
    said = graspd_command(f"synth --hand barrett --object block -n 2 --budget 1 {DRAFT_OPTIONS} -o", out, code=3)
    assert (said["grasps"], said["valid"], said["wanted"]) == (0, 0, 2)
    assert sum(said["outcomes"].values()) == said["candidates"] == 2
    assert said["reason"].startswith("found 0 of 2 valid grasps in 2 candidates: ")
    shard = read_shard(out, kind="base")
    assert shard.attributes["reason"] == said["reason"]
    assert json.loads(str(shard.attributes["outcomes"])) == said["outcomes"]
    again = graspd.open(out)
    assert (again.reason, again.outcomes) == (said["reason"], said["outcomes"])


@pytest.mark.parametrize("asked", [signal.SIGINT, signal.SIGTERM])
def test_who_stops_it_keeps_what_was_validated(folder: Path, monkeypatch, asked: signal.Signals) -> None:
    real, out = synthesis.synthesize_grasps, folder / f"stopped-{asked}.h5"

    def stopped(*given, progress, **named):
        def tell(done: float, total: float, message: str) -> None:
            if done >= 32 and signal.getsignal(asked) is not before:
                signal.raise_signal(asked)

        return real(*given, progress=tell, **named)

    before = signal.getsignal(asked)
    monkeypatch.setattr(synthesis, "synthesize_grasps", stopped)
    words = f"synth --hand barrett --object block -n 64 --budget 1 --validation none --json {DRAFT_OPTIONS} -o"
    done = CliRunner().invoke(build_app(), [*words.split(), str(out)])
    shard = read_shard(out, kind="base")
    kept = len(shard["quality/valid"])
    assert done.exit_code == 128 + asked and 0 < kept <= 32
    assert f"interrupted: {out} contains {kept} of 64" in done.stderr
    assert shard.attributes["grasps_wanted"] == 64 and signal.getsignal(asked) is before


def test_a_file_is_written_whole_or_not_at_all(folder: Path) -> None:
    out = folder / "whole.h5"
    out.write_bytes(b"before")

    def half() -> Iterator[bytes]:
        yield b"af"
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_output(out, half())
    assert out.read_bytes() == b"before" and not list(folder.glob("*.part")) and not list(folder.glob(".*.part"))
