"""Tasks that a worker takes besides one, to do them together: waiting ones of the same pair."""

from __future__ import annotations

import logging
import math
import threading
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass
from queue import SimpleQueue
from typing import Any

from redis.exceptions import RedisError, ResponseError

from service.model.messages import TaskMessage
from service.queue.port import Event, EventKind, Events
from service.queue.rq_queue import WORKERS
from service.queue.taking import message_of, take_alike
from worker.engines.joins import PER_LAUNCH
from worker.process.heartbeat import Hold
from worker.process.runner import Runner
from worker.stages.context import TaskContext
from worker.stages.packing import Packer

log = logging.getLogger(__name__)
#: The same for tasks that may be done together; None: by itself.
Alike = Callable[[TaskMessage], Hashable | None]


class Company:
    """Finds tasks that go with one."""

    def __init__(self, connection: Any, join: Callable[[], int], alike: Alike) -> None:
        """`join` tells how many batches one launch plans."""
        self._connection, self._join, self._alike = connection, join, alike

    @property
    def join(self) -> int:
        """Batches that one launch plans."""
        return self._join()

    def take(self, job: Any, queue: str) -> list[Any]:
        """The jobs that go with one that was taken off a queue, in the order in which they waited."""
        if (join := self.join) == 1 or (message := message_of(job)) is None or (kind := self._alike(message)) is None:
            return []

        def wanted(other: TaskMessage) -> bool:
            return other.task_id != message.task_id and self._alike(other) == kind

        try:
            return list(take_alike(self._connection, queue, wanted, lambda there: self._share(there, join)))
        except RedisError as error:  # the task in hand is done by itself; what was taken is for the keeper to find
            log.warning("no other tasks were taken besides one: %s", error)
            return []

    def _share(self, there: int, join: int) -> int:
        """Of so many waiting tasks those that are for this worker: the others have their share of them."""
        try:
            workers = max(1, self._connection.scard(WORKERS))
        except ResponseError:  # something else was put under that name
            workers = 1
        return min(PER_LAUNCH * join, math.ceil((there + 1) / workers)) - 1


@dataclass(eq=False)
class Held:
    """A task in hand, and what became of it."""

    job: Any
    queue: Any
    execution: Any
    raw: Any
    context: TaskContext
    hold: Hold
    outcome: Event | None = None
    error: Exception | None = None


def tell_end(events: Events, outcome: Event, packer: Packer | None) -> None:
    """Publish the end of a task; of those whose shards are in one pack one end, once all of them have ended."""
    if packer is None or not outcome.pack:
        events.publish(outcome)
    elif tasks := packer.end(outcome.task_id, outcome.pack):
        # It goes to the keeper of one of their jobs: most packs are of one.
        facts = {"job_id": outcome.job_id, "worker": outcome.worker, "pack": outcome.pack}
        events.publish(Event(kind=EventKind.PACKED, at=outcome.at, **facts))
        events.forget_reports(tasks)


def run_together(held: Sequence[Held], runner: Runner, close: Callable[[Held], None]) -> None:
    """Do tasks, each in a thread of its own, and close the books on each as it ends, in this thread."""
    ended: SimpleQueue[Held] = SimpleQueue()

    def work(one: Held) -> None:
        try:
            one.outcome = runner.run(one.raw, one.context)
        except Exception as error:
            one.error = error
        finally:
            one.context.depart()
            ended.put(one)

    log.info("%d tasks of one pair are done together", len(held))
    for one in held:
        threading.Thread(target=work, args=(one,), name=f"task {one.hold.task_id[:8]}", daemon=True).start()
    for _ in held:
        close(ended.get())
