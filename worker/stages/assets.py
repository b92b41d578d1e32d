"""Hands and objects of the tasks, loaded from the store once and kept while the worker goes on with the same pair."""

from __future__ import annotations

from collections.abc import Callable, Hashable
from typing import TypeVar, cast

from cachetools import LRUCache

from service.model import names
from service.model.domain import AssetKind, TaskMessage
from service.store.library import load_asset_files
from service.store.store import Store
from worker.hands.load import load_hand
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.stages.models import SHOWN_ERROR_M, publish_model
from worker.stages.prepared import prepared_object

T = TypeVar("T")
#: Loaded assets kept: a worker in a hands x objects dataset alternates between a few.
_cache: LRUCache[Hashable, object] = LRUCache(8)


def hand_of(store: Store, message: TaskMessage) -> HandModel:
    """The hand of a task."""
    name, digest = message.request.hand, message.hand_digest
    key = (store.url, AssetKind.HAND, name, digest)

    def load() -> HandModel:
        hand = load_hand(load_asset_files(store, AssetKind.HAND, digest), name=name, digest=digest)
        publish_model(store, AssetKind.HAND, hand)
        return hand

    return _cached(key, load)


def object_of(store: Store, message: TaskMessage) -> ObjectModel:
    """The object of a task, simplified as far as its fidelity allows."""
    name, digest = message.request.object, message.object_digest
    error = message.request.knobs.face_error_m
    key = (store.url, AssetKind.OBJECT, name, digest, error)

    def load() -> ObjectModel:
        obj = prepared_object(store, digest, name=name, face_error_m=error)
        if not store.exists(names.asset_model(AssetKind.OBJECT, digest)):
            # The same for whichever fidelity comes first.
            shown = prepared_object(store, digest, name=name, face_error_m=SHOWN_ERROR_M)
            publish_model(store, AssetKind.OBJECT, shown)
        return obj

    return _cached(key, load)


def _cached(key: Hashable, load: Callable[[], T]) -> T:
    if key not in _cache:
        _cache[key] = load()
    return cast("T", _cache[key])
