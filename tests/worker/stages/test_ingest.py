"""Uploads are hostile: each gets its verdict in bounded time, and nothing of them reaches the worker.

The self-test of a hand: objects that suit it, and a line that says whether it is ready.
"""

import io
import json
import os
import struct
import subprocess
import sys
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from itertools import count
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh

from graspd.api.uploads import files_of_upload
from graspd.service.model import names
from graspd.service.model.errors import InputError, TaskCancelled
from graspd.service.model.messages import IngestMessage
from graspd.service.model.states import AssetKind, Stage
from graspd.service.model.version import TASK_SCHEMA
from graspd.service.queue.port import EventKind
from graspd.service.store.asset_summary import summary
from graspd.service.store.library import publish_asset, record_asset, store_files
from graspd.service.store.store import Store, open_store
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.jaws import jaws_of
from graspd.worker.hands.load import hand_from_path, load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.pinch_postures import pinch_postures_of
from graspd.worker.objects.model import ObjectModel
from graspd.worker.process.runner import Runner
from graspd.worker.stages import hand_self_test, ingest
from graspd.worker.stages.context import StopReason, TaskContext
from graspd.worker.stages.hand_self_test import SelfTest, fitting_width, plain_objects, self_test, self_test_facts
from graspd.worker.validation.payload import PayloadLimit
from tests.api.factories import zipped
from tests.damage import flipped
from tests.worker.hands.urdfs import OPENING, gripper, gripper_urdf, joint, link, robot
from tests.worker.objects.shapes import sphere, stl

TETRAHEDRON = """v 0 0 0\nv 0.05 0 0\nv 0 0.05 0\nv 0 0 0.05\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"""
OBJECT = {"asset.json": b'{"file": "t.obj", "units": "m"}', "t.obj": TETRAHEDRON.encode()}
UPLOAD_BYTES = 64 * 2**20
DOOR_BYTES = 4 * 2**20  # the limit of archives that are refused before any of them is unpacked
BOUND_S = 30.0  # what is promised for any upload, as time of computing [s]
#: Children at a time: as many as the smallest machine has cores.
TOGETHER = 2
BALL = stl(sphere(segments=24))
PLY_POINT = "property float x\nproperty float y\nproperty float z\n"
#: One for each verdict on a hand and on a mesh; of all, without a child: tests/worker/hands/test_bad_hands.py.
SOME = ("mimic_chain.urdf", "kinematic_loop.urdf", "open_shell.stl", "inverted_normals.stl", "quads_and_ngons.obj")
#: Ten levels of ten: 10^10 characters once expanded.
LEVELS = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 11))
ENTITY_BOMB = f'<!DOCTYPE robot [<!ENTITY e0 "x">{LEVELS}]><robot name="&e10;"/>'.encode()
EXTERNAL = b'<!DOCTYPE robot [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="h"><link name="&x;"/></robot>'
#: 4 10^9 faces of 50 bytes: 200 GB.
HUGE_STL = b"promise".ljust(80) + struct.pack("<I", 4_000_000_000) + bytes(600)
PLY_HEADER = f"ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\n{PLY_POINT}end_header\n"
_PALM = '<collision><geometry><box size="0.09 0.09 0.02"/></geometry></collision>'
_FINGER = '<collision><origin xyz="0 0 0.05"/><geometry><box size="0.012 0.012 0.1"/></geometry></collision>'


@pytest.fixture
def context() -> TaskContext:
    return TaskContext(open_store("memory://"))


def run(store: Store, context: TaskContext, files: dict[str, bytes], kind: AssetKind) -> dict[str, object]:
    asset = publish_asset(store, kind, "upload", files)
    message = IngestMessage(schema_=1, task_id="i", kind=kind, name="upload", digest=asset.digest)
    ingest.run(message, context)
    found: dict[str, object] = json.loads(store.get(names.asset_key(kind, asset.digest, "check.json")))
    return found


