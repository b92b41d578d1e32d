"""What was answered 503 is nowhere: neither in the store, where a rebuild would find it, nor in the index."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager

import pytest
from sqlalchemy import Connection, make_url
from sqlalchemy.exc import OperationalError

from service.index import database
from service.index.index import Index
from service.index.rebuild import differences
from service.model import names
from service.model.errors import IndexUnavailable
from service.model.records import JobRecord
from service.model.states import AssetKind
from service.pipeline import job_actions, tagging
from service.pipeline.backends import Parts
from service.pipeline.datasets import actions
from service.pipeline.datasets.spec import DatasetRequest
from service.pipeline.deletion import delete_asset, delete_job
from service.store.records import read_record
from tests.fakes import make_shard, request
from tests.packs import tasks_of

ALL = (names.JOBS, names.DATASETS, names.OBJECT_SETS, names.TAGS, names.DELETIONS)


def finished(parts: Parts, **changes: object) -> str:
    """A job that succeeded."""
    job, _ = job_actions.submit(parts, request(**changes))
    record = read_record(JobRecord, parts.store, names.job_record(job.id))
    parts.index.write.add_manifests([make_shard(parts.store, task) for task in tasks_of(record)])
    return job.id


def create(parts: Parts) -> object:
    return actions.create(parts, DatasetRequest(name="d", hands=["gripper"], objects=["ball"], grasps=1))


def cancelled(parts: Parts) -> str:
    job, _ = job_actions.submit(parts, request(seed=1))
    job_actions.cancel(parts, job.id)
    return job.id


#: What is there before, and what a user does then, given the id of that.
ACTS: dict[str, tuple[Callable[[Parts], str | object], Callable[[Parts, str], object]]] = {
    "submit": (lambda parts: "", lambda parts, _: job_actions.submit(parts, request())),
    "cancel": (lambda parts: job_actions.submit(parts, request())[0].id, job_actions.cancel),
    "retry": (cancelled, job_actions.retry),
    "delete a job": (finished, delete_job),
    "delete an object": (lambda parts: "ball", lambda parts, name: delete_asset(parts, AssetKind.OBJECT, name)),
    "create": (lambda parts: "", lambda parts, _: create(parts)),
    "cancel a dataset": (create, lambda parts, _: actions.cancel(parts, "d")),
    "name objects": (lambda parts: "", lambda parts, _: actions.add_object_set(parts, "s", ["ball"])),
    "tag": (
        lambda parts: "",
        lambda parts, _: tagging.give(parts, "t", [("a" * 32, 0)], project="", owner="", permit=lambda tag: None),
    ),
}


@contextmanager
def locked(parts: Parts, monkeypatch: pytest.MonkeyPatch) -> Iterator[Parts]:
    """Another process holds the index."""
    monkeypatch.setattr(database, "_BUSY_TIMEOUT_S", 0.05)
    index = Index(parts.settings.resolved_index_url)
    with (
        closing(index),
        closing(sqlite3.connect(str(make_url(parts.settings.resolved_index_url).database))) as other,
    ):
        other.execute("BEGIN IMMEDIATE")
        yield Parts(parts.settings, parts.store, index, parts.queue)


@contextmanager
def full(parts: Parts, monkeypatch: pytest.MonkeyPatch) -> Iterator[Parts]:
    """No room on the disk when rows are to be kept."""

    def refuse(self: Connection) -> None:
        raise OperationalError("COMMIT", {}, Exception("database or disk is full"))

    with monkeypatch.context() as patch:
        patch.setattr(Connection, "commit", refuse)
        yield parts


@pytest.mark.parametrize("away", [locked, full])
@pytest.mark.parametrize("what", ACTS)
def test_nothing_is_left_of_what_the_index_refused(
    parts: Parts, monkeypatch: pytest.MonkeyPatch, what: str, away: Callable[..., Iterator[Parts]]
) -> None:
    prepare, act = ACTS[what]
    subject = str(prepare(parts))
    before = {entry.key for folder in ALL for entry in parts.store.list(folder)}
    with away(parts, monkeypatch) as refusing, pytest.raises(IndexUnavailable):  # type: ignore[attr-defined]
        act(refusing, subject)
    assert {entry.key for folder in ALL for entry in parts.store.list(folder)} == before
    assert differences(parts.index, parts.store) == []
    act(parts, subject)
    assert differences(parts.index, parts.store) == []
