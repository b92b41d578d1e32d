"""Wall-clock time as text. Durations and leases use `time.monotonic` instead."""

from datetime import UTC, datetime, timedelta


def timestamp(ago_s: float = 0.0) -> str:
    """Return the time `ago_s` before now: RFC 3339 in UTC with milliseconds, sortable as text."""
    when = datetime.now(UTC) - timedelta(seconds=ago_s)
    return when.isoformat(timespec="milliseconds").replace("+00:00", "Z")


def age_of(when: str) -> float | None:
    """Return the seconds since an RFC 3339 time, for display; None if it cannot be parsed."""
    try:
        return max(0.0, (datetime.now(UTC) - datetime.fromisoformat(when)).total_seconds())
    except (ValueError, TypeError):
        return None
