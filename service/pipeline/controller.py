"""Controller: one loop for all work outside workers. After a kill, another controller continues.

A round indexes events and queues missing tasks. One controller leads, and the others wait (`service.pipeline.leading`).
"""

import logging
import math
import threading
import time
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Final

from graspd.service.index.notes import StoreMark
from graspd.service.index.rebuild import mark_complete_if_new, rebuild
from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.errors import BusyError, DamagedError, NotFoundError, StoreUnavailable, UnavailableError
from graspd.service.model.messages import WorkerHeartbeat, requirements_of
from graspd.service.model.planning import RoundRobin, ingest_id, ingest_message
from graspd.service.model.records import JobRecord
from graspd.service.model.states import Priority
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets.actions import DatasetController
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
from graspd.service.store.packs import convert_packs
from graspd.service.store.records import newest_mark, next_mark, read_record, set_mark
from graspd.service.telemetry import HeartbeatFile

log = logging.getLogger(__name__)
#: Maximum number of events of one round, which takes about a second. The next round follows at once.
_EVENTS_A_ROUND: Final = 2000
#: Number of events that wait for the store above which no more are read from the stream.
_LONGEST_BACKLOG: Final = 10_000
_FORGET_WORKERS_AFTER_S: Final = 3600.0
_WORKERS_EVERY_S: Final = 2.0
#: Time [s] for which the capabilities of a silent worker still count.
_REMEMBERED_S: Final = 60.0
#: Interval [s] at which progress of tasks is written to the index: the polling interval of pages.
_PROGRESS_EVERY_S: Final = 0.5
_LONGEST_PAUSE_S: Final = 5.0
_COLLECT_EVERY_S: Final = 5.0
#: Interval of the check that store and index still belong to this service.
_IDENTIFY_EVERY_S: Final = 30.0
#: Maximum time [s] to wait for background threads after a stop.
_LAST_READ_S: Final = 3.0
#: Minimum pause [s] between two parts of large jobs: longer than the sleep of a writer that waits for SQLite.
_ENTERING_GAP_S: Final = 0.15


