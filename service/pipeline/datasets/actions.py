"""Actions of users on datasets (create, cancel, retry, snapshot), and their effect on jobs.

The index knows which cells have a job, and a job's event names the dataset event that caused it. Another controller
can therefore continue without applying an event twice.
"""

import logging
import time
from collections.abc import Callable, Iterable
from functools import partial
from typing import Final, Literal

from sqlalchemy import Connection

from graspd.service.index.queries.feed import DatasetWork
from graspd.service.index.views import DatasetView, ObjectSetView
from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.digests import digest_json
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import ConflictError, InputError, NotFoundError
from graspd.service.model.projects import EVERYTHING, ProjectScope
from graspd.service.model.records import (
    DatasetMember,
    DatasetRecord,
    ObjectSet,
    Snapshot,
    create_job_record,
    create_object_set,
)
from graspd.service.model.scene_spec import NamedNeighbour, SceneDocument
from graspd.service.model.states import AssetKind, State
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services, record_transaction
from graspd.service.pipeline.datasets.cost import expand_objects
from graspd.service.pipeline.datasets.spec import DatasetRequest, Matrix, create_record
from graspd.service.pipeline.fidelity_choice import FidelityResolver
from graspd.service.pipeline.job_actions import (
    TaskRanges,
    refuse_deleted,
    resolve_neighbours,
    resolve_network,
    usable_asset,
)
from graspd.service.store import records

log = logging.getLogger(__name__)
#: Maximum time for datasets in one round of the controller [s], so that other duties do not wait long.
BUDGET_S: Final = 0.5
_CELLS_AT_ONCE: Final = 20


def create(
    services: Services, request: DatasetRequest, *, owner: str = "", scope: ProjectScope = EVERYTHING
) -> tuple[DatasetView, bool]:
    """Record a dataset, whose jobs the controller adds; return the dataset, and whether it is new.

    An identical request returns the existing dataset unchanged.

    Raises:
        NotFoundError: unknown hand, object, neighbour, network or set.
        InputError: a failed check; a network of another hand; no chart meets the target.
        ConflictError: a check is still running, or another dataset has the name.
        LimitError: more than `MAX_CELLS` cells.
    """
    hands, objects = resolve_members(services, request, scope)
    shared, beside = resolve_neighbours(services, request.cell_options, scope)
    shared = resolve_network(services, shared, hands, scope)
    services.queue.ping()
    key = names.dataset_record_key(request.name)
    found = None
    if not services.store.exists(key):  # A newer chart must not change the fidelities of an existing dataset.
        choose = FidelityResolver(services.store).choose
        found = create_record(request.name, hands, objects, shared, choose, owner, scope.project)
    wanted = [(AssetKind.HAND, one.digest) for one in hands]
    wanted += [(AssetKind.OBJECT, one.digest) for one in objects]
    wanted += [(AssetKind.OBJECT, one.digest) for one in beside]
    wanted += [(AssetKind.NETWORK, shared.network)] if shared.network else []
    with record_transaction(services) as (connection, put):
        new = found is not None and put(key, found)
        record = found if found is not None and new else _load_existing(services, request.name)
        if record.project != scope.project:
            # Names are unique in the whole service. The message reveals nothing else of the other project.
            raise ConflictError(f"the name {record.name!r} is taken; take another name")
        # Options are compared instead of digests, because older records lack newer options.
        if not new and (other := _describe_difference(record, hands, objects, shared)):
            raise ConflictError(f"there is another dataset named {record.name!r} ({other}); take another name")
        records.refuse_pending_deletion(services.store, "dataset", record.name)
        refuse_deleted(services, wanted, connection)
        services.index.write_dataset.add(record, within=connection)
    return services.index.datasets.get(record.name), new


def cancel(services: Services, name: str) -> DatasetView:
    """Stop a dataset: no further jobs, and cancel unfinished ones; finished shards stay.

    A job continues if another dataset needs it or another key submitted it. NotFoundError: unknown dataset.
    ConflictError: it is finished or cancelled.
    """
    with record_transaction(services) as (connection, put):
        dataset = services.index.datasets.get(name)
        if dataset.cancelled or dataset.state.is_final:
            raise ConflictError(f"dataset {name!r} is {dataset.state} already; there is nothing to cancel")
        _add_event(services, name, "cancelled", connection, put)
    return services.index.datasets.get(name)


