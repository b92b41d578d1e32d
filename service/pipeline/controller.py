"""The controller: one loop that runs what must not run in a worker. Killed at any moment, its successor goes on.

It reconciles: events become rows, and what the index calls unfinished and the queue does not know is queued again. Of
several controllers one leads, and the others stand by (`service.pipeline.leading`).
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
from graspd.service.model.planning import RoundRobin, ingest_id, ingest_message
from graspd.service.model.records import JobRecord
from graspd.service.model.states import Priority
from graspd.service.model.workers import WorkerBeat, need_of
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets.rounds import DatasetRounds
from graspd.service.pipeline.garbage_collector import GarbageCollector
from graspd.service.pipeline.identity import identify
from graspd.service.pipeline.indexer import Indexer
from graspd.service.pipeline.integrity_scan import IntegrityScan
from graspd.service.pipeline.job_actions import HELD_S, queue_tasks
from graspd.service.pipeline.leading import PART
from graspd.service.pipeline.lease_reaper import LeaseReaper
from graspd.service.pipeline.routes import Routes
from graspd.service.pipeline.webhook_dispatcher import WebhookDispatcher
from graspd.service.queue.port import Event, EventKind
from graspd.service.store.library import publish_builtins, stored_assets
from graspd.service.store.packs import take_apart
from graspd.service.store.records import newest_mark, next_mark, read_record, set_mark
from graspd.service.telemetry import HeartbeatFile

log = logging.getLogger(__name__)
#: Events of one round: a second's work. Those behind them wait for the next round, which follows at once.
_EVENTS_A_ROUND: Final = 2000
#: Events that wait for the store; while there are more, no further ones are taken from the stream.
_LONGEST_BACKLOG: Final = 10_000
_FORGET_WORKERS_AFTER_S: Final = 3600.0
_WORKERS_EVERY_S: Final = 2.0
#: How long what a worker can do counts after it was last seen.
_REMEMBERED_S: Final = 60.0
#: How often the progress of tasks is passed on: as often as pages ask for it.
_PROGRESS_EVERY_S: Final = 0.5
_LONGEST_PAUSE_S: Final = 5.0
_COLLECT_EVERY_S: Final = 5.0
#: How often it looks whether store and index are still its service's.
_IDENTIFY_EVERY_S: Final = 30.0
#: What a read of the store that is under way has to end, once the controller stops [s].
_LAST_READ_S: Final = 3.0
#: Least wait between two pieces of large jobs [s]: longer than SQLite lets a waiting writer sleep.
_ENTERING_GAP_S: Final = 0.15


class Controller:
    """Indexes events, queues what is ready, takes tasks from lost workers, keeps the list of workers."""

    def __init__(self, services: Services, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._services = services
        self._indexer = Indexer(services)
        self._reaper = LeaseReaper(services, self._indexer, clock=clock)
        self._planner = DatasetRounds(services, clock=clock)
        self._garbage = GarbageCollector(services, clock=clock)
        self._known: str | None = None
        """Mark that the index had when it was last compared with the store's."""
        self._has_plans = False
        self._turns = RoundRobin()
        self._backlog: list[tuple[str, Event]] = []
        self._routes = Routes()
        self._seen: dict[str, tuple[float, WorkerBeat]] = {}
        self._held: set[str] = set()
        """Why tasks were held back when the queue was last filled."""
        self._has_news = False
        """Whether anything came in since the queue was filled."""
        self._made = False
        """Whether anything came in since store and index got their mark."""
        self._started = False
        self._alive = HeartbeatFile(services.settings.heartbeat_file)
        self._workers = 0
        """Workers that were there when they were last counted."""
        self._clock = clock
        self._progress: dict[str, tuple[float, float, str]] = {}
        """How far tasks were when it was last passed on."""
        interval_s = services.settings.controller_interval_s
        self._entered = ""
        """The large job whose next tasks were entered last."""
        self._identify = PeriodicDuty(clock, lambda: identify(services, holds_redis=True), _IDENTIFY_EVERY_S)
        self._duties = [
            PeriodicDuty(clock, services.queue.tidy, _WORKERS_EVERY_S),
            PeriodicDuty(clock, self._mark, _WORKERS_EVERY_S),
            PeriodicDuty(clock, self._indexer.flush, _WORKERS_EVERY_S),
            PeriodicDuty(clock, self._look_after_workers, _WORKERS_EVERY_S, share=0.1),
            # Each lease is seen three times before it can be called lost.
            PeriodicDuty(clock, self._look_after_queue, interval_s, longest_s=services.settings.lease_s / 3),
            PeriodicDuty(clock, self._feed_new, 0.0),
            PeriodicDuty(clock, self._pass_on_progress, min(_PROGRESS_EVERY_S, interval_s), share=0.1),
            # The index is free for at least as long as it was held.
            PeriodicDuty(clock, self._enter_large_job, _ENTERING_GAP_S, share=0.5),
            PeriodicDuty(clock, self._plan, interval_s),
            PeriodicDuty(clock, lambda: self._garbage.advance() or self._garbage.collect(), _COLLECT_EVERY_S),
        ]

    def run(self, stop: threading.Event) -> None:
        """Rounds until told to stop. Where a part is away, waits longer and longer, and loses nothing."""
        with self._beside(stop):
            self._run(stop)

    @contextmanager
    def _beside(self, stop: threading.Event) -> Iterator[None]:
        """What goes on beside the rounds: webhooks are told what ended; where settings want it, the store is read."""
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
            # Also while a part is away: a fresh controller would wait for it just as long.
            self._alive.touch()
            try:
                self.round(wait_s=self._services.settings.controller_interval_s)
                pause = 0.0
            except BusyError:
                raise  # another service works here: to go on would undo its work
            except UnavailableError as error:
                pause = min(_LONGEST_PAUSE_S, max(0.25, 2 * pause))
                log.warning("%s; the controller tries again in %.2g s", error, pause)
                stop.wait(pause)
            except Exception:
                pause = min(_LONGEST_PAUSE_S, max(1.0, 2 * pause))
                log.exception("a round broke off; the controller goes on in %.2g s", pause)
                stop.wait(pause)
        if self._started:
            with _noted([]):
                self._mark()

    def round(self, *, wait_s: float = 0.0) -> None:
        """Index what came in, then look after queue, leases and workers.

        Raises:
            UnavailableError: a part is away; the round can be run again.
            BusyError: another service has taken over the store.
        """
        self._identify()
        self._see_to_the_index()
        away: list[UnavailableError] = []
        with _noted(away):
            self._index_events(0.0 if self._has_plans else min(wait_s, _PROGRESS_EVERY_S))
        for duty in self._duties:
            with _noted(away):
                duty()
        if away:
            raise away[0]

    def _mark(self) -> None:
        """Give index and store a new mark if users or workers changed anything: an index that was copied before has
        another one than the store, and is made anew."""
        notes = self._services.index.notes
        present, changes = notes.marked(), notes.changes()
        if changes != present.changes or self._made:
            fresh = next_mark(present.mark)
            notes.set_marked(StoreMark(fresh, newest_mark(self._services.store), changes))
            set_mark(self._services.store, fresh)
            notes.set_marked(StoreMark(fresh, fresh, changes))
            self._known, self._made = fresh, False

    def _pass_on_progress(self) -> None:
        """What changed in how far tasks are, as their workers say."""
        busy = (beat for beat in self._services.queue.workers() if beat.task_id)
        found = {beat.task_id: (beat.done, beat.total, beat.message) for beat in busy}
        if changed := {task: one for task, one in found.items() if self._progress.get(task) != one}:
            self._services.index.live.set_progress(changed)
        self._progress = found

    def _plan(self) -> bool:
        self._has_plans = self._planner.advance()
        return self._has_plans

    def _enter_large_job(self) -> None:
        """The next tasks of a job that has too many for one turn of the index's writers: others write in between.

        Such jobs alternate. Killed at any moment, the successor goes on where a note in the index says.
        """
        if not (jobs := self._services.index.write.entering()):
            return
        self._entered = next((job for job in jobs if job > self._entered), jobs[0])
        record = None
        try:
            record = read_record(JobRecord, self._services.store, names.job_record(self._entered))
        except (NotFoundError, DamagedError) as error:
            log.error("the rest of job %s is not entered: %s", self._entered, error)
        self._services.index.write.enter_more(self._entered, record)

    def _look_after_workers(self) -> None:
        self._announce()
        # One that ended as it should says so, but its registration is gone a moment before that is read.
        present = self._services.queue.workers()
        self._workers = len(present)
        # One that is silent for a moment is still there for what it cannot do.
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

    def _see_to_the_index(self) -> None:
        """It must be whole before events are taken up, and may be lost at any time."""
        if not self._started:
            self._start()
        elif self._services.index.notes.completeness() is None or self._is_stale():
            self._make_whole()

    def _start(self) -> None:
        publish_builtins(self._services.store)
        for manifest in take_apart(self._services.store):
            self._alive.touch()
            self._indexer.made(manifest)
        complete_if_new(self._services.index, self._services.store)
        made = self._services.index.notes.completeness()
        # What was left out may have been fixed since.
        if made is None or made.left_out or self._is_stale():
            self._make_whole()
        else:
            self._index_assets()
        self._started = True

    def _is_stale(self) -> bool:
        """Whether the index, or the store, was exchanged for an older copy."""
        present = self._services.index.notes.marked()
        # Killed between the two, a controller leaves the store with the mark before.
        if present.mark == self._known or newest_mark(self._services.store) in (present.mark, present.before):
            self._known = present.mark
            return False
        log.warning("index and store have different marks: one of them is an older copy")
        self._services.index.notes.set_incomplete()
        return True

    def _make_whole(self) -> None:
        log.warning("the index may lack what the store has: it is made from the store")
        rebuild(self._services.index, self._services.store, progress=lambda *_: self._alive.touch())

    def _index_assets(self) -> None:
        for kind, digest in stored_assets(self._services.store):
            try:
                self._indexer.checked(kind, digest)
            except DamagedError as error:
                log.warning("%s", error)

    def _index_events(self, wait_s: float) -> None:
        """Take up what came in; what the store is needed for waits while that is away."""
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

    def _look_after_queue(self) -> None:
        # While Redis can be read but not written, as on a full disk, no worker can give a sign of life: then this fails
        # first, and nobody's silence is validated.
        self._announce()
        # Waiting tasks are read before leases: one that a worker takes in between is then seen as held.
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
        """What became ready by what came in, without a wait."""
        if self._has_news:
            self._feed()
            self._has_news = False

    def _feed(self, present: set[str] | None = None, missing: Collection[str] = ()) -> None:
        """Queue what is ready. Where nobody knows what is in the queue (`present`), the index's own marks say so, and
        what the queue knows of a task keeps it from being queued twice: also one that its job queues at this moment.
        Only those that are `missing` are queued whatever the queue knows of them."""
        depths = self._services.queue.depths()
        now = time.time()
        # Every worker finds a task waiting when it ends one.
        window = max(self._services.settings.queue_window, 2 * self._workers)
        held: set[str] = set()
        for priority in Priority:
            room = window - sum(n for (of, _), n in depths.items() if of is priority)
            ready = (
                self._services.index.feed.ready_tasks(priority, self._turns, now=now, limit=room) if room > 0 else []
            )
            if present is None:
                held |= queue_tasks(self._services, ready, routes=self._routes)
                continue
            # After a rebuild the index does not know what is in the queue already.
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
            if self._services.store.exists(names.asset_check(check.kind, check.digest)):
                with _noted([]):
                    self._indexer.checked(check.kind, check.digest)
            elif ingest_id(check.kind, check.digest) not in (present or ()):
                message = ingest_message(
                    check.kind,
                    check.name,
                    check.digest,
                    attempt=check.last_attempt + 1,
                    max_attempt=self._services.settings.task_attempts,
                )
                place = self._routes.place(need_of(message))
                if place.held:
                    self._services.index.live.set_asset_waiting([check.digest], queued=False, not_before=now + HELD_S)
                else:
                    again = message.task_id in missing
                    self._services.queue.enqueue([message], Priority.INTERACTIVE, again=again, apart=place.apart)


@contextmanager
def _noted(away: list[UnavailableError]) -> Iterator[None]:
    """A part that is away, or one damaged record, must not keep the controller from what does not need it."""
    try:
        yield
    except UnavailableError as error:
        away.append(error)
    except DamagedError as error:
        log.warning("%s", error)


class PeriodicDuty:
    """What need not be done in every round: once in `every_s`, and no more than `share` of the time.

    It is called in each, and where the work breaks off, or answers True for something left to do, also does it in the
    next one.
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
        """`longest_s` is the longest pause, whatever the share then is [s]."""
        self._clock, self._work = clock, work
        self._every_s, self._share, self._longest_s = every_s, share, longest_s
        self._again = -math.inf

    def __call__(self) -> None:
        """Do it if it is due."""
        begun = self._clock()
        if begun < self._again:
            return
        is_left = self._work() is True
        ended = self._clock()
        pause = max(self._every_s, (ended - begun) * (1 / self._share - 1))
        self._again = ended if is_left else ended + min(pause, max(self._every_s, self._longest_s))
