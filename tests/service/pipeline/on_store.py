"""A service without processes on a store of files or an S3 server."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from graspd.service.pipeline.backends import Services
from graspd.service.settings import Settings
from graspd.service.store.store import open_store
from tests.fakes import add_assets
from tests.indexes import empty_index
from tests.memory_queue import MemoryQueue


def parts_on(kind: str, request: pytest.FixtureRequest, folder: Path) -> Iterator[Services]:
    """SQLite index, memory queue, a hand and an object; `kind` of store: files or s3."""
    url = request.getfixturevalue("s3_url") if kind == "s3" else (folder / "store").as_uri()
    settings = Settings(data_dir=folder, store_url=url, retry_backoff_s=0.0, task_s=0.0)
    made = Services(settings, open_store(url), empty_index(settings.resolved_index_url), MemoryQueue())
    add_assets(made)
    yield made
    made.close()
