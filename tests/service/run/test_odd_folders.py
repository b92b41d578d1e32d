"""A data folder may have any name: what holds its path quotes it, and nothing is made outside of it."""

from __future__ import annotations

from pathlib import Path

import pytest

from graspd.service.index.index import Index
from graspd.service.model.errors import InputError
from graspd.service.pipeline.backends import Services
from graspd.service.run.supervisor import Supervisor
from graspd.service.settings import Settings
from graspd.service.store.store import open_store
from tests.waiting import PATIENCE_S

NAMES = [
    "100%",
    "a%20b",
    "a#b",
    "what?",
    "a b",
    "größe ÅΩ",
    "a\nb",
    "q'u\"o\\te",
    "a&b=c;d",
    "[1]",
    "a:b@c",
    "{x}",
    "~",
    "$HOME",
]


@pytest.mark.parametrize("name", NAMES)
def test_store_and_index_lie_in_the_folder_and_nothing_beside_it(name: str, tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / name)
    store = open_store(settings.resolved_store_url)
    store.put("jobs/one/job.json", b"{}")
    assert [(entry.key, store.get(entry.key)) for entry in store.list("jobs")] == [("jobs/one/job.json", b"{}")]
    assert (settings.data_dir / "store" / "jobs" / "one" / "job.json").exists()
    index = Index(settings.resolved_index_url)
    index.notes.name_service("one")
    index.close()
    again = Index(settings.resolved_index_url)
    assert again.notes.service() == "one"
    again.close()
    assert (settings.data_dir / "index.sqlite").exists()
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("name", ["100% #1? ü", "a\nb 'c' \"d\" \\e", "x" * 100])
def test_a_whole_service_gets_ready_in_an_odd_folder(name: str, tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path / name, port=0)
    with Supervisor(settings, workers=0) as supervisor:
        assert supervisor.wait_ready(PATIENCE_S)
        services = Services.open(supervisor.settings)
        assert services.queue.service() == services.index.notes.service()
        services.close()
    assert [path.name for path in tmp_path.iterdir()] == [name]


@pytest.mark.parametrize("end", ["a?b", "a#b", "a\nb", "a\tb", "a?", "a#"])
def test_a_store_url_that_would_be_cut_off_is_refused(end: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="%3F"):
        open_store(f"file://{tmp_path}/{end}")
    assert not list(tmp_path.iterdir())


def test_a_store_url_is_read_as_it_is_quoted(tmp_path: Path) -> None:
    open_store((tmp_path / "100% #1?").as_uri()).put("health/one", b"1")
    assert (tmp_path / "100% #1?" / "health" / "one").exists()
