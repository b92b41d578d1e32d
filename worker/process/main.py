"""Worker process: RQ's worker, which renews the lease of a task while a separate engine runs it.

The engine (`worker.process.engine`) lives as long as the worker: a CUDA context does not survive a fork, and a process
per task would load kernels and meshes every time. Worker and engine share no interpreter lock, so no kernel compilation
prevents the renewal of the lease."""

import logging
import math
import os
import secrets
import signal
import socket
import sys
import time
from collections.abc import Callable, Collection
from contextlib import suppress
from datetime import UTC, datetime
from functools import partial
from typing import Any, Final

from redis.exceptions import RedisError, ResponseError
from rq import SimpleWorker
from rq.exceptions import StopRequested
from rq.serializers import JSONSerializer
from rq.worker import WorkerStatus

from graspd.service.model.errors import GraspdError, QueueUnavailable, TaskRefused
from graspd.service.model.messages import WorkerHeartbeat, capabilities
from graspd.service.model.states import Stage
from graspd.service.queue import entries
from graspd.service.queue.connection import redis_url
from graspd.service.queue.entries import queue_names
from graspd.service.queue.port import Event
from graspd.service.queue.rq_queue import RqQueue, lease_state, open_queue, renew_lease
from graspd.service.settings import Settings
from graspd.worker.process.heartbeat import Heartbeat
from graspd.worker.process.link import Condition, EngineLost, Link, Setup, StartEngine, start_engine
from graspd.worker.stages.context import StopReason

log = logging.getLogger(__name__)
_PATIENCE: Final = 60  # reconnection attempts of a worker, for about a minute: longer than a restart of Redis
_WORKER_TTL_S: Final = 20  # RQ's `worker_ttl` [s]: RQ waits this time less 15 s for a task before its maintenance
_NEVER_S: Final = 10**9  # RQ's maintenance is off: see docs/adr/0003-silence-is-measured-by-one-clock.md
_REFUSED_PAUSE_S: Final = 0.5
_LONGEST_RETRY_S: Final = 2.0  # longest wait between two attempts to reach Redis [s]
_LOOK_S: Final = 0.1  # longest delay until a worker notices a request to stop [s]
STUCK_AFTER_S: Final = 60.0  # time for an engine to stop by itself before it is ended [s]


