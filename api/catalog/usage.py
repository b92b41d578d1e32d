"""What projects used, day by day."""

from __future__ import annotations

import csv
import io
from datetime import UTC, date, datetime, timedelta
from typing import Final

from api.access.auth import caller, project_scope
from api.access.keys import KeyFile, ProjectLimits
from service.index.views import UsageDay
from service.model.errors import InputError
from service.pipeline.backends import Services

#: Days that are told where nobody asks for others.
DAYS: Final = 31
MOST_DAYS: Final = 366
_COLUMNS: Final = tuple(UsageDay.model_fields)


class Usage:
    """Use in the caller's scope: of the project of the key, and with `admin` of all."""

    def __init__(self, services: Services, keys: KeyFile) -> None:
        self._services = services
        self._keys = keys

    def days(self, since: date | None = None, until: date | None = None) -> list[UsageDay]:
        """Each project's use of each day, the newest first; by default of the last month.

        Raises:
            InputError: the days are in no order, or more than a year.
        """
        last = until or datetime.now(UTC).date()
        first = since or last - timedelta(days=min(DAYS - 1, last.toordinal() - 1))
        if first > last:
            raise InputError(f"since {first} is after until {last}")
        if (last - first).days >= MOST_DAYS:
            raise InputError(f"at most {MOST_DAYS} days are told at once; ask for fewer")
        return self._services.index.usage.days(first.isoformat(), last.isoformat(), scope=project_scope())

    def limits(self) -> dict[str, ProjectLimits]:
        """What each project in scope may use together."""
        key = caller.get()
        if key is None:
            return {}
        return {name: limits for name, limits in self._keys.projects().items() if project_scope().sees(name)}


def as_csv(days: list[UsageDay]) -> str:
    """A table with a line of names (RFC 4180)."""
    text = io.StringIO()
    table = csv.writer(text)
    table.writerow(_COLUMNS)
    table.writerows([getattr(one, column) for column in _COLUMNS] for one in days)
    return text.getvalue()
