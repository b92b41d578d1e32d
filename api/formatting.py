"""Format numbers, times, sizes and host names for pages and terminals."""

import ipaddress
import shlex
from collections.abc import Callable, Mapping
from contextlib import suppress
from datetime import UTC, datetime
from typing import Any, Final

from graspd.service.model.studies import count_outcomes, format_tick

NONE: Final = "–"


def metric(value: float | None) -> str:
    """Format with about three digits (more from 1000 on); values between 0 and 0.001 as "< 0.001"."""
    if value is None or value != value:
        return NONE
    if value == 0:
        return "0"
    if abs(value) >= 1000:
        return f"{value:,.0f}"
    if 0 < value < 1e-3:
        return "< 0.001"
    digits = 3 if abs(value) < 1 else 2 if abs(value) < 10 else 1 if abs(value) < 100 else 0
    return f"{value:.{digits}f}"


def count(value: float | None) -> str:
    return NONE if value is None else f"{value:,.0f}"


def percent(value: float | None) -> str:
    """Format a share [0, 1] as per cent; 100 only if it is exactly 1."""
    if value is None:
        return NONE
    return f"{int(100 * value + 1e-9)} %" if value > 0.1 else f"{100 * value:.1f} %".replace(".0 %", " %")


def valid_yield(made: Any) -> str:
    """Format the share of validated candidates that are valid; "not validated" without validation."""
    if made.valid_yield is None:
        return "not validated" if made.candidates else NONE
    return percent(made.valid_yield)


def worker_time(stage: Any) -> str:
    """Format the worker time of a stage for its job; reused results are counted separately."""
    if not stage.reused:
        return duration(stage.seconds) if stage.seconds else NONE
    if stage.reused == stage.succeeded:
        return "none, reused"
    return f"{duration(stage.seconds)}, {stage.reused} reused"


def duration(seconds: float | None) -> str:
    """Format a time span in its two largest units."""
    if seconds is None:
        return NONE
    if seconds < 10:
        return f"{seconds:.1f} s"
    if seconds < 60:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    hours, minutes = divmod(minutes, 60)
    if hours < 48:
        return f"{hours} h {minutes} min"
    return f"{hours // 24} d {hours % 24} h" if hours % 24 else f"{hours // 24} d"


def elapsed(start: str, end: str | None) -> str:
    """Format the time from one RFC 3339 time to another, or until now."""
    last = datetime.fromisoformat(end) if end else datetime.now(UTC)
    return duration(max(0.0, (last - datetime.fromisoformat(start)).total_seconds()))


def size(value: float | None) -> str:
    if value is None:
        return NONE
    for unit in ("B", "kB", "MB", "GB"):
        if value < 1000:
            return f"{value:.0f} {unit}" if unit == "B" or value >= 100 else f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.1f} TB"


def minute(value: str | None) -> str:
    """Format an RFC 3339 time for a table of the command line: `2026-11-26 03:14`, UTC; empty for none."""
    return (value or "")[:16].replace("T", " ")


def stamp(value: str) -> str:
    """Format an RFC 3339 time for readers without JavaScript; the script replaces it by a relative time."""
    return datetime.fromisoformat(value).strftime("%Y-%m-%d %H:%M UTC")


#: Words for the kind of a scene; free grasps have none.
_PLACES: Final = {"table": "on a table", "bin": "in a bin", "shelf": "on a shelf", "file": "in a scene of their own"}
FILTERS: Final[Mapping[str, Callable[..., Any]]] = {
    "metric": metric,
    "count": count,
    "percent": percent,
    "valid_yield": valid_yield,
    "place": lambda kind: _PLACES.get(kind, ""),
    "duration": duration,
    "elapsed": elapsed,
    "worker_time": worker_time,
    "bytes": size,
    "stamp": stamp,
    "tick": format_tick,
    "outcomes": count_outcomes,
    "shell": shlex.quote,
    "python": repr,
}


def is_loopback(host: str) -> bool:
    with suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"
