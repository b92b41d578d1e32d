"""One service on a store, an index and a Redis, and one of its controllers leads."""

import shutil
import threading
from pathlib import Path
from unittest.mock import Mock

import pytest

from graspd.service.index.index import Index
from graspd.service.model.errors import BusyError, QueueUnavailable
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.controller import Controller
from graspd.service.pipeline.identity import check_service, identify, service_ids
from graspd.service.pipeline.leading import Leadership
from graspd.service.queue.rq_queue import RqQueue
from graspd.service.settings import Settings
from graspd.service.store.store import Store, open_store
from graspd.service.telemetry import HeartbeatFile
from tests.indexes import open_services
from tests.memory_queue import MemoryQueue
from tests.waiting import PATIENCE_S, Pauses, until


def service(folder: Path, *, store: Store | None = None, queue: RqQueue | None = None, **more: str) -> Services:
    """A service with an index of its own; store and Redis may be shared."""
    if store is not None:
        more["store_url"] = store.url
    return open_services(Settings(data_dir=folder, **more), store, queue)


@pytest.fixture
def first(tmp_path: Path) -> Services:
    made = service(tmp_path / "first")
    identify(made)
    return made


def test_a_second_service_on_a_store_is_refused(first: Services, tmp_path: Path) -> None:
    second = service(tmp_path / "second", store=first.store)
    for _ in range(2):
        with pytest.raises(BusyError, match=r"belongs to another graspd service.*a store of its own.*index rebuild"):
            identify(second)
    assert second.queue.service_id() is None


def test_a_second_service_on_a_redis_is_refused_also_at_once(first: Services, tmp_path: Path) -> None:
    second = service(tmp_path / "second", queue=first.queue)
    for take_over in (False, False, True):
        with pytest.raises(BusyError, match=r"Redis belongs to another graspd service.*GRASPD_REDIS_URL"):
            identify(second, take_over=take_over)
    queue = Mock(first.queue, service_id=Mock(side_effect=[None, first.queue.service_id()]))
    with pytest.raises(BusyError, match="Redis belongs to another"):
        identify(service(tmp_path / "third", queue=queue))


def test_a_worker_or_an_index_of_another_store_is_refused(first: Services, tmp_path: Path) -> None:
    second = service(tmp_path / "second")
    assert not check_service(second.store, second.queue.service_id())
    assert check_service(first.store, first.queue.service_id())
    with pytest.raises(BusyError, match="Redis belongs to another"):
        check_service(second.store, first.queue.service_id())
    identify(second)
    mixed = Services(first.settings, first.store, second.index, MemoryQueue())
    with pytest.raises(BusyError, match="the index belongs to another graspd service"):
        identify(mixed)


def test_processes_that_begin_a_service_at_once_agree(tmp_path: Path) -> None:
    one = service(tmp_path)
    other = Services(one.settings, one.store, Index(one.settings.resolved_index_url), one.queue)
    assert identify(one) == identify(other) == one.queue.service_id()
    assert identify(one, take_over=True) == one.queue.service_id(), "a rebuild of its own index"
    assert len(service_ids(one.store)) == 1


def test_a_lost_redis_or_index_becomes_the_services_again(first: Services, tmp_path: Path) -> None:
    emptied = Services(first.settings, first.store, first.index, MemoryQueue())
    assert identify(emptied) == emptied.queue.service_id() == first.queue.service_id()
    other = service(tmp_path / "other", store=first.store, queue=first.queue)
    assert identify(other) == first.index.notes.service_id() == other.index.notes.service_id()


def test_a_data_folder_remembers_its_service(tmp_path: Path) -> None:
    store = open_store((tmp_path / "store").as_uri())
    made = service(tmp_path / "first", store=store)
    mine = identify(made, folder=made.settings.data_dir)
    made.close()
    (made.settings.data_dir / "index.sqlite").unlink()
    again = service(tmp_path / "first", store=store)
    assert identify(again, folder=again.settings.data_dir) == mine


def test_a_store_in_the_data_folder_is_that_folders_own(first: Services, tmp_path: Path) -> None:
    """As it is after `cp -r` of the store, or where everything but the store was removed."""
    shutil.copytree(first.settings.data_dir / "store", tmp_path / "moved" / "store")
    assert identify(service(tmp_path / "moved")) == first.index.notes.service_id()


def test_a_first_start_that_was_killed_half_way_goes_on(tmp_path: Path) -> None:
    begun = service(tmp_path)
    begun.index.notes.set_service_id("begun")
    assert identify(begun) == "begun" == service_ids(begun.store)[-1]


