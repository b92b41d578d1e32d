"""Progress of a job: in a terminal one bar a stage with its rate and the time left, elsewhere plain lines."""

from __future__ import annotations

import time
from types import TracebackType
from typing import Final, Self

from rich.console import Console
from rich.progress import BarColumn, Progress, ProgressColumn, Task, TaskID, TextColumn, TimeRemainingColumn
from rich.text import Text

from api.formatting import duration, metric
from api.models import Job, StageStatus
from service.model.states import Stage, State

_LINE_EVERY_S: Final = 2.0


class _Rate(ProgressColumn):
    """Speed in the unit of the stage."""

    def render(self, task: Task) -> Text:
        speed = task.finished_speed or task.speed
        if not speed:
            return Text("", style="dim")
        return Text(f"{metric(speed * task.fields['scale'])} {task.fields['unit']}/s", style="cyan")


class JobDisplay:
    """Shows each new state of one job. Usable as a context manager."""

    def __init__(self, console: Console) -> None:
        self._console = console
        self._progress = Progress(
            TextColumn("{task.description:<11}"),
            BarColumn(bar_width=32),
            TextColumn("{task.percentage:>3.0f} %"),
            _Rate(),
            TimeRemainingColumn(compact=True, elapsed_when_finished=True),
            TextColumn("{task.fields[message]}", style="dim", markup=False),
            console=console,
            disable=not console.is_terminal,
        )
        self._bars: dict[Stage, TaskID] = {}
        self._said: dict[Stage, tuple[float, State]] = {}
        self._started: dict[Stage, float] = {}

    def __enter__(self) -> Self:
        self._progress.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._progress.stop()

    def update(self, job: Job) -> None:
        """Show a state of the job."""
        for stage in job.stages:
            if stage.state is not State.QUEUED:
                self._started.setdefault(stage.stage, time.monotonic())
            if self._console.is_terminal:
                self._draw(stage, job)
            else:
                self._say(stage, job)

    def _draw(self, stage: StageStatus, job: Job) -> None:
        if stage.stage not in self._bars:
            scale, unit = (job.requested / stage.tasks, "grasps") if stage.stage is Stage.SYNTHESIZE else (1, "tasks")
            self._bars[stage.stage] = self._progress.add_task(
                stage.stage.value, total=stage.tasks, start=False, message="", scale=scale, unit=unit
            )
        bar = self._bars[stage.stage]
        if stage.state is not State.QUEUED and not self._progress.tasks[bar].started:
            self._progress.start_task(bar)
        message = stage.message if stage.state is State.RUNNING else stage.state.value
        self._progress.update(bar, completed=stage.done, message=message)

    def _say(self, stage: StageStatus, job: Job) -> None:
        now = time.monotonic()
        at, state = self._said.get(stage.stage, (0.0, State.QUEUED))
        if stage.state is state and (state is not State.RUNNING or now - at < _LINE_EVERY_S):
            return
        self._said[stage.stage] = (now, stage.state)
        self._console.print(self._line(stage, job, now))

    def _line(self, stage: StageStatus, job: Job, now: float) -> str:
        elapsed = now - self._started.get(stage.stage, now)
        words = f"{stage.stage.value:<11} {stage.state.value:<10} {100 * stage.progress:3.0f} %"
        if stage.state is State.SUCCEEDED:
            seconds = stage.seconds or elapsed
            return f"{words}  {_rate_words(stage, job, 1 / seconds)}  in {duration(seconds)}" if seconds else words
        if stage.state is State.RUNNING and elapsed > 1 and 0 < stage.progress < 1:
            pace = stage.progress / elapsed
            return f"{words}  {_rate_words(stage, job, pace)}  {duration((1 - stage.progress) / pace)} left"
        return words


def _rate_words(stage: StageStatus, job: Job, pace: float) -> str:
    """Speed in the unit of the stage; `pace` is the share of the stage per second."""
    if stage.stage is Stage.SYNTHESIZE:
        return f"{metric(job.requested * pace)} grasps/s"
    return f"{metric(stage.tasks * pace)} tasks/s"
