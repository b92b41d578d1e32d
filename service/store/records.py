"""JSON records in the store besides shards: jobs, attempts, datasets, tags, marks, deletions, studies.

A record of a kind is `{kind}/{created}.json`; `charts` come from `graspd chart`, `scene_charts/{scene}` from it with a
scene, `stability` from `graspd stability`.
"""

from __future__ import annotations

import contextlib
import itertools
import json
import re
import secrets
from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Any, Final, Literal, TypeVar

from pydantic import BaseModel, Field, ValidationError

from graspd.service.model import names
from graspd.service.model.base import refusal
from graspd.service.model.clock import timestamp
from graspd.service.model.digests import digest_json
from graspd.service.model.errors import ConflictError, DamagedError, NotFoundError
from graspd.service.model.records import (
    AttemptRecord,
    DatasetEvent,
    DatasetRecord,
    JobEvent,
    JobRecord,
    Record,
    Snapshot,
    Tag,
)
from graspd.service.model.renamed import has_old_names, renamed
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.store.integrity import get_document, is_sealed, put_document, put_sealed
from graspd.service.store.store import Store

RecordT = TypeVar("RecordT", bound=BaseModel)
#: Writes a record under a key if there is none; whether there was none.
Put = Callable[[str, BaseModel], bool]


def read_record(model: type[RecordT], store: Store, key: str) -> RecordT:
    """A record by its key; NotFoundError if there is none, DamagedError if it is not what its name says."""
    return parse_record(model, store.get(key), key)


def parse_record(model: type[RecordT], data: bytes, key: str) -> RecordT:
    """A record from its bytes; DamagedError if they are not those that were sealed, or hold no such record."""
    is_sealed(key, [data], len(data))
    try:
        if has_old_names(data):
            return model.model_validate(renamed(json.loads(data)))
        return model.model_validate_json(data)
    except ValidationError as error:
        raise DamagedError(
            f"the record {key} in the store is damaged ({refusal(error)}); put a copy in its place, or "
            "remove it and retry its job"
        ) from None


def put_record(store: Store, key: str, record: BaseModel) -> bool:
    """Write a record if there is none yet; False if there was."""
    return put_sealed(store, key, record.model_dump_json().encode())


def job_events(store: Store, job: str) -> list[JobEvent]:
    """What users did to a job, in order."""
    keys = sorted(entry.key for entry in store.list(names.job_events(job)))
    return [read_record(JobEvent, store, key) for key in keys]


def add_job_event(
    store: Store,
    job: str,
    what: Literal["cancelled", "retried"],
    retried: dict[str, int] | None = None,
    *,
    cause: str = "",
    put: Put | None = None,
) -> JobEvent:
    """Append an event after those there are; the state of a job follows from reading them all again, in order."""
    put = put or partial(put_record, store)
    while True:
        taken = [int(entry.key.rsplit("/", 1)[1].partition("-")[0]) for entry in store.list(names.job_events(job))]
        number = max(taken, default=0) + 1
        event = JobEvent(number=number, what=what, at=timestamp(), retried=retried or {}, cause=cause)
        if put(names.job_event(job, event.number, what), event):
            return event


def task_attempts(store: Store, task: str) -> list[AttemptRecord]:
    """Failed attempts of a task, in order."""
    entries = [entry.key for entry in store.list(names.attempts(task))]
    return sorted((read_record(AttemptRecord, store, key) for key in entries), key=lambda attempt: attempt.number)


def load_dataset(store: Store, name: str) -> DatasetRecord:
    """The record of a dataset; NotFoundError if there is none."""
    return read_record(DatasetRecord, store, names.dataset_record(name))


def dataset_events(store: Store, name: str) -> list[DatasetEvent]:
    """What users did to a dataset, in order."""
    keys = sorted(entry.key for entry in store.list(names.dataset_events(name)))
    return [read_record(DatasetEvent, store, key) for key in keys]


