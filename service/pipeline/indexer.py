"""Application of events to the index. An event only names its data, which is read from the store."""

import logging
import time
from collections import OrderedDict, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from typing import Final

from graspd.service.index.database import chunks
from graspd.service.model.clock import timestamp
from graspd.service.model.errors import InputError, StoreUnavailable, UnavailableError
from graspd.service.model.names import attempt_key as attempt_key
from graspd.service.model.planning import backoff
from graspd.service.model.records import AttemptRecord
from graspd.service.model.series import SERIES, STAGE_BUCKETS_S, field_name
from graspd.service.model.states import AssetKind, Stage, State
from graspd.service.pipeline.backends import Services
from graspd.service.queue.port import Event, EventKind
from graspd.service.store.library import load_asset, load_check
from graspd.service.store.manifests import ShardManifest, load_manifest
from graspd.service.store.records import read_record

log = logging.getLogger(__name__)
_REMEMBERED_JOBS: Final = 10_000
_REMEMBERED_TASKS: Final = 100_000
#: Maximum number of batches per transaction, so that other writers wait for a fraction of a second.
_BATCHES_AT_ONCE: Final = 200
#: Maximum number of manifests in memory, each of up to 64 batches.
_MANIFESTS_AT_ONCE: Final = 32
_READERS: Final = 8
_NEEDS_STORE: Final = frozenset({EventKind.FINISHED, EventKind.FAILED})


class Indexer:
    """Applies events to the index, and publishes changed states of jobs."""

    def __init__(self, services: Services) -> None:
        self._services = services
        self._told: OrderedDict[str, State] = OrderedDict()
        self._deferrals: dict[str, int] = {}
        self._tally = Tally(services.queue.add_to_counters)
        self._readers = ThreadPoolExecutor(_READERS, thread_name_prefix="manifests")

    def apply(self, events: Sequence[Event]) -> list[int]:
        """Apply events; return the positions of those to apply again, because the store was unavailable."""
        started: dict[str, str] = {}
        finished: list[int] = []
        left: list[str] = []
        waiting: list[int] = []
        for place, event in enumerate(events):
            if event.kind is EventKind.STARTED:
                if event.stage is not Stage.INGEST:
                    started[event.task_id] = event.worker
            elif event.kind is EventKind.FINISHED and event.stage not in (None, Stage.INGEST):
                finished.append(place)
            elif event.kind is EventKind.LEFT:
                left.append(event.worker)
            elif event.kind is not EventKind.JOB:
                self._mark_running(started)
                # While the store is unavailable, only events that do not need it are applied.
                if not (waiting and event.kind in _NEEDS_STORE) and self._apply_event(event):
                    continue
                waiting.append(place)
        self._mark_running(started)
        waiting += self._index_finished_tasks(events, finished)
        if left:
            self._services.index.live.delete_workers(left)
        return sorted(waiting)

    def _mark_running(self, started: dict[str, str]) -> None:
        """Mark tasks, mapped to their workers, as running; then clear the mapping."""
        if started:
            with _skip_invalid(f"the start of {len(started)} tasks"):
                self.publish_states(self._services.index.live.set_running(started))
            started.clear()

    def _index_finished_tasks(self, events: Sequence[Event], places: Sequence[int]) -> list[int]:
        """Index the shards of finished tasks; return the positions of events that must wait for the store."""
        made, waiting = list[ShardManifest](), []
        for place, found in self._load_manifests(events, places):
            if isinstance(found, ShardManifest):
                self._deferrals.pop(events[place].task_id, None)
                made.append(found)
                if sum(manifest.batches for manifest in made) >= _BATCHES_AT_ONCE:
                    self._index_manifests(made)
                    made = []
            elif isinstance(found, StoreUnavailable):
                waiting.append(place)
            else:
                log.error("the end of task %s is not indexed", events[place].task_id, exc_info=found)
        if waiting:
            log.warning("the store does not answer, and %d events wait for it", len(waiting))
        self._index_manifests(made)
        return waiting

    def _load_manifests(
        self, events: Sequence[Event], places: Sequence[int]
    ) -> Iterator[tuple[int, ShardManifest | Exception]]:
        for some in chunks(places, _MANIFESTS_AT_ONCE):
            yield from zip(some, self._readers.map(self._load_manifest, [events[place] for place in some]), strict=True)

    def _load_manifest(self, event: Event) -> ShardManifest | Exception:
        """Return the manifest of a finished task, or the error, so that a thread pool can read many."""
        try:
            assert event.stage is not None
            return load_manifest(self._services.store, event.stage, event.output)
        except Exception as error:
            return error

    def _index_manifests(self, made: list[ShardManifest]) -> None:
        """Index shards in one transaction; if it is rejected, index each shard by itself."""
        try:
            states = self._services.index.write.add_manifests(made) if made else {}
        except InputError:
            if len(made) == 1:
                log.exception("shard %s is not indexed", made[0].shard_id)
            else:
                for manifest in made:
                    self._index_manifests([manifest])
            return
        self.publish_states(states)
        self._tally.count_shards(made)

    def publish_states(self, states: Mapping[str, State]) -> None:
        """Publish the states of jobs that changed since they were last published."""
        changed = {job: state for job, state in states.items() if self._told.get(job) is not state}
        now = timestamp()
        events = [Event(kind=EventKind.JOB, at=now, job_id=job, message=s.value) for job, s in changed.items()]
        if events:
            self._services.queue.publish(*events)
        for job, state in changed.items():
            log.info("job is %s", state, extra={"job": job})
            if state.is_final:
                self._tally.add("graspd_jobs_ended_total", state.value)
            self._told[job] = state
        for job in states:
            self._told.move_to_end(job)
        while len(self._told) > _REMEMBERED_JOBS:
            self._told.popitem(last=False)

    def index_shard(self, manifest: ShardManifest) -> None:
        self.publish_states(self._services.index.write.add_manifests([manifest]))
        self._tally.count_shards([manifest])

    def index_asset(self, kind: AssetKind, digest: str) -> None:
        asset = load_asset(self._services.store, kind, digest)
        self._services.index.write.add_asset(asset, load_check(self._services.store, kind, digest))

    def index_attempt(self, attempt: AttemptRecord, *, at_once: bool = False) -> None:
        """Index a failed attempt; the next one follows after a back-off, or at once."""
        wait = 0.0 if at_once else backoff(self._services.settings.retry_backoff_s, attempt.number)
        state = self._services.index.write.add_attempt(attempt, not_before=time.time() + wait)
        if state is not None:
            said = {"job": attempt.job_id, "task": attempt.task_id, "attempt": attempt.number, "worker": attempt.worker}
            log.warning("attempt failed: %s: %s", attempt.kind, attempt.reason, extra=said)
            self._tally.count_failure(attempt.stage.value, attempt.kind)
            self.publish_states({attempt.job_id: state})

    def flush(self) -> None:
        self._tally.flush()

    def _apply_event(self, event: Event) -> bool:
        """Apply one event by itself; return False if it must wait for the store."""
        try:
            with _skip_invalid(f"event {event.kind} of task {event.task_id}"):
                self._handle_event(event)
        except StoreUnavailable as error:
            log.warning("%s; events wait for it", error)
            return False
        return True

    def _handle_event(self, event: Event) -> None:
        if event.kind is EventKind.FINISHED:
            kind, _, digest = event.output.partition("/")
            self.index_asset(AssetKind(kind), digest)
        elif event.kind is EventKind.FAILED and event.stage is Stage.INGEST:
            # A check that ended without a result is repeated.
            self._defer(event)
        elif event.kind is EventKind.FAILED:
            key = attempt_key(event.task_id, event.attempt)
            self.index_attempt(read_record(AttemptRecord, self._services.store, key))
        else:
            self._tally.add("graspd_task_handbacks_total", event.stage or "", event.kind.value)
            if event.kind is EventKind.DEFERRED:
                self._defer(event)
            else:
                self._set_waiting(event, 0.0, None)

    def _defer(self, event: Event) -> None:
        if len(self._deferrals) >= _REMEMBERED_TASKS:
            self._deferrals.clear()
        count = self._deferrals[event.task_id] = self._deferrals.get(event.task_id, 0) + 1
        wait = backoff(self._services.settings.retry_backoff_s, count)
        self._set_waiting(event, time.time() + wait, f"waits: {event.message}")

    def _set_waiting(self, event: Event, not_before: float, message: str | None) -> None:
        live = self._services.index.live
        if event.stage is Stage.INGEST:
            digest = event.output.partition("/")[2]
            live.set_asset_waiting([digest], queued=False, not_before=not_before, message=message)
        else:
            self.publish_states(live.set_waiting([event.task_id], not_before=not_before, message=message))


