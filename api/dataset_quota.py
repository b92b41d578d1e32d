"""What a key may do to datasets: its own are changed, and count against its quota as one job with all their grasps
until the dataset ends."""

from __future__ import annotations

from collections.abc import Collection
from typing import TYPE_CHECKING, Final

from api.auth import caller, must_own
from service.datasets import actions
from service.datasets.spec import DatasetRequest
from service.domain import State
from service.index.dataset_views import DatasetView
from service.index.index import Index

if TYPE_CHECKING:
    from api.catalog import Catalog

_PREFIX: Final = "dataset:"


def create(catalog: Catalog, request: DatasetRequest) -> tuple[DatasetView, bool]:
    """`actions.create` within the caller's quota.

    Raises:
        QuotaError: the caller's key has all it may have.
    """
    hands, objects = actions.members(catalog.parts, request)
    asked = len(hands) * len(objects) * request.grasps
    key = caller.get()
    with catalog.quotas.claim(key, _PREFIX + request.name, asked) as claim:
        dataset, is_new = actions.create(catalog.parts, request, owner=key.id if key else "")
        claim.counts = is_new
    return dataset, is_new


def cancel(catalog: Catalog, name: str) -> DatasetView:
    """`actions.cancel` of the caller's own dataset.

    Raises:
        NotYours: another key submitted it.
    """
    must_own(catalog.parts.index.dataset(name).owner, f"dataset {name!r}")
    return actions.cancel(catalog.parts, name)


def retry(catalog: Catalog, name: str) -> DatasetView:
    """`actions.retry` of the caller's own dataset within his quota: it counts the cells that are started again.

    Raises:
        NotYours: another key submitted it.
        QuotaError: the caller's key has all it may have.
    """
    dataset = catalog.parts.index.dataset(name)
    must_own(dataset.owner, f"dataset {name!r}")
    again = dataset.states[State.FAILED] + dataset.states[State.CANCELLED]
    grasps = again * dataset.options.grasps
    with catalog.quotas.claim(caller.get(), _PREFIX + name, grasps, is_new=False):
        return actions.retry(catalog.parts, name)


def unfinished(index: Index, ids: Collection[str]) -> set[str]:
    """Of these jobs and datasets, as quotas name them, those that have not ended."""
    names = {one.removeprefix(_PREFIX) for one in ids if one.startswith(_PREFIX)}
    found = index.unfinished_of([one for one in ids if not one.startswith(_PREFIX)])
    return found | {_PREFIX + name for name in index.unfinished_datasets(names)}
