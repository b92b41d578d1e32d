"""Controller: one loop for all work outside workers. After a kill, another controller continues.

A round writes events to the index, and queues unfinished tasks of the index that the queue lacks. One controller leads;
the others stand by (`service.pipeline.leading`).
"""

from __future__ import annotations

import logging
import math
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from typing import Final

from graspd.service.index.notes import StoreMark
from graspd.service.index.rebuild import complete_if_new, rebuild
from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.errors import BusyError, DamagedError, NotFoundError, StoreUnavailable, UnavailableError
from graspd.service.model.messages import WorkerBeat, requirements_of
from graspd.service.model.planning import RoundRobin, ingest_id, ingest_message
from graspd.service.model.records import JobRecord
from graspd.service.model.states import Priority
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets.actions import DatasetRounds
from graspd.service.pipeline.deletion import GarbageCollector
from graspd.service.pipeline.identity import identify
from graspd.service.pipeline.indexer import Indexer
from graspd.service.pipeline.integrity import IntegrityScan
from graspd.service.pipeline.job_actions import HELD_S, Routes, queue_tasks
from graspd.service.pipeline.leading import PART
from graspd.service.pipeline.lease_reaper import LeaseReaper
from graspd.service.pipeline.webhook_dispatcher import WebhookDispatcher
from graspd.service.queue.port import Event, EventKind
from graspd.service.store.library import publish_builtins, stored_assets
from graspd.service.store.packs import unpack_all
from graspd.service.store.records import newest_mark, next_mark, read_record, set_mark
from graspd.service.telemetry import HeartbeatFile

log = logging.getLogger(__name__)
#: Maximum number of events of one round, about one second of work. The next round follows at once.
_EVENTS_A_ROUND: Final = 2000
#: Maximum number of events that may wait for the store; above this, no more are read from the stream.
_LONGEST_BACKLOG: Final = 10_000
_FORGET_WORKERS_AFTER_S: Final = 3600.0
_WORKERS_EVERY_S: Final = 2.0
#: Validity of a worker's capabilities after its last registration [s].
_REMEMBERED_S: Final = 60.0
#: Interval at which progress of tasks is published, equal to the polling interval of pages [s].
_PROGRESS_EVERY_S: Final = 0.5
_LONGEST_PAUSE_S: Final = 5.0
_COLLECT_EVERY_S: Final = 5.0
#: Interval of the check that store and index still belong to this service.
_IDENTIFY_EVERY_S: Final = 30.0
#: Longest wait [s] for a running read of the store after a stop.
_LAST_READ_S: Final = 3.0
#: Least wait between two parts of large jobs [s]: longer than the sleep of a writer that waits for SQLite.
_ENTERING_GAP_S: Final = 0.15


