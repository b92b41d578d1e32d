"""Wall-clock time as text. Durations and leases never use it: they use `time.monotonic`."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta


def timestamp(ago_s: float = 0.0) -> str:
    """Now, or some seconds ago, RFC 3339 in UTC with milliseconds; such texts sort by time."""
    when = datetime.now(UTC) - timedelta(seconds=ago_s)
    return when.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def age_of(when: str) -> float | None:
    """Seconds since a time in RFC 3339, for showing; None if it cannot be read."""
    try:
        return max(0.0, (datetime.now(UTC) - datetime.fromisoformat(when)).total_seconds())
    except (ValueError, TypeError):
        return None
