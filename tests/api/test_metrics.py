"""What a scrape tells of the queue."""

from __future__ import annotations

import pytest

from graspd.api.metrics import Metrics, Snapshot
from graspd.service.model.series import SERIES
from graspd.service.model.states import Stage
from graspd.service.model.workers import WorkerBeat
from graspd.service.queue.port import QueueStatus

STATES = ("checking", "idle", "busy", "stopping", "quarantined")


def test_workers_are_counted_in_every_state_that_they_can_be_in() -> None:
    """An alert on workers in quarantine asks for this very series; none is 0 and not absent."""
    snapshot = Snapshot()
    beats = [
        WorkerBeat(str(i), "h", 1, "cpu", "CPU", tuple(Stage), "0", state, "", "", "")
        for i, state in enumerate(["idle", "quarantined", "quarantined"])
    ]
    snapshot.add_queue(QueueStatus(workers={beat.name: (beat, 0.1) for beat in beats}), is_kept=True)
    text = Metrics().render(snapshot).decode()
    assert all(state in SERIES["graspd_workers"].meaning for state in STATES)
    counts = {state: float(text.partition(f'graspd_workers{{state="{state}"}} ')[2].split()[0]) for state in STATES}
    assert counts == {"checking": 0, "idle": 1, "busy": 0, "stopping": 0, "quarantined": 2}


@pytest.mark.parametrize("lives", [True, False])
def test_the_controller_is_up_while_one_gives_signs_of_life(lives: bool) -> None:
    snapshot = Snapshot()
    snapshot.add_queue(QueueStatus(), is_kept=lives)
    assert f"graspd_controller_up {float(lives)}" in Metrics().render(snapshot).decode().splitlines()
