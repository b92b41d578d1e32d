"""Numbers, times, sizes and names of machines as pages and terminals show them."""

from __future__ import annotations

import ipaddress
import shlex
from collections.abc import Callable, Mapping
from datetime import datetime
from typing import Any, Final

NONE: Final = "–"


def metric(value: float | None) -> str:
    """Three significant digits, without a tail of zeros that says nothing."""
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
    """A whole number with thousands apart."""
    return NONE if value is None else f"{value:,.0f}"


def percent(value: float | None) -> str:
    """Share [0, 1] as per cent; 100 only when it is all."""
    if value is None:
        return NONE
    return f"{int(100 * value + 1e-9)} %" if value > 0.1 else f"{100 * value:.1f} %".replace(".0 %", " %")


def valid_yield(made: Any) -> str:
    """Share of the validated grasps that are valid, of whatever counts them; words where not validated."""
    if made.valid_yield is None:
        return "not validated" if made.candidates else NONE
    return percent(made.valid_yield)


def worker_time(stage: Any) -> str:
    """Time that workers spent on a stage for its job; what another job had made before is said and not counted."""
    if not stage.reused:
        return duration(stage.seconds) if stage.seconds else NONE
    if stage.reused == stage.succeeded:
        return "none, reused"
    return f"{duration(stage.seconds)}, {stage.reused} reused"


def duration(seconds: float | None) -> str:
    """The two largest units of a time span."""
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


def size(value: float | None) -> str:
    """Bytes in decimal units."""
    if value is None:
        return NONE
    for unit in ("B", "kB", "MB", "GB"):
        if value < 1000:
            return f"{value:.0f} {unit}" if unit == "B" or value >= 100 else f"{value:.1f} {unit}"
        value /= 1000
    return f"{value:.1f} TB"


def minute(value: str | None) -> str:
    """An RFC 3339 time as a table of the command line shows it: `2026-11-26 03:14`, UTC; empty for none."""
    return (value or "")[:16].replace("T", " ")


def stamp(value: str) -> str:
    """What a reader without JavaScript sees of an RFC 3339 time; the script says it relative to now."""
    return datetime.fromisoformat(value).strftime("%Y-%m-%d %H:%M UTC")


#: The names that templates call them by.
_PLACES: Final = {"table": "on a table", "bin": "in a bin", "shelf": "on a shelf", "file": "in a scene of their own"}


def place(kind: str) -> str:
    """Where grasps of a kind of scene are used; empty: a free object."""
    return _PLACES.get(kind, "")


FILTERS: Final[Mapping[str, Callable[..., str]]] = {
    "metric": metric,
    "count": count,
    "percent": percent,
    "valid_yield": valid_yield,
    "place": place,
    "duration": duration,
    "worker_time": worker_time,
    "bytes": size,
    "stamp": stamp,
    "shell": shlex.quote,
}


def host_name(host: str) -> str:
    """Name in a Host header, without port and brackets."""
    if host.startswith("["):
        return host[1:].partition("]")[0]
    return host.rpartition(":")[0] if host.count(":") == 1 else host


def is_loopback(host: str) -> bool:
    """Whether an address to bind is reachable from this machine alone."""
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
