"""What a scrape tells of the queue."""

from __future__ import annotations

from api.metrics import Metrics, Snapshot
from service.pipeline.series import SERIES
from service.queue.at_scrape import QueueNow, WorkerPulse
from service.queue.port import Keeping

STATES = ("checking", "idle", "busy", "stopping", "quarantined")


def test_workers_are_counted_in_every_state_that_they_can_be_in() -> None:
    """An alert on workers in quarantine asks for this very series; none is 0 and not absent."""
    snapshot = Snapshot()
    pulses = {str(i): WorkerPulse("cpu", state, 0.1) for i, state in enumerate(["idle", "quarantined", "quarantined"])}
    snapshot.add_queue(QueueNow(workers=pulses), [Keeping(0, "a", True)])
    text = Metrics().render(snapshot).decode()
    assert all(state in SERIES["graspd_workers"].meaning for state in STATES)
    counts = {state: float(text.partition(f'graspd_workers{{state="{state}"}} ')[2].split()[0]) for state in STATES}
    assert counts == {"checking": 0, "idle": 1, "busy": 0, "stopping": 0, "quarantined": 2}


def test_the_keeper_is_up_while_each_shard_has_one_that_works() -> None:
    snapshot = Snapshot()
    snapshot.add_queue(QueueNow(), [Keeping(0, "a", True), Keeping(1, "b", False)])
    lines = Metrics().render(snapshot).decode().splitlines()
    assert "graspd_keeper_up 0.0" in lines
    assert 'graspd_keeper_shard_up{keeper="a",shard="0"} 1.0' in lines
    assert 'graspd_keeper_shard_up{keeper="b",shard="1"} 0.0' in lines
