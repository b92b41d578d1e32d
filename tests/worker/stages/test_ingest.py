"""Uploads are hostile: what the checking child does must not reach its worker."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from graspd.service.model import names
from graspd.service.model.errors import InputError, TaskCancelled
from graspd.service.model.messages import IngestMessage
from graspd.service.model.states import AssetKind
from graspd.service.store.library import publish_asset, record_asset, store_files
from graspd.service.store.store import Store, open_store
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.model import HandModel
from graspd.worker.stages import hand_self_test, ingest
from graspd.worker.stages.context import StopReason, TaskContext
from graspd.worker.stages.hand_self_test import SelfTest
from tests.worker.hands.grippers import gripper_urdf

TETRAHEDRON = """\
solid t
facet normal 0 0 -1
outer loop
vertex 0 0 0
vertex 0 0.05 0
vertex 0.05 0 0
endloop
endfacet
facet normal 0 -1 0
outer loop
vertex 0 0 0
vertex 0.05 0 0
vertex 0 0 0.05
endloop
endfacet
facet normal -1 0 0
outer loop
vertex 0 0 0
vertex 0 0 0.05
vertex 0 0.05 0
endloop
endfacet
facet normal 1 1 1
outer loop
vertex 0.05 0 0
vertex 0 0.05 0
vertex 0 0 0.05
endloop
endfacet
endsolid t
"""
OBJECT = {"asset.json": b'{"file": "t.stl", "units": "m"}', "t.stl": TETRAHEDRON.encode()}


@pytest.fixture
def context() -> TaskContext:
    return TaskContext(open_store("memory://"))


def run(store: Store, context: TaskContext, files: dict[str, bytes], kind: AssetKind) -> dict[str, object]:
    asset = publish_asset(store, kind, "upload", files)
    message = IngestMessage(schema_=1, task_id="i", kind=kind, name="upload", digest=asset.digest)
    ingest.run(message, context)
    found: dict[str, object] = json.loads(store.get(names.asset_check(kind, asset.digest)))
    return found


def test_a_sound_object_is_taken_with_its_facts(context: TaskContext) -> None:
    found = run(context.store, context, OBJECT, AssetKind.OBJECT)
    assert found["verdict"] in ("accept", "repair"), found["message"]
    assert found["facts"]


def test_a_hand_is_tried_if_its_record_says_so(context: TaskContext, monkeypatch: pytest.MonkeyPatch) -> None:
    """The trial itself is tested beside it: here that it runs on the hand that was checked, and what is kept."""
    candidates = []

    def stand_in(hand: HandModel, run: ExecutionContext) -> SelfTest:
        candidates.append(hand.name)
        return SelfTest(0.9, 64, 0.04, {"box": 0.9}, 0.8, 16)

    monkeypatch.setattr(hand_self_test, "self_test", stand_in)
    files = {"asset.json": b'{"file": "gripper.urdf"}', "gripper.urdf": gripper_urdf()}
    untried = run(context.store, context, files, AssetKind.HAND)
    assert not candidates and "self_test" not in untried["facts"]  # type: ignore[operator]
    asset = store_files(context.store, AssetKind.HAND, "mine", {**files, "note.txt": b"x"}, said={"self_test": True})
    record_asset(context.store, asset)
    message = IngestMessage(schema_=1, task_id="i", kind=AssetKind.HAND, name="mine", digest=asset.digest)
    ingest.run(message, context)
    found = json.loads(context.store.get(names.asset_check(AssetKind.HAND, asset.digest)))
    assert candidates == ["mine"]
    assert found["facts"]["self_test"]["says"] == "ready: 90 % hold, 80 % lift off a table"


def test_a_hand_that_finds_no_grasp_is_taken_and_says_why(
    context: TaskContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stand_in(hand: HandModel, run: ExecutionContext) -> SelfTest:
        raise InputError("no way in")

    monkeypatch.setattr(hand_self_test, "self_test", stand_in)
    files = {"asset.json": b'{"file": "gripper.urdf"}', "gripper.urdf": gripper_urdf()}
    asset = store_files(context.store, AssetKind.HAND, "mine", files, said={"self_test": True})
    record_asset(context.store, asset)
    message = IngestMessage(schema_=1, task_id="i", kind=AssetKind.HAND, name="mine", digest=asset.digest)
    ingest.run(message, context)
    found = json.loads(context.store.get(names.asset_check(AssetKind.HAND, asset.digest)))
    assert found["verdict"] == "accept"
    assert found["facts"]["self_test"]["says"] == "suspicious: no way in"


def test_a_broken_object_is_refused_with_a_reason(context: TaskContext) -> None:
    found = run(context.store, context, OBJECT | {"t.stl": b"not a mesh"}, AssetKind.OBJECT)
    assert found["verdict"] == "refuse"
    assert "t.stl" in str(found["message"])


def test_a_check_that_wants_too_much_memory_is_a_refusal(context: TaskContext) -> None:
    found, _ = ingest.check_in_child(AssetKind.OBJECT, "big", OBJECT, context, memory_bytes=64 * 2**20)
    assert found["verdict"] == "refuse"
    assert "needs more than 0.0625 GiB of memory" in found["message"]


def test_a_disk_without_room_says_nothing_about_the_file(
    context: TaskContext, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    command = ingest.subprocess.Popen
    # A link: whatever becomes of the name, the device stays.
    (target := tmp_path / "check.json").symlink_to("/dev/full")

    def full(arguments: list[str], **options: object) -> object:
        # The child cannot write what it found.
        return command([*arguments[:6], str(target), *arguments[7:]], **options)  # type: ignore[call-overload]

    monkeypatch.setattr(ingest.subprocess, "Popen", full)
    with pytest.raises(OSError, match="No space left on device"):
        ingest.check_in_child(AssetKind.OBJECT, "t", OBJECT, context)


def child_does(monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    """Children do this instead of a check; `sys.argv[1]` is where they would leave their finding."""
    command = ingest.subprocess.Popen

    def other(arguments: list[str], **options: object) -> object:
        return command([sys.executable, "-c", f"import os, signal, sys\n{code}", arguments[6]], **options)  # type: ignore[call-overload]

    monkeypatch.setattr(ingest.subprocess, "Popen", other)


def test_a_check_that_the_machine_killed_says_nothing_about_the_file(
    context: TaskContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    child_does(monkeypatch, "os.kill(os.getpid(), signal.SIGKILL)")
    with pytest.raises(OSError, match="was killed"):
        run(context.store, context, OBJECT, AssetKind.OBJECT)
    assert not [one for one in context.store.list("assets") if one.key.endswith("check.json")]


def test_a_finding_stands_whatever_its_picture_costs(context: TaskContext, monkeypatch: pytest.MonkeyPatch) -> None:
    finding = '{"verdict": "accept"}'
    half = "open(os.path.dirname(sys.argv[1]) + '/model.glb', 'w').write('half')"
    end = f"{half}\nos.kill(os.getpid(), signal.SIGXCPU)"
    with monkeypatch.context() as patch:
        child_does(patch, f"with open(sys.argv[1], 'w') as file: file.write({finding!r})\n{end}")
        assert ingest.check_in_child(AssetKind.OBJECT, "t", OBJECT, context) == ({"verdict": "accept"}, b"")
    child_does(monkeypatch, f"with open(sys.argv[1], 'w') as file: file.write({finding[:5]!r})\n{end}")
    assert ingest.check_in_child(AssetKind.OBJECT, "t", OBJECT, context)[0]["verdict"] == "refuse"


def test_the_child_knows_no_credentials(context: TaskContext, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    monkeypatch.setenv("GRASPD_REDIS_URL", "redis://:secret@host")
    assert "secret" not in " ".join(ingest._environment().values())


@pytest.mark.parametrize("reason", [StopReason.CANCELLED, StopReason.TIMEOUT])
def test_a_check_that_is_stopped_ends_its_child(
    reason: StopReason, context: TaskContext, monkeypatch: pytest.MonkeyPatch
) -> None:
    pids: list[int] = []
    popen = ingest.subprocess.Popen

    def spy(*args: object, **kwargs: object) -> object:
        child = popen(*args, **kwargs)  # type: ignore[call-overload]
        pids.append(child.pid)
        context.stop(reason)
        return child

    monkeypatch.setattr(ingest.subprocess, "Popen", spy)
    with pytest.raises(TaskCancelled):
        ingest.check_in_child(AssetKind.OBJECT, "t", OBJECT, context)
    assert not Path(f"/proc/{pids[0]}").exists()


def test_a_check_loads_no_engine() -> None:
    """It would cost four seconds of computing for every upload, and memory of the child's limit."""
    modules = ("stages.ingest", "hands.check", "objects.check", "stages.models")
    code = f"import sys, {', '.join(f'graspd.worker.{module}' for module in modules)}\n"
    done = subprocess.run(
        [sys.executable, "-c", f"{code}print(*sys.modules)"], capture_output=True, text=True, check=True
    )
    assert not {"warp", "newton", "mujoco"} & set(done.stdout.split())


def test_a_finding_that_is_too_long_is_told_as_that(context: TaskContext, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ingest, "_FINDING_BYTES", 10)
    found, _ = ingest.check_in_child(AssetKind.OBJECT, "t", OBJECT, context)
    assert found["verdict"] == "refuse"
    assert "finds more to say" in found["message"] and "ended the checker" not in found["message"]


def test_a_check_that_complains_at_length_goes_on(context: TaskContext, monkeypatch: pytest.MonkeyPatch) -> None:
    environment = ingest._environment()
    # Python tells each import: more than a pipe holds.
    monkeypatch.setattr(ingest, "_environment", lambda: {**environment, "PYTHONVERBOSE": "1"})
    assert ingest.check_in_child(AssetKind.OBJECT, "t", OBJECT, context)[0]["verdict"] == "accept"
