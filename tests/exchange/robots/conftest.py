"""Real grasps, of a free block and of a bottle on a table, as shards that robots are to carry out."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from graspd.worker.engines import backend
from tests.exchange.robots.shards import CLUTTER, FREE, PRESSING, TABLE, make


@pytest.fixture(scope="session", autouse=True)
def engine() -> None:
    backend.start()


def _shard(name: str, words: str) -> Any:
    @pytest.fixture(scope="session", name=name)
    def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
        return make(words, tmp_path_factory.mktemp(name) / "grasps.h5")

    return made


# Barrett grasps as they come, feasible or not: of a free block, of a bottle on tables, with fingertips that may press
# into the table, and with a block beside it.
free_shard, table_shard = _shard("free_shard", FREE), _shard("table_shard", TABLE)
pressing_shard, clutter_shard = _shard("pressing_shard", PRESSING), _shard("clutter_shard", CLUTTER)
