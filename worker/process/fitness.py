"""Is this worker fit for tasks? One that is not must not use up their attempts: it hands them back and steps aside.

A worker is unfit if

- its engine does not pass the check, before the first task or after a task failed for another reason than its input; or
- tasks fail here in a row, each of them another one, and two of them were meanwhile done by other workers.

It is then in quarantine: listed with the reason, without tasks. It checks itself again after longer and longer pauses,
and comes back when it passes. If it does not, or if the check cannot see what is wrong, its process ends, for a fresh
one to start and check itself.
"""

from __future__ import annotations

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
#: Check of the engine for some stages; raises EngineError.
Check = Callable[[Collection[Stage]], None]
#: Pauses before the checks of a worker in quarantine [s].
PAUSES_S: Final = (2.0, 5.0, 10.0, 20.0)
#: So many tasks that failed here and were done elsewhere are no accident.
_DONE_ELSEWHERE: Final = 2
_REMEMBERED: Final = 16
_LOSSES_BYTES: Final = 2**16
_LOOK_S: Final = 0.1
#: Errors that say nothing about the worker: the input is bad, or a record in the store.
_OF_THE_TASK: Final = (InputError, TaskRefused, DamagedError)


def first_loss(task: str) -> bool:
    """Whether no GPU of this machine, nor a process beside a worker, was lost over a task before. The first time
    nothing says that it is the task's fault; one that takes each down must use up its attempts, or it would go round
    for ever."""
    file = user_cache.folder("gpus") / f"{hashlib.sha256(task.encode()).hexdigest()[:32]}.lost"
    if user_cache.load(file) is not None:
        return False
    user_cache.keep(file, b"", limit_bytes=_LOSSES_BYTES)
    return True


class Fitness:
    """What a worker knows about itself."""

    def __init__(self, store: Store, check: Check | None = None) -> None:
        """Without `check` only what other workers can do tells."""
        self._store = store
        self._check = check
        self._failed: dict[str, tuple[Stage, str]] = {}
        self._can_pass = True
        self.reason = ""
        """Why the worker is unfit; "" while it is not."""

    def try_engine(self, stages: Collection[Stage]) -> bool:
        """Check the engine for these stages."""
        try:
            if self._check is not None:
                self._check(stages)
        except EngineError as error:
            log.warning("the engine of this worker does not work", exc_info=error)
            self.reason, self._can_pass = str(error), True
            return False
        self.reason = ""
        return True

    def passed(self) -> None:
        """A task succeeded here."""
        self._failed.clear()

    def doubt(self, message: Message, error: Exception) -> str:
        """Why this worker, and not the task, is to blame for a failure; "" if it is not known to be."""
        if isinstance(error, _OF_THE_TASK):
            return ""
        if self.try_engine((message.stage,)):
            others = self._done_elsewhere(except_for=message.task_id)
            if len(others) >= _DONE_ELSEWHERE:
                self._can_pass = False
                self.reason = f"{len(others)} tasks in a row failed here and were done by other workers"
            elif not isinstance(message, IngestMessage):
                self._failed[message.task_id] = (message.stage, message.output)
                self._failed = dict(list(self._failed.items())[-_REMEMBERED:])
        return self.reason

    def sit_out(self, stages: Collection[Stage], update: Callable[..., None], told_to_stop: Callable[[], bool]) -> bool:
        """Quarantine; returns whether the worker is fit again. It ends early when the worker is told to stop.

        Args:
            update: takes facts for the list of workers.
        """
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

    def _done_elsewhere(self, *, except_for: str) -> list[str]:
        """Tasks that failed here and whose result is there now: nothing succeeded here since."""
        try:
            return [
                task
                for task, (stage, output) in self._failed.items()
                if task != except_for and shard_exists(self._store, stage, output)
            ]
        except UnavailableError:
            return []
