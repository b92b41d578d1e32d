"""The worker process: RQ's loop with graspd's leases, stop reasons and outcomes.

Everything runs in this one process: a CUDA context does not survive a fork, and a new process for each task would load
kernels and meshes anew each time.
"""

from __future__ import annotations

import logging
import math
import os
import secrets
import socket
import time
from collections.abc import Collection, Mapping
from datetime import UTC, datetime
from typing import Any, Final

from redis.exceptions import ResponseError
from rq import SimpleWorker
from rq.job import JobStatus
from rq.serializers import JSONSerializer

from service.model.ability import own_ability
from service.model.clock import timestamp
from service.model.errors import QueueUnavailable, TaskRefused
from service.model.states import Stage
from service.model.version import PACKAGE_VERSION
from service.model.worker_beat import WorkerBeat
from service.pipeline.identity import check_queue
from service.queue import allowed
from service.queue.address import redis_url
from service.queue.lists import queue_names
from service.queue.port import Event
from service.queue.rq_queue import RqQueue, open_queue
from service.settings import Settings
from service.store.store import open_store
from worker.engines.devices import Device
from worker.process.fitness import Check, Fitness
from worker.process.heartbeat import Heartbeat, Hold
from worker.process.runner import Runner
from worker.process.selfcheck import check_engine
from worker.process.surroundings import Surroundings
from worker.stages import stage_table
from worker.stages.context import StopReason, TaskContext
from worker.stages.output import StageFunction

log = logging.getLogger(__name__)
#: Reconnection attempts of a worker, about a minute's worth: longer than a Redis takes to come back.
_PATIENCE: Final = 60
#: RQ waits this long for a task before it looks after itself [s]: its `worker_ttl` less 15.
_WORKER_TTL_S: Final = 20
#: RQ's maintenance is off: see docs/adr/0003-silence-is-judged-by-one-clock.md.
_NEVER_S: Final = 10**9
_REFUSED_PAUSE_S: Final = 0.5
#: Longest wait between two attempts to reach Redis [s].
_LONGEST_RETRY_S: Final = 2.0


