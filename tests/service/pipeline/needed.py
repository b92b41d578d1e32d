"""What every asset must keep that jobs and datasets are made of, in whichever place they name it."""

from __future__ import annotations

import pytest

from graspd.service.model.errors import ConflictError
from graspd.service.model.states import AssetKind
from graspd.service.pipeline import job_actions
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.spec import DatasetRequest
from graspd.service.pipeline.deletion import delete_asset, delete_dataset, delete_job
from tests.planning import plan_all


def needed_until_its_users_are_deleted(
    services: Services, kind: AssetKind, name: str, job_id: str, wanted: DatasetRequest
) -> None:
    """Delete an asset, which takes the deletion of a job and of the dataset `wanted` first."""
    actions.create(services, wanted)
    with pytest.raises(ConflictError, match=f"the {kind.value} {name!r} is needed by job {job_id}"):
        delete_asset(services, kind, name)
    job_actions.cancel(services, job_id)
    delete_job(services, job_id)
    with pytest.raises(ConflictError, match=f"needed by dataset {wanted.name!r}"):
        delete_asset(services, kind, name)
    actions.cancel(services, wanted.name)
    plan_all(services)
    delete_dataset(services, wanted.name)
    delete_asset(services, kind, name)
