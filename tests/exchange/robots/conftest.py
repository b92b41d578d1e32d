"""Real grasps, of a free block and of a bottle on a table, as shards that robots are to carry out."""

from __future__ import annotations

from pathlib import Path

import pytest

from graspd.worker.engines import backend
from tests.exchange.robots.shards import CLUTTER, FREE, PRESSING, TABLE, make


@pytest.fixture(scope="session", autouse=True)
def engine() -> None:
    backend.start()


@pytest.fixture(scope="session")
def free_shard(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Barrett grasps of a free block, feasible or not, as they come."""
    return make(FREE, tmp_path_factory.mktemp("free") / "grasps.h5")


@pytest.fixture(scope="session")
def table_shard(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Barrett grasps of a bottle that lies on tables, as they come."""
    return make(TABLE, tmp_path_factory.mktemp("table") / "grasps.h5")


@pytest.fixture(scope="session")
def pressing_shard(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Barrett grasps of a bottle, whose fingertips may press into the table."""
    return make(PRESSING, tmp_path_factory.mktemp("pressing") / "grasps.h5")


@pytest.fixture(scope="session")
def clutter_shard(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Barrett grasps of a bottle with a block beside it."""
    return make(CLUTTER, tmp_path_factory.mktemp("clutter") / "grasps.h5")
