"""Conversion of the names of graspd 0.2, which all readers accept and tasks for old workers contain."""

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
    "fragile": "not_robust",
}
_LEVELS: Final = {"letter": "dexgraspbench", "certificate": "standard", "screen": "fast"}
#: Values, by the current name of their key.
VALUES: Final = {"validation": _LEVELS, "verdict_level": _LEVELS, "level": _LEVELS, "want": {"raw": "candidates"}}
_OLD_KEYS: Final = {new: old for old, new in KEYS.items()}
_OLD_VALUES: Final = {key: {new: old for old, new in names.items()} for key, names in VALUES.items()}
#: Option of 0.2 without a successor. Digests of options contain its default.
_REMOVED: Final = "robustness"
#: Columns of base shards: present path, and path in schema graspd/base@1.
COLUMNS: Final = {
    "quality/feasible": "quality/sound",
    "quality/recheck": "quality/audit",
    "quality/validated_by": "quality/judged_by",
}
#: Revision of each stage in graspd 0.2.
_REVISIONS: Final = {"synthesize": 23, "scene": 2, "render": 4}
_OLD: Final = re.compile(f'"(?:{"|".join([*KEYS, *_LEVELS, "raw", _REMOVED])})"'.encode())
#: Measures of charts: success under the unmodified protocol (free or lifted), and speed over all candidates.
_CHART: Final = re.compile(r"^(lift_)?(?:(letter)(?=_low$|_high$|_count$|$)|raw(?=_end_to_end_per_second$))")


def has_old_names(document: bytes) -> bool:
    return _OLD.search(document) is not None


def convert_names(value: Any) -> Any:
    """Convert the names of graspd 0.2 in a JSON value to present names."""
    if isinstance(value, dict):
        # The planner's own options, next to the method, are not renamed.
        own = {"options"} if "method" in value else set()
        found = {KEYS.get(key, key): inner if key in own else convert_names(inner) for key, inner in value.items()}
        for key, names in VALUES.items():
            if isinstance(old := found.get(key), str):
                found[key] = names.get(old, old)
        if "rechecks" in found:
            found.pop(_REMOVED, None)
        return found
    if isinstance(value, list):
        return [convert_names(inner) for inner in value]
    return value


def convert_chart(chart: Any) -> Any:
    """Convert a chart of `graspd chart` to present names."""
    return _convert_measures(convert_names(chart))


def _convert_measures(value: Any) -> Any:
    if isinstance(value, dict):
        return {_chart_name(key): _convert_measures(inner) for key, inner in value.items()}
    if isinstance(value, list):
        return [_chart_name(inner) if isinstance(inner, str) else _convert_measures(inner) for inner in value]
    return value


def _chart_name(name: str) -> str:
    return _CHART.sub(lambda found: f"{found[1] or ''}{'dexgraspbench' if found[2] else 'candidates'}", name)


def original_request(request: dict[str, Any]) -> dict[str, Any]:
    """Return a request with the names of graspd 0.2, which the digests of jobs and shards use."""
    found = {
        _OLD_KEYS.get(key, key): _OLD_VALUES[key].get(value, value) if key in _OLD_VALUES else value
        for key, value in request.items()
    }
    return found | {_REMOVED: 0} if "rechecks" in request else found


def message_for_revision(revision: int, stage: str, message: dict[str, Any]) -> dict[str, Any]:
    """Convert a task message to the names of its stage's revision, for workers of 0.2 during an upgrade."""
    request = message.get("request")
    if not isinstance(request, dict) or not 0 < revision <= _REVISIONS.get(stage, 0):
        return message
    return message | {"request": original_request(request)}
