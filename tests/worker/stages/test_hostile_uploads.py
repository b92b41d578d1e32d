"""Every bad file from upload to verdict; attacks on a reader are refused in bounded time, the worker unharmed."""

from __future__ import annotations

import io
import json
import os
import struct
import zipfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspd.api.uploads import files_of_upload
from graspd.service.model import names
from graspd.service.model.errors import InputError
from graspd.service.model.messages import IngestMessage
from graspd.service.model.states import AssetKind, Stage
from graspd.service.model.version import TASK_SCHEMA
from graspd.service.queue.port import EventKind
from graspd.service.store.library import publish_asset
from graspd.service.store.store import Store, open_store
from graspd.worker.process.runner import Runner
from graspd.worker.stages import ingest
from graspd.worker.stages.context import TaskContext
from tests.worker.objects.shapes import join, sphere, stl

UPLOAD_BYTES = 64 * 2**20
#: What is promised for any upload, as time of computing [s].
BOUND_S = 30.0
#: Children at a time: as many as the smallest machine has cores.
TOGETHER = 2
BALL = stl(sphere(segments=24))
PLY_POINT = "property float x\nproperty float y\nproperty float z\n"
PLY_FACE = "property list uchar int vertex_indices\n"


def computed() -> float:
    """Processor time of this process and of the children it waited for [s]."""
    used = os.times()
    return used.user + used.system + used.children_user + used.children_system


def zipped(files: dict[str, bytes]) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return buffer.getvalue()


def upload(store: Store, kind: AssetKind, filename: str, data: bytes, options: dict[str, Any] | None = None) -> Any:
    """What a user is told of an upload: refused at the door, or what the worker's check says."""
    try:
        files = files_of_upload(kind, filename, data, limit_bytes=UPLOAD_BYTES)
        asset = publish_asset(store, kind, "upload", files)
    except InputError as error:
        return {"verdict": "refuse", "message": str(error)}
    message = IngestMessage(schema_=TASK_SCHEMA, task_id="i", kind=kind, name=Path(filename).stem, digest=asset.digest)
    outcome = Runner({Stage.INGEST: ingest.run}, worker="w", publish=lambda event: None).run(
        message.model_dump(mode="json", by_alias=True), TaskContext(store)
    )
    assert outcome is not None and outcome.kind is EventKind.FINISHED, outcome
    return json.loads(store.get(names.asset_check(kind, asset.digest)))


def kind_of(filename: str) -> AssetKind:
    return AssetKind.HAND if filename.endswith(".urdf") else AssetKind.OBJECT


#: One for each verdict on a hand and on a mesh. What the check says of every bad file is tested beside it, without a
#: child: tests/worker/hands/test_bad_hands.py, tests/worker/objects/test_repair.py.
SOME = ("mimic_chain.urdf", "kinematic_loop.urdf", "open_shell.stl", "inverted_normals.stl", "quads_and_ngons.obj")


@pytest.mark.parametrize("chosen", [SOME, pytest.param((), marks=pytest.mark.slow)], ids=["some", "all"])
def test_a_bad_file_gets_its_verdict_from_the_checking_child(shared_data: Path, chosen: tuple[str, ...]) -> None:
    known = json.loads((shared_data / "bad" / "INDEX.json").read_text())["inputs"]
    entries = [entry for entry in known if entry["file"] in chosen] if chosen else known

    def validate(entry: dict[str, str]) -> str | None:
        data, start = (shared_data / "bad" / entry["file"]).read_bytes(), computed()
        found = upload(open_store("memory://"), kind_of(entry["file"]), entry["file"], data)
        right = found["verdict"] == entry["expect"] and entry["message_names"].lower() in found["message"].lower()
        return None if right and computed() - start < BOUND_S else f"{entry['file']}: {found}"

    with ThreadPoolExecutor(TOGETHER) as pool:
        wrong = [text for text in pool.map(validate, entries) if text]
    assert len(entries) >= (len(chosen) or 40) and not wrong


def big_entity_bomb() -> bytes:
    """Ten levels of ten: 10^10 characters once expanded."""
    levels = "".join(f'<!ENTITY e{i} "{f"&e{i - 1};" * 10}">' for i in range(1, 11))
    return f'<!DOCTYPE robot [<!ENTITY e0 "x">{levels}]><robot name="&e10;"/>'.encode()


def external_entity() -> bytes:
    return b'<!DOCTYPE robot [<!ENTITY x SYSTEM "file:///etc/passwd">]><robot name="h"><link name="&x;"/></robot>'


def huge_promise() -> bytes:
    """4 10^9 faces of 50 bytes: 200 GB."""
    return b"promise".ljust(80) + struct.pack("<I", 4_000_000_000) + bytes(600)


def ply_promise() -> bytes:
    header = "ply\nformat binary_little_endian 1.0\nelement vertex 4000000000\n"
    return (header + PLY_POINT + "end_header\n").encode() + bytes(64)


@cache
def zip_bomb() -> bytes:
    """A few hundred kilobytes that unpack to more than eight times the upload limit."""
    return zipped({f"{i}.stl": bytes(UPLOAD_BYTES) for i in range(9)})


