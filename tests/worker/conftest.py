"""What tests of the engine share with those of the service."""

from pathlib import Path

import pytest

from tests.service.conftest import redis_server, redis_settings, rq_queue

__all__ = ["redis_server", "redis_settings", "rq_queue"]


@pytest.fixture
def own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Folder of a disk cache of the test's own, empty."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    return tmp_path / "graspd"
