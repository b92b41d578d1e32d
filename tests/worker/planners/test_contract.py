"""Methods: the plug-in point, and what every method promises of its grasps, whatever its process made before."""

import os
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from importlib import metadata
from importlib.metadata import EntryPoint
from multiprocessing import get_context

import h5py
import numpy as np
import pytest
import trimesh

from graspd.service.model.digests import digest_bytes
from graspd.service.model.domain import FREE_ONLY_METHODS
from graspd.service.model.errors import InputError, TaskCancelled
from graspd.service.model.fidelity import FIDELITIES, Fidelity
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import load_object, object_from_path
from graspd.worker.planners import PLANNERS, method, method_names, planner, synthesize
from graspd.worker.planners.port import Method, PlanRequest
from graspd.worker.quality.table import measure
from tests.conftest import REPOSITORY

#: All methods around free objects, with the options that make them quick.
PEERS: dict[str, dict[str, object]] = {name: dict(method(name).quick) for name in PLANNERS if method(name).free}
PEERS["graspd2022"]["grid"] = 24
ONE = ExecutionContext(threads=1)
EACH = pytest.mark.parametrize("name", sorted(PEERS))
#: Knobs that make a call short; the mesh, which is what the fidelities here differ in, stays theirs.
SHORT = dict.fromkeys(("coarse_points", "fine_points", "object_points"), 64)
SHORT |= {"starts": 1, "finalists": 1, "coarse_iterations": 3, "fine_iterations": 2, "polish_iterations": 1}
PAIR = ("draft", "fine")
PAGE = (REPOSITORY / "docs" / "how-to" / "planners.md").read_text()


def grasps(name: str, count: int, *, run: ExecutionContext = ONE, seed=0, batch=0, hand="barrett") -> GraspSet:
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
    run = ExecutionContext("cpu", 1, progress=lambda *what: calls.append(what[0]), cancelled=lambda: bool(calls))
    with pytest.raises(TaskCancelled):
        grasps(name, 2, run=run)
    assert len(calls) == 1


def egg() -> bytes:
    """Round all over, so that every bound simplifies it to another mesh; small, so that this is soon done."""
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=0.03)
    mesh.apply_scale((1.0, 0.9, 1.3))
    return bytes(mesh.export(file_type="stl"))


def made(name: str, fidelity: Fidelity) -> dict[str, str]:
    """Digests of what a method makes on an egg at a fidelity: the mesh, postures, quality."""
    hand = hand_from_path("barrett")
    obj = load_object({"egg.stl": egg()}, name="egg", digest="egg", face_error_m=fidelity.face_error_m)
    found = synthesize(hand, obj, PlanRequest(2, fidelity, seed=3), ONE, method=name, options=PEERS[name])
    columns = {"faces": obj.faces, **found.to_columns(), **measure(hand, obj, found, run=ONE)}
    return {column: digest_bytes(values.tobytes()) for column, values in columns.items()}


def all_made(wanted: list[str]) -> dict[str, dict[str, str]]:
    found = {}
    for one in wanted:
        name, _, level = one.partition(":")
        found[one] = made(name, FIDELITIES[level].model_copy(update=SHORT))
    return found


@pytest.mark.slow
def test_every_method_in_one_process_is_as_in_fresh_ones() -> None:
    apart = [[f"{name}:{level}" for name in PEERS] for level in PAIR]
    # The other way round in methods, so that what methods share is met in another order, too.
    mixed = [f"{name}:{level}" for name in reversed(PEERS) for level in PAIR]
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        told = pool.map(all_made, apart)
        # This process has made other things before, and its caches are as full as any.
        together = all_made(mixed)
        fresh = list(told)
    assert together == {key: value for found in fresh for key, value in found.items()}
    coarse, fine = (fresh[k][f"autograsp:{level}"] for k, level in enumerate(PAIR))
    assert coarse["faces"] != fine["faces"] and coarse["grasp/hand_pose"] != fine["grasp/hand_pose"]


@pytest.mark.parametrize("name", sorted(PLANNERS))
def test_every_method_of_graspds_own_says_what_it_is_and_where_it_is_published(name: str) -> None:
    found = method(name)
    assert found.summary and found.source
    options = {name: "0" * 32 for name, field in found.options.model_fields.items() if field.is_required()}
    assert callable(planner(name, options, in_scenes=found.in_scenes))


def test_options_of_a_method_are_read_from_text() -> None:
    assert planner("autograsp", {"standoff_m": "0.01"}).options.standoff_m == 0.01  # type: ignore[attr-defined]


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"speed": "9"}, "its options: standoff_m"),
        ({"standoff_m": "far"}, "standoff_m"),
        ({"standoff_m": -1}, "at least 0;"),
    ],
)
def test_a_wrong_option_is_refused_with_those_there_are(options: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        planner("autograsp", options)


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("theirs", "graspd.baselines.autograsp.method:METHOD", None),
        ("theirs", "no.such.module:METHOD", "theirs"),
        ("theirs", "graspd.worker.planners:GROUP", "theirs"),
        ("fast_graspd", "graspd.baselines.autograsp.method:METHOD", None),
    ],
)
def test_entry_points_of_other_packages_are_methods_or_refused(monkeypatch, name, value, message: str | None) -> None:
    monkeypatch.setattr(metadata, "entry_points", lambda group: [EntryPoint(name, value, group)])
    assert name in method_names()
    if message is None:
        assert isinstance(method(name), Method)
    else:
        with pytest.raises(InputError, match=message):
            method(name)
    assert "Fast-Grasp'D" in method("fast_graspd").source, "nobody takes the name of a method of graspd's own"
    with pytest.raises(InputError, match=r"unknown method 'magic'.*fast_graspd"):
        method("magic")


def test_the_documented_package_runs_as_a_method(tmp_path) -> None:
    (tmp_path / "mine.py").write_text(PAGE.split("```python\n", 1)[1].split("```", 1)[0])
    metadata = tmp_path / "mine-0.1.dist-info"
    metadata.mkdir()
    (metadata / "METADATA").write_text("Metadata-Version: 2.1\nName: mine\nVersion: 0.1\n")
    (metadata / "entry_points.txt").write_text("[graspd.planners]\nmine = mine:METHOD\n")
    out = tmp_path / "grasps.h5"
    command = [sys.executable, "-m", "graspd", "synth", "--hand", "barrett", "--object", "block", "-n", "2"]
    command += ["--method", "mine", "--option", "tries=2", "--threads", "1", "-o", str(out)]
    path = os.pathsep.join([str(tmp_path), os.environ.get("PYTHONPATH", "")])
    done = subprocess.run(command, env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, timeout=240)
    assert done.returncode == 0, done.stderr
    with h5py.File(out) as file:
        assert file.attrs["method"] == "mine" and len(file["grasp/hand_pose"]) == 2


@pytest.mark.parametrize("name", sorted(PLANNERS))
def test_the_page_names_every_method_with_all_its_options_and_defaults(name: str) -> None:
    row = next(line for line in PAGE.splitlines() if line.startswith(f"| `{name}` | "))
    for option, field in method(name).options.model_fields.items():
        assert f"`{option}` ({'required' if field.is_required() else format(field.default, 'g')}" in row


@pytest.mark.parametrize("name", FREE_ONLY_METHODS)
def test_a_method_that_plans_around_free_objects_is_refused_in_scenes(name: str) -> None:
    with pytest.raises(InputError, match=f"{name} plans around free objects only; in scenes choose fast_graspd"):
        planner(name, in_scenes=True)
    assert callable(planner("fast_graspd", in_scenes=True))
