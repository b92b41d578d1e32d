"""What a key may do to datasets: its own are changed, and count against its quota as one job with all their grasps
until the dataset ends."""

from __future__ import annotations

from typing import TYPE_CHECKING

from api.access.auth import caller, must_own
from api.access.unfinished import DATASET_PREFIX
from service.index.dataset_views import DatasetView
from service.model.domain import State
from service.pipeline.datasets import actions
from service.pipeline.datasets.spec import DatasetRequest

if TYPE_CHECKING:
    from api.catalog.catalog import Catalog


def create(catalog: Catalog, request: DatasetRequest) -> tuple[DatasetView, bool]:
    """`actions.create` within the caller's quota.

    Raises:
        QuotaError: the caller's key has all it may have.
    """
    hands, objects = actions.members(catalog.parts, request)
    asked = len(hands) * len(objects) * request.grasps
    key = caller.get()
    with catalog.quotas.claim(key, DATASET_PREFIX + request.name, asked) as claim:
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
    with catalog.quotas.claim(caller.get(), DATASET_PREFIX + name, grasps, is_new=False):
        return actions.retry(catalog.parts, name)
