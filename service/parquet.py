"""Parquet files by pyarrow, an optional dependency."""

import json
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from graspd.service.model.errors import InputError

#: Type of pictures for Hugging Face's readers: bytes and path of a file.
IMAGE: Final = "image"


def import_pyarrow() -> Any:
    try:
        import pyarrow
        import pyarrow.parquet
    except ModuleNotFoundError:
        raise InputError("Parquet files need pyarrow; install it: pip install 'graspd[parquet]'") from None
    return pyarrow


def arrow_type(name: str) -> Any:
    """Return an Arrow type by name: `image`, `text`, `int64`, ..., with suffix [LENGTH] or [] for lists."""
    pa = import_pyarrow()
    if name.endswith("]"):
        inner, _, size = name[:-1].rpartition("[")
        return pa.list_(arrow_type(inner), int(size)) if size else pa.list_(arrow_type(inner))
    if name == IMAGE:
        return pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    return pa.string() if name == "text" else getattr(pa, name)()


def arrow_schema(columns: Mapping[str, str], also: Mapping[str, str] | None = None) -> Any:
    """Return the schema of columns with the type names of `arrow_type`, and metadata for Hugging Face."""
    pa = import_pyarrow()
    pictures = {name: {"_type": "Image"} for name, word in columns.items() if word == IMAGE}
    metadata = {"huggingface": json.dumps({"info": {"features": pictures}})} if pictures else {}
    return pa.schema([(name, arrow_type(word)) for name, word in columns.items()], metadata=metadata | dict(also or {}))


def write(file: Path, schema: Any, groups: Iterable[Sequence[Mapping[str, Any]]]) -> int:
    """Write each group of rows as one row group; return the number of rows."""
    pa = import_pyarrow()
    file.parent.mkdir(parents=True, exist_ok=True)
    count = 0
    with pa.parquet.ParquetWriter(file, schema, compression="zstd") as out:
        for rows in groups:
            out.write_table(pa.Table.from_pylist([dict(row) for row in rows], schema=schema))
            count += len(rows)
    return count
