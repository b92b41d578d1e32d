"""A task with a nonsense scene that somebody wrote into Redis."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from service.model.states import Lane, Stage
from service.queue.rq_queue import RqQueue
from service.settings import Settings
from tests.fakes import message_for
from worker.process.main import run_worker
from worker.stages import scene


class Forged:
    """A message that says what it likes."""

    def __init__(self, nonsense: Any) -> None:
        self._message, self._nonsense = message_for(Stage.SCENE, scene="table"), nonsense
        self.stage, self.task_id, self.attempt = Stage.SCENE, self._message.task_id, 1

    def model_dump(self, **how: Any) -> dict[str, Any]:
        said = self._message.model_dump(**how)
        return said | {"request": said["request"] | {"scene": self._nonsense}}


@pytest.mark.parametrize(
    "nonsense",
    [
        "moon",
        {"supports": [{"kind": "mesh", "file": "/etc/passwd"}]},
        {"supports": [{"kind": "box", "size": [1e300, 1, 1]}]},
        {"supports": [{"kind": "half_space"}] * 100_000},
    ],
    ids=["kind", "path", "size", "number"],
)
def test_it_is_refused_and_the_worker_goes_on(
    rq_queue: RqQueue, redis_server: str, tmp_path: Path, nonsense: Any
) -> None:
    rq_queue.enqueue([Forged(nonsense)], Lane.BULK)  # type: ignore[list-item]
    settings = Settings(redis_url=redis_server, data_dir=tmp_path, device="cpu")  # type: ignore[arg-type]
    assert run_worker(settings, table={Stage.SCENE: scene.run}, burst=True), "the worker is none the worse"
    assert rq_queue.leases() == [] and sum(rq_queue.depths().values()) == 0
    assert not list(tmp_path.rglob("*.h5")) and not list(tmp_path.rglob("attempts/*"))
