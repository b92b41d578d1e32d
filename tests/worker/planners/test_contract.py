"""What every method promises of its grasps, whatever it searches with and whatever its process made before."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import numpy as np
import pytest
import trimesh

from graspd.service.model.digests import digest_bytes
from graspd.service.model.errors import TaskCancelled
from graspd.service.model.fidelity import FIDELITIES, Fidelity
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import load_object, object_from_path
from graspd.worker.planners import PLANNERS, method, synthesize
from graspd.worker.planners.port import PlanRequest
from graspd.worker.quality.table import measure

#: All methods around free objects, with the options that make them quick.
PEERS: dict[str, dict[str, object]] = {name: dict(method(name).quick) for name in PLANNERS if method(name).free}
PEERS["graspd2022"]["grid"] = 24
ONE = ExecutionContext(threads=1)
EACH = pytest.mark.parametrize("name", sorted(PEERS))


def grasps(
    name: str, count: int, *, run: ExecutionContext = ONE, seed: int = 0, batch: int = 0, hand: str = "barrett"
) -> GraspSet:
    wanted, obj = PlanRequest(count, FIDELITIES["draft"], seed, batch), object_from_path("block")
    return synthesize(hand_from_path(hand), obj, wanted, run, method=name, options=PEERS[name])


@EACH
def test_a_grasp_depends_on_seed_batch_and_index_alone(name: str) -> None:
    small, large, other = grasps(name, 2), grasps(name, 3, run=ExecutionContext(threads=2)), grasps(name, 2, seed=1)
    assert np.array_equal(small.grasp.hand_pose, large.grasp.hand_pose[:2])
    assert np.array_equal(small.grasp.joint_positions, large.grasp.joint_positions[:2])
    assert not np.allclose(small.grasp.hand_pose, other.grasp.hand_pose)
    assert not np.allclose(small.grasp.hand_pose, grasps(name, 2, batch=1).grasp.hand_pose)


@EACH
def test_grasps_respect_joint_limits_and_unit_quaternions(name: str) -> None:
    model = hand_from_path("allegro")
    found = grasps(name, 2, hand="allegro")
    q = model.reduce(found.grasp.joint_positions)
    assert np.all(q >= model.lower - 1e-5) and np.all(q <= model.upper + 1e-5)
    np.testing.assert_allclose(np.linalg.norm(found.grasp.hand_pose[:, 3:], axis=1), 1, atol=1e-6)


@EACH
def test_cancelling_stops_at_the_first_look(name: str) -> None:
    calls: list[float] = []
    run = ExecutionContext(
        threads=1, progress=lambda done, total, message: calls.append(done), cancelled=lambda: bool(calls)
    )
    with pytest.raises(TaskCancelled):
        grasps(name, 2, run=run)
    assert len(calls) == 1


#: Knobs that make a call short; the mesh, which is what the fidelities here differ in, stays theirs.
SHORT: dict[str, Any] = dict.fromkeys(("coarse_points", "fine_points", "object_points"), 64)
SHORT |= {"starts": 1, "finalists": 1, "coarse_iterations": 3, "fine_iterations": 2, "polish_iterations": 1}
METHODS = sorted(name for name in PLANNERS if method(name).free)
PAIR = ("draft", "fine")


def egg() -> bytes:
    """Round all over, so that every bound simplifies it to another mesh; small, so that this is soon done."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    mesh.apply_scale((1.0, 0.9, 1.3))
    return bytes(mesh.export(file_type="stl"))


def made(name: str, fidelity: Fidelity) -> dict[str, str]:
    """Digests of what a method makes on an egg at a fidelity: the mesh, postures, quality."""
    hand = hand_from_path("barrett")
    obj = load_object({"egg.stl": egg()}, name="egg", digest="egg", face_error_m=fidelity.face_error_m)
    options = dict(method(name).quick) | ({"grid": 24} if name == "graspd2022" else {})
    wanted, run = PlanRequest(count=2, fidelity=fidelity, seed=3), ExecutionContext(threads=1)
    found = synthesize(hand, obj, wanted, run, method=name, options=options)
    columns = {
        "faces": obj.faces,
        "grasp": found.grasp.hand_pose,
        "joints": found.grasp.joint_positions,
        "pregrasp": found.pregrasp.joint_positions,
        "squeeze": found.squeeze.joint_positions,
        **measure(hand, obj, found, run=run),
    }
    return {column: digest_bytes(values.tobytes()) for column, values in columns.items()}


def all_made(wanted: list[str]) -> dict[str, dict[str, str]]:
    """Those of `method:fidelity`, in that order."""
    found = {}
    for one in wanted:
        name, _, level = one.partition(":")
        found[one] = made(name, FIDELITIES[level].model_copy(update=SHORT))
    return found


@pytest.mark.slow
def test_every_method_in_one_process_is_as_in_fresh_ones() -> None:
    apart = [[f"{name}:{level}" for name in METHODS] for level in PAIR]
    # The other way round in methods, so that what methods share is met in another order, too.
    mixed = [f"{name}:{level}" for name in reversed(METHODS) for level in PAIR]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        told = pool.map(all_made, apart)
        # This process has made other things before, and its caches are as full as any.
        together = all_made(mixed)
        fresh = list(told)
    assert together == {key: value for found in fresh for key, value in found.items()}
    coarse, fine = (fresh[k][f"autograsp:{level}"] for k, level in enumerate(PAIR))
    assert coarse["faces"] != fine["faces"] and coarse["grasp"] != fine["grasp"]
