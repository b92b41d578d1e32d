"""Where tasks that are done together leave their shards, so that those which end together are put as one object."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Final

from service.store.manifests import ShardManifest
from service.store.packs import put_pack
from service.store.store import Store

log = logging.getLogger(__name__)
#: How long the first shard waits for others [s]: a launch of a GPU and what follows it. Nothing waits for a task that
#: waits: its launches go on without it, and its worker takes no others before all tasks in hand have ended.
WAIT_S: Final = 2.0
#: A pack is put once it holds so much [bytes].
LARGEST: Final = 64 << 20


@dataclass(eq=False)
class _Batch:
    """Shards that go into one object."""

    until: float
    tasks: list[str] = field(default_factory=list)
    shards: list[tuple[ShardManifest, bytes]] = field(default_factory=list)
    size: int = 0
    taken: bool = False
    """Whether a thread puts it: nothing is added any more."""
    over: threading.Event = field(default_factory=threading.Event)
    key: str = ""
    error: Exception | None = None


class Packer:
    """Gathers the shards of tasks that end within a short time; each task comes in a thread of its own."""

    def __init__(
        self,
        store: Store,
        members: int,
        *,
        least: int,
        is_read: Callable[[], bool],
        wait_s: float,
    ) -> None:
        """
        Args:
            store: where the shards go.
            members: tasks that are done together; a shard waits only while another may come.
            least: fewer shards are put each by itself.
            is_read: whether the keeper that will be told knows packs; asked before one is put.
            wait_s: how long a shard waits for others [s].
        """
        self._store, self._least, self._is_read = store, least, is_read
        self._wait_s, self._awaited = wait_s, members
        self._changed = threading.Condition()
        self._batch: _Batch | None = None
        self._untold: dict[str, tuple[tuple[str, ...], set[str]]] = {}
        """Tasks of each pack that was put: all of them, and those that have not ended yet."""

    def leave(self) -> None:
        """A task has ended and left no shard."""
        with self._changed:
            self._awaited -= 1
            self._changed.notify_all()

    def put(self, task: str, manifest: ShardManifest, data: bytes) -> str:
        """Put the shard of a task together with others.

        Returns:
            key of the pack that holds it; "" where it was not put, since too few ended with it.

        Raises:
            StoreUnavailable: the store took nothing; so for each shard of the pack.
        """
        with self._changed:
            self._awaited -= 1
            batch = self._batch = self._batch or _Batch(time.monotonic() + self._wait_s)
            batch.tasks.append(task)
            batch.shards.append((manifest, data))
            batch.size += len(data)
            self._changed.notify_all()
            while not (batch.taken or self._is_due(batch)):
                self._changed.wait(max(0.0, batch.until - time.monotonic()))
            is_mine, batch.taken = not batch.taken, True
            if is_mine:
                self._batch = None
        if is_mine:
            self._carry_out(batch)
        batch.over.wait()
        if batch.error is not None:
            raise batch.error
        return batch.key

    def end(self, task: str, pack: str) -> tuple[str, ...]:
        """A task whose shard is in a pack has ended. All tasks of the pack if it was the last of them, else none."""
        tasks, left = self._untold[pack]
        left.discard(task)
        return () if left else tasks

    def _is_due(self, batch: _Batch) -> bool:
        """Whether nothing more comes, or it has been waited for long enough."""
        cannot = len(batch.shards) + self._awaited < self._least
        return cannot or self._awaited <= 0 or batch.size >= LARGEST or time.monotonic() >= batch.until

    def _carry_out(self, batch: _Batch) -> None:
        try:
            if len(batch.shards) >= self._least and self._is_read():
                key = put_pack(self._store, batch.shards)
                log.info("%d shards are put as one object, %s", len(batch.shards), key)
                self._untold[key] = (tuple(batch.tasks), set(batch.tasks))
                batch.key = key
        except Exception as error:
            batch.error = error
        finally:
            batch.over.set()
