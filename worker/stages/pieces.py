"""Convex pieces of objects, shared by all workers through the store: they move verdicts, and cost up to minutes."""

from __future__ import annotations

import threading
from contextlib import suppress
from pathlib import Path

from service.model import names
from service.model.errors import DamagedError, NotFoundError
from service.store.integrity import get_sealed, put_sealed
from service.store.store import Store
from service.user_cache import write_whole
from worker.objects.model import ObjectModel
from worker.quality.referee.decomposition import ConvexPieces, decompose, piece_file

_lock = threading.Lock()


def pieces_of(store: Store, obj: ObjectModel, *, cache: Path | None = None) -> ConvexPieces:
    """The pieces of an object: this machine's, else those in the store, else made now and put there.

    Raises:
        MeshError: the object has no usable pieces.
        StoreUnavailable: the store does not answer.
    """
    file = piece_file(obj, cache)
    key = names.object_pieces(obj.digest, file.stem)
    with _lock:  # tasks of one object start at once: one of them makes the pieces
        if not file.is_file():
            _fetch(store, key, file)
        pieces = decompose(obj, cache=cache)
        if file.is_file() and not store.exists(key):
            put_sealed(store, key, file.read_bytes())
        return pieces


def _fetch(store: Store, key: str, file: Path) -> None:
    try:
        data = get_sealed(store, key)
    except (NotFoundError, DamagedError):
        return
    # A folder that cannot be written only costs time.
    with suppress(OSError):
        write_whole(file, data)
