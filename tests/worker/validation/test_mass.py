"""Mass and friction of the object: what is lifted weighs what it weighs, and the payload is the heaviest of it."""

import math
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import MeshError
from graspd.service.model.matter import ACCELERATION, FRICTION, MASS_KG
from graspd.service.store.shards import read_shard
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.objects.options import apply_request
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.quality.wrench_space import EDGES
from graspd.worker.simulation.environment import Obstacle, PlacedGrasps
from graspd.worker.validation import payload as heaviest
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.key import verdict_key
from graspd.worker.validation.lifting import validate_lifts
from graspd.worker.validation.payload import (
    ENOUGH,
    PayloadLimit,
    load_capacities,
    payload_limit,
    payloads,
    shake_margins,
)
from tests.worker.commands_run import graspd
from tests.worker.models import object_from_mesh, two_finger_hand

#: A box between the fingertips of the two-finger hand, whose pads are 58 mm apart and 68 mm above its joints.
BOX = object_from_mesh(trimesh.creation.box((0.058, 0.06, 0.04)), "box")
PIECES = ConvexPieces((BOX.hull_vertices,), 1.0, 0.0, "box")
LEVER_M = 0.068
#: Torque of a finger [N m].
TORQUE = 0.2
HAND = replace(two_finger_hand(), effort=np.full(2, TORQUE))
#: The object's y is up: friction alone holds it.
UPRIGHT = np.array([[0.0, 0.0, 0.03, np.sqrt(0.5), np.sqrt(0.5), 0.0, 0.0]])
TABLE = PlacedGrasps((Obstacle.half_space((0, 0, 1), 0.0),), UPRIGHT, np.zeros(1, np.intp))
BARRETT = "synth --hand barrett --object block --scene table --fidelity draft --seed 3"
UP = np.array([[[0.0, 1.0, 0.0]]])


def pinch() -> GraspSet:
    """Both fingers from beside the box to where they touch it, then commanded so far into it that their torque is what
    limits them."""
    opened, touching, pressing = (np.array([[q, q]]) for q in (-0.1, 0.0, 0.3))
    at = np.array([[0.0, 0.0, -LEVER_M, 1.0, 0.0, 0.0, 0.0]])
    found = GraspSet(Posture(at, touching), Posture(at, opened), Posture(at, pressing), np.zeros(1))
    found.scene, found.coming = np.zeros(1, np.intp), opened
    found.approach = np.stack([at + np.array([0.0, 0.0, back, 0, 0, 0, 0]) for back in (-0.15, -0.05, 0.0)], axis=1)
    return found


def bears(friction: float) -> float:
    """Mass that the friction of the pinch bears [kg]."""
    return 2 * friction * TORQUE / LEVER_M / ACCELERATION


def payload(friction: float) -> float:
    (found,) = payloads(HAND, BOX.with_mass(mass=0.02, friction=friction), pinch(), pieces=PIECES, placed=TABLE)
    return float(found)


@pytest.mark.parametrize("friction", [0.3, FRICTION, 1.0])
def test_the_payload_of_a_pinch_is_what_its_friction_bears(friction: float) -> None:
    assert 0.95 * bears(friction) < payload(friction) < bears(friction)


def test_the_worst_direction_counts_and_what_is_out_of_touch_bears_nothing() -> None:
    assert np.isnan(payload(0.01))
    away = Posture(pinch().grasp.hand_pose - np.eye(7)[2], pinch().grasp.joint_positions)
    assert load_capacities(HAND, BOX, away, UP).tolist() == [0.0]
    at_stop = replace(HAND, lower=np.full(2, -heaviest.AT_STOP * 1e-3))
    assert not np.isfinite(load_capacities(at_stop, BOX, pinch().grasp, UP)).any()
    # Along the line of the fingers one of them presses with all its effort, the other not at all.
    along = np.array([[[0.0, 1.0, 0.0], [1.0, 0.0, 0.0]]])
    assert load_capacities(HAND, BOX, pinch().grasp, along) == pytest.approx(TORQUE / LEVER_M / ACCELERATION, rel=0.01)


@pytest.mark.parametrize("friction", [0.3, FRICTION, 1.0])
def test_what_friction_bears_of_the_shake_survives_it(friction: float) -> None:
    # Along the line of the fingers an acceleration takes from the forces that press: mg <= friction (2 F - ma).
    accelerated = heaviest.AMPLITUDE_M * (2 * np.pi * heaviest.FREQUENCY_HZ) ** 2
    borne = 2 * friction * TORQUE / LEVER_M / (ACCELERATION + friction * accelerated)
    survives, lost = (
        shake_margins(HAND, BOX.with_mass(mass=share * borne, friction=friction), pinch(), TABLE, pieces=PIECES)[0]
        for share in (0.92, 1.15)
    )
    assert survives < 0.2 and lost >= 1
    # Gravity alone loses neither.
    assert 1.15 * borne < payload(friction)


def test_a_lift_has_the_mass_and_the_friction_of_the_object() -> None:
    for share, friction, lifted in ((0.8, FRICTION, 1), (1.2, FRICTION, 0), (1.2, 1.5 * FRICTION, 1)):
        obj = BOX.with_mass(mass=share * bears(FRICTION), friction=friction)
        assert validate_lifts(HAND, obj, pinch(), TABLE, pieces=PIECES).success.tolist() == [lifted], (share, friction)


def test_verdicts_of_other_masses_have_other_keys() -> None:
    objects = [BOX, BOX.with_mass(mass=0.5), BOX.with_mass(friction=0.5), BOX.with_mass(mass=0.5).for_dexgraspbench]
    keys = [verdict_key(HAND, obj, "standard", False, pieces=PIECES) for obj in objects]
    assert len(set(keys)) == 3 and keys[0] == keys[3]