class GraspWorker(SimpleWorker):  # type: ignore[misc]
    """RQ's in-process worker. What of RQ it does without, and why, is in docs/adr."""

    def __init__(
        self,
        queue: RqQueue,
        runner: Runner,
        heart: Heartbeat,
        surroundings: Surroundings,
        fitness: Fitness,
        *,
        stages: Collection[Stage],
        name: str,
    ) -> None:
        super().__init__(
            queues=queue_names(stages, ability=own_ability()),
            name=name,
            connection=queue.connection,
            serializer=JSONSerializer,
            worker_ttl=_WORKER_TTL_S,
            maintenance_interval=_NEVER_S,
            log_job_description=False,
        )
        self.last_cleaned_at = datetime.now(UTC)
        self.max_connection_wait_time = _LONGEST_RETRY_S
        self._queue = queue
        self._runner = runner
        self._heart = heart
        self._surroundings = surroundings
        self._fitness = fitness
        self._stages, self._taken = stages, 0
        self.gave_up = False
        """Whether it ended because it is unfit for tasks."""
        self._stop_requested: bool = False
        self.found_none = False
        """Whether it ended because no task waits."""
        self.makes_room = False
        """Whether it ended so that its supervisor starts a fresh one."""
        self._context: TaskContext | None = None
        self._outcome: Event | None = None
        allowed.task_function = self._run_task

    def execute_job(self, job: Any, queue: Any) -> None:
        """One task under a lease. Its outcome is told after RQ has closed its books on it."""
        self._outcome = None
        self.prepare_execution(job)
        self._job, self._context = job, self._surroundings.context(job.args[0], self._queue)
        if self._stop_requested:
            self._context.stop(StopReason.SHUTDOWN)
        limit_s = self._surroundings.settings.task_timeout_s
        task_id = job.id.rpartition("-")[0]
        hold = Hold.of(task_id, self._context, self.execution, job.started_job_registry, limit_s)
        self._heart.hold(hold, state="stopping" if self._stop_requested else "busy")
        try:
            self.perform_job(job, queue)
        finally:
            self._heart.hold(None, state="stopping" if self._stop_requested else "idle")
            self._context = None
        self._tell_outcome()
        self._look_after_itself()
        self.set_state("idle")

    def _look_after_itself(self) -> None:
        """What a worker sees to between two tasks: is it fit, and is it time to end?"""
        if self._runner.device_lost:
            log.error("this worker ends: %s", self._runner.device_lost)
            self._heart.stopping()
            self.gave_up = self._stop_requested = True
        if self._fitness.reason and not self._stop_requested:
            fit = self._fitness.sit_out(self._stages, self._heart, lambda: self._stop_requested)
            self.gave_up = not fit and not self._stop_requested
            self._stop_requested = self._stop_requested or self.gave_up
        if why := self._surroundings.outgrown():
            log.info("this worker ends for a fresh one to start: %s", why)
            self._heart.stopping()
            self.makes_room = True
            self._stop_requested = True

    def _tell_outcome(self) -> None:
        """Of a task whose books are closed."""
        self._surroundings.tasks_done += 1
        if self._outcome is not None:
            try:
                self._queue.publish(self._outcome)
            except QueueUnavailable as error:
                log.warning("the end of task %s is for the keeper to find: %s", self._outcome.task_id, error)

    def _run_task(self, message: dict[str, Any]) -> None:
        assert self._context is not None
        self._outcome = self._runner.run(message, self._context)
        self._prepare_end()

    def _prepare_end(self) -> None:
        """See to it that RQ can close its books: Redis refuses writes on a full disk, and a task that was taken away
        has no books any more."""
        if not self.job_class.exists(self._job.id, self.connection):
            log.info("task %s was taken from this worker meanwhile: it was slow", self._job.id.rpartition("-")[0])
        told = False
        while True:
            try:
                with self.connection.pipeline() as pipe:
                    self._job.set_status(JobStatus.STARTED, pipe)
                    pipe.expire(self._job.key, allowed.FAILURE_TTL_S)
                    pipe.execute()
                return
            except ResponseError as error:
                if not told:
                    log.warning("Redis takes no writes, and the end of a task waits for it: %s", error)
                told = True
                if self._stop_requested:
                    return
                time.sleep(_REFUSED_PAUSE_S)

    def dequeue_job_and_maintain_ttl(self, *args: Any, **options: Any) -> Any:
        """The next task, or None where none waits. An entry of the queue that is no task is passed over."""
        while True:
            try:
                found = super().dequeue_job_and_maintain_ttl(*args, **options)
                self.found_none = found is None
                return found and (allowed.allowed_job(*found), found[1])
            except TaskRefused as error:
                log.warning("%s", error)
                self.connection.delete(found[0].key)
            except Exception as error:
                if not allowed.is_of_an_entry(error):
                    raise
                log.warning("an entry of the queue cannot be read: %s", error)

    def reorder_queues(self, reference_queue: Any) -> None:
        """RQ calls this after each task it took: which lane comes first for the next one."""
        self._taken += 1
        queues = {queue.name: queue for queue in self.queues}
        self._ordered_queues = [queues[name] for name in queue_names(self._stages, self._taken, ability=own_ability())]

    def handle_warm_shutdown_request(self) -> None:
        """SIGTERM: the task in hand stops at its next launch and goes back to the queue."""
        self._heart.stopping()
        if self._context is not None:
            self._context.stop(StopReason.SHUTDOWN)

    @property
    def was_told_to_stop(self) -> bool:
        """Whether a signal ended the loop."""
        return self._shutdown_requested_date is not None

    def subscribe(self) -> None:
        """No command channel: it is deaf after a reconnect, and lets anybody in Redis stop workers."""


