"""Tasks that end together leave their shards in one object; none waits for what cannot come."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from service.model import names
from service.model.errors import StoreUnavailable
from service.model.messages import TaskMessage
from service.store.packs import pack_at
from service.store.store import Store, open_store
from tests.packing import batches, made_of
from worker.stages.packing import Packer

#: So long no test waits.
NEVER_S = 600.0


@pytest.fixture
def store(tmp_path: Path) -> Store:
    return open_store(tmp_path.as_uri())


def put_all(packer: Packer, tasks: Sequence[TaskMessage]) -> list[str]:
    """What each of these tasks, in a thread of its own, is told."""
    made = [made_of(task) for task in tasks]
    with ThreadPoolExecutor(len(tasks)) as pool:
        return list(pool.map(lambda task, one: packer.put(task.task_id, *one), tasks, made))


def always() -> bool:
    return True


def test_all_that_are_done_together_are_one_object_and_end_once(store: Store) -> None:
    tasks = batches(4)
    packer = Packer(store, 4, least=2, is_read=always, wait_s=NEVER_S)
    (key,) = set(put_all(packer, tasks))
    assert {shard.id for shard in pack_at(store, key).shards} == {task.output for task in tasks}
    ends = [packer.end(task.task_id, key) for task in tasks]
    assert ends[:3] == [()] * 3
    assert set(ends[3]) == {task.task_id for task in tasks}


@pytest.mark.parametrize(("least", "is_read"), [(5, always), (2, lambda: False)], ids=["too few", "nobody reads packs"])
def test_each_is_put_by_itself(store: Store, least: int, is_read: Callable[[], bool]) -> None:
    packer = Packer(store, 4, least=least, is_read=is_read, wait_s=NEVER_S)
    assert put_all(packer, batches(4)) == [""] * 4
    assert list(store.list(names.PACKS)) == []


def test_who_waits_is_let_go_when_no_other_can_come(store: Store) -> None:
    tasks = batches(2)
    packer = Packer(store, 3, least=2, is_read=always, wait_s=NEVER_S)
    with ThreadPoolExecutor(2) as pool:
        waiting = [pool.submit(packer.put, task.task_id, *made_of(task)) for task in tasks]
        packer.leave()
        (key,) = {one.result() for one in waiting}
    assert len(pack_at(store, key).shards) == 2


def test_a_shard_waits_for_others_only_so_long(store: Store) -> None:
    tasks = batches(3)
    packer = Packer(store, 3, least=1, is_read=always, wait_s=0.0)
    keys = [packer.put(task.task_id, *made_of(task)) for task in tasks]
    assert [[shard.id for shard in pack_at(store, key).shards] for key in keys] == [[task.output] for task in tasks]


def test_a_store_that_is_away_is_told_to_each(store: Store, monkeypatch: pytest.MonkeyPatch) -> None:
    def away(*_: object) -> bool:
        raise StoreUnavailable("the store is away")

    packer = Packer(store, 2, least=2, is_read=always, wait_s=NEVER_S)
    tasks, told = batches(2), list[str]()
    made = made_of(tasks[0])
    monkeypatch.setattr(Store, "put", away)

    def put(task: TaskMessage) -> None:
        try:
            packer.put(task.task_id, *made)
        except StoreUnavailable as error:
            told.append(str(error))

    threads = [threading.Thread(target=put, args=(task,)) for task in tasks]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert told == ["the store is away"] * 2