def nested_bomb() -> bytes:
    return zipped({"inner.zip": zipped({"innermost.zip": zip_bomb()})})


def symlink() -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        entry = zipfile.ZipInfo("mesh.stl")
        entry.external_attr = 0o120777 << 16
        archive.writestr(entry, "/etc/passwd")
    return buffer.getvalue()


def damaged_zip() -> bytes:
    data = bytearray(zipped({"ball.stl": BALL["m.stl"]}))
    data[200:260] = bytes(60)
    return bytes(data)


def unusual_zip() -> bytes:
    """LZMA's header may ask for a dictionary of 4 GiB."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", zipfile.ZIP_LZMA) as archive:
        archive.writestr("ball.stl", BALL["m.stl"])
    return buffer.getvalue()


@pytest.mark.parametrize(
    ("filename", "data", "says"),
    [
        ("bomb.urdf", big_entity_bomb(), "entit"),
        ("external.urdf", external_entity(), "entit"),
        ("promise.stl", huge_promise(), "truncated"),
        ("promise.ply", ply_promise(), ""),
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
        (nested_bomb, "holds no object file"),
        (zip_bomb, "unpacks to more"),
        (symlink, "symbolic link"),
        (lambda: zipped({f"{i}.obj": b"v" for i in range(3000)}), "3000 files"),
        (damaged_zip, "damaged"),
        (unusual_zip, "unusual"),
    ],
    ids=["slip", "absolute", "nested", "bomb", "link", "many", "damaged", "lzma"],
)
def test_an_archive_that_attacks_is_refused_at_the_door_and_reaches_no_worker(
    archive: Callable[[], bytes], says: str
) -> None:
    data, start = archive(), computed()
    with pytest.raises(InputError, match=says):
        publish_asset(
            open_store("memory://"),
            AssetKind.OBJECT,
            "upload",
            files_of_upload(AssetKind.OBJECT, "archive.zip", data, limit_bytes=UPLOAD_BYTES),
        )
    assert computed() - start < BOUND_S


@cache
def rough(segments: int) -> bytes:
    """A ball with noise on it: slow to simplify."""
    vertices, faces = sphere(0.04, segments)
    noise = np.random.default_rng(0).normal(1.0, 0.003, (len(vertices), 1))
    return stl((vertices * noise, faces))["m.stl"]


@pytest.mark.parametrize(
    ("limits", "says"),
    [({"cpu_s": 1}, "takes longer than 1 s"), ({"memory_bytes": 400 * 2**20}, "needs more than 0.391 GiB")],
)
def test_a_mesh_that_costs_too_much_is_refused_and_the_next_one_is_taken(limits: dict[str, int], says: str) -> None:
    context, start = TaskContext(open_store("memory://")), computed()
    files = {"asset.json": b'{"file": "m.stl"}', "m.stl": rough(512)}
    found, _ = ingest.check_in_child(AssetKind.OBJECT, "rough", files, context, **limits)  # type: ignore[arg-type]
    assert found["verdict"] == "refuse" and says in found["message"]
    assert computed() - start < BOUND_S
    feasible = {"asset.json": b'{"file": "m.stl"}', **BALL}
    assert ingest.check_in_child(AssetKind.OBJECT, "ball", feasible, context)[0]["verdict"] == "accept"


def test_a_small_archive_of_ten_million_faces_is_refused() -> None:
    count = 10_000_000
    points = f"ply\nformat binary_little_endian 1.0\nelement vertex 3\n{PLY_POINT}"
    header = f"{points}element face {count}\n{PLY_FACE}end_header\n"
    face = b"\3" + np.arange(3, dtype="<i4").tobytes()
    data = zipped({"big.ply": header.encode() + np.eye(3, dtype="<f4").tobytes() + face * count})
    assert len(data) < 2**20
    start = computed()
    found = upload(open_store("memory://"), AssetKind.OBJECT, "big.zip", data)
    assert found["verdict"] == "refuse" and "10000000 faces; at most 1000000 are taken" in found["message"]
    assert computed() - start < BOUND_S


@pytest.mark.slow
def test_a_tangle_of_balls_is_united_within_the_bound() -> None:
    """220 balls of 4000 faces in one another: each pair of faces that cross is work for the repair."""
    rng = np.random.default_rng(0)
    centres = rng.uniform(-0.02, 0.02, (220, 3))
    tangle = join(*(sphere(0.04, 64, at=tuple(centre)) for centre in centres))
    start = computed()
    found = upload(open_store("memory://"), AssetKind.OBJECT, "tangle.stl", stl(tangle)["m.stl"])
    assert computed() - start < BOUND_S
    assert found["verdict"] == "repair" and found["repairs"] == ["united 220 intersecting components"]
    points = rng.uniform(-0.06, 0.06, (50_000, 3))
    inside = (np.linalg.norm(points[:, None] - centres[None], axis=2) < 0.04).any(axis=1).mean()
    # Standard error of the sample 0.3 %; balls of flat faces are 0.5 % smaller than round ones.
    assert found["facts"]["volume_m3"] == pytest.approx(0.12**3 * inside, rel=0.02)


def test_the_limits_of_a_check_keep_the_promised_bound() -> None:
    assert ingest.CPU_LIMIT_S < BOUND_S
