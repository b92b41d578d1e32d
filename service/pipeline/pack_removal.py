"""Packed shards that no job needs any more: a record says that they are gone, and a pack goes with the last of them."""

from __future__ import annotations

import logging
from collections.abc import Callable

from service.model import names
from service.model.digests import digest_json
from service.model.errors import DamagedError
from service.model.planning import plan
from service.model.records import JobRecord
from service.pipeline.backends import Parts
from service.store.packs import DeadShards, Pack, packs_below
from service.store.records import put_record

log = logging.getLogger(__name__)


def remove_packed(parts: Parts, job: JobRecord, is_over: Callable[[], bool]) -> bool:
    """Take out of the packs what a job made, as far as its rows are gone and no task of any job makes it.

    Args:
        is_over: whether to stop, for the rest to be done later.

    Returns:
        whether all is done.

    Raises:
        UnavailableError: a part is away; call again later.
    """
    made = {task.output for task in plan(job)}
    for _, pack in packs_below(parts.store, names.packs_of(job.hand_digest, job.object_digest)):
        if is_over():
            return False
        if isinstance(pack, DamagedError):
            log.warning("%s", pack)  # nothing more is lost by keeping it
        elif not pack.living or not made.isdisjoint(shard.id for shard in pack.living):
            _remove(parts, pack, made)
    return True


def _remove(parts: Parts, pack: Pack, made: set[str]) -> None:
    """While nobody else writes the index: a job that is entered meanwhile waits, and makes its shards anew.

    The pack goes before the records beside it: what they say is gone must not come back.
    """
    with parts.index.database.writing() as connection:
        free = parts.index.removals.without_rows([shard.id for shard in pack.living], within=connection)
        gone = sorted(made & free)
        beside = names.pack_dead(pack.key)
        if len(gone) == len(pack.living):
            parts.store.delete(pack.key)
            for entry in list(parts.store.list(beside)):
                parts.store.delete(entry.key)
        elif gone:
            put_record(parts.store, f"{beside}/{digest_json(gone)}.json", DeadShards(shards=tuple(gone)))