def test_the_letter_has_the_mass_of_the_protocol() -> None:
    obj = BOX.with_mass(mass=0.7, friction=0.4)
    published = apply_request(obj, JobOptions(validation="dexgraspbench"))
    assert (published.mass, published.friction) == (MASS_KG, FRICTION)
    assert apply_request(obj, JobOptions()).mass == 0.7
    asked = apply_request(obj, JobOptions(density=500.0, object_friction=0.8))
    assert (asked.mass, asked.friction) == (pytest.approx(500 * BOX.volume), 0.8)
    with pytest.raises(ValueError, match="dexgraspbench gives all objects"):
        JobOptions(validation="dexgraspbench", mass=0.5)


def test_what_is_said_with_a_job_goes_over_what_the_file_says() -> None:
    assert object_from_path("block").mass == pytest.approx(650 * object_from_path("block").volume)
    assert object_from_path("block", options={"mass": 0.4}).mass == 0.4
    with pytest.raises(MeshError, match="exclude each other"):
        object_from_path("block", options={"mass": 0.4, "density": 3.0})
    with pytest.raises(MeshError, match="100 kg"):
        BOX.with_mass(density=1e7)


def test_whoever_says_the_weight_is_told_what_the_grasps_lift(tmp_path) -> None:
    keys = {"mass_kg", "lift_share", "lift_hard_share", "payload_kg"}
    words = f"{BARRETT} -n 1 --mass 0.37 -o"
    for more, told in (((), keys), (("--no-payload",), keys - {"payload_kg"})):
        said = graspd(words, tmp_path / "g.h5", *more)
        assert keys & said.keys() == told and said["mass_kg"] == 0.37 and said.get("payload_kg", 1.0) >= 0.37


def test_half_a_gram_is_lifted_off_the_table(tmp_path) -> None:
    told = graspd(f"{BARRETT} -n 8 --want candidates --mass 0.0005 -o", tmp_path / "g.h5")
    # By 50 times its weight alone, 0.25 N, 7 of 8 hold, and the planner starts 24 times more.
    assert told["valid"] == 8 and told["outcomes"].get("repeated", 0) < 12


@pytest.mark.parametrize(("least", "kept", "outcomes"), [(0.3, 2, {}), (90.0, 0, {"weak": 2})])
def test_a_job_counts_grasps_that_lift_the_wanted_payload(tmp_path, least, kept: int, outcomes: dict[str, int]) -> None:
    words = f"{BARRETT} -n 2 --budget 1 --mass 0.2 --min-payload {least} --shake -o"
    told = graspd(words, tmp_path / "g.h5", code=0 if kept else 3)
    shard = read_shard(tmp_path / "g.h5")
    assert (told["grasps"], told["mass_kg"], shard.attributes["object_mass_kg"]) == (kept, 0.2, 0.2)
    assert {name: told["outcomes"].get(name) for name in outcomes} == outcomes
    assert (shard["quality/payload_kg"] >= least).all()
    survive = shard["quality/shake_margin"] < 1
    assert told["shake_share"] == (survive.mean() if kept else None)


@pytest.mark.parametrize("friction", [0.01, 0.3, FRICTION, 1.0])
def test_pinch_could_bear_what_pyramids_around_its_cones_bear(friction: float) -> None:
    found = load_capacities(HAND, BOX.with_mass(friction=friction), pinch().grasp, UP)
    assert found == pytest.approx(bears(friction) / math.cos(math.pi / EDGES), rel=2e-3)


def test_what_is_wanted_is_told_with_what_the_best_grasp_lifts() -> None:
    def limit(wanted: float, count: int = ENOUGH) -> PayloadLimit | None:
        rows = np.zeros(count, int)
        return payload_limit(HAND, BOX, pinch().take(rows), pieces=PIECES, placed=TABLE.take(rows), wanted=wanted)

    lifts = bears(FRICTION)
    found = limit(3 * lifts)
    assert found.is_far_exceeded and 0.95 * lifts < found.lifts_kg < lifts < found.bound_kg < 1.1 * lifts
    assert found.line == (
        "two_finger lifts 0.34 kg at friction 0.6 in the best of 8 grasps, and at most 0.38 kg by actuator effort; "
        "1.06 kg are wanted"
    )
    assert not limit(0.9 * heaviest.HOPELESS * lifts).is_far_exceeded
    assert limit(0.9 * lifts) is None, "they lift it"
    assert not limit(3 * lifts, ENOUGH - 1).is_far_exceeded, "it may be their shape"
    assert limit(3 * lifts, heaviest.LEAST - 1) is None, "too few to tell"


@pytest.mark.parametrize("wanted", [ENOUGH // 2, ENOUGH])
def test_weight_out_of_reach_ends_work_with_what_the_hand_lifts(tmp_path, wanted: int) -> None:
    words = f"synth --hand allegro --object block --mass 20 --scene table -n {wanted} --fidelity draft --seed 3 -o"
    told = graspd(words, tmp_path / "g.h5", code=3)
    assert (told["grasps"], told["candidates"]) == (0, wanted), "the budget would be four times as many"
    assert 0.3 < told["limit"]["lifts_kg"] <= told["limit"]["bound_kg"] < 10
    tries = wanted + told["outcomes"]["repeated"]
    assert told["reason"].startswith(f"found 0 of {wanted} valid grasps in {tries} candidates: ")
    assert told["reason"].endswith(told["limit"]["says"]) and "20 kg are wanted" in told["reason"]
