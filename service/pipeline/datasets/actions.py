"""What a user does to datasets: create, cancel, retry, snapshot. The planner carries it out, job by job."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Literal

from sqlalchemy import Connection

from graspd.service.index.views import DatasetView, ObjectSetView
from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.digests import digest_json
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import ConflictError, InputError, LimitError, NotFoundError
from graspd.service.model.projects import EVERYTHING, ProjectScope
from graspd.service.model.records import DatasetRecord, Member, ObjectSet, Snapshot, object_set_of
from graspd.service.model.scene_spec import NamedNeighbour, SceneDocument
from graspd.service.model.states import AssetKind, State
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets.spec import MAX_CELLS, DatasetRequest, Matrix, describe
from graspd.service.pipeline.fidelity_choice import Resolver
from graspd.service.pipeline.recording import recording
from graspd.service.pipeline.usable import usable, with_neighbours, with_network
from graspd.service.store.records import (
    Put,
    add_dataset_event,
    dataset_events,
    load_dataset,
    load_snapshot,
    read_record,
    refuse_pending,
)


def create(
    services: Services, request: DatasetRequest, *, owner: str = "", scope: ProjectScope = EVERYTHING
) -> tuple[DatasetView, bool]:
    """Record a dataset; the controller plans its jobs. The same hands, objects and options again are the same dataset.

    Args:
        owner: id of the API key that submits it; its jobs get the same.
        scope: which hands, objects and networks it may name, and the project that it and its jobs belong to.

    Returns:
        the dataset, and whether it is new. A failed or cancelled one is returned as it is: `retry` starts it again.

    Raises:
        NotFoundError: unknown hand, object, neighbour, network or set.
        InputError: one of them was refused when it was checked; the network is of another hand; no chart tells which
            fidelity meets the target.
        ConflictError: a check is still running, or the name stands for another dataset.
        LimitError: more than `MAX_CELLS` cells.
        QueueUnavailable, StoreUnavailable, IndexUnavailable: nothing was recorded.
    """
    hands, objects = members(services, request, scope)
    shared, beside = with_neighbours(services, request.shared, scope)
    shared = with_network(services, shared, hands, scope)
    services.queue.ping()
    key = names.dataset_record(request.name)
    # One that is there stays what it is: a later chart changes none of its fidelities.
    found = None
    if not services.store.exists(key):
        found = describe(request.name, hands, objects, shared, Resolver(services.store).choose, owner, scope.project)
    wanted = [(AssetKind.HAND, one.digest) for one in hands]
    wanted += [(AssetKind.OBJECT, one.digest) for one in objects]
    wanted += [(AssetKind.OBJECT, one.digest) for one in beside]
    wanted += [(AssetKind.NETWORK, shared.network)] if shared.network else []
    with recording(services) as (connection, put):
        new = found is not None and put(key, found)
        record = found if found is not None and new else _present(services, request.name)
        if record.project != scope.project:
            # Nothing else of it is said: names are of the whole service.
            raise ConflictError(f"the name {record.name!r} is taken; take another name")
        # Not by the digest: a newer graspd knows more options, whose defaults an older one meant as well.
        if not new and (other := _difference(record, hands, objects, shared)):
            raise ConflictError(f"there is another dataset named {record.name!r} ({other}); take another name")
        refuse_pending(services.store, "dataset", record.name)
        if missing := services.index.assets.missing(wanted, within=connection):
            raise NotFoundError(f"there is no {missing[0]} any more; it was deleted just now")
        services.index.write_dataset.add(record, within=connection)
    return services.index.datasets.get(record.name), new


def cancel(services: Services, name: str) -> DatasetView:
    """Stop a dataset: what is not planned never is, and its unfinished jobs are cancelled. Finished shards stay.

    A job that another dataset waits for as well goes on, and so does one that another key submitted.

    Raises:
        NotFoundError: unknown dataset.
        ConflictError: it is finished or cancelled already.
    """
    with recording(services) as (connection, put):
        dataset = services.index.datasets.get(name)
        if dataset.cancelled or dataset.state.is_final:
            raise ConflictError(f"dataset {name!r} is {dataset.state} already; there is nothing to cancel")
        _add_event(services, name, "cancelled", connection, put)
    return services.index.datasets.get(name)


def retry(services: Services, name: str) -> DatasetView:
    """Start the failed and cancelled cells of a dataset again, with fresh attempts; what is made is not made twice.

    Raises:
        NotFoundError: unknown dataset.
        ConflictError: no cell failed or was cancelled.
    """
    with recording(services) as (connection, put):
        dataset = services.index.datasets.get(name)
        if not dataset.cancelled and not dataset.states[State.FAILED] and not dataset.states[State.CANCELLED]:
            raise ConflictError(f"dataset {name!r} is {dataset.state}, and no cell failed; there is nothing to retry")
        _add_event(services, name, "retried", connection, put)
    return services.index.datasets.get(name)


def snapshot(services: Services, name: str) -> tuple[Snapshot, bool]:
    """Write down which shards a dataset holds now. The same shards again are the same snapshot.

    Returns:
        the snapshot, and whether it is new.

    Raises:
        NotFoundError: unknown dataset.
        ConflictError: the dataset has no shard yet.
    """
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
    with recording(services) as (connection, put):
        if services.index.datasets.get(name).digest != dataset.digest:
            raise ConflictError(f"dataset {name!r} was deleted just now, and there is another one; try again")
        new = put(names.dataset_snapshot(name, taken.digest), taken)
        if not new:
            taken = load_snapshot(services.store, name, taken.digest)
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
    """Give objects a name together. The same objects again change nothing; others make a new version.

    Args:
        owner: id of the API key that asks; a new version keeps the owner of the set.
        scope: which objects it may name, and the project that a new set belongs to.
        may_follow: called with owner and project of the set before it gets a new version; raises where that is refused.

    Raises:
        NotFoundError: unknown object.
        InputError: an object was refused when it was checked, or there is none.
        ConflictError: a check is still running.
    """
    assets = [services.index.assets.get(AssetKind.OBJECT, one, scope=scope) for one in objects]
    wanted = tuple(asset.name for asset in assets)
    if not wanted:
        raise InputError(f"the set {name!r} holds no object; name some")
    # Of two that want one name at once, the later one must see the earlier one's set.
    with recording(services) as (connection, put):
        after, project = "", scope.project
        if (present := services.index.object_sets.named(name)) is not None:
            if not scope.sees(present.project):
                raise ConflictError(f"the name {name!r} is taken; take another name")
            if set(present.objects) == set(wanted):
                return present
            after = present.digest
            known = read_record(ObjectSet, services.store, names.object_set(name, after))
            owner, project = known.owner, known.project
            may_follow(owner, project)
        if missing := services.index.assets.missing(
            [(AssetKind.OBJECT, one.digest) for one in assets], within=connection
        ):
            raise NotFoundError(f"there is no {missing[0]} any more; it was deleted just now")
        found = object_set_of(name, wanted, after=after, owner=owner, project=project)
        if not put(key := names.object_set(name, found.digest), found):
            # It broke off before its row was there.
            found = read_record(ObjectSet, services.store, key)
            if not scope.sees(found.project):
                raise ConflictError(f"the name {name!r} is taken; take another name")
        services.index.write_dataset.add_object_set(found, within=connection)
    return services.index.object_sets.get(name)


def members(services: Services, matrix: Matrix, scope: ProjectScope = EVERYTHING) -> tuple[list[Member], list[Member]]:
    """Hands and objects of a matrix as they are now, sets spelled out; errors as in `create`."""
    objects = dict.fromkeys(matrix.objects)
    for name in matrix.sets:
        objects |= dict.fromkeys(services.index.object_sets.get(name, scope=scope).objects)
    if len(matrix.hands) * len(objects) > MAX_CELLS:
        raise LimitError(f"{len(matrix.hands)} hands x {len(objects)} objects is over {MAX_CELLS} cells; split it")
    hands = _members(services, AssetKind.HAND, matrix.hands, scope)
    return hands, _members(services, AssetKind.OBJECT, objects, scope)


def _members(services: Services, kind: AssetKind, wanted: Iterable[str], scope: ProjectScope) -> list[Member]:
    assets = [usable(services, kind, name, scope) for name in wanted]
    found = [Member(name=asset.name, digest=asset.digest) for asset in assets]
    return list(dict.fromkeys(found))


def _present(services: Services, name: str) -> DatasetRecord:
    try:
        return load_dataset(services.store, name)
    except NotFoundError:
        raise ConflictError(f"dataset {name!r} was deleted just now; create it again") from None


def _add_event(
    services: Services, name: str, what: Literal["cancelled", "retried"], connection: Connection, put: Put
) -> None:
    add_dataset_event(services.store, name, what, put=put)
    services.index.write_dataset.set_events(name, dataset_events(services.store, name), within=connection)


def _difference(known: DatasetRecord, hands: list[Member], objects: list[Member], options: JobOptions) -> str:
    """What another dataset of the same name has that this one has not, in a few words; empty if it is the same."""
    words = []
    for what, ours, theirs in (("hands", hands, known.hands), ("objects", objects, known.objects)):
        if tuple(ours) != theirs:
            words.append(f"its {what} are {_named(theirs)}")
    # Not by their dumps: those leave out what is at its default.
    mine, other = ({name: getattr(one, name) for name in JobOptions.model_fields} for one in (options, known.options))
    words += [f"its {name} is {_said(other[name])}" for name in mine if mine[name] != other[name]]
    return "; ".join(words)


def _said(value: object) -> str:
    if isinstance(value, tuple) and value and isinstance(value[0], NamedNeighbour):
        return ", ".join(one.object for one in value)
    return "a document of its own" if isinstance(value, SceneDocument) else repr(value)


def _named(members: Iterable[Member]) -> str:
    found = [member.name for member in members]
    more = f" and {len(found) - 5} more" if len(found) > 5 else ""
    return ", ".join(found[:5]) + more
