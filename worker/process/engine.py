"""Engine of a worker: the process that owns the device and runs tasks one by one.

Over a pipe the worker (`worker.process.main`) first sends a `Setup`, then orders of the form (name, argument).
`service` compares store and Redis. `check` is answered by `ready`, `task` by `done` and then `idle`; `end` ends the
process. `refused`, with an error, may replace any answer. `stop` with a reason is accepted at any time. The engine also
sends `facts` for the list of workers (including progress), `event`, and the task's `log`. It does not access Redis."""

from __future__ import annotations

import atexit
import logging
import os
import queue
import resource
import signal
import sys
import threading
from collections.abc import Callable, Collection, Mapping
from contextlib import suppress
from functools import cached_property
from multiprocessing.connection import Connection
from pathlib import Path
from typing import TYPE_CHECKING, Any

from graspd.service import telemetry
from graspd.service.model.cores import available_memory
from graspd.service.model.errors import BusyError, InputError, TaskRefused, UnavailableError
from graspd.service.model.libraries import freeze_imports
from graspd.service.model.states import Stage
from graspd.service.pipeline.identity import check_service
from graspd.service.queue.port import rq_id
from graspd.service.store.store import Store, open_store
from graspd.worker.engines.batch_sizes import batches_per_launch, pool_process_count
from graspd.worker.engines.devices import Device
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.pool.pool import MODULES, Pool
from graspd.worker.process.fitness import Check, Fitness
from graspd.worker.process.link import Condition, Setup
from graspd.worker.process.runner import Runner
from graspd.worker.process.selfcheck import check_engine
from graspd.worker.process.task_log import TaskLog
from graspd.worker.stages import stage_table
from graspd.worker.stages.context import StageFunction, StopReason, TaskContext

if TYPE_CHECKING:
    from graspd.service.settings import Settings

log = logging.getLogger(__name__)


class Engine:
    """Executes the orders of its worker."""

    def __init__(
        self,
        connection: Connection,
        setup: Setup,
        table: Mapping[Stage, StageFunction] | None = None,
        check: Check | None = None,
    ) -> None:
        """`table` has the function of each stage (default: `stage_table`), `check` tests their engines."""
        self._connection, self._setup = connection, setup
        self._table, self._check = table, check
        self._speaking = threading.Lock()
        self._changing = threading.Lock()
        self._orders: queue.SimpleQueue[tuple[str, Any]] = queue.SimpleQueue()
        self._reason: StopReason | None = None
        self._context: TaskContext | None = None
        self._log = TaskLog(lambda task, text: self._send("log", (task, text)))

    def serve(self) -> None:
        with self._connection:
            threading.Thread(target=self._listen, name="engine-orders", daemon=True).start()
            try:
                self._start()
                word, about = self._orders.get()
                while word != "end":
                    self._execute_order(word, about)
                    word, about = self._orders.get()
                self._surroundings.close()
            except (InputError, UnavailableError, BusyError) as error:
                self._send("refused", error)

    def _execute_order(self, word: str, about: Any) -> None:
        if word == "service":
            check_service(self._surroundings.store, about)
            self._send("service", True)
        elif word == "check":
            self._send("ready", self._check_engine())
        else:
            self._run_task(about)

    def update(self, **facts: str | float) -> None:
        self._send("facts", facts)

    def _start(self) -> None:
        settings = self._setup.settings
        device = Device(settings.device, number=settings.worker_number)
        store = open_store(settings.resolved_store_url)
        table, check = self._table, self._check
        if table is None:
            table, check = stage_table(), lambda some: check_engine(device.resolve, some, threads=settings.threads)
        self._fitness = Fitness(store, check)
        self._runner = Runner(
            table, worker=self._setup.worker, publish=lambda event: self._send("event", event), fitness=self._fitness
        )
        self._surroundings = TaskResources(settings, store, device)
        self.update(device_name=device.name)
        device.start_resolving(lambda: self.update(device=device.resolve(), device_name=device.name))

    def _check_engine(self) -> bool:
        """Check the engine before the first task; with `Setup.patient`, wait in quarantine until it passes."""
        # Synthesis is the most expensive stage. If it is among the stages, the others are only checked after failures
        # and load with their first task.
        stages = self._setup.stages
        first = (Stage.SYNTHESIZE,) if Stage.SYNTHESIZE in stages else stages
        fit = self._fitness.try_engine(first) or (self._setup.patient and self._wait_in_quarantine(first))
        if fit:
            self.update(state="idle")
        return fit

    def _wait_in_quarantine(self, stages: Collection[Stage]) -> bool:
        return self._fitness.wait_in_quarantine(stages, self.update, lambda: self._reason is not None)

    def _run_task(self, raw: dict[str, Any]) -> None:
        context = self._surroundings.context(raw, self.update, self._log)
        with self._changing:
            self._context = context
            if self._reason is not None:
                context.stop(self._reason)
        try:
            with self._log.of_task(rq_id(str(raw.get("task_id", "")), raw.get("attempt", 1))):
                outcome = self._runner.run(raw, context)
            self._send("done", outcome)
        except TaskRefused as error:
            self._send("refused", error)
        finally:
            with self._changing:
                self._context = None
        self._send("idle", self._check_condition())

    def _check_condition(self) -> Condition:
        if self._runner.device_lost:
            log.error("this worker ends: %s", self._runner.device_lost)
            return "unfit"
        if self._fitness.reason and self._reason is None and not self._wait_in_quarantine(self._setup.stages):
            return "fit" if self._reason is StopReason.SHUTDOWN else "unfit"
        if why := self._surroundings.memory_excess():
            log.info("this worker ends, so that a fresh one starts: %s", why)
            return "outgrown"
        return "fit"

    def _listen(self) -> None:
        while True:
            try:
                word, about = self._connection.recv()
            except (EOFError, OSError, TypeError):
                # The worker ended, so the task can stop. TypeError: the other thread closed the pipe between two reads.
                word, about = "end", StopReason.LEASE_LOST
            with self._changing:
                if word in ("stop", "end"):
                    self._reason = about
                    if self._context is not None:
                        self._context.stop(about)
                elif word == "task":
                    self._reason = None
            if word != "stop":
                self._orders.put((word, about))
            if word == "end":
                return

    def _send(self, word: str, about: Any) -> None:
        with self._speaking, suppress(OSError):  # the worker has ended
            self._connection.send((word, about))


