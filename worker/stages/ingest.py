"""Check of an upload in a child process: a hostile file may crash the child, not the worker."""

import contextlib
import errno
import json
import os
import resource
import signal
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path
from typing import Any, Final

from graspd.service.model import names
from graspd.service.model.errors import HandError
from graspd.service.model.messages import IngestMessage
from graspd.service.model.states import AssetKind
from graspd.service.store.assets import pack, unpack
from graspd.service.store.integrity import put_document, put_sealed
from graspd.service.store.library import UNPACKED_LIMIT_BYTES, load_asset, load_asset_files
from graspd.service.store.network_file import check_network
from graspd.worker.stages.context import TaskContext

#: Address space of the child [bytes]: the largest accepted meshes need about a tenth of it.
MEMORY_LIMIT_BYTES: Final = 4 * 2**30
#: CPU time limit [s]; wall time of the same file grows on a busy machine. For a child that waits without computing, the
#: task's time limit ends the check, which is then retried.
CPU_LIMIT_S: Final = 25
_PASSED_ON: Final = ("PATH", "HOME", "LANG", "TMPDIR", "PYTHONPATH", "LD_LIBRARY_PATH", "VIRTUAL_ENV")
_OUT_OF_MEMORY: Final = ("MemoryError", "bad_alloc", "Cannot allocate", "failed to map")
_FINDING_BYTES: Final = 2**20
_MODEL: Final = "model.glb"
_MODEL_BYTES: Final = 2**24
_MODEL_CPU_S: Final = 8.0  # CPU time of a check [s] above which the first task with the asset makes its 3D model


def run(message: IngestMessage, context: TaskContext) -> None:
    """Check the asset and write `check.json`, also for a refusal."""
    files = _load_files(message, context)
    found, model = check_in_child(message.kind, message.name, files, context)
    if found["verdict"] != "refuse" and load_asset(context.store, message.kind, message.digest).self_test:
        from graspd.worker.hands.load import load_hand
        from graspd.worker.stages.hand_self_test import self_test_facts

        # A hand that holds none of the test objects is a result, not an error.
        load = partial(load_hand, files, name=message.name, digest=message.digest)
        found["facts"]["self_test"] = self_test_facts(load, context.run)
    if model:
        put_sealed(context.store, names.asset_key(message.kind, message.digest, "model.glb"), model)
    put_document(context.store, names.asset_key(message.kind, message.digest, "check.json"), found)


def _load_files(message: IngestMessage, context: TaskContext) -> dict[str, bytes]:
    if message.kind is AssetKind.HAND:
        from graspd.worker.stages.assets import load_hand_files

        # If the expansion fails, the check refuses the hand with the reason.
        with contextlib.suppress(HandError):
            return load_hand_files(context.store, message.digest)
    return load_asset_files(context.store, message.kind, message.digest)


def check_in_child(
    kind: AssetKind,
    name: str,
    files: dict[str, bytes],
    context: TaskContext,
    *,
    memory_bytes: int = MEMORY_LIMIT_BYTES,
    cpu_s: int = CPU_LIMIT_S,
) -> tuple[dict[str, Any], bytes]:
    """Check an upload; return the result (a refusal if the check crashed) and the model for viewers.
    The model (glTF) of an object of wrong size is in the likeliest units. It is empty after any other refusal, for a
    network, or if making it would take too long.
    Raises OSError: the check was killed, or the disk is full. TaskCancelled: the task should stop."""
    with tempfile.TemporaryDirectory(prefix="graspd-ingest-") as folder:
        source, target, errors = (Path(folder) / file for file in ("files.zip", "check.json", "errors.txt"))
        source.write_bytes(pack(files))
        arguments = [kind.value, name, str(source), str(target), str(memory_bytes), str(cpu_s)]
        command = [sys.executable, "-m", "graspd.worker.stages.ingest", *arguments]
        # A file of limited size: a full pipe would block the child, and reading from a pipe has no limit.
        with errors.open("wb") as stderr:
            streams: dict[str, Any] = {"stdin": subprocess.DEVNULL, "stdout": subprocess.DEVNULL, "stderr": stderr}
            with subprocess.Popen(command, **streams, start_new_session=True, env=_environment()) as child:
                code = _wait(child, context)
        complaint = errors.read_bytes()[-4000:].decode(errors="replace")
        if target.is_file() and target.stat().st_size > _FINDING_BYTES:
            why = f"the result of the check exceeds {_FINDING_BYTES >> 20} MiB; simplify it, or shorten its names"
            return _refusal_record(kind, name, why), b""
        if target.is_file():
            # A complete result counts even if the model after it failed. A truncated result does not parse.
            with contextlib.suppress(ValueError):
                found, model = dict(json.loads(target.read_bytes())), target.with_name(_MODEL)
                return found, model.read_bytes() if code == 0 and model.is_file() else b""
        if os.strerror(errno.ENOSPC) in complaint:
            # The file gets no verdict: the check is retried once there is disk space.
            raise OSError(errno.ENOSPC, f"{os.strerror(errno.ENOSPC)} to check {name}")
        if code == -signal.SIGKILL:
            raise OSError(f"the check of {name} was killed; the machine may lack memory")
        return _explain_crash(kind, name, code, complaint, memory_bytes, cpu_s), b""


