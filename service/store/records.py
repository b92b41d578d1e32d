"""JSON records in the store: jobs, attempts, datasets, tags, marks, deletions, studies.

The key of a study is `{kind}/{created}.json`, with kind `charts` or `scene_charts/{scene}` for `graspd chart`, and
`stability` for `graspd stability`.
"""

import contextlib
import itertools
import json
import re
import secrets
from collections.abc import Callable, Mapping
from functools import partial
from typing import Any, Final, Literal, TypeVar

from pydantic import BaseModel, Field, ValidationError

from graspd.service.model import names, records
from graspd.service.model.base import first_error
from graspd.service.model.clock import timestamp
from graspd.service.model.digests import digest_json
from graspd.service.model.errors import ConflictError, DamagedError, NotFoundError
from graspd.service.model.renamed import convert_chart, convert_names, has_old_names
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.store.integrity import get_document, is_sealed, put_document, put_sealed
from graspd.service.store.store import Store

RecordT = TypeVar("RecordT", bound=BaseModel)
EventT = TypeVar("EventT", records.JobEvent, records.DatasetEvent)
#: Function that writes a record, unless the key exists; returns whether it wrote the record.
Put = Callable[[str, BaseModel], bool]


def read_record(model: type[RecordT], store: Store, key: str) -> RecordT:
    return parse_record(model, store.get(key), key)


def parse_record(model: type[RecordT], data: bytes, key: str) -> RecordT:
    is_sealed(key, [data], len(data))
    try:
        if has_old_names(data):
            return model.model_validate(convert_names(json.loads(data)))
        return model.model_validate_json(data)
    except ValidationError as error:
        raise DamagedError(
            f"the record {key} in the store is damaged ({first_error(error)}); put a copy in its place, or "
            "remove it and retry its job"
        ) from None


def put_record(store: Store, key: str, record: BaseModel) -> bool:
    return put_sealed(store, key, record.model_dump_json().encode())


def _records(model: type[RecordT], store: Store, prefix: str) -> list[RecordT]:
    return [read_record(model, store, key) for key in store.keys(prefix)]


def _append_event(make: Callable[..., EventT], store: Store, folder: str, put: Put | None) -> EventT:
    """Write an event under the next free number; try again if another process takes the number first."""
    while True:
        number = max((int(key.rpartition("/")[2].partition("-")[0]) for key in store.keys(folder)), default=0) + 1
        event = make(number=number, at=timestamp())
        if (put or partial(put_record, store))(f"{folder}/{number:06}-{event.what}.json", event):
            return event


def job_events(store: Store, job: str) -> list[records.JobEvent]:
    return _records(records.JobEvent, store, names.job_events_folder(job))


def add_job_event(
    store: Store,
    job: str,
    what: Literal["cancelled", "retried"],
    retried: dict[str, int] | None = None,
    *,
    cause: str = "",
    put: Put | None = None,
) -> records.JobEvent:
    make = partial(records.JobEvent, what=what, retried=retried or {}, cause=cause)
    return _append_event(make, store, names.job_events_folder(job), put)


def task_attempts(store: Store, task: str) -> list[records.AttemptRecord]:
    return sorted(
        _records(records.AttemptRecord, store, names.attempts_folder(task)), key=lambda attempt: attempt.number
    )


def load_dataset(store: Store, name: str) -> records.DatasetRecord:
    return read_record(records.DatasetRecord, store, names.dataset_record_key(name))


def dataset_events(store: Store, name: str) -> list[records.DatasetEvent]:
    return _records(records.DatasetEvent, store, names.dataset_events_folder(name))


def add_dataset_event(
    store: Store, name: str, what: Literal["cancelled", "retried"], *, put: Put | None = None
) -> records.DatasetEvent:
    return _append_event(partial(records.DatasetEvent, what=what), store, names.dataset_events_folder(name), put)


def load_snapshot(store: Store, dataset: str, digest: str) -> records.Snapshot:
    return read_record(records.Snapshot, store, names.dataset_snapshot_key(dataset, digest))


def newest_snapshot(store: Store, dataset: str, digest: str | None = None) -> records.Snapshot:
    if digest is not None:
        return load_snapshot(store, dataset, digest)
    snapshots = _records(records.Snapshot, store, names.dataset_snapshots_folder(dataset))
    if not snapshots:
        raise NotFoundError(f"dataset {dataset!r} has no snapshot; `graspd datasets snapshot {dataset}` takes one")
    return max(snapshots, key=lambda snapshot: (snapshot.created, snapshot.digest))


def newest_tag_version(store: Store, tag: str) -> records.Tag | None:
    keys = store.keys(names.tag_versions_folder(tag))
    return read_record(records.Tag, store, keys[-1]) if keys else None


def put_tag_version(put: Put, tag: records.Tag) -> None:
    """Write the next version of a tag; ConflictError if another change was written first."""
    if not put(names.tag_version_key(tag.id, tag.number), tag):
        raise ConflictError(f"the tag {tag.name!r} was changed a moment ago; try again")


