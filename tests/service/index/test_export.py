"""Tables of the index as Parquet files, read by pyarrow itself."""

import json
from pathlib import Path

import pytest
from sqlalchemy import select

from graspd.service.index.export import TABLES, export
from graspd.service.model.errors import InputError
from graspd.service.pipeline.backends import Services
from tests.service.index.test_projects import enter, make

pq = pytest.importorskip("pyarrow.parquet", reason="pyarrow is not installed; pip install 'graspd[parquet]'")


def test_every_row_and_value_of_a_table_is_in_its_file(services: Services, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr("graspd.service.index.export.GROUP", 7)  # several groups of rows, the last one not full
    make(services, enter(services, "vision", 1, batches=2))
    counts = export(services.index.database, tmp_path)
    assert counts["grasps"] == 64 and counts["jobs"] == 1 and counts["shards"] == counts["tasks"] > 1
    with services.index.database.read_transaction() as connection:
        for name, table in TABLES.items():
            stored = [
                {key: json.dumps(value) if isinstance(value, dict | list) else value for key, value in row.items()}
                for row in connection.execute(select(table).order_by(*table.primary_key.columns)).mappings()
            ]
            found = pq.read_table(tmp_path / f"{name}.parquet")
            assert found.schema.names == [column.name for column in table.columns], "also of a table without rows"
            assert found.to_pylist() == stored
            assert len(stored) == counts[name]


def test_no_table_holds_what_is_secret(services: Services, tmp_path: Path) -> None:
    columns = {column.name for table in TABLES.values() for column in table.columns}
    assert not {name for name in columns if "secret" in name or "token" in name or "url" in name}


def test_without_pyarrow_the_fix_is_told(services: Services, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow", None)
    with pytest.raises(InputError, match=r"graspd\[parquet\]"):
        export(services.index.database, tmp_path)
