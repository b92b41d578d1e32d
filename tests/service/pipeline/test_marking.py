"""Store and index stay in step: an older copy of either is not believed, and what was answered 503 is in neither."""

import shutil
import sqlite3
import threading
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from sqlalchemy import Connection, make_url
from sqlalchemy.exc import OperationalError

from graspd.service.index import database
from graspd.service.index import rebuild as rebuilding
from graspd.service.index.index import Index
from graspd.service.index.notes import Notes
from graspd.service.index.rebuild import differences
from graspd.service.model import names
from graspd.service.model.clock import timestamp
from graspd.service.model.errors import IndexUnavailable
from graspd.service.model.planning import create_task_message, plan_tasks
from graspd.service.model.states import AssetKind
from graspd.service.pipeline import controller, job_actions, tagging
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.spec import DatasetRequest
from graspd.service.pipeline.deletion import delete_asset, delete_job
from graspd.service.queue.port import Event, EventKind
from graspd.service.settings import Settings
from tests.fakes import add_assets, make_shard, record_of, request
from tests.indexes import open_services
from tests.service.pipeline.test_deletion import finished


@pytest.fixture
def rebuilt(monkeypatch: pytest.MonkeyPatch) -> list[object]:
    """Stores from which an index was made."""
    made = list[object]()

    def noted(index: Index, store: object, **more: object) -> object:
        made.append(store)
        return rebuilding.rebuild(index, store, **more)  # type: ignore[arg-type]

    monkeypatch.setattr(controller, "rebuild", noted)
    return made


def in_service(folder: Path, act: Callable[[Services], object] = lambda services: None) -> list[str]:
    """A controller starts, a user does something, the controller stops; how the index then differs from the store."""
    with closing(open_services(Settings(data_dir=folder))) as services:
        working = controller.Controller(services)
        working.run_round()
        add_assets(services)
        act(services)
        working.run_round()
        stop = threading.Event()
        stop.set()
        working.run(stop)
        return [line for line in differences(services.index, services.store) if not line.startswith("assets ")]


def submit(seed: int) -> Callable[[Services], object]:
    return lambda services: job_actions.submit(services, request(seed=seed))


def make_first_shard(services: Services) -> None:
    record = record_of(services, services.index.jobs.page().items[0].id)
    task = next(plan_tasks(record))
    make_shard(services.store, create_task_message(record, task, attempt=1, max_attempt=3))
    done = Event(kind=EventKind.FINISHED, at=timestamp(), task_id=task.id, stage=task.stage, output=task.output)
    services.queue.publish(done)


def copy_index(folder: Path, target: Path) -> None:
    target.mkdir(exist_ok=True)
    for old in target.glob("index.sqlite*"):
        old.unlink()
    for file in folder.glob("index.sqlite*"):
        shutil.copy2(file, target)


def test_an_older_copy_of_the_index_is_made_anew(tmp_path: Path, rebuilt: list[object]) -> None:
    """One that lacks jobs and records, then one that lacks what a worker made; neither is made anew again."""
    data, backup = tmp_path / "data", tmp_path / "backup"
    in_service(data, submit(1))
    copy_index(data, backup)
    in_service(data, submit(2))
    in_service(data, lambda services: actions.add_object_set(services, "balls", ["ball"]))
    copy_index(backup, data)
    assert rebuilt == []
    assert in_service(data) == []
    assert len(rebuilt) == 1
    assert in_service(data, submit(3)) == []
    assert len(rebuilt) == 1
    copy_index(data, backup)
    in_service(data, make_first_shard)
    copy_index(backup, data)
    assert in_service(data) == []
    assert len(rebuilt) == 2


def test_an_older_copy_of_the_store_is_believed(tmp_path: Path, rebuilt: list[object]) -> None:
    data, backup = tmp_path / "data", tmp_path / "backup"
    in_service(data, submit(1))
    shutil.copytree(data / "store", backup)
    in_service(data, submit(2))
    shutil.rmtree(data / "store")
    shutil.copytree(backup, data / "store")
    assert in_service(data) == []
    assert len(rebuilt) == 1


def test_a_copy_that_is_as_new_as_the_store_is_kept(tmp_path: Path, rebuilt: list[object]) -> None:
    data, backup = tmp_path / "data", tmp_path / "backup"
    in_service(data, submit(1))
    copy_index(data, backup)
    in_service(data)
    copy_index(backup, data)
    assert in_service(data) == []
    assert rebuilt == []


def test_an_index_exchanged_meanwhile_is_made_anew(tmp_path: Path, rebuilt: list[object]) -> None:
    data, backup = tmp_path / "data", tmp_path / "backup"
    in_service(data, submit(1))
    copy_index(data, backup)
    in_service(data, submit(2))
    services = open_services(Settings(data_dir=data))
    working = controller.Controller(services)
    working.run_round()
    for file in data.glob("index.sqlite*"):
        file.unlink()
    copy_index(backup, data)
    working.run_round()
    assert len(services.index.jobs.page().items) == 2
    services.close()


def test_a_controller_killed_between_index_and_store_is_harmless(
    tmp_path: Path, rebuilt: list[object], monkeypatch: pytest.MonkeyPatch
) -> None:
    data, real = tmp_path / "data", Notes.set_store_mark

    def killed(notes: Notes, *args: object, **more: object) -> None:
        real(notes, *args, **more)  # type: ignore[arg-type]
        raise KeyboardInterrupt

    in_service(data, submit(1))
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(Notes, "set_store_mark", killed)
        in_service(data, submit(2))
    assert in_service(data) == []
    assert rebuilt == []


ALL = (names.JOBS, names.DATASETS, names.OBJECT_SETS, names.TAGS, names.DELETIONS)


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
    "tag": (lambda services: "", lambda services, _: tagging.tag_grasps(services, "t", [("a" * 32, 0)], **NOBODYS)),
}


@contextmanager
def locked(services: Services, monkeypatch: pytest.MonkeyPatch) -> Iterator[Services]:
    """Another process holds the index."""
    monkeypatch.setattr(database, "_BUSY_TIMEOUT_S", 0.05)
    url = services.settings.resolved_index_url
    with closing(Index(url)) as index, closing(sqlite3.connect(str(make_url(url).database))) as other:
        other.execute("BEGIN IMMEDIATE")
        yield Services(services.settings, services.store, index, services.queue)


@contextmanager
def full(services: Services, monkeypatch: pytest.MonkeyPatch) -> Iterator[Services]:
    """No room on the disk when rows are to be kept."""
    error = OperationalError("COMMIT", {}, Exception("database or disk is full"))
    with monkeypatch.context() as patch:
        patch.setattr(Connection, "commit", Mock(side_effect=error))
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
