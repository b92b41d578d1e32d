"""A worker in this process."""

import pytest

from graspd.service.settings import Settings
from graspd.worker.process.main import run_worker
from tests.fakes import engine_of


@pytest.fixture
def work(rq_queue, redis_server: str, tmp_path):
    """Runs a worker with a table of stages, until no task waits; whether it ended well."""
    settings = Settings(redis_url=redis_server, data_dir=tmp_path, device="cpu")

    def run(table, **options) -> bool:
        return run_worker(settings, start=engine_of(table), **{"burst": True} | options)

    return run


@pytest.fixture
def kinds(rq_queue):
    return lambda: [event.kind for _, event in rq_queue.tail("0", limit=100, wait_s=0)]