def run_worker(
    settings: Settings,
    *,
    stages: Collection[Stage] = tuple(Stage),
    table: Mapping[Stage, StageFunction] | None = None,
    check: Check | None = None,
    burst: bool = False,
    idle_s: int = 0,
    max_tasks: int | None = None,
) -> bool:
    """Do tasks until told to stop; with `burst` until none waits, with `max_tasks` that many.

    Args:
        table: what each stage does; the real ones by default.
        idle_s: with `burst`: how long it waits for a task before none waits [s].
        check: of what they run on, before the first task and in doubt; that of the real engine if the stages are.

    Returns:
        False if the worker ended because something broke.

    Raises:
        InputError: there is no such device.
        BusyError: Redis belongs to another service than the store.
        QueueUnavailable, StoreUnavailable: at the start.
    """
    queue = open_queue(settings, patience=_PATIENCE)
    name = f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(3)}"
    device = Device(settings.device, number=settings.worker_number)
    store = open_store(settings.resolved_store_url)
    queue.ping()
    check_queue(store, queue)
    heart = Heartbeat(
        redis_url(settings), _first_beat(name, device, stages), lease_s=settings.lease_s, alive=settings.heartbeat_file
    )
    if table is None:
        table, check = stage_table(), lambda some: check_engine(device.resolve, some, threads=settings.threads)
    fitness = Fitness(store, check)
    runner = Runner(table, worker=name, publish=queue.publish, fitness=fitness)
    surroundings = Surroundings(settings, store, device)
    worker = GraspWorker(queue, runner, heart, surroundings, fitness, stages=stages, name=name)
    does_all = not burst and max_tasks is None
    heart.start()
    try:
        device.find_out(lambda: heart.update(device=device.resolve(), device_name=device.name))
        if not _admitted(fitness, heart, stages, limit_s=settings.task_timeout_s, patient=does_all):
            return False
        check_queue(store, queue)  # an empty Redis may have become somebody's meanwhile
        patient = burst and idle_s > 0
        worker.work(
            burst=burst and not patient,
            max_jobs=max_tasks,
            max_idle_time=idle_s if patient else None,
            logging_level="WARNING",
        )
    finally:
        allowed.task_function = None
        surroundings.close()
        heart.stop()
        queue.close()
    # RQ's loop ends in the same way where an error that nobody foresaw broke it off.
    is_done = not does_all and (worker.found_none or surroundings.tasks_done >= (max_tasks or math.inf))
    return not worker.gave_up and (is_done or worker.was_told_to_stop or worker.makes_room)


def _admitted(fitness: Fitness, heart: Heartbeat, stages: Collection[Stage], *, limit_s: float, patient: bool) -> bool:
    """Check the engine before the first task; a worker that is patient waits in quarantine until it passes.

    A signal to stop ends the process at once here: it holds no task.
    """
    heart.update(state="checking")
    heart.limit("the check of the engine", limit_s)
    # The dearest part of the engine; what the other stages add is loaded by their first task, and checked in doubt.
    first = (Stage.SYNTHESIZE,) if Stage.SYNTHESIZE in stages else tuple(stages)
    fit = fitness.try_engine(first) or (patient and fitness.sit_out(first, heart, lambda: False))
    heart.limit("", 0.0)
    if fit:
        heart.update(state="idle")
    return fit


def _first_beat(name: str, device: Device, stages: Collection[Stage]) -> WorkerBeat:
    now = timestamp()
    return WorkerBeat(
        name=name,
        host=socket.gethostname(),
        pid=os.getpid(),
        device=device.wanted,
        device_name=device.name,
        stages=tuple(stages),
        version=PACKAGE_VERSION,
        state="checking",
        task_id="",
        started=now,
        seen=now,
        schemas=own_ability().schemas,
        revisions=dict(own_ability().revisions),
    )
