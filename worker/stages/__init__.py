"""Stages turn a task into a shard. Only this package connects store and queue with the engine."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from importlib import import_module
from typing import TYPE_CHECKING, Any

from graspd.service.model.states import Stage

if TYPE_CHECKING:
    from graspd.worker.stages.context import Output, StageFunction, TaskContext


def stage_table() -> Mapping[Stage, StageFunction]:
    """Return each stage's function. It imports its module at the first task, so a worker starts at once."""
    return {stage: partial(_run, stage) for stage in Stage}


def _run(stage: Stage, message: Any, context: TaskContext) -> Output | None:
    made: Output | None = import_module(f"{__name__}.{stage.value}").run(message, context)
    return made