class TaskResources:
    """Resources of a task besides its message, and the memory limit above which a worker is replaced."""

    def __init__(self, settings: Settings, store: Store, device: Device) -> None:
        self.settings, self.store, self._device = settings, store, device
        self._memory_mb = settings.worker_max_memory_mb or available_memory() / 2 / 2**20

    def memory_excess(self) -> str:
        """Return how far this process and its pool exceed the memory limit, in words; "" if they do not."""
        pool: Pool | None = vars(self).get("_pool")  # not yet made before the first task
        if (held := resident_mb() + sum(map(resident_mb, pool.pids if pool else ()))) > self._memory_mb:
            return f"it uses {held:.0f} MiB, more than {self._memory_mb:.0f} (GRASPD_WORKER_MAX_MEMORY_MB)"
        return ""

    @cached_property
    def _join(self) -> int:
        """Return the number of batches per kernel launch; block until the device is known."""
        join = self.settings.join
        return batches_per_launch(self._device.resolve(), None if join == "auto" else int(join))

    def pool(self, stage: str) -> Pool | None:
        """Return the pool that validates and measures, or None; block until its size is known."""
        if stage != Stage.SYNTHESIZE:
            return None
        if self._pool is not None:
            self._pool.start()
        return self._pool

    @cached_property
    def _pool(self) -> Pool | None:
        chosen, device = self.settings, self._device.resolve()
        count = pool_process_count(device, chosen.processes, threads=chosen.threads, workers=chosen.workers_here)
        return Pool(count, MODULES) if count > 1 else None

    def close(self) -> None:
        """End the pool, if there is one."""
        if (pool := vars(self).get("_pool")) is not None:
            pool.close()

    def context(self, raw: Mapping[str, Any], update: Callable[..., None], log: TaskLog) -> TaskContext:
        def tell(done: float, total: float, message: str) -> None:
            update(done=done, total=total, message=message[:200])
            log.note_progress(done, total, message)

        stage, chosen = raw.get("stage", ""), self.settings
        device = "cpu" if stage == Stage.INGEST else self._device.resolve()
        run = ExecutionContext(device, chosen.threads, prefilter=chosen.prefilter, pool=self.pool(stage))
        join = self._join if stage == Stage.SYNTHESIZE else 1
        return TaskContext(self.store, run, join=join, tell=tell, log=log.text)


def resident_mb(pid: int | None = None) -> float:
    """Return the resident memory of this process or another one [MiB].
    If the system does not report it, return this process's peak, or 0 for another process."""
    try:
        pages = int(Path(f"/proc/{pid or 'self'}/statm").read_text().split()[1])
    except (OSError, ValueError, IndexError):
        if pid is not None:
            return 0.0
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        return peak / (2**20 if sys.platform == "darwin" else 2**10)
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def main(table: Mapping[Stage, StageFunction] | None = None, check: Check | None = None) -> None:
    """Run the process. It ignores signals to end: the worker handles them, and ends this process."""
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        signal.signal(number, signal.SIG_IGN)
    freeze_imports()
    connection = Connection(int(sys.argv[-1]))
    setup: Setup = connection.recv()
    telemetry.set_up_logs(setup.settings, "worker")
    Engine(connection, setup, table, check).serve()
    exit_process()


def exit_process() -> None:
    """Exit at once: finalising Warp and its kernels takes seconds, and no state needs saving."""
    atexit._run_exitfuncs()
    sys.stderr.flush()
    os._exit(0)


if __name__ == "__main__":
    main()