def add_dataset_event(
    store: Store, name: str, what: Literal["cancelled", "retried"], *, put: Put | None = None
) -> DatasetEvent:
    """Append an event after those there are."""
    put = put or partial(put_record, store)
    while True:
        taken = [event.number for event in dataset_events(store, name)]
        event = DatasetEvent(number=max(taken, default=0) + 1, what=what, at=timestamp())
        if put(names.dataset_event(name, event.number, what), event):
            return event


def load_snapshot(store: Store, dataset: str, digest: str) -> Snapshot:
    """A snapshot; NotFoundError if there is none."""
    return read_record(Snapshot, store, names.dataset_snapshot(dataset, digest))


def newest_snapshot(store: Store, dataset: str, digest: str | None = None) -> Snapshot:
    """The newest snapshot of a dataset, or the one with a digest; NotFoundError if there is none."""
    if digest is not None:
        return load_snapshot(store, dataset, digest)
    taken = [read_record(Snapshot, store, entry.key) for entry in store.list(names.dataset_snapshots(dataset))]
    if not taken:
        raise NotFoundError(f"dataset {dataset!r} has no snapshot; `graspd datasets snapshot {dataset}` takes one")
    return max(taken, key=lambda one: (one.created, one.digest))


def newest_version(store: Store, tag: str) -> Tag | None:
    """A tag as it is; None: there is none.

    Raises:
        DamagedError: its record is not what its name says.
    """
    keys = sorted(entry.key for entry in store.list(names.tag_versions(tag)))
    return read_record(Tag, store, keys[-1]) if keys else None


def put_version(put: Put, tag: Tag) -> None:
    """Write a tag after a change.

    Raises:
        ConflictError: another change came first.
    """
    if not put(names.tag_version(tag.id, tag.number), tag):
        raise ConflictError(f"the tag {tag.name!r} was changed a moment ago; try again")


def drop_older(store: Store, tag: Tag) -> None:
    """Remove the versions that no longer count; of a tag that is gone the last one too, which goes last."""
    last = names.tag_version(tag.id, tag.number)
    for key in sorted(entry.key for entry in store.list(names.tag_versions(tag.id))):
        if key < last or (key == last and tag.gone):
            store.delete(key)


def newest_mark(store: Store) -> str:
    """The mark of a store; empty where it has none yet."""
    return max((entry.key.rpartition("/")[2].removesuffix(".json") for entry in store.list(names.MARKS)), default="")


def next_mark(mark: str) -> str:
    """One that sorts behind a mark, and that no other store or index has."""
    number = int(mark.partition("-")[0] or 0) + 1
    return f"{number:012}-{secrets.token_hex(4)}"


def set_mark(store: Store, mark: str) -> None:
    """Give a store another mark."""
    put_document(store, names.mark(mark), {"at": timestamp()})
    for key in [entry.key for entry in store.list(names.MARKS)]:
        if key != names.mark(mark):
            store.delete(key)


CHARTS: Final = "charts"
IN_SCENES: Final = "scene_charts"
STABILITY: Final = "stability"


def charts_of(place: SceneSpec) -> str:
    """The kind of the charts that hold for a scene: one for each kind of scene, and one for each scene file, by its
    supports and the target's pose. Neighbours, faces and `touch` do not count."""
    if place.kind == "free":
        return CHARTS
    if place.kind != "file":
        return f"{IN_SCENES}/{place.kind}"
    told = place.model_dump(mode="json", include={"supports", "target"})
    return f"{IN_SCENES}/file-{digest_json(told)[:12]}"


def kind_of(chart: Mapping[str, Any]) -> str:
    """The kind of a chart as `graspd chart` made it."""
    return charts_of(SceneSpec.model_validate(chart["scene"])) if "scene" in chart else CHARTS


def scene_kinds(store: Store) -> list[str]:
    """The kinds of charts in scenes of which there is one, by name."""
    return sorted({entry.key.rpartition("/")[0] for entry in store.list(IN_SCENES) if entry.key.endswith(".json")})