@contextmanager
def _skip_invalid(what: str) -> Iterator[None]:
    """Log and skip an invalid event: any client of Redis can write one, which must not block others."""
    try:
        yield
    except UnavailableError:
        raise
    except Exception:
        log.exception("%s is ignored", what)


#: Maximum number of pairs of stage and error name with their own series, because names can be forged.
MOST_KINDS: Final = 60
OTHER_KIND: Final = "other"


class Tally:
    """In-memory counts for `/metrics`; `flush` adds them to the sums in Redis."""

    def __init__(self, count: Callable[[Mapping[str, float]], None]) -> None:
        """`count` adds amounts to the sums in Redis."""
        self._count = count
        self._amounts: defaultdict[str, float] = defaultdict(float)
        self._kinds: set[tuple[str, str]] = set()

    def count_shards(self, manifests: Iterable[ShardManifest]) -> None:
        for manifest in manifests:
            stage = manifest.stage.value
            self.add("graspd_shards_total", stage)
            self.add("graspd_shard_bytes_total", stage, amount=manifest.size_bytes)
            self._observe("graspd_stage_seconds", stage, seconds=manifest.seconds)
            if manifest.kind == "base":
                self.add("graspd_grasps_total", "all", amount=manifest.count)
                self.add("graspd_grasps_total", "valid", amount=manifest.valid)
                self.add("graspd_grasps_total", "validated", amount=manifest.validated)

    def count_failure(self, stage: str, kind: str) -> None:
        if (stage, kind) not in self._kinds and len(self._kinds) >= MOST_KINDS:
            kind = OTHER_KIND
        self._kinds.add((stage, kind))
        self.add("graspd_task_failures_total", stage, kind)

    def flush(self) -> None:
        """Add the counts to the sums; QueueUnavailable keeps them for the next call."""
        if self._amounts:
            self._count(self._amounts)
            self._amounts.clear()

    def _observe(self, name: str, *labels: str, seconds: float) -> None:
        bound = next((bound for bound in STAGE_BUCKETS_S if seconds <= bound), None)
        self._amounts[field_name(f"{name}_bucket", *labels, "+Inf" if bound is None else str(bound))] += 1
        self._amounts[field_name(f"{name}_sum", *labels)] += seconds

    def add(self, name: str, *labels: str, amount: float = 1) -> None:
        assert len(SERIES[name].labels) == len(labels)
        self._amounts[field_name(name, *labels)] += amount
