"""What each fidelity is expected to cost and give for a job, from what was measured here or is stored."""

from __future__ import annotations

import threading
import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from pydantic import ValidationError

from api.access.auth import project_scope
from service.index.index import Index
from service.index.queries.usage import BatchCost, Costs
from service.model.errors import GraspdError
from service.model.fidelity import OFFERED
from service.model.projects import ProjectScope
from service.model.states import Stage
from service.pipeline.datasets.cost import estimate
from service.pipeline.datasets.spec import Matrix

#: Costs of batches change slowly, and reading two thousand of them takes as long as a page may.
KEPT_S: Final = 60.0
WORDS: Final = {
    "draft": "Fewest points and starts. For a first look.",
    "standard": "The balance that the docs measure.",
    "fine": "More starts, more points. Contacts that hold up.",
}


@dataclass(frozen=True)
class Expected:
    """A fidelity and its price."""

    name: str
    words: str
    seconds: float | None
    """One worker's time for the whole job [s]; None: not known."""
    low: float | None
    high: float | None
    """Interval of the seconds [s]."""
    valid_yield: float | None
    origin: str


def listed(text: str) -> list[str]:
    """Names that a field of a form holds, between commas or spaces."""
    return text.replace(",", " ").split()


class Expectations:
    """Estimates for the form of a job; what it remembers between two requests may be lost."""

    def __init__(self, index: Index) -> None:
        self._index = index
        self._costs = _RememberedCosts(index.costs)

    def of(self, form: Mapping[str, Any]) -> list[Expected]:
        """Every offered fidelity for what a form says; without numbers where it cannot be estimated."""
        # An empty field says nothing.
        wanted = {
            key: value for key, value in form.items() if key not in ("hand", "object", "fidelity") and value != ""
        }
        wanted["neighbours"] = listed(str(form.get("neighbours", "")))
        return [self._one(name, wanted, str(form["hand"]), str(form["object"])) for name in OFFERED]

    def _one(self, name: str, wanted: dict[str, Any], hand: str, obj: str) -> Expected:
        try:
            matrix = Matrix.model_validate(wanted | {"hands": (hand,), "objects": (obj,), "fidelity": name})
            cost = estimate(self._index, matrix, costs=self._costs.of_batches, scope=project_scope())
        except (ValidationError, GraspdError):
            return Expected(name, WORDS[name], None, None, None, None, "")
        rate = cost.rates[0] if cost.rates else None
        share, origin = (rate.valid_yield, rate.origin) if rate else (None, "")
        return Expected(name, WORDS[name], cost.seconds, cost.seconds_low, cost.seconds_high, share, origin)


class _RememberedCosts:
    """Costs of batches, read at most once in a while."""

    def __init__(self, costs: Costs) -> None:
        self._costs = costs
        self._read: dict[tuple[Stage, ProjectScope], tuple[float, list[BatchCost]]] = {}
        self._lock = threading.Lock()

    def of_batches(self, stage: Stage) -> list[BatchCost]:
        with self._lock:
            now = time.monotonic()
            key = (stage, project_scope())
            if key not in self._read or now - self._read[key][0] > KEPT_S:
                self._read[key] = (now, self._costs.of_batches(stage, scope=project_scope()))
            return self._read[key][1]