def delete_older_tag_versions(store: Store, tag: records.Tag) -> None:
    """Remove outdated versions of a tag; for a deleted tag then also the last version."""
    last = names.tag_version_key(tag.id, tag.number)
    for key in store.keys(names.tag_versions_folder(tag.id)):
        if key < last or (key == last and tag.gone):
            store.delete(key)


def newest_mark(store: Store) -> str:
    return max(store.keys(names.MARKS), default="").rpartition("/")[2].removesuffix(".json")


def next_mark(mark: str) -> str:
    """Return a new unique mark that sorts after `mark`."""
    return f"{int(mark.partition('-')[0] or 0) + 1:012}-{secrets.token_hex(4)}"


def set_mark(store: Store, mark: str) -> None:
    put_document(store, names.mark_key(mark), {"at": timestamp()})
    for key in store.keys(names.MARKS):
        if key != names.mark_key(mark):
            store.delete(key)


CHARTS: Final = "charts"
IN_SCENES: Final = "scene_charts"
STABILITY: Final = "stability"


def scene_chart_kind(place: SceneSpec) -> str:
    """Return the kind of charts for a scene; supports and the target's pose identify a scene file."""
    if place.kind == "free":
        return CHARTS
    if place.kind != "file":
        return f"{IN_SCENES}/{place.kind}"
    content = place.model_dump(mode="json", include={"supports", "target"})
    return f"{IN_SCENES}/file-{digest_json(content)[:12]}"


def scene_kinds(store: Store) -> list[str]:
    return sorted({key.rpartition("/")[0] for key in store.keys(IN_SCENES) if key.endswith(".json")})


def publish_record(store: Store, kind: str, record: Mapping[str, Any]) -> str:
    """Store a record of a kind; return its key, with a number if another record has the same time."""
    stem = f"{kind}/{re.sub(r'[^0-9A-Za-z]', '', str(record['created']))}"
    keys = (f"{stem}{number:03}.json" if number else f"{stem}.json" for number in itertools.count())
    data = json.dumps(record, allow_nan=False).encode()
    return next(key for key in keys if put_sealed(store, key, data))


def latest_record(store: Store, kind: str) -> dict[str, Any] | None:
    """Load the newest record of a kind, with present names; None if there is none."""
    key = latest_record_key(store, kind)
    return convert_chart(get_document(store, key)) if key else None


def latest_record_key(store: Store, kind: str) -> str:
    return max((key for key in store.keys(kind) if key.endswith(".json")), default="")


_DIGITS: Final = re.compile(r"\D")
What = Literal["hand", "object", "network", "job", "dataset", "tag"]


class Deletion(records.Record):
    """Deleted resource, with the data for its removal after the removal of its own record."""

    version: Literal[1] = 1
    what: What
    id: str
    at: str
    owner: str = Field("", description="id of the API key that deleted it")
    name: str = Field("", description="name for users, if it differs from the id")
    submitter: str = Field("", description="id of the API key that submitted it")
    project: str = ""
    job: records.JobRecord | None = None
    attempts: tuple[tuple[str, int], ...] = ()


class DeletedJob(records.Record):
    """Deleted job. Its shards are removed after the grace time, unless another job needs them."""

    version: Literal[1] = 1
    at: str
    job: records.JobRecord


def pending_deletions(store: Store) -> set[tuple[str, str]]:
    keys = [key.split("/") for key in store.keys(names.DELETIONS)]
    return {(key[1], key[2].removesuffix(".json")) for key in keys if len(key) == 3}


def refuse_pending_deletion(store: Store, what: str, name: str) -> None:
    if store.exists(names.deletion_key(what, name)):
        raise ConflictError(f"the deleted {what} {name} is still being removed; try again in a moment")


def removed_folder(deletion: Deletion) -> str:
    """Return the folder of the objects of a deleted resource until the end of the grace time."""
    return f"{names.REMOVED}/{_DIGITS.sub('', deletion.at)}-{deletion.what}-{deletion.id}"


def is_removed_before(key: str, at: str) -> bool:
    """Check whether a key below `removed/` belongs to a deletion before the time `at`."""
    return key.split("/")[1].partition("-")[0] < _DIGITS.sub("", at)


def restorable_deletions(store: Store, what: str = "") -> list[Deletion]:
    """Return the deletions that can be undone, newest first, of one kind of resource or of all."""
    found: dict[str, Deletion] = {}
    # The controller copies a deletion to the second folder, and then removes it from the first folder.
    for folder, before_kind in ((names.DELETIONS, "/"), (names.REMOVED, "-")):
        for key in store.keys(folder):
            if key.count("/") == 2 and (not what or key.split(before_kind)[1] == what):
                with contextlib.suppress(NotFoundError, DamagedError):
                    deletion = read_record(Deletion, store, key)
                    found[removed_folder(deletion)] = deletion
    return sorted(found.values(), key=lambda one: one.at, reverse=True)


def released_key(deletion: Deletion) -> str:
    """Return the key of the `DeletedJob` of a deletion."""
    return f"{names.RELEASED}/{_DIGITS.sub('', deletion.at)}-{deletion.id}.json"
