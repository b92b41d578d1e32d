"""One process that works at several fidelities gives what fresh ones give: no cache serves one's mesh to another."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from typing import Any

import pytest
import trimesh

from graspd.service.model.digests import digest_bytes
from graspd.service.model.fidelity import FIDELITIES, Fidelity
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import load_object
from graspd.worker.planners import PLANNERS, method, synthesize
from graspd.worker.planners.port import PlanRequest
from graspd.worker.quality.table import measure

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