def retry(services: Services, name: str) -> DatasetView:
    """Restart a dataset's failed and cancelled cells, with new attempts; ConflictError if there are none."""
    with record_transaction(services) as (connection, put):
        dataset = services.index.datasets.get(name)
        if not dataset.cancelled and not dataset.states[State.FAILED] and not dataset.states[State.CANCELLED]:
            raise ConflictError(f"dataset {name!r} is {dataset.state}, and no cell failed; there is nothing to retry")
        _add_event(services, name, "retried", connection, put)
    return services.index.datasets.get(name)


def take_snapshot(services: Services, name: str) -> tuple[Snapshot, bool]:
    """Record the present shards; return the snapshot, and whether it is new; ConflictError without shards."""
    dataset = services.index.datasets.get(name)
    held = tuple(services.index.datasets.shards(name))
    if not held:
        raise ConflictError(f"dataset {name!r} has no shard yet; wait until a cell is done")
    base = [shard for shard in held if shard.kind == "base"]
    taken = Snapshot(
        dataset=name,
        dataset_digest=dataset.digest,
        digest=digest_json({"dataset": dataset.digest, "shards": sorted([s.id, s.sha256] for s in held)}),
        complete=dataset.state is State.SUCCEEDED,
        grasps=sum(shard.count for shard in base),
        valid=sum(shard.valid for shard in base),
        size_bytes=sum(shard.size_bytes for shard in held),
        created=timestamp(),
        shards=held,
    )
    with record_transaction(services) as (connection, put):
        if services.index.datasets.get(name).digest != dataset.digest:
            raise ConflictError(f"dataset {name!r} was deleted just now, and there is another one; try again")
        new = put(names.dataset_snapshot_key(name, taken.digest), taken)
        if not new:
            taken = records.load_snapshot(services.store, name, taken.digest)
        services.index.write_dataset.add_snapshot(taken, within=connection)
    return taken, new


def add_object_set(
    services: Services,
    name: str,
    objects: Iterable[str],
    *,
    owner: str = "",
    scope: ProjectScope = EVERYTHING,
    may_follow: Callable[[str, str], None] = lambda owner, project: None,
) -> ObjectSetView:
    """Name a set of objects; other objects under its name make a new version with the same owner.

    `may_follow(owner, project)` may raise before a new version. NotFoundError: unknown object. ConflictError: the name
    belongs to another project. InputError: no objects.
    """
    assets = [services.index.assets.get(AssetKind.OBJECT, one, scope=scope) for one in objects]
    wanted = tuple(asset.name for asset in assets)
    if not wanted:
        raise InputError(f"the set {name!r} holds no object; name at least one")
    # The newest version is read within the transaction, so that concurrent requests for one name see each other.
    with record_transaction(services) as (connection, put):
        after, project = "", scope.project
        if (present := services.index.object_sets.newest_version(name)) is not None:
            if not scope.can_see(present.project):
                raise ConflictError(f"the name {name!r} is taken; take another name")
            if set(present.objects) == set(wanted):
                return present
            after = present.digest
            known = records.read_record(ObjectSet, services.store, names.object_set_key(name, after))
            owner, project = known.owner, known.project
            may_follow(owner, project)
        refuse_deleted(services, [(AssetKind.OBJECT, one.digest) for one in assets], connection)
        found = create_object_set(name, wanted, after=after, owner=owner, project=project)
        if not put(key := names.object_set_key(name, found.digest), found):
            # An earlier request was interrupted before it wrote the row.
            found = records.read_record(ObjectSet, services.store, key)
            if not scope.can_see(found.project):
                raise ConflictError(f"the name {name!r} is taken; take another name")
        services.index.write_dataset.add_object_set(found, within=connection)
    return services.index.object_sets.get(name)


def resolve_members(
    services: Services, matrix: Matrix, scope: ProjectScope = EVERYTHING
) -> tuple[list[DatasetMember], list[DatasetMember]]:
    """Return names and digests of a matrix's hands and objects, sets included; errors as in `create`."""
    objects = expand_objects(services.index, matrix, scope)
    hands = _usable_members(services, AssetKind.HAND, matrix.hands, scope)
    return hands, _usable_members(services, AssetKind.OBJECT, objects, scope)


def _usable_members(
    services: Services, kind: AssetKind, wanted: Iterable[str], scope: ProjectScope
) -> list[DatasetMember]:
    assets = [usable_asset(services, kind, name, scope) for name in wanted]
    return list(dict.fromkeys(DatasetMember(name=asset.name, digest=asset.digest) for asset in assets))


