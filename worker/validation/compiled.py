"""Cache of compiled MuJoCo models, and threads that run simulated tests.
Models are cached because a compilation costs as much as half a verdict."""

from __future__ import annotations

import queue
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import numpy as np
from cachetools import LRUCache
from numpy.typing import NDArray

from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.disk_cache import content_of
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation.environment import Neighbour, Obstacle
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.model import MujocoOptions, Scene, build

#: Number of cached models; one takes some megabytes.
KEPT: Final = 8


@dataclass(frozen=True)
class _Asked:
    test: str
    hand: HandModel
    obj: ObjectModel
    pieces: ConvexPieces
    physics: MujocoOptions | None
    supports: tuple[Obstacle, ...]
    neighbours: tuple[Neighbour, ...]


_models: LRUCache[str, Any] = LRUCache(KEPT)
_lock = threading.Lock()


def scene_of(
    hand: HandModel,
    obj: ObjectModel,
    pieces: ConvexPieces,
    physics: MujocoOptions,
    supports: Sequence[Obstacle] = (),
    neighbours: Sequence[Neighbour] = (),
) -> Scene:
    """Return `build` of the arguments, cached. Threads share the scene: its model is read-only."""
    asked = _Asked("pushes", hand, obj, pieces, physics, tuple(supports), tuple(neighbours))
    scene: Scene = _kept(asked, lambda: build(hand, obj, pieces, physics, supports, neighbours))
    return scene


def slipping_model(
    hand: HandModel, obj: ObjectModel, pieces: ConvexPieces, make: Callable[[HandModel, ObjectModel, ConvexPieces], Any]
) -> Any:
    """Return the model of the displacement test, from the cache or made by `make`."""
    return _kept(_Asked("slips", hand, obj, pieces, None, (), ()), lambda: make(hand, obj, pieces))


def _kept(asked: _Asked, make: Callable[[], Any]) -> Any:
    key = content_of(asked)
    with _lock:
        model = _models.get(key)
        if model is None:
            model = _models[key] = make()
        return model


Test = TypeVar("Test")
Answer = TypeVar("Answer")


def answers(
    rows: Sequence[int], make: Callable[[], Test], ask: Callable[[Test, int], Answer], *, threads: int, name: str
) -> list[Answer]:
    """Run tests on some grasps in parallel; return the results in their order."""
    tests: queue.SimpleQueue[Test] = queue.SimpleQueue()
    workers = max(1, min(threads, len(rows)))
    for _ in range(workers):
        tests.put(make())

    def work(row: int) -> Answer:
        test = tests.get()
        try:
            return ask(test, row)
        finally:
            tests.put(test)

    with ThreadPoolExecutor(workers, thread_name_prefix=name) as pool:
        return list(pool.map(work, rows))


def measured(
    count: int,
    held: NDArray[np.bool_] | None,
    make: Callable[[], Test],
    ask: Callable[[Test, int], float],
    *,
    run: ExecutionContext,
    name: str,
) -> NDArray[np.float64]:
    """Return measurements (count,) on grasps that are `held` (count,), None: all; nan for the others."""

    def asked(test: Test, row: int) -> float:
        run.check("the validator")
        return ask(test, row)

    out = np.full(count, np.nan)
    rows = np.arange(count) if held is None else np.flatnonzero(held)
    if len(rows):
        out[rows] = answers(rows.tolist(), make, asked, threads=run.cores, name=name)
    return out
