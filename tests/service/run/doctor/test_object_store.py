"""The store as the doctor sees it: real ones, and ones that break a promise."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import IO

import obstore
import pytest
from obstore.store import MemoryStore

from graspd.service.run.doctor.backends import check_store, store
from graspd.service.run.doctor.checks import Condition
from graspd.service.settings import Settings
from graspd.service.store.store import Entry, Store, open_store


def test_a_folder_is_good_and_nothing_is_left_in_it(tmp_path: Path) -> None:
    settings = Settings(data_dir=tmp_path)
    assert store(settings).condition is Condition.GOOD
    assert not (tmp_path / "store").exists(), "a look makes no store"
    (tmp_path / "store").mkdir()
    found = store(settings)
    assert found.condition is Condition.GOOD, found
    assert [path for path in (tmp_path / "store").rglob("*") if path.is_file()] == []


@pytest.mark.s3
def test_a_bucket_is_good_and_nothing_is_left_in_it(tmp_path: Path, s3_url: str) -> None:
    found = store(Settings(data_dir=tmp_path, store_url=s3_url))
    assert found.ok, found
    assert "refuses a name that is taken" in found.message
    assert list(open_store(s3_url).list("health")) == []


@pytest.mark.s3
def test_a_wrong_secret_is_bad_and_the_mend_names_the_variables(
    tmp_path: Path, s3_url: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("AWS_SECRET_ACCESS_KEY", "of-somebody-else")
    found = store(Settings(data_dir=tmp_path, store_url=s3_url))
    assert not found.ok
    assert "AWS_SECRET_ACCESS_KEY" in found.fix
    assert "of-somebody-else" not in str(found)


def test_a_store_in_memory_is_gone_with_its_process() -> None:
    assert check_store("store", open_store("memory://")).condition is Condition.WARNING


class Overwriting(Store):
    """As S3 servers do that know no conditional put."""

    def put_file(self, key: str, file: IO[bytes]) -> bool:
        file.seek(0)
        obstore.put(self._backend, key, file.read(), mode="overwrite")
        return True


class Deaf(Store):
    """Refuses a second put, and lists nothing yet."""

    def list(self, prefix: str, *, offset: str | None = None) -> Iterator[Entry]:
        return iter(())


class Keeping(Store):
    """Removes nothing but once nobody looks."""

    def exists(self, key: str) -> bool:
        return True


@pytest.mark.parametrize(
    ("kind", "word"), [(Overwriting, "overwritten"), (Deaf, "not in the list"), (Keeping, "still there")]
)
def test_a_store_that_breaks_a_promise_is_bad(kind: type[Store], word: str) -> None:
    found = check_store("store", kind(MemoryStore(), "fake://"))
    assert not found.ok
    assert word in found.message