def _environment() -> dict[str, str]:
    """Return the child's environment: no credentials; one thread, since each takes address space."""
    passed_on = {name: os.environ[name] for name in _PASSED_ON if name in os.environ}
    return passed_on | {"OPENBLAS_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}


def _wait(child: subprocess.Popen[bytes], context: TaskContext) -> int:
    try:
        while True:
            context.check()
            with contextlib.suppress(subprocess.TimeoutExpired):
                return child.wait(timeout=0.1)
    finally:
        if child.poll() is None:
            os.killpg(child.pid, signal.SIGKILL)
            child.wait()


def _explain_crash(
    kind: AssetKind, name: str, code: int, complaint: str, memory_bytes: int, cpu_s: int
) -> dict[str, Any]:
    if code == -signal.SIGXCPU:
        why = f"reading it takes longer than {cpu_s} s of computing; simplify it"
    elif any(sign in complaint for sign in _OUT_OF_MEMORY):
        why = f"reading it needs more than {memory_bytes / 2**30:.3g} GiB of memory; simplify it"
    else:
        last = complaint.strip().splitlines()[-1:] or [f"exit code {code}"]
        why = f"reading it crashed the checker ({last[0][:200]}); repair or re-export the file"
    return _refusal_record(kind, name, why)


def _refusal_record(kind: AssetKind, name: str, why: str) -> dict[str, Any]:
    return {"verdict": "refuse", "message": f"{name}: {why}", "repairs": [], "facts": {"kind": kind.value}}


def _check_upload(kind: str, name: str, source: str, target: str, memory_bytes: str, cpu_s: str) -> None:
    # The hard limit stays, since its signal equals that of a machine out of memory. Children have their own limits.
    resource.setrlimit(resource.RLIMIT_CPU, (int(cpu_s), resource.getrlimit(resource.RLIMIT_CPU)[1]))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_AS, (int(memory_bytes),) * 2)
    files = unpack(Path(source).read_bytes(), limit_bytes=UNPACKED_LIMIT_BYTES)
    # The reader of USD needs the layers as files.
    resource.setrlimit(resource.RLIMIT_FSIZE, (max(_MODEL_BYTES, *map(len, files.values())),) * 2)
    if AssetKind(kind) is AssetKind.HAND:
        from graspd.worker.hands.check import check_hand

        found = check_hand(files, name)
    elif AssetKind(kind) is AssetKind.NETWORK:
        # The API checks networks. A check here replaces a lost or damaged result of the API.
        found = check_network(files, name)
    else:
        from graspd.worker.objects.check import check_object

        found = check_object(files, name)
    Path(target).write_text(json.dumps(found))
    if units := found["facts"].get("units_suggested"):
        # The refused file is shown in the likeliest units.
        stated = json.loads(files.get("asset.json", b"{}")) | {"units": units[0]}
        files = {**files, "asset.json": json.dumps(stated).encode()}
    if (found["verdict"] != "refuse" or units) and kind != AssetKind.NETWORK and time.process_time() < _MODEL_CPU_S:
        from graspd.worker.stages.models import model_glb

        # The result is kept even if its model cannot be made.
        with contextlib.suppress(Exception):
            model = model_glb(AssetKind(kind), name, files)
            if len(model) <= _MODEL_BYTES:
                Path(target).with_name(_MODEL).write_bytes(model)


if __name__ == "__main__":
    _check_upload(*sys.argv[1:])
