"""What a study leaves in the store for everybody: each record is an immutable object, the last by name counts.

A record of a kind is `{kind}/{created}.json`; `charts` come from `graspd chart`, `stability` from `graspd stability`.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any, Literal

from service.store.store import Store

Kind = Literal["charts", "stability"]


def publish(store: Store, kind: Kind, record: Mapping[str, Any]) -> str:
    """Put a record beside the earlier ones of its kind; its key follows from its `created`.

    Raises:
        ValueError: a number in it that JSON does not know.
    """
    key = f"{kind}/{re.sub(r'[^0-9A-Za-z]', '', str(record['created']))}.json"
    store.put(key, json.dumps(record, allow_nan=False).encode())
    return key


def latest(store: Store, kind: Kind) -> dict[str, Any] | None:
    """The record of a kind that was published last; None where there is none."""
    keys = [entry.key for entry in store.list(kind) if entry.key.endswith(".json")]
    return dict(json.loads(store.get(max(keys)))) if keys else None
