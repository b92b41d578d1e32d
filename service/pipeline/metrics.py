"""Counters of the controller for `/metrics`.

The sums lie in one hash in Redis, so every API process shows the same values. They restart from zero when Redis is
lost, which Prometheus counts as a restart. A repeated event counts twice.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from typing import Final

from graspd.service.model.series import SERIES, STAGE_BUCKETS_S, field
from graspd.service.store.manifests import ShardManifest

#: Most names of errors with their own series: more than an engine raises, and a bound against forged names.
MOST_KINDS: Final = 60
OTHER_KIND: Final = "other"


class Tally:
    """Counts in memory; `flush` adds them to the sums in one call."""

    def __init__(self, count: Callable[[Mapping[str, float]], None]) -> None:
        """`count` adds to the sums."""
        self._count = count
        self._amounts: defaultdict[str, float] = defaultdict(float)
        self._kinds: set[tuple[str, str]] = set()

    def made(self, manifests: Iterable[ShardManifest]) -> None:
        for manifest in manifests:
            stage = manifest.stage.value
            self.add("graspd_shards_total", stage)
            self.add("graspd_shard_bytes_total", stage, amount=manifest.size_bytes)
            self._observe("graspd_stage_seconds", stage, seconds=manifest.seconds)
            if manifest.kind == "base":
                self.add("graspd_grasps_total", "all", amount=manifest.count)
                self.add("graspd_grasps_total", "valid", amount=manifest.valid)
                self.add("graspd_grasps_total", "validated", amount=manifest.validated)

    def failed(self, stage: str, kind: str) -> None:
        if (stage, kind) not in self._kinds:
            if len(self._kinds) >= MOST_KINDS:
                kind = OTHER_KIND
            self._kinds.add((stage, kind))
        self.add("graspd_task_failures_total", stage, kind)

    def flush(self) -> None:
        """Add the counts to the sums; after QueueUnavailable they stay for the next call."""
        if self._amounts:
            self._count(self._amounts)
            self._amounts.clear()

    def _observe(self, name: str, *labels: str, seconds: float) -> None:
        bound = next((bound for bound in STAGE_BUCKETS_S if seconds <= bound), None)
        self._amounts[field(f"{name}_bucket", *labels, "+Inf" if bound is None else str(bound))] += 1
        self._amounts[field(f"{name}_sum", *labels)] += seconds

    def add(self, name: str, *labels: str, amount: float = 1) -> None:
        assert len(SERIES[name].labels) == len(labels)
        self._amounts[field(name, *labels)] += amount