def test_a_hand_is_tried_if_its_record_says_so(context: TaskContext, monkeypatch: pytest.MonkeyPatch) -> None:
    """The trial itself is tested beside it: here that it runs on the hand that was checked, and what is kept."""
    files = {"asset.json": b'{"file": "gripper.urdf"}', "gripper.urdf": gripper_urdf()}

    def stand_in(hand: HandModel, run: ExecutionContext) -> SelfTest:
        if hand.name == "other":
            raise InputError("no way in")
        return SelfTest(0.9, 64, 0.04, {"box": 0.9}, 0.8, 16)

    def tried(name: str) -> tuple[str, str]:
        own = {**files, "note.txt": name.encode()}
        asset = store_files(context.store, AssetKind.HAND, name, own, said={"self_test": True})
        record_asset(context.store, asset)
        ingest.run(IngestMessage(schema_=1, task_id="i", kind=AssetKind.HAND, name=name, digest=asset.digest), context)
        found = json.loads(context.store.get(names.asset_key(AssetKind.HAND, asset.digest, "check.json")))
        return found["verdict"], found["facts"]["self_test"]["says"]

    monkeypatch.setattr(hand_self_test, "self_test", stand_in)
    assert "self_test" not in run(context.store, context, files, AssetKind.HAND)["facts"]
    assert tried("mine") == ("accept", "ready: 90 % hold, 80 % lift off a table")
    assert tried("other") == ("accept", "suspicious: no way in")


def start_instead(monkeypatch: pytest.MonkeyPatch, other: Callable[[list[str]], list[str]]) -> None:
    start = ingest.subprocess.Popen
    monkeypatch.setattr(ingest.subprocess, "Popen", lambda command, **options: start(other(command), **options))


def test_a_disk_without_room_says_nothing_about_the_file(context: TaskContext, monkeypatch, tmp_path: Path) -> None:
    # A link: whatever becomes of the name, the device stays. The child cannot write what it found.
    (target := tmp_path / "check.json").symlink_to("/dev/full")
    start_instead(monkeypatch, lambda command: [*command[:6], str(target), *command[7:]])
    with pytest.raises(OSError, match="No space left on device"):
        ingest.check_in_child(AssetKind.OBJECT, "t", OBJECT, context)


def child_does(monkeypatch: pytest.MonkeyPatch, code: str) -> None:
    """Children do this instead of a check; `sys.argv[1]` is where they would leave their finding."""
    program = [sys.executable, "-c", f"import os, signal, sys\n{code}"]
    start_instead(monkeypatch, lambda command: [*program, command[6]])


def test_check_that_machine_killed_says_nothing_about_the_file(context: TaskContext, monkeypatch) -> None:
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


def test_a_file_in_wrong_units_is_refused_with_a_picture(context: TaskContext) -> None:
    block = {"block.stl": trimesh.creation.box((60.0, 40.0, 50.0)).export(file_type="stl"), "asset.json": b"{}"}
    found, model = ingest.check_in_child(AssetKind.OBJECT, "t", block, context)
    assert found["verdict"] == "refuse" and found["facts"]["units_suggested"][0] == "mm"
    assert np.ptp(trimesh.load(io.BytesIO(model), file_type="glb").bounds, axis=0) == pytest.approx([0.06, 0.04, 0.05])


def test_the_child_knows_no_credentials(context: TaskContext, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "secret")
    monkeypatch.setenv("GRASPD_REDIS_URL", "redis://:secret@host")
    assert "secret" not in " ".join(ingest._environment().values())


@pytest.mark.parametrize("reason", [StopReason.CANCELLED, StopReason.TIMEOUT])
def test_a_check_that_is_stopped_ends_its_child(reason: StopReason, context: TaskContext, monkeypatch) -> None:
    pids: list[int] = []
    popen = ingest.subprocess.Popen

    def spy(*args: object, **kwargs: object) -> object:
        child = popen(*args, **kwargs)
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
    told = subprocess.check_output([sys.executable, "-c", f"{code}print(*sys.modules)"], text=True)
    assert not {"warp", "newton", "mujoco"} & set(told.split())


def test_finding_that_is_long_and_check_that_complains_are_told(context: TaskContext, monkeypatch) -> None:
    with monkeypatch.context() as patch:
        patch.setattr(ingest, "_FINDING_BYTES", 10)
        found, _ = ingest.check_in_child(AssetKind.OBJECT, "t", OBJECT, context)
    assert found["verdict"] == "refuse"
    assert "the result of the check exceeds" in found["message"] and "crashed the checker" not in found["message"]
    environment = ingest._environment()
    # Python tells each import: more than a pipe holds.
    monkeypatch.setattr(ingest, "_environment", lambda: {**environment, "PYTHONVERBOSE": "1"})
    found, model = ingest.check_in_child(AssetKind.OBJECT, "t", OBJECT, context)
    assert found["verdict"] == "accept" and model.startswith(b"glTF")


