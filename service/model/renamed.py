"""Names of graspd 0.2 in stores, shards and queues, and their names since. Nothing writes the old ones."""

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
