"""Export of index tables as Parquet files, for DuckDB, pandas and others."""

import json
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any, Final

from sqlalchemy import JSON, BigInteger, Boolean, Column, Connection, Float, Integer, Table, select

from graspd.service.index.database import Database
from graspd.service.index.tables import assets, attempts, dataset_cells, datasets, grasps, jobs, shards, spent, tasks
from graspd.service.parquet import arrow_schema, write

#: Exported tables. Other tables contain current state (workers, notes) or internal data.
_EXPORTED: Final = (grasps, shards, jobs, tasks, attempts, assets, datasets, dataset_cells, spent)
TABLES: Final[Mapping[str, Table]] = {table.name: table for table in _EXPORTED}
#: Number of rows per row group; only one group is in memory at a time.
GROUP: Final = 20_000


def export(database: Database, folder: Path) -> dict[str, int]:
    """Write `TABLES` as `folder/NAME.parquet`; return their row counts; InputError without pyarrow.

    Rows are of one snapshot, ordered by primary key. Integers are int64, other numbers float64, JSON is text.
    """
    # The schemas need pyarrow: a missing package is reported before any query.
    schemas = {name: arrow_schema({c.name: _type_name(c) for c in table.columns}) for name, table in TABLES.items()}
    with database.read_transaction() as connection:
        return {
            name: write(folder / f"{name}.parquet", schemas[name], _row_groups(connection, table))
            for name, table in TABLES.items()
        }


def _row_groups(connection: Connection, table: Table) -> Iterator[list[dict[str, Any]]]:
    documents = [column.name for column in table.columns if isinstance(column.type, JSON)]
    query = select(table).order_by(*table.primary_key.columns).execution_options(yield_per=GROUP)
    for part in connection.execute(query).mappings().partitions():
        rows = [dict(row) for row in part]
        for row in rows:
            row.update({name: json.dumps(row[name]) for name in documents if row[name] is not None})
        yield rows


def _type_name(column: Column[Any]) -> str:
    kinds = {BigInteger: "int64", Integer: "int64", Float: "float64", Boolean: "bool_"}
    return next((word for kind, word in kinds.items() if isinstance(column.type, kind)), "text")