def computed() -> float:
    """Processor time of this process and of the children it waited for [s]."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def upload(store: Store, kind: AssetKind, filename: str, data: bytes, options: dict | None = None):
    try:
        files = files_of_upload(kind, filename, data, limit_bytes=UPLOAD_BYTES)
        asset = publish_asset(store, kind, "upload", files)
    except InputError as error:
        return {"verdict": "refuse", "message": str(error)}
    message = IngestMessage(schema_=TASK_SCHEMA, task_id="i", kind=kind, name=Path(filename).stem, digest=asset.digest)
    runner = Runner({Stage.INGEST: ingest.run}, worker="w", publish=lambda event: None)
    outcome = runner.run(message.model_dump(mode="json", by_alias=True), TaskContext(store))
    assert outcome.kind is EventKind.FINISHED, outcome
    return json.loads(store.get(names.asset_key(kind, asset.digest, "check.json")))


def bad_files(shared_data: Path) -> list[dict[str, str]]:
    return list(json.loads((shared_data / "bad" / "INDEX.json").read_text())["inputs"])


def is_expected(found: dict, entry: dict[str, str]) -> bool:
    return found["verdict"] == entry["expect"] and entry["message_names"].lower() in found["message"].lower()


def kind_of(filename: str) -> AssetKind:
    return AssetKind.HAND if filename.endswith(".urdf") else AssetKind.OBJECT


@pytest.mark.parametrize("chosen", [SOME, pytest.param((), marks=pytest.mark.slow)], ids=["some", "all"])
def test_a_bad_file_gets_its_verdict_from_the_checking_child(shared_data: Path, chosen: tuple[str, ...]) -> None:
    entries = [entry for entry in bad_files(shared_data) if not chosen or entry["file"] in chosen]

    def validate(entry: dict[str, str]) -> str | None:
        data, start = (shared_data / "bad" / entry["file"]).read_bytes(), computed()
        found = upload(open_store("memory://"), kind_of(entry["file"]), entry["file"], data)
        return None if is_expected(found, entry) and computed() - start < BOUND_S else f"{entry['file']}: {found}"

    with ThreadPoolExecutor(TOGETHER) as pool:
        wrong = [text for text in pool.map(validate, entries) if text]
    assert len(entries) >= (len(chosen) or 40) and not wrong


@cache
def zip_bomb() -> bytes:
    return zipped({f"{i}.stl": bytes(DOOR_BYTES) for i in range(9)})


def archive_of(data: bytes, *, mode: int = 0o100644, how: int = zipfile.ZIP_DEFLATED) -> bytes:
    buffer, entry = io.BytesIO(), zipfile.ZipInfo("ball.stl")
    entry.external_attr = mode << 16
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(entry, data, how)
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("filename", "data", "says"),
    [
        ("bomb.urdf", ENTITY_BOMB, "entit"),
        ("external.urdf", EXTERNAL, "entit"),
        ("promise.stl", HUGE_STL, "truncated"),
        ("promise.ply", PLY_HEADER.encode() + bytes(64), ""),
        ("far.obj", b"v 1e300 0 0\nv 0 1e300 0\nv 0 0 1e300\nf 1 2 3\nf 1 3 2\n", "exceeds"),
    ],
    ids=lambda value: value if isinstance(value, str) and "." in value else "",
)
def test_an_attack_is_refused_and_the_worker_does_the_next_task(filename: str, data: bytes, says: str) -> None:
    store, start = open_store("memory://"), computed()
    found = upload(store, kind_of(filename), filename, data)
    assert computed() - start < BOUND_S
    assert found["verdict"] == "refuse"
    assert says in found["message"] and "root:" not in found["message"]
    assert upload(store, AssetKind.OBJECT, "ball.stl", BALL["m.stl"])["verdict"] == "accept"


@pytest.mark.parametrize(
    ("archive", "says"),
    [
        (lambda: zipped({"../../../tmp/slip.stl": BALL["m.stl"]}), "leaves its folder"),
        (lambda: zipped({"/tmp/slip.stl": BALL["m.stl"]}), "leaves its folder"),
        (lambda: zipped({"inner.zip": zipped({"innermost.zip": zip_bomb()})}), "holds no object file"),
        (zip_bomb, "unpacks to more"),
        (lambda: archive_of(b"/etc/passwd", mode=0o120777), "symbolic link"),
        (lambda: zipped({f"{i}.obj": b"v" for i in range(3000)}), "3000 files"),
        (lambda: flipped(archive_of(BALL["m.stl"]), 200), "damaged"),
        # LZMA's header may ask for a dictionary of 4 GiB.
        (lambda: archive_of(BALL["m.stl"], how=zipfile.ZIP_LZMA), "unusual"),
        (lambda: archive_of(b"").replace(b"\x14\3\x14\0\0", b"\x14\3\x14\0\1"), "without a password"),
    ],
    ids=["slip", "absolute", "nested", "bomb", "link", "many", "damaged", "lzma", "locked"],
)
def test_an_archive_that_attacks_is_refused_at_the_door(archive: Callable[[], bytes], says: str) -> None:
    data, start = archive(), computed()
    with pytest.raises(InputError, match=says):
        files = files_of_upload(AssetKind.OBJECT, "archive.zip", data, limit_bytes=DOOR_BYTES)
        publish_asset(open_store("memory://"), AssetKind.OBJECT, "upload", files)
    assert computed() - start < BOUND_S


@cache
def rough(segments: int) -> bytes:
    """A ball with noise on it: slow to simplify."""
    vertices, faces = sphere(0.04, segments)
    return stl((vertices * np.random.default_rng(0).normal(1.0, 0.003, (len(vertices), 1)), faces))["m.stl"]


@pytest.mark.parametrize(
    ("limits", "says"),
    [({"cpu_s": 1}, "takes longer than 1 s"), ({"memory_bytes": 400 * 2**20}, "needs more than 0.391 GiB")],
)
def test_a_mesh_that_costs_too_much_is_refused_the_next_taken(limits: dict[str, int], says: str) -> None:
    context, start = TaskContext(open_store("memory://")), computed()
    files = {"asset.json": b'{"file": "m.stl"}', "m.stl": rough(512)}
    found, _ = ingest.check_in_child(AssetKind.OBJECT, "rough", files, context, **limits)
    assert found["verdict"] == "refuse" and says in found["message"]
    assert computed() - start < BOUND_S
    feasible = {"asset.json": b'{"file": "m.stl"}', **BALL}
    assert ingest.check_in_child(AssetKind.OBJECT, "ball", feasible, context)[0]["verdict"] == "accept"


def held(count: int):
    ones = np.ones(count)
    columns = {f"quality/{name}": ones for name in ("success", "verdict_margin")}
    columns |= {f"quality/{name}": ones[:, None] for name in ("epsilon", "verdict_outcome")}
    return SimpleNamespace(columns=columns, grasps=SimpleNamespace(grasp=SimpleNamespace(take=lambda rows: None)))


def test_objects_are_as_wide_as_suits_the_opening() -> None:
    width = fitting_width(gripper())
    assert width == pytest.approx(hand_self_test.OF_OPENING * OPENING)
    for obj in plain_objects(width).values():
        # A sphere of triangles lies inside the true one by less than a hundredth.
        assert np.ptp(obj.vertices, axis=0).min() == pytest.approx(width, rel=0.01)


def test_verdict_is_that_of_tables_and_tells_of_weak_free_grasps() -> None:
    held = SelfTest(0.91, 64, 0.04, {"box": 0.9, "sphere": 0.92}, 0.6, 16)
    assert held.line == "ready: 91 % hold, 60 % lift off a table"
    dropped = replace(held, gsr=0.5, by_object={"box": 0.1, "sphere": 0.9})
    free = "ready for tables: 60 % lift off a table; of free grasps 50 % hold, 10 % of a box; most objects slip"
    assert dropped.line.startswith(free)
    assert "lost while the hand closes" in replace(dropped, lost=0.8).line
    assert "within 0.9 mm of fingertip motion" in replace(dropped, give_m=0.9e-3).line
    assert replace(held, table=0.55).line.startswith("suspicious: 91 % hold, but 55 % lift off a table")
    assert replace(dropped, table=0.55).line.startswith("suspicious: 50 % hold, 55 % lift off a table, 10 % of a box")


def test_what_a_hand_lifts_at_best_is_a_line_of_its_check() -> None:
    limit = PayloadLimit("claw", 0.6, 16, 1.44, 4.53)
    held = SelfTest(0.91, 64, 0.04, {"box": 0.9}, 0.8, 16, limit=limit)
    facts = held.facts()
    assert (facts["table_n"], facts["limit"]["lifts_kg"], facts["limit"]["bound_kg"]) == (16, 1.44, 4.53)
    first, second = summary(AssetKind.HAND, {"self_test": facts})
    assert "ready: 91 % hold" in first and "claw lifts 1.4 kg" in second and "at most 4.5 kg" in second
    assert replace(limit, bound_kg=np.inf).facts()["bound_kg"] is None
    assert len(summary(AssetKind.HAND, {"self_test": replace(held, limit=None).facts()})) == 1


def three_fingers(**options) -> HandModel:
    fingers = [link(f"finger{k}", _FINGER) for k in range(3)]
    for k, (x, y) in enumerate(((0.03, 0.0), (-0.015, 0.026), (-0.015, -0.026))):
        fingers.append(joint(f"bend{k}", "palm", f"finger{k}", origin=f"{x} {y} 0.01", axis=f"{y} {-x} 0"))
    urdf = robot(link("palm", _PALM), *fingers)
    return load_hand({"r.urdf": urdf}, name="r", digest="0" * 32, options=options)


def test_a_finger_of_one_joint_reaches_to_its_pad() -> None:
    hand = three_fingers(approach=[0, 0, 1])
    assert jaws_of(hand) is None
    # Its joints lie 30 mm from the palm's middle, its pads beyond half of the 100 mm of a finger.
    assert hand_self_test.OF_REACH * 0.05 < fitting_width(hand) < hand_self_test.OF_REACH * 0.11


def test_objects_are_no_thinner_than_opposed_pads_come_together(monkeypatch: pytest.MonkeyPatch) -> None:
    hand = hand_from_path("barrett")
    known, width = pinch_postures_of(hand), fitting_width(hand)
    assert known.width[0] < width
    thick = replace(known, width=known.width + 0.03)
    monkeypatch.setattr("graspd.worker.stages.hand_self_test.pinch_postures_of", lambda hand: thick)
    assert fitting_width(hand) == pytest.approx(thick.width[0])
    assert width < thick.width[0] < hand_self_test.WIDTH_M[1]


def test_a_busy_machine_leaves_nothing_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("time.monotonic", count(0.0, 1e4).__next__)

    def batches(hand: HandModel, obj: ObjectModel, count: int, run: ExecutionContext):
        run.progress(1, 10, "planning")
        run.check("planning")
        return [held(count)]

    monkeypatch.setattr(hand_self_test, "_plan_batches", batches)
    monkeypatch.setattr(hand_self_test, "_test_lifts", lambda hand, obj, count, run: (count, 0.5, None))
    found = self_test_facts(gripper)
    assert (found["table_n"], found["table"]) == (16, 0.5)
    assert (found["n"], sorted(found["by_object"])) == (64, ["box", "cylinder", "sphere"])


def test_a_servo_that_is_stiff_for_its_limit_gives_little() -> None:
    """0.1 N m at 20 N m/rad are 5 mrad, and the pad lies 50 to 100 mm from its joint."""
    hand = three_fingers(effort=0.1, stiffness=20.0)
    assert 0.005 * 0.05 < hand_self_test._drive_deflection(hand) < 0.005 * 0.1
    assert hand_self_test._drive_deflection(gripper()) == np.inf


@pytest.mark.parametrize(
    ("error", "says"),
    [
        (InputError("no way in"), "suspicious: no way in"),
        (ValueError("array"), "not tried: the test itself failed (ValueError)"),
    ],
)
def test_a_test_that_ends_badly_is_told_and_stops_nothing(error: Exception, says: str, monkeypatch) -> None:
    def breaks(hand: HandModel, run: ExecutionContext) -> SelfTest:
        raise error

    monkeypatch.setattr(hand_self_test, "self_test", breaks)
    assert self_test_facts(gripper)["says"] == says
    monkeypatch.undo()
    with pytest.raises(TaskCancelled):
        self_test_facts(gripper, ExecutionContext(cancelled=lambda: True))


@pytest.mark.slow
def test_a_parallel_gripper_holds_what_fits() -> None:
    found = self_test(gripper(), grasps=12, on_table=6)
    assert (found.n, found.table_n, found.limit.grasps) == (12, 6, 6)
    assert found.gsr >= 0.7 and found.table >= 0.6 and 0.1 < found.limit.lifts_kg <= found.limit.bound_kg
