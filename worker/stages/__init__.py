"""Stages turn a task into a shard. Only here do store and queue meet the engine."""

from __future__ import annotations

from collections.abc import Mapping
from importlib import import_module
from typing import TYPE_CHECKING, Any, Final

from graspd.service.model.states import Stage

if TYPE_CHECKING:
    from graspd.worker.stages.context import Output, StageFunction, TaskContext

_MODULES: Final = {
    Stage.INGEST: "graspd.worker.stages.ingest",
    Stage.SYNTHESIZE: "graspd.worker.stages.synthesize",
    Stage.SCENE: "graspd.worker.stages.scene",
    Stage.RENDER: "graspd.worker.stages.render",
}


def stage_table() -> Mapping[Stage, StageFunction]:
    """Return the stages. Their modules are imported at the first task, so that a worker starts at once."""
    return {stage: _Lazy(module) for stage, module in _MODULES.items()}


class _Lazy:
    def __init__(self, module: str) -> None:
        self._module = module

    def __call__(self, message: Any, context: TaskContext) -> Output | None:
        made: Output | None = import_module(self._module).run(message, context)
        return made
