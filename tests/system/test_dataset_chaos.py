"""A dataset whose every process is killed in the middle: the same dataset goes on and makes nothing twice."""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Callable

import pytest

from graspd.service.index.rebuild import differences
from graspd.service.model import names
from graspd.service.model.errors import QueueUnavailable
from graspd.service.model.states import State
from graspd.service.pipeline.datasets import actions
from graspd.service.store.manifests import ShardManifest
from graspd.service.store.records import read_record
from tests.dataset_status import status
from tests.service.pipeline.datasets.makers import add_asset, wanted
from tests.system.conftest import System

pytestmark = pytest.mark.chaos
OBJECTS = tuple(f"object-{i}" for i in range(20))


def made(system: System) -> dict[str, str]:
    """When each shard was made."""
    store = system.services.store
    keys = [entry.key for entry in store.list(names.SHARDS) if entry.key.endswith(".json")]
    return {key: read_record(ShardManifest, store, key).created for key in keys}


def test_a_dataset_goes_on_after_everything_was_killed(start: Callable[..., System]) -> None:
    system = start(environment={"FAKE_SECONDS": "0.1"}, lease_s=2.0, retry_backoff_s=0.1)
    for name in OBJECTS:
        add_asset(system.services, "object", name)
    request = wanted("kitchen", hands=("gripper",), objects=OBJECTS, scenes=1)
    actions.create(system.services, request)
    system.until(
        lambda: system.services.index.datasets.get("kitchen").states[State.SUCCEEDED] >= 5, "a quarter is done"
    )
    system.hold.touch()
    for pid in system.supervisor.pids.values():
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)
    before = made(system)
    assert len(before) < 2 * len(OBJECTS)
    system.until(lambda: _redis_answers(system), "Redis is started again")
    again, new = actions.create(system.services, request)
    assert not new and not again.state.is_final
    system.hold.unlink()
    system.until(lambda: system.services.index.datasets.get("kitchen").state.is_final, "the dataset is done")
    after = made(system)
    assert {key: after[key] for key in before} == before
    assert len(after) == 2 * len(OBJECTS)
    assert {cell.state for cell in status(system.services.index, "kitchen").cells} == {State.SUCCEEDED}
    assert differences(system.services.index, system.services.store) == []
    taken, _ = actions.snapshot(system.services, "kitchen")
    assert taken.complete and len(taken.shards) == len(after)


@pytest.mark.slow
def test_a_dataset_that_is_cancelled_stops_and_stays_so(start: Callable[..., System]) -> None:
    system = start(environment={"FAKE_SECONDS": "0.3"}, lease_s=2.0, retry_backoff_s=0.1)
    for name in OBJECTS:
        add_asset(system.services, "object", name)
    actions.create(system.services, wanted("kitchen", hands=("gripper",), objects=OBJECTS))
    system.until(lambda: system.services.index.datasets.get("kitchen").states[State.SUCCEEDED] >= 2, "two are done")
    system.hold.touch()
    actions.cancel(system.services, "kitchen")
    system.until(lambda: system.services.index.datasets.get("kitchen").state is State.CANCELLED, "it is cancelled")
    system.kill("controller")
    system.until(lambda: _waits_for_nothing(system), "nothing waits for it any more")
    # A task that was at its end when the cancellation came has succeeded; the new controller hears of it.
    system.until(
        lambda: not differences(system.services.index, system.services.store), "the index is what the store says"
    )
    states = {cell.state for cell in status(system.services.index, "kitchen").cells}
    assert states == {State.SUCCEEDED, State.CANCELLED}


def _redis_answers(system: System) -> bool:
    try:
        system.services.queue.ping()
    except QueueUnavailable:
        return False
    return True


def _waits_for_nothing(system: System) -> bool:
    return not system.services.queue.waiting() and not system.services.queue.leases()
