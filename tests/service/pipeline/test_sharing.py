"""Shards of the keepers' work that are held, renewed, shared out anew, lost and given back."""

from __future__ import annotations

import threading
from collections.abc import Collection
from pathlib import Path

import pytest

from service.heartbeat_file import HeartbeatFile
from service.model.errors import QueueUnavailable
from service.model.keeper_shards import ALL_SHARDS, KeeperShards
from service.pipeline.sharing import Sharing
from service.queue.port import Share
from tests.memory_queue import MemoryQueue
from tests.waiting import PATIENCE_S, until


class Moody(MemoryQueue):
    """A queue whose Redis may be away."""

    away = False
    asked_in_vain = 0

    def take_share(self, holder: str, seconds: float, *, number: int, before: Collection[int] = ()) -> Share:
        if self.away:
            self.asked_in_vain += 1
            raise QueueUnavailable("away")
        return super().take_share(holder, seconds, number=number, before=before)


#: Longer than any test: no lease runs out on a busy machine.
LEASE_S = 600.0


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leases are renewed every 10 ms."""
    monkeypatch.setattr("service.pipeline.sharing._RENEWALS", LEASE_S * 100)


class Pauses(threading.Event):
    """A word to stop, for which nobody waits: each pause moves the queue's clock on."""

    def __init__(self) -> None:
        super().__init__()
        self.now = 0.0
        self.queue = MemoryQueue(clock=lambda: self.now)

    def wait(self, timeout: float | None = None) -> bool:
        self.now += timeout or 0.0
        return self.is_set()


def sharing(queue: MemoryQueue, *, number: int = 1, file: Path | None = None) -> Sharing:
    return Sharing(queue, number=number, lease_s=LEASE_S, alive=HeartbeatFile(file))


def held_by(queue: MemoryQueue, holder: str) -> set[int]:
    return {one.shard for one in queue.keepers("keeper") if one.holder == holder}


def test_a_lease_is_renewed_for_as_long_as_it_is_held_and_then_given_back() -> None:
    queue, stop = MemoryQueue(), threading.Event()
    mine = sharing(queue)
    assert mine.wait(stop) == ALL_SHARDS
    begun = queue._leases[0][1]
    with mine.held(stop) as over:
        until(lambda: queue._leases[0][1] > begun, "it is renewed")
        assert not queue.take_share("another", 600, number=1).held
        assert not over.is_set()
        stop.set()
        assert over.wait(PATIENCE_S)
    assert queue.take_share("another", 600, number=1).held == {0}


def test_who_waits_leads_within_a_lease_and_a_look_after_the_other_fell_silent(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr("service.pipeline.sharing._RENEWALS", 3.0)
    stop = Pauses()
    stop.queue.take_share("silent", LEASE_S, number=1)
    assert sharing(stop.queue).wait(stop) == ALL_SHARDS
    assert LEASE_S <= stop.now <= LEASE_S * 4 / 3


def test_who_waits_lives_and_can_be_told_to_stop(tmp_path: Path) -> None:
    queue, stop = MemoryQueue(), threading.Event()
    queue.take_share("another", 600, number=1)
    waiting = sharing(queue, file=tmp_path / "alive")
    ended: list[KeeperShards | None] = []
    thread = threading.Thread(target=lambda: ended.append(waiting.wait(stop)))
    thread.start()
    until((tmp_path / "alive").exists, "health checks would end it")
    stop.set()
    thread.join(PATIENCE_S)
    assert ended == [None]


def test_a_lease_that_another_has_is_over_and_is_not_given_back() -> None:
    queue, stop = MemoryQueue(), threading.Event()
    mine = sharing(queue)
    assert mine.wait(stop)
    with mine.held(stop) as over:
        with queue._changed:
            queue._leases[0] = ("another", queue.clock() + 600)
        assert over.wait(PATIENCE_S)
        stop.set()
    assert held_by(queue, "another") == {0}


def test_while_redis_is_away_nobody_loses_the_lead() -> None:
    queue, stop = Moody(), threading.Event()
    mine = sharing(queue)
    assert mine.wait(stop)
    with mine.held(stop) as over:
        queue.away = True
        until(lambda: queue.asked_in_vain > 3, "it tries again and again")
        queue.away = False
        begun = queue._leases[0][1]
        until(lambda: queue._leases[0][1] > begun, "it is renewed")
        assert not over.is_set()
        stop.set()


def test_where_another_comes_the_work_is_laid_down_and_shared_out_anew() -> None:
    queue, stop = MemoryQueue(), threading.Event()
    first = sharing(queue, number=4)
    assert first.wait(stop) == KeeperShards(4, frozenset(range(4)))
    with first.held(stop) as over:
        assert not queue.take_share("second", 600, number=4).held, "none is free"
        assert over.wait(PATIENCE_S), "the first has more than is fair"
        assert held_by(queue, first.holder) == {0, 1, 2, 3}, "until its work is laid down"
    assert first.wait(stop) == KeeperShards(4, frozenset({0, 1}))
    assert queue.take_share("second", 600, number=4).held == {2, 3}


def test_where_another_goes_its_shards_are_taken_over() -> None:
    queue, stop = MemoryQueue(), threading.Event()
    mine = sharing(queue, number=4)
    queue.take_share(mine.holder, 600, number=4)
    queue.take_share("second", 600, number=4)
    queue.resign(mine.holder, {2, 3})
    assert queue.take_share("second", 600, number=4).held == {2, 3}
    assert mine.wait(stop) == KeeperShards(4, frozenset({0, 1}))
    with mine.held(stop) as over:
        queue.resign("second", {2, 3})
        queue.leave("second", number=4)
        assert over.wait(PATIENCE_S)
    assert mine.wait(stop) == KeeperShards(4, frozenset(range(4)))


def test_one_that_was_told_another_number_of_shards_waits_until_the_others_end() -> None:
    queue, stop = MemoryQueue(), threading.Event()
    queue.take_share("other", 600, number=2)
    mine = sharing(queue, number=4)
    found: list[KeeperShards | None] = []
    thread = threading.Thread(target=lambda: found.append(mine.wait(stop)))
    thread.start()
    until(lambda: (4, mine.holder) in queue._keepers, "it asks")
    assert held_by(queue, mine.holder) == set()
    queue.resign("other", {0})
    thread.join(PATIENCE_S)
    assert found and found[0] is not None and 0 in found[0].held
    assert not queue.take_share("other", 600, number=2).held, "the number is another one"
