"""Of what a key has in work, jobs and datasets, that which has not ended: what its quota counts."""

from __future__ import annotations

from collections.abc import Collection
from typing import Final

from service.index.index import Index

DATASET_PREFIX: Final = "dataset:"


def unfinished(index: Index, ids: Collection[str]) -> set[str]:
    """Of these jobs and datasets, as quotas name them, those that have not ended."""
    names = {one.removeprefix(DATASET_PREFIX) for one in ids if one.startswith(DATASET_PREFIX)}
    found = index.jobs.unfinished([one for one in ids if not one.startswith(DATASET_PREFIX)])
    return found | {DATASET_PREFIX + name for name in index.datasets.unfinished(names)}
