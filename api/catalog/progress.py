"""Progress, rate and expected end of a job's stages, from what the index says of its tasks."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from collections.abc import Callable, Sequence
from typing import Final

from api.models import StageStatus, stage_state
from service.index.views import JobView, StageProgress, TaskView
from service.model.states import State

#: A shorter look at a task says more about when its progress was reported than about its speed.
_LEAST_SPAN_S: Final = 1.0
#: A task that has only begun spent its time on loading, not on its work.
_LEAST_SHARE: Final = 0.03
_KEPT_TASKS: Final = 4096


class Paces:
    """How fast running tasks move, from the first and the latest sight of each.

    This is memory of one process that may be lost: then the paces are unknown for a second.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._first: OrderedDict[tuple[str, int], tuple[float, float]] = OrderedDict()
        self._lock = threading.Lock()

    def of(self, task: TaskView) -> float | None:
        """Share of the task done per second; None while that cannot be told."""
        share = task.done / task.total if task.total else 0.0
        now = self._clock()
        with self._lock:
            since, start = self._first.setdefault((task.id, task.attempt), (now, share))
            while len(self._first) > _KEPT_TASKS:
                self._first.popitem(last=False)
        if now - since < _LEAST_SPAN_S or share - start < _LEAST_SHARE:
            return None
        return (share - start) / (now - since)


def stage_statuses(job: JobView, tasks: Sequence[TaskView], paces: Paces) -> list[StageStatus]:
    """The stages of a job in their order, each with its state and, where it can be told, its rate and end.

    Args:
        tasks: those that run, and of those that wait any that say why.
    """
    return [_status(stage, [task for task in tasks if task.stage is stage.stage], paces) for stage in job.stages]


def progress_of_job(job: JobView) -> float:
    """Share of a job's tasks that are done [0, 1]; running ones count by their own progress."""
    tasks = sum(stage.tasks for stage in job.stages)
    return min(1.0, sum(stage.done for stage in job.stages) / tasks) if tasks else 0.0


def eta_of_job(job: JobView, stages: Sequence[StageStatus]) -> float | None:
    """Expected time until the job ends [s]: its stages follow one another; None until each one's pace is known."""
    if job.state is not State.RUNNING:
        return None
    remaining = [stage for stage in stages if stage.progress < 1]
    if not remaining or any(stage.eta_s is None for stage in remaining):
        return None
    return sum(stage.eta_s or 0.0 for stage in remaining)


def _status(stage: StageProgress, tasks: list[TaskView], paces: Paces) -> StageStatus:
    state = stage_state(stage)
    running = [task for task in tasks if task.state is State.RUNNING]
    rate = None if state.is_final else _rate(stage, running, paces)
    left = max(0.0, stage.tasks - stage.done)
    return StageStatus(
        **stage.model_dump(),
        state=state,
        progress=min(1.0, stage.done / stage.tasks) if stage.tasks else 0.0,
        message=next((task.message for task in tasks if task.message), ""),
        rate_per_s=rate,
        eta_s=left / rate if rate else None,
    )


def _rate(stage: StageProgress, running: list[TaskView], paces: Paces) -> float | None:
    """Batches per second: of the running tasks by their own progress, else from the time the finished ones took."""
    known = [pace for task in running if (pace := paces.of(task)) is not None]
    if known:
        return sum(known) * len(running) / len(known)
    if stage.succeeded > stage.reused and stage.seconds > 0:
        return (stage.succeeded - stage.reused) / stage.seconds * max(1, stage.running)
    return None
