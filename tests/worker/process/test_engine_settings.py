"""What a worker gives its tasks besides their messages."""

from __future__ import annotations

from pathlib import Path

import pytest

from graspd.service.model.states import Stage
from graspd.service.settings import Settings
from graspd.service.store.store import open_store
from graspd.worker.engines.devices import Device
from graspd.worker.process import engine
from graspd.worker.process.engine import TaskResources
from tests.worker.pool import works


def of(folder: Path, processes: int) -> TaskResources:
    settings = Settings(data_dir=folder, processes=processes)  # type: ignore[call-arg]
    return TaskResources(settings, open_store("memory://"), Device("cpu"))


def test_tasks_that_make_grasps_share_the_processes_of_their_worker(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine, "MODULES", ())  # these need none of the engine
    worker = of(tmp_path, 2)
    try:
        assert [worker.pool(stage) for stage in Stage if stage is not Stage.SYNTHESIZE] == [None] * (len(Stage) - 1)
        pool = worker.pool(Stage.SYNTHESIZE)
        assert pool is not None and pool is worker.pool(Stage.SYNTHESIZE) and pool.processes == 2
        assert pool.map(works.times, "three", 3, [1, 2]) == [3, 6]
    finally:
        worker.close()
    assert of(tmp_path, 1).pool(Stage.SYNTHESIZE) is None
    assert of(tmp_path, 0).pool(Stage.SYNTHESIZE) is None, "on a CPU threads do it, where nobody says otherwise"