def _load_existing(services: Services, name: str) -> DatasetRecord:
    try:
        return records.load_dataset(services.store, name)
    except NotFoundError:
        raise ConflictError(f"dataset {name!r} was deleted just now; create it again") from None


def _add_event(
    services: Services, name: str, what: Literal["cancelled", "retried"], connection: Connection, put: records.Put
) -> None:
    records.add_dataset_event(services.store, name, what, put=put)
    services.index.write_dataset.set_events(name, records.dataset_events(services.store, name), within=connection)


def _describe_difference(
    known: DatasetRecord, hands: list[DatasetMember], objects: list[DatasetMember], options: JobOptions
) -> str:
    """Describe how an existing dataset differs from a request for the same name; empty if it does not."""
    words = []
    for what, ours, theirs in (("hands", hands, known.hands), ("objects", objects, known.objects)):
        if tuple(ours) != theirs:
            words.append(f"its {what} are {_member_names(theirs)}")
    mine, other = ({name: getattr(one, name) for name in JobOptions.model_fields} for one in (options, known.options))
    words += [f"its {name} is {_format_value(other[name])}" for name in mine if mine[name] != other[name]]
    return "; ".join(words)


def _format_value(value: object) -> str:
    if isinstance(value, tuple) and value and isinstance(value[0], NamedNeighbour):
        return ", ".join(one.object for one in value)
    return "custom" if isinstance(value, SceneDocument) else repr(value)


def _member_names(members: Iterable[DatasetMember]) -> str:
    found = [member.name for member in members]
    more = f" and {len(found) - 5} more" if len(found) > 5 else ""
    return ", ".join(found[:5]) + more


class DatasetController:
    """Adds jobs of datasets and applies events of datasets to jobs, a part in each round."""

    def __init__(self, services: Services, *, clock: Callable[[], float] = time.monotonic) -> None:
        self._services = services
        self._clock = clock
        self._ranges = TaskRanges(services, clock=clock)
        self._positions: dict[tuple[str, int], int] = {}

    def advance(self, budget_s: float = BUDGET_S) -> bool:
        """Work for about `budget_s` [s]; return whether work is left."""
        deadline = self._clock() + budget_s
        for work in self._services.index.dataset_feed.pending_datasets():
            if not self._apply_event(work, deadline) or not self._plan(work, deadline):
                return True
        return False

    def _plan(self, work: DatasetWork, deadline: float) -> bool:
        """Add jobs for cells without one, until the deadline; return whether all have a job."""
        after, feed = -1, self._services.index.dataset_feed
        while not work.cancelled and (cells := feed.cells_to_plan(work.name, after=after, limit=_CELLS_AT_ONCE)):
            for cell in cells:
                if self._clock() > deadline:
                    return False
                job = create_job_record(cell, work.options, work.revisions, work.owner, work.project)
                job_actions.enter_job(self._services, self._ranges.with_span(job, among=len(cells)), keeps_assets=True)
                after = cell.position
        self._services.index.write_dataset.set_progress(work.name, planned=True)
        return True

    def _apply_event(self, work: DatasetWork, deadline: float) -> bool:
        """Cancel or retry jobs according to the last event, until the deadline; return whether all are done."""
        if work.applied >= work.events:
            return True
        key = (work.name, work.events)
        states = (State.QUEUED, State.RUNNING) if work.cancelled else (State.FAILED, State.CANCELLED)
        feed = self._services.index.dataset_feed
        cells = partial(feed.cells_in_states, work.name, states, limit=_CELLS_AT_ONCE, unshared=work.cancelled)
        while found := cells(after=self._positions.get(key, -1)):
            for position, job in found:
                if self._clock() > deadline:
                    return False
                self._apply_to_job(job, work)
                self._positions[key] = position
        self._positions.pop(key, None)
        self._services.index.write_dataset.set_progress(work.name, applied=work.events)
        return True

    def _apply_to_job(self, job: str, work: DatasetWork) -> None:
        cause = f"{work.name}/{work.events}"
        if any(event.cause == cause for event in records.job_events(self._services.store, job)):
            return
        act = job_actions.cancel if work.cancelled else job_actions.retry
        try:
            act(self._services, job, cause=cause)
        except ConflictError as error:
            # The job ended or was restarted after the query of the index.
            log.info("job %s of dataset %s is unchanged: %s", job, work.name, error)