def publish(store: Store, kind: str, record: Mapping[str, Any]) -> str:
    """Put a record beside the earlier ones of its kind; its key follows from its `created`, and those of one moment
    are numbered.

    Raises:
        ValueError: a number in it that JSON does not know.
    """
    stem = f"{kind}/{re.sub(r'[^0-9A-Za-z]', '', str(record['created']))}"
    keys = (f"{stem}{number:03}.json" if number else f"{stem}.json" for number in itertools.count())
    data = json.dumps(record, allow_nan=False).encode()
    return next(key for key in keys if put_sealed(store, key, data))


def latest(store: Store, kind: str) -> dict[str, Any] | None:
    """The record of a kind that was published last; None where there is none.

    Raises:
        DamagedError: its bytes are not those that were published.
    """
    key = latest_key(store, kind)
    return get_document(store, key) if key else None


def latest_key(store: Store, kind: str) -> str:
    """The key of that record; empty where there is none."""
    return max((entry.key for entry in store.list(kind) if entry.key.endswith(".json")), default="")


_DIGITS: Final = re.compile(r"\D")
What = Literal["hand", "object", "network", "job", "dataset", "tag"]


class Deletion(Record):
    """One thing that is gone, and what its removal needs to know once its own record is gone too."""

    version: Literal[1] = 1
    what: What
    id: str
    at: str
    owner: str = Field("", description="id of the API key that deleted it")
    name: str = Field("", description="what its users call it, where that is not its id")
    submitter: str = Field("", description="id of the API key that it was submitted with")
    project: str = ""
    job: JobRecord | None = None
    attempts: tuple[tuple[str, int], ...] = ()


class DeletedJob(Record):
    """A job that was deleted: its shards go when nobody has needed them for the grace time."""

    version: Literal[1] = 1
    at: str
    job: JobRecord


def pending(store: Store) -> set[tuple[str, str]]:
    """Kind and id of all that is gone but still has objects in the store."""
    keys = [entry.key.split("/") for entry in store.list(names.DELETIONS)]
    return {(key[1], key[2].removesuffix(".json")) for key in keys if len(key) == 3}


def refuse_pending(store: Store, what: str, name: str) -> None:
    """ConflictError while a thing of this id is being removed: what is new would be removed with it."""
    if store.exists(names.deletion(what, name)):
        raise ConflictError(f"the {what} {name} of before is still being removed; try again in a moment")


def removed_folder(deletion: Deletion) -> str:
    """Where the objects of a deleted thing lie until the grace time ends; the same deletion has the same."""
    return f"{names.REMOVED}/{_DIGITS.sub('', deletion.at)}-{deletion.what}-{deletion.id}"


def removed_before(key: str, at: str) -> bool:
    """Whether an object below `removed/` belongs to a deletion from before a time."""
    return key.split("/")[1].partition("-")[0] < _DIGITS.sub("", at)


def deletions(store: Store, what: str = "") -> list[Deletion]:
    """Deletions that can be taken back, the newest first; of one kind of thing or of all."""
    found: dict[str, Deletion] = {}

    def read(keys: Iterable[str]) -> None:
        for key in keys:
            with contextlib.suppress(NotFoundError, DamagedError):
                deletion = read_record(Deletion, store, key)
                found[removed_folder(deletion)] = deletion

    # What the controller moves meanwhile is in the second folder before it leaves the first.
    waiting = [entry.key for entry in store.list(names.DELETIONS) if entry.key.count("/") == 2]
    read(key for key in waiting if not what or key.split("/")[1] == what)
    removed = [entry.key for entry in store.list(names.REMOVED) if entry.key.count("/") == 2]
    read(key for key in removed if not what or key.split("-")[1] == what)
    return sorted(found.values(), key=lambda one: one.at, reverse=True)


def released_key(deletion: Deletion) -> str:
    """Where a deleted job's shards are remembered; the same deletion, carried out again, has the same."""
    return f"{names.RELEASED}/{_DIGITS.sub('', deletion.at)}-{deletion.id}.json"