class Controller:
    """Index events, queue ready tasks, recover tasks of lost workers, update the list of workers."""

    def __init__(self, services: Services, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._services = services
        self._indexer = Indexer(services)
        self._reaper = LeaseReaper(services, self._indexer, clock=clock)
        self._planner = DatasetRounds(services, clock=clock)
        self._garbage = GarbageCollector(services, clock=clock)
        self._known: str | None = None
        """Mark of the index when it last matched the store's mark."""
        self._has_plans = False
        self._turns = RoundRobin()
        self._backlog: list[tuple[str, Event]] = []
        self._routes = Routes()
        self._seen: dict[str, tuple[float, WorkerBeat]] = {}
        self._held: set[str] = set()
        self._has_news = False
        """Whether events arrived since the last fill of the queue."""
        self._made = False
        """Whether events arrived since the last mark of store and index."""
        self._started = False
        self._alive = HeartbeatFile(services.settings.heartbeat_file)
        self._workers = 0
        self._clock = clock
        self._progress: dict[str, tuple[float, float, str]] = {}
        interval_s = services.settings.controller_interval_s
        self._entered = ""
        self._identify = PeriodicDuty(clock, lambda: identify(services, holds_redis=True), _IDENTIFY_EVERY_S)
        self._duties = [
            PeriodicDuty(clock, services.queue.tidy, _WORKERS_EVERY_S),
            PeriodicDuty(clock, self._mark, _WORKERS_EVERY_S),
            PeriodicDuty(clock, self._indexer.flush, _WORKERS_EVERY_S),
            PeriodicDuty(clock, self._check_workers, _WORKERS_EVERY_S, share=0.1),
            # A lease is checked three times before it counts as lost.
            PeriodicDuty(clock, self._reconcile_queue, interval_s, longest_s=services.settings.lease_s / 3),
            PeriodicDuty(clock, self._feed_new, 0.0),
            PeriodicDuty(clock, self._publish_progress, min(_PROGRESS_EVERY_S, interval_s), share=0.1),
            # The index is free for at least as long as it was locked.
            PeriodicDuty(clock, self._enter_large_job, _ENTERING_GAP_S, share=0.5),
            PeriodicDuty(clock, self._plan, interval_s),
            PeriodicDuty(clock, lambda: self._garbage.advance() or self._garbage.collect(), _COLLECT_EVERY_S),
        ]

    def run(self, stop: threading.Event) -> None:
        """Run rounds until `stop` is set; wait with growing pauses for an unavailable backend."""
        with self._background_duties(stop):
            self._run(stop)

    @contextmanager
    def _background_duties(self, stop: threading.Event) -> Iterator[None]:
        """Run webhooks, and the integrity scan if enabled, in parallel with the rounds."""
        duties = {"webhooks": WebhookDispatcher(self._services, stop).run}
        if self._services.settings.integrity_scan_mb_per_s:
            duties["integrity scan"] = IntegrityScan(self._services, stop).run
        threads = [threading.Thread(target=duty, name=name, daemon=True) for name, duty in duties.items()]
        for thread in threads:
            thread.start()
        try:
            yield
        finally:
            stop.set()
            for thread in threads:
                thread.join(_LAST_READ_S)

    def _run(self, stop: threading.Event) -> None:
        pause = 0.0
        while not stop.is_set():
            # The heartbeat goes on while a backend is unavailable: a restarted controller would wait just as long.
            self._alive.touch()
            try:
                self.round(wait_s=self._services.settings.controller_interval_s)
                pause = 0.0
            except BusyError:
                raise  # Another service has taken over the store; further rounds would undo its work.
            except UnavailableError as error:
                pause = min(_LONGEST_PAUSE_S, max(0.25, 2 * pause))
                log.warning("%s; the controller tries again in %.2g s", error, pause)
                stop.wait(pause)
            except Exception:
                pause = min(_LONGEST_PAUSE_S, max(1.0, 2 * pause))
                log.exception("a round failed; the controller continues in %.2g s", pause)
                stop.wait(pause)
        if self._started:
            with _log_failures([]):
                self._mark()

    def round(self, *, wait_s: float = 0.0) -> None:
        """Index new events, then check queue, leases and workers; BusyError if another service took the store."""
        self._identify()
        self._ensure_index()
        away: list[UnavailableError] = []
        with _log_failures(away):
            self._index_events(0.0 if self._has_plans else min(wait_s, _PROGRESS_EVERY_S))
        for duty in self._duties:
            with _log_failures(away):
                duty()
        if away:
            raise away[0]

    def _mark(self) -> None:
        """Renew the mark of index and store after changes, to detect and rebuild an older copy of the index."""
        notes = self._services.index.notes
        present, changes = notes.store_mark(), notes.changes()
        if changes != present.changes or self._made:
            fresh = next_mark(present.mark)
            notes.set_store_mark(StoreMark(fresh, newest_mark(self._services.store), changes))
            set_mark(self._services.store, fresh)
            notes.set_store_mark(StoreMark(fresh, fresh, changes))
            self._known, self._made = fresh, False

    def _publish_progress(self) -> None:
        """Write changed progress of tasks, from the reports of workers, to the index."""
        busy = (beat for beat in self._services.queue.workers() if beat.task_id)
        found = {beat.task_id: (beat.done, beat.total, beat.message) for beat in busy}
        if changed := {task: one for task, one in found.items() if self._progress.get(task) != one}:
            self._services.index.live.set_progress(changed)
        self._progress = found

    def _plan(self) -> bool:
        self._has_plans = self._planner.advance()
        return self._has_plans

    def _enter_large_job(self) -> None:
        """Enter the next tasks of a job too large for one transaction; other writers can run in between.

        Such jobs alternate. A note in the index stores the position, so another controller can continue.
        """
        if not (jobs := self._services.index.write.partly_entered_jobs()):
            return
        self._entered = next((job for job in jobs if job > self._entered), jobs[0])
        record = None
        try:
            record = read_record(JobRecord, self._services.store, names.job_record_key(self._entered))
        except (NotFoundError, DamagedError) as error:
            log.error("the remaining tasks of job %s are not entered: %s", self._entered, error)
        self._services.index.write.enter_more(self._entered, record)

    def _check_workers(self) -> None:
        self._announce()
        # A worker that ends is unregistered a moment before it reports this: it does not count as lost at once.
        present = self._services.queue.workers()
        self._workers = len(present)
        # A briefly silent worker still counts in the decision whether tasks are held back.
        now = self._clock()
        self._seen |= {beat.name: (now, beat) for beat in present}
        self._seen = {name: one for name, one in self._seen.items() if now - one[0] < _REMEMBERED_S}
        known = [beat for _, beat in self._seen.values()]
        self._routes = Routes(known)
        self._services.queue.clear_untaken(known)
        self._services.index.live.set_workers(
            present,
            lost_before=timestamp(self._services.settings.lease_s),
            forget_before=timestamp(_FORGET_WORKERS_AFTER_S),
        )

    def _ensure_index(self) -> None:
        """Ensure that the index is complete before events are applied, because it may be lost at any time."""
        if not self._started:
            self._start()
        elif self._services.index.notes.completeness() is None or self._is_stale():
            self._rebuild_index()

    def _start(self) -> None:
        publish_builtins(self._services.store)
        for manifest in unpack_all(self._services.store):
            self._alive.touch()
            self._indexer.index_shard(manifest)
        complete_if_new(self._services.index, self._services.store)
        made = self._services.index.notes.completeness()
        # Omitted records may be repaired by now.
        if made is None or made.left_out or self._is_stale():
            self._rebuild_index()
        else:
            self._index_assets()
        self._started = True

    def _is_stale(self) -> bool:
        """Return whether index or store was replaced by an older copy."""
        present = self._services.index.notes.store_mark()
        # A kill between the two writes leaves the previous mark in the store.
        if present.mark == self._known or newest_mark(self._services.store) in (present.mark, present.before):
            self._known = present.mark
            return False
        log.warning("index and store have different marks: one of them is an older copy")
        self._services.index.notes.set_incomplete()
        return True

    def _rebuild_index(self) -> None:
        log.warning("the index may lack records of the store: it is rebuilt from the store")
        rebuild(self._services.index, self._services.store, progress=lambda *_: self._alive.touch())

    def _index_assets(self) -> None:
        for kind, digest in stored_assets(self._services.store):
            try:
                self._indexer.checked(kind, digest)
            except DamagedError as error:
                log.warning("%s", error)

    def _index_events(self, wait_s: float) -> None:
        """Apply new events; events that need the store wait while it is unavailable."""
        if len(self._backlog) < _LONGEST_BACKLOG:
            wait_s = wait_s if not self._backlog else 0.0
            self._backlog += self._services.queue.consume(limit=_EVENTS_A_ROUND, wait_s=wait_s)
        if not self._backlog:
            return
        waiting = set(self._indexer.apply([event for _, event in self._backlog]))
        done = [entry for place, entry in enumerate(self._backlog) if place not in waiting]
        self._backlog = [entry for place, entry in enumerate(self._backlog) if place in waiting]
        self._services.queue.acknowledge([event_id for event_id, _ in done])
        self._has_news |= (made := any(event.kind is not EventKind.JOB for _, event in done))
        self._made |= made
        if waiting:
            raise StoreUnavailable(f"the store does not answer, and {len(waiting)} events wait for it")

    def _announce(self) -> None:
        self._services.queue.announce(PART, 5 * self._services.settings.controller_interval_s + 5)

    def _reconcile_queue(self) -> None:
        # If Redis is readable but not writable, as on a full disk, no worker can send a heartbeat. This call then fails
        # first, and no worker counts as lost.
        self._announce()
        # Waiting tasks are read before leases, so that a task taken in between counts as leased.
        waiting = self._services.queue.waiting()
        leases = self._services.queue.leases()
        lost = self._reaper.reap(leases)
        present = waiting | {lease.task_id for lease in leases if lease not in lost}
        if stray := self._services.index.feed.cancelled(present):
            self._services.queue.discard(stray)
        missing = {*self._reaper.find_missing(present), *(lease.task_id for lease in lost)}
        self._feed(present, missing)
        self._has_news = False

    def _feed_new(self) -> None:
        if self._has_news:
            self._feed()
            self._has_news = False

    def _feed(self, present: set[str] | None = None, missing: Collection[str] = ()) -> None:
        """Queue ready tasks; without the queue's content (`present`), the marks of the index decide.

        The queue refuses a second entry of a task, even from a concurrent request, except for `missing` tasks.
        """
        depths = self._services.queue.depths()
        now = time.time()
        # Two tasks per worker, so that a worker that ends a task finds another one waiting.
        window = max(self._services.settings.queue_window, 2 * self._workers)
        held: set[str] = set()
        for priority in Priority:
            room = max(0, window - sum(n for (of, _), n in depths.items() if of is priority))
            ready = self._services.index.feed.ready_tasks(priority, self._turns, now=now, limit=room) if room else []
            if present is None:
                held |= queue_tasks(self._services, ready, routes=self._routes)
                continue
            # After a rebuild the index has no marks of queued tasks.
            self._services.index.live.set_queued([task.task.id for task in ready if task.task.id in present])
            left = [task for task in ready if task.task.id not in present]
            for again in (False, True):
                if some := [task for task in left if (task.task.id in missing) == again]:
                    held |= queue_tasks(self._services, some, again=again, routes=self._routes)
        for why in sorted(held - self._held):
            log.warning("tasks are %s", why)
        self._held = held
        self._feed_checks(present, missing, now)

    def _feed_checks(self, present: set[str] | None, missing: Collection[str], now: float) -> None:
        for check in self._services.index.feed.ready_checks(now=now, limit=self._services.settings.queue_window):
            self._services.index.live.set_asset_waiting([check.digest], queued=True)
            if self._services.store.exists(names.asset_check_key(check.kind, check.digest)):
                with _log_failures([]):
                    self._indexer.checked(check.kind, check.digest)
            elif ingest_id(check.kind, check.digest) not in (present or ()):
                numbers = {"attempt": check.last_attempt + 1, "max_attempt": self._services.settings.task_attempts}
                message = ingest_message(check.kind, check.name, check.digest, **numbers)
                place = self._routes.route_of(requirements_of(message))
                if place.held:
                    self._services.index.live.set_asset_waiting([check.digest], queued=False, not_before=now + HELD_S)
                else:
                    again = message.task_id in missing
                    self._services.queue.enqueue([message], Priority.INTERACTIVE, again=again, apart=place.apart)


@contextmanager
def _log_failures(away: list[UnavailableError]) -> Iterator[None]:
    """Log an unavailable backend or a damaged record, so that independent work continues."""
    try:
        yield
    except UnavailableError as error:
        away.append(error)
    except DamagedError as error:
        log.warning("%s", error)


class PeriodicDuty:
    """Duty called in each round: runs at most once per `every_s`, and for at most `share` of the time.

    The duty also runs in the next round after an error, or after a result True, which means that work is left.
    """

    def __init__(
        self,
        clock: Callable[[], float],
        work: Callable[[], object],
        every_s: float,
        *,
        share: float = 0.2,
        longest_s: float = math.inf,
    ) -> None:
        """`longest_s` [s] is the longest pause, regardless of `share`."""
        self._clock, self._work = clock, work
        self._every_s, self._share, self._longest_s = every_s, share, longest_s
        self._again = -math.inf

    def __call__(self) -> None:
        begun = self._clock()
        if begun < self._again:
            return
        is_left = self._work() is True
        ended = self._clock()
        pause = max(self._every_s, (ended - begun) * (1 / self._share - 1))
        self._again = ended if is_left else ended + min(pause, max(self._every_s, self._longest_s))
