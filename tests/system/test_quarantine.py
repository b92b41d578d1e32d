"""A worker whose engine breaks steps aside, and takes no attempts of tasks with it."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import httpx
import pytest

from graspd.service.model.states import State
from tests.fakes import request
from tests.system.conftest import System

pytestmark = pytest.mark.chaos


def test_a_worker_whose_engine_breaks_hands_its_tasks_back_and_returns_when_it_is_mended(
    start: Callable[..., System], tmp_path: Path
) -> None:
    broken = tmp_path / "broken"
    system = start(api=True, environment={"FAKE_BROKEN": str(broken)})
    system.finish(system.submit(request(seed=1)))
    broken.touch()
    jobs = [system.submit(request(seed=seed)) for seed in (2, 3)]
    url = f"{system.supervisor.api_url}/v1/workers"
    found: list[dict[str, str]] = []

    def is_shown() -> bool:
        found[:] = [worker for worker in httpx.get(url, timeout=60).json() if worker["state"] == "quarantined"]
        return bool(found)

    system.until(is_shown, "the worker is shown in quarantine")
    assert found[0]["reason"] == "no kernel can be loaded"
    page = httpx.get(f"{system.supervisor.api_url}/workers", timeout=60).text
    assert "takes no tasks: no kernel can be loaded" in page
    broken.unlink()
    done = system.finish(*jobs)
    assert {job.state for job in done} == {State.SUCCEEDED}
    assert system.services.index.jobs.attempts() == [], "it cost no attempt"


def test_a_worker_that_cannot_load_its_engine_takes_no_task(start: Callable[..., System], tmp_path: Path) -> None:
    broken = tmp_path / "broken"
    system = start(environment={"FAKE_BROKEN": str(broken)})
    broken.touch()
    first = system.kill("worker-0")
    job = system.submit(request())
    states = lambda: {worker.state for worker in system.services.index.overview.workers()}  # noqa: E731
    system.until(lambda: "quarantined" in states(), "its successor is in quarantine")
    assert system.supervisor.pids["worker-0"] != first
    assert system.services.index.jobs.get(job).state is State.QUEUED
    assert system.services.index.jobs.attempts() == []
