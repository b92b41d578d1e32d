"""Context of a task (inputs, progress, cancellation), and its output as a shard with a manifest."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from enum import StrEnum
from typing import TYPE_CHECKING, Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.clock import timestamp
from graspd.service.model.digests import digest_json
from graspd.service.model.errors import TaskCancelled
from graspd.service.model.messages import TaskMessage
from graspd.service.model.names import SHARD_KINDS
from graspd.service.model.version import PACKAGE_VERSION
from graspd.service.store.columns import Attribute
from graspd.service.store.manifests import ShardManifest, create_manifest
from graspd.service.store.shards import check_columns, json_attribute, write_shard
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext

if TYPE_CHECKING:
    from graspd.service.store.store import Store

REPORT_EVERY_S: Final = 1.0  # least time between two progress reports [s]: enough for a moving progress bar


class StopReason(StrEnum):
    """Reason for which a running task should stop."""

    CANCELLED = "cancelled"
    LEASE_LOST = "lease lost"
    SHUTDOWN = "shutdown"
    TIMEOUT = "timeout"


class TaskContext:
    """Store, progress and cancellation of one task. `progress` and `cancelled` are thread-safe and cheap."""

    def __init__(
        self,
        store: Store,
        run: ExecutionContext = DEFAULT_CONTEXT,
        *,
        join: int = 1,
        tell: Callable[[float, float, str], None] | None = None,
        log: Callable[[], str] = str,
    ) -> None:
        """`join`: batches per launch; `tell`: receives done, total and a message; `log`: log so far."""
        self.store, self.device, self.join = store, run.device, join
        self.run = replace(run, progress=self.progress, cancelled=self.cancelled)  # execution context for the engine
        self._tell, self._tell_again, self.log = tell, 0.0, log
        self._stop = threading.Event()
        self.stop_reason: StopReason | None = None

    def progress(self, done: float, total: float, message: str) -> None:
        """Report progress; most calls are dropped to limit the number of messages."""
        now = time.monotonic()
        if self._tell is not None and now >= self._tell_again:
            self._tell_again = now + REPORT_EVERY_S
            self._tell(done, total, message)

    def cancelled(self) -> bool:
        """Check whether the task should stop."""
        return self._stop.is_set()

    def check(self) -> None:
        """Raise TaskCancelled if the task should stop."""
        if self._stop.is_set():
            raise TaskCancelled(f"stopped: {self.stop_reason}")

    def stop(self, reason: StopReason) -> None:
        """Request the task to stop; the first reason is stored."""
        self.stop_reason = self.stop_reason or reason
        self._stop.set()


@dataclass(frozen=True)
class Output:
    """Columns of a shard, its attributes, and further entries of the manifest."""

    arrays: Mapping[str, NDArray[np.generic]]
    attributes: Mapping[str, Attribute] = field(default_factory=dict)
    info: Mapping[str, Any] = field(default_factory=dict)


def build_shard(
    message: TaskMessage, output: Output, *, device: str, seconds: float, worker: str, lost: ShardManifest | None = None
) -> tuple[ShardManifest, bytes]:
    """Build a stage's manifest and HDF5 bytes. Raises InputError: the columns do not fit the schema.
    A file that replaces a lost one keeps the times and package version of the manifest `lost`."""
    kind = SHARD_KINDS[message.stage]
    request = message.request
    attributes: dict[str, Attribute] = {
        "hand": request.hand,
        "hand_digest": message.hand_digest,
        "object": request.object,
        "object_digest": message.object_digest,
        "method": request.method,
        "fidelity": json_attribute(request.resolved_fidelity.model_dump(mode="json")),
        "seed": request.seed,
        "batch": message.batch,
        "device": device,
        "seconds": lost.seconds if lost is not None else round(seconds, 4),
        "created": lost.created if lost is not None else timestamp(),
        "code_version": lost.code_version if lost is not None else PACKAGE_VERSION,
        "shard_id": message.output,
        "inputs": list(message.inputs),
        **output.attributes,
    }
    columns = output.arrays
    counts = check_columns(kind, columns)  # type: ignore[arg-type]
    data = write_shard(kind, columns, attributes)  # type: ignore[arg-type]
    manifest = create_manifest(
        message, data, columns, attributes, counts, device=device, seconds=seconds, worker=worker, info=output.info
    )
    return manifest, data


def batch_seed(message: TaskMessage) -> int:
    """Compute the seed of this stage for this batch of a hand and an object.
    Methods share it: networks trained on grasps of two methods see the same pictures."""
    pair = [message.hand_digest, message.object_digest]
    return int(digest_json([message.request.seed, message.stage, message.batch, *pair])[:8], 16) % 2**31


#: Makes the arrays of a shard or, like ingest, writes its result itself.
StageFunction = Callable[[Any, TaskContext], Output | None]
