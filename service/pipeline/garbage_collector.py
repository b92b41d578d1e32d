"""Garbage collector of the store: moves deleted objects aside, a part in each round of the controller.

After the grace time they are removed permanently, with the shards that no job needs.
"""

from __future__ import annotations

import contextlib
import logging
import time
from collections.abc import Callable, Iterator
from typing import Final, TypeVar

from graspd.service.index.database import chunks
from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.errors import ConflictError, DamagedError, NotFoundError
from graspd.service.model.planning import plan
from graspd.service.model.records import Record
from graspd.service.model.states import AssetKind, Stage
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.deletion import delete_job, move_to_removed
from graspd.service.store.records import DeletedJob, Deletion, load_dataset, read_record, removed_before

log = logging.getLogger(__name__)
RecordT = TypeVar("RecordT", bound=Record)
BUDGET_S: Final = 0.5
_AT_ONCE: Final = 200


class GarbageCollector:
    def __init__(self, services: Services, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._services = services
        self._clock = clock

    def advance(self, budget_s: float = BUDGET_S) -> bool:
        """Work for at most `budget_s`; return whether work is left."""
        deadline = self._clock() + budget_s
        for _, deletion in self._records(Deletion, names.DELETIONS):
            if self._clock() > deadline or not self._execute(deletion, deadline):
                return True
            log.info("the objects of %s %s are removed", deletion.what, deletion.id)
        return False

    def collect(self, budget_s: float = BUDGET_S) -> bool:
        """Remove objects deleted before the grace time, and unused shards; return whether work is left."""
        deadline = self._clock() + budget_s
        before = timestamp(self._services.settings.shard_grace_s)
        # The record of the deletion sorts first and is removed last.
        removed = [entry.key for entry in self._services.store.list(names.REMOVED)]
        for key in sorted(removed, key=lambda key: key.endswith("/deletion.json")):
            if self._clock() > deadline:
                return True
            if removed_before(key, before):
                self._services.store.delete(key)
        known = self._services.index.notes.completeness()
        if known is not None and known.left_out:
            return False  # A job with an unreadable record may need one of these shards.
        for key, released in self._records(DeletedJob, names.RELEASED):
            if released.at > before:
                break  # All further records are younger.
            for stage, shard in self._unneeded(released):
                if self._clock() > deadline:
                    return True
                self._remove_shard(stage, shard)
            self._services.store.delete(key)
        return False

    def _records(self, model: type[RecordT], folder: str) -> Iterator[tuple[str, RecordT]]:
        """Yield readable records in the order of their keys."""
        for key in sorted(entry.key for entry in self._services.store.list(folder)):
            try:
                yield key, read_record(model, self._services.store, key)
            except DamagedError as error:
                log.warning("%s", error)

    def _execute(self, deletion: Deletion, deadline: float) -> bool:
        """Remove rows that a killed process left, then objects; return whether all is done."""
        with self._services.index.database.writing() as connection:
            if not self._services.store.exists(names.deletion(deletion.what, deletion.id)):
                return True  # The resource was restored after the listing.
            removals = self._services.index.removals
            if deletion.what == "job":
                removals.remove_job(deletion.id, within=connection)
            elif deletion.what == "dataset":
                removals.remove_dataset(deletion.id, within=connection)
            else:
                removals.remove_asset(AssetKind(deletion.what), deletion.id, within=connection)
        if deletion.what == "dataset" and not self._remove_jobs_of(deletion.id, deadline):
            return False
        move_to_removed(self._services, deletion)
        return True

    def _remove_jobs_of(self, dataset: str, deadline: float) -> bool:
        """Delete the jobs planned for a dataset that no other dataset contains; return whether all are gone."""
        try:
            jobs = load_dataset(self._services.store, dataset).jobs
        except (NotFoundError, DamagedError):
            return True
        for some in chunks(jobs, _AT_ONCE):
            for job in self._services.index.removals.planned_only(some):
                if self._clock() > deadline:
                    return False
                try:
                    # The jobs of a recently cancelled dataset may still be unfinished.
                    with contextlib.suppress(ConflictError):
                        job_actions.cancel(self._services, job)
                    delete_job(self._services, job)
                except (ConflictError, NotFoundError) as error:
                    log.info("job %s of the deleted dataset %s stays: %s", job, dataset, error)
        return True

    def _unneeded(self, released: DeletedJob) -> Iterator[tuple[Stage, str]]:
        planned = [(task.stage, task.output) for task in plan(released.job)]
        for some in chunks(planned, _AT_ONCE):
            unneeded = self._services.index.removals.unneeded_shards([shard for _, shard in some])
            yield from ((stage, shard) for stage, shard in some if shard in unneeded)

    def _remove_shard(self, stage: Stage, shard: str) -> None:
        """Remove the manifest first, which ends the shard; a job entered meanwhile makes the shard again."""
        with self._services.index.database.writing() as connection:
            if self._services.index.removals.remove_shard(shard, within=connection):
                self._services.store.delete(names.shard_manifest(stage, shard))
                self._services.store.delete(names.shard_file(stage, shard))