def test_a_second_store_under_one_index_is_refused(first: Services, tmp_path: Path) -> None:
    first.index.notes.set_complete()
    second = Services(first.settings, open_store((tmp_path / "other").as_uri()), first.index, MemoryQueue())
    with pytest.raises(BusyError, match="the index belongs to another graspd service"):
        identify(second)
    assert not service_ids(second.store)


def test_a_service_that_takes_over_is_the_only_one_from_then_on(first: Services, tmp_path: Path) -> None:
    second = service(tmp_path / "second", store=first.store)
    mine = identify(second, take_over=True)
    assert identify(second) == mine == second.queue.service_id()
    with pytest.raises(BusyError, match=r"was taken over by another graspd service.*index rebuild"):
        identify(first)
    assert identify(first, take_over=True) == first.queue.service_id() != mine
    with pytest.raises(BusyError, match="was taken over"):
        identify(second)


def test_a_controller_ends_when_its_store_is_taken_over(first: Services, tmp_path: Path) -> None:
    now = [0.0]
    controller = Controller(first, clock=lambda: now[0])
    controller.run_round()
    identify(service(tmp_path / "second", store=first.store), take_over=True)
    now[0] += 60.0
    with pytest.raises(BusyError, match="was taken over"):
        controller.run_round()


def test_what_is_forged_in_redis_stops_no_controller(first: Services) -> None:
    first.queue.set_service_id("forged", instead=True)
    Controller(first).run_round()
    assert first.queue.service_id() == first.index.notes.service_id()


#: Longer than any test: no lease runs out on a busy machine.
LEASE_S = 600.0


@pytest.fixture(autouse=True)
def often(monkeypatch: pytest.MonkeyPatch) -> None:
    """Leases are renewed every 10 ms."""
    monkeypatch.setattr("graspd.service.pipeline.leading._RENEWALS", LEASE_S * 100)


def leadership(queue: MemoryQueue, *, file: Path | None = None) -> Leadership:
    return Leadership(queue, lease_s=LEASE_S, alive=HeartbeatFile(file))


def test_a_lease_is_renewed_while_held_and_given_back() -> None:
    queue, stop = MemoryQueue(), threading.Event()
    mine = leadership(queue)
    assert mine.wait(stop)
    begun = queue._lease[1]
    with mine.hold(stop) as over:
        until(lambda: queue._lease[1] > begun, "it is renewed")
        assert not queue.renew_leadership("another", 600)
        assert not over.is_set()
        stop.set()
        assert over.wait(PATIENCE_S)
    assert queue.renew_leadership("another", 600)


def test_who_waits_leads_soon_after_the_other_fell_silent(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspd.service.pipeline.leading._RENEWALS", 3.0)
    stop = Pauses()
    queue = MemoryQueue(clock=stop.clock)
    queue.renew_leadership("silent", LEASE_S)
    assert leadership(queue).wait(stop)
    assert LEASE_S <= stop.now <= LEASE_S * 4 / 3


def test_who_waits_lives_and_can_be_told_to_stop(tmp_path: Path) -> None:
    queue, stop = MemoryQueue(), threading.Event()
    queue.renew_leadership("another", 600)
    waiting = leadership(queue, file=tmp_path / "alive")
    ended: list[bool] = []
    thread = threading.Thread(target=lambda: ended.append(waiting.wait(stop)))
    thread.start()
    until((tmp_path / "alive").exists, "health checks would end it")
    stop.set()
    thread.join(PATIENCE_S)
    assert ended == [False]


def test_a_lease_that_another_has_is_over_and_is_not_given_back() -> None:
    queue, stop = MemoryQueue(), threading.Event()
    mine = leadership(queue)
    assert mine.wait(stop)
    with mine.hold(stop) as over:
        with queue._changed:
            queue._lease = ("another", queue.clock() + 600)
        assert over.wait(PATIENCE_S)
        stop.set()
    assert queue._lease[0] == "another"


def test_while_redis_is_away_nobody_loses_the_lead(monkeypatch: pytest.MonkeyPatch) -> None:
    queue, stop, away = MemoryQueue(), threading.Event(), Mock(side_effect=QueueUnavailable("away"))
    mine = leadership(queue)
    assert mine.wait(stop)
    with mine.hold(stop) as over:
        with monkeypatch.context() as patch:
            patch.setattr(queue, "renew_leadership", away)
            until(lambda: away.call_count > 3, "it tries again and again")
        begun = queue._lease[1]
        until(lambda: queue._lease[1] > begun, "it is renewed")
        assert not over.is_set()
        stop.set()