class GraspWorker(SimpleWorker):  # type: ignore[misc]
    """RQ's in-process worker with tasks run by an engine; docs/adr explains the unused parts of RQ."""

    execution: Any

    def __init__(
        self, queue: RqQueue, engine: Link, heart: Heartbeat, *, stages: Collection[Stage], name: str, limit_s: float
    ) -> None:
        super().__init__(
            queues=queue_names(stages, ability=capabilities()),
            name=name,
            connection=queue.connection,
            serializer=JSONSerializer,
            worker_ttl=_WORKER_TTL_S,
            maintenance_interval=_NEVER_S,
            log_job_description=False,
        )
        self.last_cleaned_at = datetime.now(UTC)
        self.max_connection_wait_time = _LONGEST_RETRY_S
        self._queue, self._engine, self._heartbeat = queue, engine, heart
        self._stages, self._taken, self._limit_s = stages, 0, limit_s
        self.tasks_done = 0
        self.told_to_stop = False  # whether a signal requested a stop
        self.found_none = False  # whether it ended because no task was waiting
        self.engine_is: Condition = "fit"  # state of the engine after the last task

    def check_service(self) -> None:
        """Raise BusyError if Redis belongs to another service, InputError if the device is unknown."""
        self._engine.send("service", self._queue.service_id())
        self._wait_for_answer("service")

    def admit(self) -> bool:
        """Wait for the engine's check before the first task; False if the worker must end. Raises EngineLost."""
        self._engine.send("check")
        return bool(self._wait_for_answer("ready"))

    def execute_job(self, job: Any, queue: Any) -> None:
        """Run one task under a lease. Its outcome is sent after the lease is released."""
        self.prepare_execution(job)
        self.prepare_job_execution(job)
        self._heartbeat.update(task_id=job.id.rpartition("-")[0], state="busy", done=0.0, total=0.0, message="")
        outcome: Event | None = None
        self._engine.send("task", job.args[0])
        try:
            outcome = self._wait_for_answer("done", partial(self._keep_lease, job))
        except GraspdError as error:
            log.warning("the engine refuses a task: %s", error)
        except EngineLost as error:
            # As after a kill of this process, the lease remains, and the controller detects its expiry.
            log.error("this worker ends: %s", error)
            os._exit(1)
        self._return_task(job)
        self._heartbeat.update(task_id="", state="stopping" if self.told_to_stop else "idle")
        self.tasks_done += 1
        if outcome is not None:
            self._publish(outcome)
        self.engine_is = self._wait_for_answer("idle")
        if self.engine_is != "fit":
            self._heartbeat.update(state="stopping")
            raise StopRequested
        self.set_state(WorkerStatus.IDLE)

    def _wait_for_answer(self, word: str, beat: Callable[[], None] = lambda: None) -> Any:
        """Return the engine's answer within the time limit of a task; pass on its other messages meanwhile."""
        began = time.monotonic()
        due = began + self._heartbeat.interval_s
        told: StopReason | None = None
        while True:
            if (news := self._engine.receive(_LOOK_S)) is not None:
                if news[0] == word:
                    return news[1]
                self._forward(*news)
            elapsed = time.monotonic() - began
            reason = (
                StopReason.TIMEOUT if elapsed > self._limit_s else StopReason.SHUTDOWN if self.told_to_stop else None
            )
            if reason is not told:
                self._engine.send("stop", reason)
                told = reason
            if elapsed > self._limit_s + STUCK_AFTER_S:
                log.error("the engine does not stop; it is killed")
                self._engine.kill()
            if time.monotonic() >= due:
                beat()
                due = time.monotonic() + self._heartbeat.interval_s

    def _forward(self, word: str, about: Any) -> None:
        if word == "refused":
            raise about
        if word == "facts":
            self._heartbeat.update(**about)
        elif word == "log":
            with suppress(QueueUnavailable):
                self._queue.put_task_log(*about)
        else:
            self._publish(about)

    def _publish(self, event: Event) -> None:
        try:
            self._queue.publish(event)
        except QueueUnavailable as error:
            log.warning("the outcome of task %s could not be sent: %s", event.task_id, error)

    def _keep_lease(self, job: Any) -> None:
        """Renew the lease of the current task, and stop the task if it is cancelled."""
        if self._engine.is_stopped:
            return
        try:
            is_held, is_cancelled = lease_state(self.connection, job, self.execution)
            if is_held:
                with self.connection.pipeline() as pipe:
                    self.heartbeat(pipeline=pipe)
                    renew_lease(pipe, job, self.execution, self.get_heartbeat_ttl(job))
                    pipe.execute()
        except RedisError as error:
            log.warning("the lease of a task could not be renewed: %s", error)
            return
        if is_cancelled or not is_held:
            self._engine.send("stop", StopReason.CANCELLED if is_cancelled else StopReason.LEASE_LOST)

    def _return_task(self, job: Any) -> None:
        """Remove the task from Redis; wait while Redis refuses writes because its disk is full."""
        if not job.exists(job.id, self.connection):
            log.info("task %s was taken from this worker, which was too slow", job.id.rpartition("-")[0])
        execution, told = self.execution, False
        while True:
            try:
                with self.connection.pipeline() as pipe:
                    self.execution = execution
                    self.cleanup_execution(job, pipe)
                    pipe.delete(job.key)
                    pipe.execute()
                return
            except ResponseError as error:
                if not told:
                    log.warning("Redis refuses writes; the removal of a finished task waits: %s", error)
                told = True
                if self.told_to_stop:
                    return
                time.sleep(_REFUSED_PAUSE_S)

    def dequeue_job_and_maintain_ttl(self, *args: Any, **options: Any) -> Any:
        """Return the next task, or None if no task waits. Invalid entries of the queue are skipped."""
        while True:
            try:
                found = super().dequeue_job_and_maintain_ttl(*args, **options)
                self.found_none = found is None
                return found and (entries.sanitized_job(*found), found[1])
            except TaskRefused as error:
                log.warning("%s", error)
                self.connection.delete(found[0].key)
            except Exception as error:
                if not entries.is_entry_error(error):
                    raise
                log.warning("an entry of the queue cannot be read: %s", error)

    def reorder_queues(self, reference_queue: Any) -> None:
        """Choose the queue of the next task. RQ calls this function after each task."""
        self._taken += 1
        queues = {queue.name: queue for queue in self.queues}
        self._ordered_queues = [queues[name] for name in queue_names(self._stages, self._taken, ability=capabilities())]

    def handle_warm_shutdown_request(self) -> None:
        """On SIGTERM, stop the current task at its next launch and return it to the queue."""
        self.told_to_stop = True
        self._heartbeat.update(state="stopping")

    def subscribe(self) -> None:
        """Disable RQ's command channel. It fails after a reconnect, and lets any Redis client stop workers."""


def run_worker(
    settings: Settings,
    *,
    stages: Collection[Stage] = tuple(Stage),
    burst: bool = False,
    idle_s: int = 0,
    max_tasks: int | None = None,
    start: StartEngine = start_engine,
) -> bool:
    """Run tasks until a stop is requested, `max_tasks` are done, or (`burst`) none came for `idle_s` [s].
    Return False if the worker ended because of a failure. Raises InputError: there is no such device. BusyError: Redis
    and store belong to different services. QueueUnavailable, StoreUnavailable: at the start."""
    does_all = not burst and max_tasks is None
    name = f"{socket.gethostname()}-{os.getpid()}-{secrets.token_hex(3)}"
    queue = open_queue(settings, patience=_PATIENCE)
    heart = Heartbeat(
        redis_url(settings),
        WorkerHeartbeat.of_this_process(name, settings.device, stages),
        lease_s=settings.lease_s,
        alive=settings.heartbeat_file,
        is_stopped=lambda: engine.is_stopped,
    )
    engine = start(Setup(settings, tuple(stages), name, patient=does_all))
    try:
        queue.ping()
        worker = GraspWorker(queue, engine, heart, stages=stages, name=name, limit_s=settings.task_timeout_s)
        worker.check_service()
        heart.start()
        # The worker holds no task yet, so a signal may end it at once. RQ sets its own handler later.
        signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
        if not worker.admit():
            return False
        worker.check_service()  # an empty Redis may belong to another service by now
        patient = burst and idle_s > 0
        wait = {"burst": burst and not patient, "max_idle_time": idle_s if patient else None}
        worker.work(**wait, max_jobs=max_tasks, logging_level="WARNING")
    except EngineLost as error:
        log.error("this worker ends: %s", error)
        return False
    finally:
        engine.close()
        heart.stop()
        queue.close()
    # RQ's loop also returns after an unexpected error.
    is_done = not does_all and (worker.found_none or worker.tasks_done >= (max_tasks or math.inf))
    return worker.engine_is == "outgrown" or (worker.engine_is == "fit" and (is_done or worker.told_to_stop))
