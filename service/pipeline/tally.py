"""What the controller counts as it indexes. The sums lie in one hash in Redis, so every API process shows the same.

They start from zero when Redis is lost, which Prometheus takes for a restart; an event that comes twice counts twice.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Iterable
from typing import Final

from pydantic_core import from_json

from service.model.states import State
from service.pipeline.series import SERIES, STAGE_BUCKETS_S
from service.queue.port import Counters
from service.store.manifests import ShardManifest

#: Names of errors that get a series of their own; more than an engine raises, and a bound if somebody forges them.
MOST_KINDS: Final = 60
OTHER_KIND: Final = "other"


class Tally:
    """Counts in memory; `flush` adds that to the sums in one go."""

    def __init__(self, counters: Counters) -> None:
        self._counters = counters
        self._amounts: defaultdict[str, float] = defaultdict(float)
        self._kinds: set[tuple[str, str]] = set()

    def made(self, manifests: Iterable[ShardManifest]) -> None:
        """Shards that were indexed."""
        for manifest in manifests:
            stage = manifest.stage.value
            self._add("graspd_shards_total", stage)
            self._add("graspd_shard_bytes_total", stage, amount=manifest.size_bytes)
            self._observe("graspd_stage_seconds", stage, seconds=manifest.seconds)
            if manifest.kind == "base":
                self._add("graspd_grasps_total", "all", amount=manifest.count)
                self._add("graspd_grasps_total", "valid", amount=manifest.valid)
                self._add("graspd_grasps_total", "judged", amount=manifest.judged)

    def failed(self, stage: str, kind: str) -> None:
        """An attempt of a task failed."""
        if (stage, kind) not in self._kinds:
            if len(self._kinds) >= MOST_KINDS:
                kind = OTHER_KIND
            self._kinds.add((stage, kind))
        self._add("graspd_task_failures_total", stage, kind)

    def handed_back(self, stage: str, kind: str) -> None:
        """A task was deferred, returned or cancelled."""
        self._add("graspd_task_handbacks_total", stage, kind)

    def ended(self, state: State) -> None:
        """A job came to its end."""
        self._add("graspd_jobs_ended_total", state.value)

    def flush(self) -> None:
        """Add what was counted to the sums; QueueUnavailable keeps it for the next time."""
        if self._amounts:
            self._counters.count(self._amounts)
            self._amounts.clear()

    def _observe(self, name: str, *labels: str, seconds: float) -> None:
        bound = next((bound for bound in STAGE_BUCKETS_S if seconds <= bound), None)
        self._amounts[field(f"{name}_bucket", *labels, "+Inf" if bound is None else str(bound))] += 1
        self._amounts[field(f"{name}_sum", *labels)] += seconds

    def _add(self, name: str, *labels: str, amount: float = 1) -> None:
        assert len(SERIES[name].labels) == len(labels)
        self._amounts[field(name, *labels)] += amount


def field(name: str, *labels: str) -> str:
    """Name of a sum: the series and the values of its labels."""
    return json.dumps([name, *labels])


def parse_field(text: str) -> tuple[str, tuple[str, ...]] | None:
    """Series and label values of a sum; None if it is not one of ours."""
    try:
        name, *labels = from_json(text)
    except (ValueError, TypeError):
        return None
    return (name, tuple(map(str, labels))) if isinstance(name, str) else None
