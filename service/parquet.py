"""Parquet files by pyarrow, an optional dependency."""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from graspd.service.model.errors import InputError

#: Limit [bytes] of the unpacked size that a file of unknown origin states.
LARGEST: Final = 2**31
#: Type of pictures for Hugging Face's readers: bytes and path of a file.
IMAGE: Final = "image"


def arrow() -> Any:
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError:
        raise InputError("Parquet files need pyarrow; install it: pip install 'graspd[parquet]'") from None
    return pyarrow


def type_of(name: str) -> Any:
    """Return an Arrow type by name, such as `image`, `text`, `int64`; lists have a suffix [length] or []."""
    pa = arrow()
    if name.endswith("]"):
        inner, _, size = name[:-1].rpartition("[")
        return pa.list_(type_of(inner), int(size)) if size else pa.list_(type_of(inner))
    if name == IMAGE:
        return pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    return pa.string() if name == "text" else getattr(pa, name)()


def schema_of(columns: Mapping[str, str], also: Mapping[str, str] | None = None) -> Any:
    """Return the schema of columns with types as in `type_of`; mark pictures for Hugging Face's readers."""
    pa = arrow()
    pictures = {name: {"_type": "Image"} for name, word in columns.items() if word == IMAGE}
    told = {"huggingface": json.dumps({"info": {"features": pictures}})} if pictures else {}
    return pa.schema([(name, type_of(word)) for name, word in columns.items()], metadata=told | dict(also or {}))


def write(file: Path, schema: Any, groups: Iterable[Sequence[Mapping[str, Any]]]) -> int:
    """Write rows, each group as one row group; return the number of rows."""
    pa = arrow()
    file.parent.mkdir(parents=True, exist_ok=True)
    count = 0
    with pa.parquet.ParquetWriter(file, schema, compression="zstd") as out:
        for rows in groups:
            out.write_table(pa.Table.from_pylist([dict(row) for row in rows], schema=schema))
            count += len(rows)
    return count


def read(file: Path, wanted: Iterable[str]) -> dict[str, list[Any]]:
    """Read the wanted columns that a file has; InputError if it is not Parquet or exceeds `LARGEST`."""
    pa = arrow()
    try:
        with pa.parquet.ParquetFile(file) as found:
            names = [name for name in wanted if name in found.schema_arrow.names]
            said = found.metadata
            size = sum(said.row_group(k).total_byte_size for k in range(said.num_row_groups))
            if size > LARGEST:
                raise InputError(f"{file} unpacks to {size >> 20} MiB; split it into files below {LARGEST >> 20} MiB")
            return dict(found.read(columns=names).to_pydict())
    except (OSError, pa.ArrowException, MemoryError) as error:
        raise InputError(f"{file} is not a readable Parquet file: {error}") from None
