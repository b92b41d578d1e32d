"""Compiled models of the engine, kept for a hand that meets an object again: one costs as much as half a verdict."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final

from cachetools import LRUCache

from worker.hands.model import HandModel
from worker.objects.disk_cache import content_of
from worker.objects.model import ObjectModel
from worker.quality.referee.decomposition import ConvexPieces
from worker.quality.referee.model import MujocoOptions, Scene, build
from worker.simulation.surroundings import Neighbour, Obstacle

#: Models kept; one takes some megabytes.
KEPT: Final = 8


@dataclass(frozen=True)
class _Asked:
    """All that a model follows from."""

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
    """`build`, or what it gave for the same arguments lately. Threads share a scene: nobody may write to its model."""
    asked = _Asked("pushes", hand, obj, pieces, physics, tuple(supports), tuple(neighbours))
    scene: Scene = _kept(asked, lambda: build(hand, obj, pieces, physics, supports, neighbours))
    return scene


def slipping_model(
    hand: HandModel, obj: ObjectModel, pieces: ConvexPieces, make: Callable[[HandModel, ObjectModel, ConvexPieces], Any]
) -> Any:
    """The model of the displacement test, made by `make` where it was not lately."""
    return _kept(_Asked("slips", hand, obj, pieces, None, (), ()), lambda: make(hand, obj, pieces))


def _kept(asked: _Asked, make: Callable[[], Any]) -> Any:
    key = content_of(asked)
    with _lock:
        model = _models.get(key)
        if model is None:
            model = _models[key] = make()
        return model