class Controller:
    """Index events, queue ready tasks, recover tasks of lost workers, update the list of workers."""

    def __init__(self, services: Services, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._services = services
        self._indexer = Indexer(services)
        self._reaper = LeaseReaper(services, self._indexer, clock=clock)
        self._planner = DatasetController(services, clock=clock)
        self._garbage = GarbageCollector(services, clock=clock)
        self._known: str | None = None
        """Mark of the index when it last matched the store's mark."""
        self._has_plans = False
        self._turns = RoundRobin()
        self._backlog: list[tuple[str, Event]] = []
        self._routes = Routes()
        self._seen: dict[str, tuple[float, WorkerHeartbeat]] = {}
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
            PeriodicDuty(clock, services.queue.remove_stale_keys, _WORKERS_EVERY_S),
            PeriodicDuty(clock, self._renew_mark, _WORKERS_EVERY_S),
            PeriodicDuty(clock, self._indexer.flush, _WORKERS_EVERY_S),
            PeriodicDuty(clock, self._check_workers, _WORKERS_EVERY_S, share=0.1),
            # Each lease is checked at least three times before it counts as lost.
            PeriodicDuty(clock, self._reconcile_queue, interval_s, longest_s=services.settings.lease_s / 3),
            PeriodicDuty(clock, self._queue_new_tasks, 0.0),
            PeriodicDuty(clock, self._publish_progress, min(_PROGRESS_EVERY_S, interval_s), share=0.1),
            # The index is unlocked for at least as long as it was locked.
            PeriodicDuty(clock, self._enter_large_job, _ENTERING_GAP_S, share=0.5),
            PeriodicDuty(clock, self._plan_datasets, interval_s),
            PeriodicDuty(clock, lambda: self._garbage.execute_deletions() or self._garbage.collect(), _COLLECT_EVERY_S),
        ]

    def run(self, stop: threading.Event) -> None:
        """Run rounds until `stop` is set; wait with growing pauses for an unavailable backend."""
        with self._background_duties(stop):
            self._run_rounds(stop)

    @contextmanager
    def _background_duties(self, stop: threading.Event) -> Iterator[None]:
        """Deliver webhooks, and run the integrity scan if enabled, in threads beside the rounds."""
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

    def _run_rounds(self, stop: threading.Event) -> None:
        pause = 0.0
        while not stop.is_set():
            # The heartbeat continues while a backend is unavailable, because a restart would not help.
            self._alive.touch()
            try:
                self.run_round(wait_s=self._services.settings.controller_interval_s)
                pause = 0.0
            except BusyError:
                raise  # Another service has taken over the store.
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
                self._renew_mark()

    def run_round(self, *, wait_s: float = 0.0) -> None:
        """Index new events, then run due duties; BusyError if another service has taken over the store."""
        self._identify()
        if not self._started:
            self._start()
        elif self._services.index.notes.completeness() is None or self._is_stale():
            self._rebuild_index()
        away: list[UnavailableError] = []
        with _log_failures(away):
            self._index_events(0.0 if self._has_plans else min(wait_s, _PROGRESS_EVERY_S))
        for duty in self._duties:
            with _log_failures(away):
                duty()
        if away:
            raise away[0]

    def _renew_mark(self) -> None:
        """After changes, give index and store a new common mark, by which an older copy of either is detected."""
        notes = self._services.index.notes
        present, changes = notes.store_mark(), notes.change_count()
        if changes != present.changes or self._made:
            fresh = next_mark(present.mark)
            notes.set_store_mark(StoreMark(fresh, newest_mark(self._services.store), changes))
            set_mark(self._services.store, fresh)
            notes.set_store_mark(StoreMark(fresh, fresh, changes))
            self._known, self._made = fresh, False

    def _publish_progress(self) -> None:
        """Write progress of tasks that workers report to the index, if it has changed."""
        busy = (beat for beat in self._services.queue.workers() if beat.task_id)
        found = {beat.task_id: (beat.done, beat.total, beat.message) for beat in busy}
        if changed := {task: one for task, one in found.items() if self._progress.get(task) != one}:
            self._services.index.live.set_progress(changed)
        self._progress = found

    def _plan_datasets(self) -> bool:
        self._has_plans = self._planner.advance()
        return self._has_plans

    def _enter_large_job(self) -> None:
        """Enter the next tasks of a job too large for one transaction; such jobs take turns."""
        if not (jobs := self._services.index.write.partly_entered_jobs()):
            return
        self._entered = next((job for job in jobs if job > self._entered), jobs[0])
        record = None
        try:
            record = read_record(JobRecord, self._services.store, names.job_record_key(self._entered))
        except (NotFoundError, DamagedError) as error:
            log.error("the remaining tasks of job %s are not entered: %s", self._entered, error)
        self._services.index.write.enter_next_tasks(self._entered, record)

    def _check_workers(self) -> None:
        self._announce()
        present = self._services.queue.workers()
        self._workers = len(present)
        # The capabilities of a briefly silent worker still count, so that its tasks are not held back.
        now = self._clock()
        self._seen |= {beat.name: (now, beat) for beat in present}
        self._seen = {name: one for name, one in self._seen.items() if now - one[0] < _REMEMBERED_S}
        known = [beat for _, beat in self._seen.values()]
        self._routes = Routes(known)
        self._services.queue.remove_unserved_lists(known)
        # A worker that ends is unregistered shortly before its event arrives: only a longer silence means a loss.
        lost, forgotten = timestamp(self._services.settings.lease_s), timestamp(_FORGET_WORKERS_AFTER_S)
        self._services.index.live.set_workers(present, lost_before=lost, forget_before=forgotten)

    def _start(self) -> None:
        publish_builtins(self._services.store)
        for manifest in convert_packs(self._services.store):
            self._alive.touch()
            self._indexer.index_shard(manifest)
        mark_complete_if_new(self._services.index, self._services.store)
        made = self._services.index.notes.completeness()
        # Records that an earlier rebuild omitted may have been repaired.
        if made is None or made.left_out or self._is_stale():
            self._rebuild_index()
        else:
            for kind, digest in stored_assets(self._services.store):
                try:
                    self._indexer.index_asset(kind, digest)
                except DamagedError as error:
                    log.warning("%s", error)
        self._started = True

    def _is_stale(self) -> bool:
        """Return whether index or store was replaced by an older copy; if so, mark the index as incomplete."""
        present = self._services.index.notes.store_mark()
        # After a kill between the writes of `_renew_mark`, the store has the previous mark.
        if present.mark == self._known or newest_mark(self._services.store) in (present.mark, present.before):
            self._known = present.mark
            return False
        log.warning("index and store have different marks: one of them is an older copy")
        self._services.index.notes.set_incomplete()
        return True

    def _rebuild_index(self) -> None:
        log.warning("the index may lack records of the store: it is rebuilt from the store")
        rebuild(self._services.index, self._services.store, progress=lambda *_: self._alive.touch())

    def _index_events(self, wait_s: float) -> None:
        """Apply new events; events that need an unavailable store wait in the backlog."""
        if len(self._backlog) < _LONGEST_BACKLOG:
            wait_s = 0.0 if self._backlog else wait_s
            self._backlog += self._services.queue.consume(limit=_EVENTS_A_ROUND, wait_s=wait_s)
        if not self._backlog:
            return
        waiting = set(self._indexer.apply([event for _, event in self._backlog]))
        done = [entry for place, entry in enumerate(self._backlog) if place not in waiting]
        self._backlog = [self._backlog[place] for place in sorted(waiting)]
        self._services.queue.acknowledge([event_id for event_id, _ in done])
        if any(event.kind is not EventKind.JOB for _, event in done):
            self._has_news = self._made = True
        if waiting:
            raise StoreUnavailable(f"the store does not answer, and {len(waiting)} events wait for it")

    def _announce(self) -> None:
        self._services.queue.announce(PART, 5 * self._services.settings.controller_interval_s + 5)

    def _reconcile_queue(self) -> None:
        # While Redis refuses writes, workers cannot send heartbeats: this write fails first, so none counts as lost.
        self._announce()
        # Waiting tasks are read before leases: a task that is taken in between then counts as leased.
        waiting = self._services.queue.waiting_tasks()
        leases = self._services.queue.leases()
        lost = self._reaper.reap(leases)
        present = waiting | {lease.task_id for lease in leases if lease not in lost}
        if stray := self._services.index.feed.cancelled_tasks(present):
            self._services.queue.discard(stray)
        missing = {*self._reaper.find_missing(present), *(lease.task_id for lease in lost)}
        self._queue_ready_tasks(present, missing)

    def _queue_new_tasks(self) -> None:
        if self._has_news:
            self._queue_ready_tasks()

    def _queue_ready_tasks(self, present: set[str] | None = None, missing: Collection[str] = ()) -> None:
        """Queue ready tasks that are not in `present`, the queue's content (None: use the index's marks).

        The queue refuses a second entry of a task, except of `missing` tasks.
        """
        depths = self._services.queue.depths()
        now = time.time()
        # At least two tasks per worker, so that a worker never waits for its next task.
        window = max(self._services.settings.queue_window, 2 * self._workers)
        held: set[str] = set()
        for priority in Priority:
            room = max(0, window - sum(n for (of, _), n in depths.items() if of is priority))
            ready = self._services.index.feed.ready_tasks(priority, self._turns, now=now, limit=room) if room else []
            if present is None:
                held |= queue_tasks(self._services, ready, routes=self._routes)
                continue
            # A rebuilt index lacks the marks of queued tasks.
            self._services.index.live.set_queued([task.task.id for task in ready if task.task.id in present])
            left = [task for task in ready if task.task.id not in present]
            for again in (False, True):
                if some := [task for task in left if (task.task.id in missing) == again]:
                    held |= queue_tasks(self._services, some, again=again, routes=self._routes)
        for why in sorted(held - self._held):
            log.warning("tasks are %s", why)
        self._held = held
        self._queue_checks(present, missing, now)
        self._has_news = False

    def _queue_checks(self, present: set[str] | None, missing: Collection[str], now: float) -> None:
        for check in self._services.index.feed.ready_checks(now=now, limit=self._services.settings.queue_window):
            self._services.index.live.set_asset_waiting([check.digest], queued=True)
            if self._services.store.exists(names.asset_key(check.kind, check.digest, "check.json")):
                with _log_failures([]):
                    self._indexer.index_asset(check.kind, check.digest)
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


@dataclass
class PeriodicDuty:
    """Work of a round that runs at most once per `every_s` [s] and for at most `share` of the time.

    After an error, or a result True (work is left), the work runs again in the next round.
    """

    clock: Callable[[], float]
    work: Callable[[], object]
    every_s: float
    share: float = 0.2
    longest_s: float = math.inf
    """Limit [s] of the pause that follows from `share`."""
    due: float = -math.inf

    def __call__(self) -> None:
        begun = self.clock()
        if begun < self.due:
            return
        is_left = self.work() is True
        ended = self.clock()
        pause = max(self.every_s, (ended - begun) * (1 / self.share - 1))
        self.due = ended if is_left else ended + min(pause, max(self.every_s, self.longest_s))
