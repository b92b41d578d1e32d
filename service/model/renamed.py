"""Names of graspd 0.2 in stores, shards and queues, and their names since.

Old names are read everywhere. They are written only in tasks that a worker of 0.2 does.
"""

from __future__ import annotations

import re
from typing import Any, Final

#: Keys of records, manifests, messages and root attributes.
KEYS: Final = {
    "referee": "validation",
    "audits": "rechecks",
    "audited": "rechecked",
    "audit_held": "recheck_held",
    "tried": "candidates",
    "lane": "priority",
    "unsound": "infeasible",
    "fragile": "not_robust",
}
_LEVELS: Final = {"letter": "dexgraspbench", "certificate": "standard", "screen": "fast"}
#: Values of keys, by today's name of the key.
VALUES: Final = {
    "validation": _LEVELS,
    "verdict_level": _LEVELS,
    "want": {"raw": "candidates"},
}
#: Columns of base shards: today's path, and that of schema graspd/base@1.
COLUMNS: Final = {
    "quality/feasible": "quality/sound",
    "quality/recheck": "quality/audit",
    "quality/validated_by": "quality/judged_by",
}
#: Revision that graspd 0.2 makes of each stage.
_REVISIONS: Final = {"synthesize": 23, "scene": 2, "render": 4}
_OLD: Final = re.compile(rb'"(?:' + b"|".join([*map(str.encode, KEYS), *map(str.encode, _LEVELS), b"raw"]) + rb')"')


def has_old_names(document: bytes) -> bool:
    """Whether a JSON text may hold names of graspd 0.2."""
    return _OLD.search(document) is not None


def renamed(value: Any) -> Any:
    """A JSON document, or a part of one, with today's names."""
    if isinstance(value, dict):
        found = {KEYS.get(key, key): renamed(inner) for key, inner in value.items()}
        for key, names in VALUES.items():
            if isinstance(old := found.get(key), str):
                found[key] = names.get(old, old)
        return found
    if isinstance(value, list):
        return [renamed(inner) for inner in value]
    return value


def for_worker_of(revision: int, stage: str, message: dict[str, Any]) -> dict[str, Any]:
    """A task message with the names that workers of its revision read: in a rolling upgrade some are of 0.2."""
    request = message.get("request")
    if not isinstance(request, dict) or not 0 < revision <= _REVISIONS.get(stage, 0):
        return message
    values = {key: {new: old for old, new in names.items()} for key, names in VALUES.items()}
    request = {key: values[key].get(value, value) if key in values else value for key, value in request.items()}
    keys = {new: old for old, new in KEYS.items()}
    return message | {"request": {keys.get(key, key): value for key, value in request.items()}}
