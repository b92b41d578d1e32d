"""From events to the index. An event only says where to look: what enters the index is read from the store."""

from __future__ import annotations

import logging
import time
from collections import OrderedDict
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from typing import Final

from service.model.clock import timestamp
from service.model.domain import AssetKind, Stage, State
from service.model.errors import InputError, StoreUnavailable, UnavailableError
from service.model.names import attempt as attempt_key
from service.model.planning import backoff
from service.model.records import AttemptRecord
from service.pipeline.backends import Parts
from service.pipeline.tally import Tally
from service.queue.port import Event, EventKind
from service.store.library import load_asset, load_check
from service.store.manifests import ShardManifest, load_manifest
from service.store.records import read_record

log = logging.getLogger(__name__)
_REMEMBERED_JOBS: Final = 10_000


_NEEDS_STORE: Final = frozenset({EventKind.FINISHED, EventKind.FAILED})


class Indexer:
    """Applies events; tells listeners when a job's state changes."""

    def __init__(self, parts: Parts) -> None:
        self._parts = parts
        self._told: OrderedDict[str, State] = OrderedDict()
        self._deferrals: dict[str, int] = {}
        self._tally = Tally(parts.queue)

    def apply(self, events: Sequence[Event]) -> list[int]:
        """Bring the index up to date. Applying an event twice changes nothing.

        Returns:
            places of the events for which the store is needed and away; apply these again later.

        Raises:
            UnavailableError: another part is away; apply the same events again later.
        """
        progress: dict[str, tuple[float, float, str]] = {}
        made: list[ShardManifest] = []
        waiting: list[int] = []
        for place, event in enumerate(events):
            if event.kind is EventKind.PROGRESS:
                progress[event.task_id] = (event.done, event.total, event.message)
                continue
            progress.pop(event.task_id, None)
            # What a store that is away keeps from being known must not hide what does not need it.
            if waiting and event.kind in _NEEDS_STORE:
                waiting.append(place)
                continue
            try:
                with _left_out(f"event {event.kind} of task {event.task_id}"):
                    self._take_up(event, made)
            except StoreUnavailable as error:
                log.warning("%s; %d or more events wait for it", error, 1 + len(waiting))
                waiting.append(place)
        self._index(made)
        if progress:
            with _left_out(f"progress of {len(progress)} tasks"):
                self._parts.index.live.set_progress(progress)
        return waiting

    def _take_up(self, event: Event, made: list[ShardManifest]) -> None:
        if event.kind is EventKind.FINISHED and event.stage not in (None, Stage.INGEST):
            made.append(load_manifest(self._parts.store, event.stage, event.output))
            self._deferrals.pop(event.task_id, None)
        else:
            self._apply(event)

    def _index(self, made: list[ShardManifest]) -> None:
        """Shards in one transaction; where the index cannot hold one of them, each by itself."""
        try:
            states = self._parts.index.write.add_manifests(made) if made else {}
        except InputError:
            if len(made) == 1:
                log.exception("shard %s is left out", made[0].shard_id)
            else:
                for manifest in made:
                    self._index([manifest])
            return
        self.tell(states)
        self._tally.made(made)

    def tell(self, states: Mapping[str, State]) -> None:
        """Publish the states of jobs where they changed."""
        for job, state in states.items():
            if self._told.get(job) is not state:
                self._parts.queue.publish(Event(kind=EventKind.JOB, at=timestamp(), job_id=job, message=state.value))
                log.info("job is %s", state, extra={"job": job})
                if state.is_final:
                    self._tally.ended(state)
            self._told[job] = state
            self._told.move_to_end(job)
            if len(self._told) > _REMEMBERED_JOBS:
                self._told.popitem(last=False)

    def finished(self, stage: Stage, output: str) -> None:
        """Index a shard, or what the check of an asset found."""
        if stage is Stage.INGEST:
            kind, _, digest = output.partition("/")
            self.checked(AssetKind(kind), digest)
        else:
            manifest = load_manifest(self._parts.store, stage, output)
            self.tell(self._parts.index.write.add_manifest(manifest))
            self._tally.made([manifest])

    def checked(self, kind: AssetKind, digest: str) -> None:
        """Index a hand or object as the store has it now."""
        asset = load_asset(self._parts.store, kind, digest)
        self._parts.index.write.add_asset(asset, load_check(self._parts.store, kind, digest))

    def failed(self, attempt: AttemptRecord, *, at_once: bool = False) -> None:
        """Index a failed attempt; the next follows after a back-off, or at once."""
        wait = 0.0 if at_once else backoff(self._parts.settings.retry_backoff_s, attempt.number)
        not_before = time.time() + wait
        state = self._parts.index.write.add_attempt(attempt, not_before=not_before)
        if state is not None:
            about = {
                "job": attempt.job_id,
                "task": attempt.task_id,
                "attempt": attempt.number,
                "worker": attempt.worker,
            }
            log.warning("attempt failed: %s: %s", attempt.kind, attempt.reason, extra=about)
            self._tally.failed(attempt.stage.value, attempt.kind)
            self.tell({attempt.job_id: state})

    def flush(self) -> None:
        """Add what was counted since the last time to the sums that Prometheus reads."""
        self._tally.flush()

    def _apply(self, event: Event) -> None:
        if event.kind is EventKind.STARTED:
            if event.stage is not Stage.INGEST and (
                started := self._parts.index.live.set_running(event.task_id, event.worker)
            ):
                self.tell(dict([started]))
        elif event.kind is EventKind.FINISHED:
            self.finished(Stage.INGEST, event.output)
        elif event.kind is EventKind.FAILED:
            self.failed(read_record(AttemptRecord, self._parts.store, attempt_key(event.task_id, event.attempt)))
        elif event.kind is EventKind.LEFT:
            self._parts.index.live.forget_worker(event.worker)
        elif event.kind is EventKind.DEFERRED:
            self._tally.handed_back(event.stage or "", event.kind.value)
            self._defer(event)
        elif event.kind in (EventKind.RETURNED, EventKind.CANCELLED):
            self._tally.handed_back(event.stage or "", event.kind.value)
            self._wait_again(event, 0.0, None)

    def _defer(self, event: Event) -> None:
        count = self._deferrals[event.task_id] = self._deferrals.get(event.task_id, 0) + 1
        wait = backoff(self._parts.settings.retry_backoff_s, count)
        self._wait_again(event, time.time() + wait, f"waits: {event.message}")

    def _wait_again(self, event: Event, not_before: float, message: str | None) -> None:
        if event.stage is Stage.INGEST:
            digest = event.output.partition("/")[2]
            self._parts.index.live.set_asset_waiting([digest], queued=False, not_before=not_before)
        else:
            self.tell(self._parts.index.live.set_waiting([event.task_id], not_before=not_before, message=message))


@contextmanager
def _left_out(what: str) -> Iterator[None]:
    """Anybody who can write to Redis can put an event there: a bad one must not stop those behind it."""
    try:
        yield
    except UnavailableError:
        raise
    except Exception:
        log.exception("%s is left out", what)
