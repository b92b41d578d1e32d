"""Recovery of tasks whose worker is lost, and of tasks that the queue lost."""

import logging
import time
from collections.abc import Callable, Collection
from typing import Any, Final

from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.errors import DamagedError, NotFoundError, UnavailableError
from graspd.service.model.messages import IngestMessage, TaskMessage
from graspd.service.model.planning import ingest_id
from graspd.service.model.records import AttemptRecord
from graspd.service.model.states import Stage
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.indexer import Indexer
from graspd.service.queue.port import Lease, rq_id
from graspd.service.store.integrity import put_document
from graspd.service.store.manifests import load_manifest
from graspd.service.store.packs import convert_packs
from graspd.service.store.records import put_record, read_record, task_attempts

log = logging.getLogger(__name__)
#: Time [s] for which a task may be in transit, neither in the queue nor leased.
LOST_AFTER_S: Final = 3.0


class LeaseReaper:
    """Detects lost leases by unchanged heartbeats, timed by this process's clock."""

    def __init__(self, services: Services, indexer: Indexer, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._services = services
        self._indexer = indexer
        self._clock = clock
        self._heartbeats: dict[Any, tuple[str, float]] = {}
        self._looked = clock()
        self._missing: dict[str, float] = {}

    def reap(self, leases: Collection[Lease]) -> list[Lease]:
        """Release leases without a heartbeat for the duration of a lease, and fail their tasks; return them."""
        now = self._clock()
        lease_s = self._services.settings.lease_s
        # Long gaps between calls do not count as silence: Redis was unavailable, or this process suspended.
        looked, self._looked = min(now - self._looked, lease_s / 3), now
        heartbeats: dict[Any, tuple[str, float]] = {}
        lost = []
        for lease in leases:
            beat, silence = self._heartbeats.get(lease.key, (None, 0.0))
            silence = silence + looked if beat == lease.beat else 0.0
            if silence <= lease_s:
                heartbeats[lease.key] = (lease.beat, silence)
            else:
                self._handle_lost_lease(lease)
                lost.append(lease)
        self._heartbeats = heartbeats
        return lost

    def find_missing(self, present: Collection[str]) -> list[str]:
        """Recover tasks that are marked as queued, but for `LOST_AFTER_S` not in `present`; return their ids."""
        tasks, checks = self._services.index.feed.queued_tasks_and_checks()
        believed = tasks | {ingest_id(kind, digest) for kind, digest in checks}
        now = self._clock()
        self._missing = {task: self._missing.get(task, now) for task in believed - set(present)}
        missing = [task for task, since in self._missing.items() if now - since >= LOST_AFTER_S]
        self._recover_tasks([task for task in missing if task in tasks])
        for kind, digest in checks:
            if ingest_id(kind, digest) in missing:
                if self._services.store.exists(names.asset_key(kind, digest, "check.json")):
                    try:
                        self._indexer.index_asset(kind, digest)
                    except DamagedError as error:
                        log.warning("%s", error)
                else:
                    self._services.index.live.set_asset_waiting([digest], queued=False)
        return missing

    def _recover_tasks(self, missing: list[str]) -> None:
        """Index results of missing tasks that the store has; mark the other ones as not queued."""
        again = []
        if missing:  # During an upgrade, workers of graspd 0.2 may have written packs.
            for manifest in convert_packs(self._services.store):
                self._indexer.index_shard(manifest)
        for task, (stage, shard) in self._services.index.feed.outputs(missing).items():
            if self._index_existing_shard(task, Stage(stage), shard):
                continue
            known = self._services.index.jobs.task(task).attempt
            try:
                recorded = [a for a in task_attempts(self._services.store, task) if a.number >= known]
            except DamagedError as error:
                self._fail_task(task, Stage(stage), error)
                continue
            for attempt in recorded:
                self._indexer.index_attempt(attempt)
            if not recorded:
                again.append(task)
        if again:
            log.warning("%d tasks were lost from the queue and are queued again", len(again))
            self._indexer.publish_states(self._services.index.live.set_waiting(again))

    def _index_existing_shard(self, task_id: str, stage: Stage, shard: str) -> bool:
        """Index a shard if it exists; return whether it does. A damaged manifest fails its task for good."""
        try:
            self._indexer.index_shard(load_manifest(self._services.store, stage, shard))
        except NotFoundError:
            return False
        except DamagedError as error:
            self._fail_task(task_id, stage, error)
        return True

    def _fail_task(self, task_id: str, stage: Stage, error: DamagedError) -> None:
        task = self._services.index.jobs.task(task_id)
        about = {"task_id": task_id, "job_id": task.job_id, "stage": stage, "number": task.attempt}
        why = {"kind": type(error).__name__, "reason": str(error), "worker": "controller"}
        attempt = AttemptRecord.model_validate({**about, **why, "ended": timestamp(), "last": True})
        put_record(self._services.store, names.attempt_key(task_id, attempt.number), attempt)
        self._indexer.index_attempt(attempt)

    def _handle_lost_lease(self, lease: Lease) -> None:
        worker, message = self._services.queue.lease_holder(lease)
        log.warning("worker %s was lost with task %s (attempt %d)", worker, lease.task_id, lease.attempt)
        try:
            if isinstance(message, TaskMessage):
                self._fail_lost_task(worker, message)
            elif isinstance(message, IngestMessage):
                self._fail_lost_check(message)
        except UnavailableError:
            raise
        except Exception:  # Any client of Redis can forge a lease.
            log.exception("the lease of task %s is ignored", lease.task_id)
        # The lease is removed last, so that the next round finds it again if the store was unavailable.
        self._services.queue.release(lease)

    def _fail_lost_task(self, worker: str, message: TaskMessage) -> None:
        if self._index_existing_shard(message.task_id, message.stage, message.output):
            return
        attempt = AttemptRecord.from_message(
            message,
            kind="WorkerLost",
            reason=f"worker {worker} was lost: no heartbeat for {self._services.settings.lease_s:g} s",
            worker=worker,
            last=message.attempt >= message.max_attempt,
            log=self._services.queue.task_log(rq_id(message.task_id, message.attempt)),
        )
        key = names.attempt_key(message.task_id, message.attempt)
        if not put_record(self._services.store, key, attempt):
            try:
                attempt = read_record(AttemptRecord, self._services.store, key)
            except DamagedError as error:
                self._fail_task(message.task_id, message.stage, error)
                return
        # No back-off after the first attempt: its loss is more often caused by the machine than by the task.
        self._indexer.index_attempt(attempt, at_once=attempt.number == 1)

    def _fail_lost_check(self, message: IngestMessage) -> None:
        if message.attempt >= message.max_attempt:
            ended = f"the check of this {message.kind.value} crashed its worker {message.attempt} times"
            reason = f"{ended}; delete it to try again"
            found = {"verdict": "refuse", "message": reason, "repairs": [], "facts": {}}
            put_document(self._services.store, names.asset_key(message.kind, message.digest, "check.json"), found)
            self._indexer.index_asset(message.kind, message.digest)
        else:
            self._services.index.live.add_asset_attempt(message.digest, message.attempt, not_before=0.0)
