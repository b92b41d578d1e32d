"""Empty indexes of SQLite in milliseconds: the migrations run once a process, and their outcome is copied."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

from service.index.index import Index

_PREFIX = "sqlite:///"


def empty_index(url: str) -> Index:
    """`Index(url)` where nothing is yet. Tests of how an index comes to be make theirs themselves."""
    if url.startswith(_PREFIX) and not (file := Path(url.removeprefix(_PREFIX))).exists():
        file.parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(_migrated())
    return Index(url)


@cache
def _migrated() -> bytes:
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "index.sqlite"
        Index(f"{_PREFIX}{file}").close()
        return file.read_bytes()
