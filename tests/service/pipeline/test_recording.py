"""What was answered 503 is nowhere: neither in the store, where a rebuild would find it, nor in the index."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from typing import Any

import pytest
from sqlalchemy import Connection, make_url
from sqlalchemy.exc import OperationalError

from graspd.service.index import database
from graspd.service.index.index import Index
from graspd.service.index.rebuild import differences
from graspd.service.model import names
from graspd.service.model.errors import IndexUnavailable
from graspd.service.model.planning import plan
from graspd.service.model.states import AssetKind
from graspd.service.pipeline import job_actions, tagging
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.spec import DatasetRequest
from graspd.service.pipeline.deletion import delete_asset, delete_job
from tests.fakes import make_task, record_of, request

ALL = (names.JOBS, names.DATASETS, names.OBJECT_SETS, names.TAGS, names.DELETIONS)


def finished(services: Services, **changes: object) -> str:
    """A job that succeeded."""
    job, _ = job_actions.submit(services, request(**changes))
    for task in plan(record := record_of(services, job.id)):
        make_task(services, record, task)
    return job.id


def create(services: Services) -> object:
    return actions.create(services, DatasetRequest(name="d", hands=["gripper"], objects=["ball"], grasps=1))


def cancelled(services: Services) -> str:
    job, _ = job_actions.submit(services, request(seed=1))
    job_actions.cancel(services, job.id)
    return job.id


NOBODYS: dict[str, Any] = {"project": "", "owner": "", "permit": lambda tag: None}


#: What is there before, and what a user does then, given the id of that.
ACTS: dict[str, tuple[Callable[[Services], str | object], Callable[[Services, str], object]]] = {
    "submit": (lambda services: "", lambda services, _: job_actions.submit(services, request())),
    "cancel": (lambda services: job_actions.submit(services, request())[0].id, job_actions.cancel),
    "retry": (cancelled, job_actions.retry),
    "delete a job": (finished, delete_job),
    "delete an object": (lambda _: "ball", lambda services, name: delete_asset(services, AssetKind.OBJECT, name)),
    "create": (lambda services: "", lambda services, _: create(services)),
    "cancel a dataset": (create, lambda services, _: actions.cancel(services, "d")),
    "name objects": (lambda services: "", lambda services, _: actions.add_object_set(services, "s", ["ball"])),
    "tag": (lambda services: "", lambda services, _: tagging.give(services, "t", [("a" * 32, 0)], **NOBODYS)),
}


@contextmanager
def locked(services: Services, monkeypatch: pytest.MonkeyPatch) -> Iterator[Services]:
    """Another process holds the index."""
    monkeypatch.setattr(database, "_BUSY_TIMEOUT_S", 0.05)
    index = Index(services.settings.resolved_index_url)
    with (
        closing(index),
        closing(sqlite3.connect(str(make_url(services.settings.resolved_index_url).database))) as other,
    ):
        other.execute("BEGIN IMMEDIATE")
        yield Services(services.settings, services.store, index, services.queue)


@contextmanager
def full(services: Services, monkeypatch: pytest.MonkeyPatch) -> Iterator[Services]:
    """No room on the disk when rows are to be kept."""

    def refuse(self: Connection) -> None:
        raise OperationalError("COMMIT", {}, Exception("database or disk is full"))

    with monkeypatch.context() as patch:
        patch.setattr(Connection, "commit", refuse)
        yield services


@pytest.mark.parametrize("away", [locked, full])
@pytest.mark.parametrize("what", ACTS)
def test_nothing_is_left_of_what_the_index_refused(
    services: Services, monkeypatch: pytest.MonkeyPatch, what: str, away: Callable[..., Iterator[Services]]
) -> None:
    prepare, act = ACTS[what]
    subject = str(prepare(services))
    before = {entry.key for folder in ALL for entry in services.store.list(folder)}
    with away(services, monkeypatch) as refusing, pytest.raises(IndexUnavailable):  # type: ignore[attr-defined]
        act(refusing, subject)
    assert {entry.key for folder in ALL for entry in services.store.list(folder)} == before
    assert differences(services.index, services.store) == []
    act(services, subject)
    assert differences(services.index, services.store) == []
