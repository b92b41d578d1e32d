"""Fitness of a worker: an unfit worker returns tasks, which lose no attempt, and goes into quarantine.

A worker is unfit if its engine fails the check, before the first task or after a failure not due to the task's input.
It is also unfit if several tasks fail here in a row, of which other workers completed two.

A worker in quarantine is listed with the reason and gets no tasks. It repeats its check after increasing pauses and
resumes when the check passes. If it never passes, or cannot find the fault, the process ends and a fresh one starts."""

import hashlib
import logging
import time
from collections.abc import Callable, Collection
from typing import Final

from graspd.service import user_cache
from graspd.service.model.errors import DamagedError, InputError, TaskRefused, UnavailableError
from graspd.service.model.messages import IngestMessage
from graspd.service.model.states import Stage
from graspd.service.queue.port import Message
from graspd.service.store.manifests import shard_exists
from graspd.service.store.store import Store
from graspd.worker.process.selfcheck import EngineError

log = logging.getLogger(__name__)
Check = Callable[[Collection[Stage]], None]  # check of the engine for some stages; raises EngineError
PAUSES_S: Final = (2.0, 5.0, 10.0, 20.0)  # pauses before the checks of a worker in quarantine [s]
_DONE_ELSEWHERE: Final = 2  # least number of tasks that failed here and succeeded elsewhere at which a worker is unfit
_REMEMBERED: Final = 16
_LOSSES_BYTES: Final = 2**16
_LOOK_S: Final = 0.1
#: Errors not due to the worker: invalid input, or a damaged record in the store.
_OF_THE_TASK: Final = (InputError, TaskRefused, DamagedError)


def is_first_loss(task: str) -> bool:
    """Check whether a task loses a GPU or pool process for the first time on this machine.
    Only later losses count as failed attempts, so that a task that causes them ends."""
    file = user_cache.cache_folder("gpus") / f"{hashlib.sha256(task.encode()).hexdigest()[:32]}.lost"
    if user_cache.load(file) is not None:
        return False
    user_cache.store(file, b"", limit_bytes=_LOSSES_BYTES)
    return True


class Fitness:
    def __init__(self, store: Store, check: Check | None = None) -> None:
        """Without `check`, only results of other workers decide."""
        self._store, self._check, self._can_pass = store, check, True
        self._failed: dict[str, tuple[Stage, str]] = {}
        self.reason = ""  # reason why the worker is unfit; "" while it is fit

    def try_engine(self, stages: Collection[Stage]) -> bool:
        try:
            if self._check is not None:
                self._check(stages)
        except EngineError as error:
            log.warning("the engine of this worker does not work", exc_info=error)
            self.reason, self._can_pass = str(error), True
            return False
        self.reason = ""
        return True

    def record_success(self) -> None:
        self._failed.clear()

    def diagnose(self, message: Message, error: Exception) -> str:
        """Return the reason why a failure is due to this worker and not to the task; "" if it is unknown."""
        if isinstance(error, _OF_THE_TASK):
            return ""
        if self.try_engine((message.stage,)):
            others = self._tasks_done_elsewhere(except_for=message.task_id)
            if len(others) >= _DONE_ELSEWHERE:
                self._can_pass = False
                self.reason = f"{len(others)} tasks in a row failed here and were done by other workers"
            elif not isinstance(message, IngestMessage):
                self._failed[message.task_id] = (message.stage, message.output)
                self._failed = dict(list(self._failed.items())[-_REMEMBERED:])
        return self.reason

    def wait_in_quarantine(
        self, stages: Collection[Stage], update: Callable[..., None], told_to_stop: Callable[[], bool]
    ) -> bool:
        """Wait in quarantine, reported by `update`; return True once fit, False on a stop or a lasting fault."""
        log.warning("this worker takes no tasks: %s", self.reason)
        for pause in PAUSES_S:
            update(state="quarantined", reason=self.reason)
            end = time.monotonic() + pause
            while time.monotonic() < end:
                if told_to_stop():
                    return False
                time.sleep(_LOOK_S)
            if self._can_pass and self.try_engine(stages):
                log.info("this worker is fit again")
                update(state="idle", reason="")
                return True
        return False

    def _tasks_done_elsewhere(self, *, except_for: str) -> list[str]:
        try:
            others = [(task, made) for task, made in self._failed.items() if task != except_for]
            return [task for task, made in others if shard_exists(self._store, *made)]
        except UnavailableError:
            return []
