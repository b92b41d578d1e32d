"""What every asset must keep that jobs and datasets are made of, in whichever place they name it."""

from __future__ import annotations

import pytest

from service.model.errors import ConflictError
from service.model.states import AssetKind
from service.pipeline import job_actions
from service.pipeline.backends import Parts
from service.pipeline.datasets import actions
from service.pipeline.datasets.spec import DatasetRequest
from service.pipeline.deletion import delete_asset, delete_dataset, delete_job
from tests.planning import plan_all


def needed_until_its_users_are_deleted(
    parts: Parts, kind: AssetKind, name: str, job_id: str, wanted: DatasetRequest
) -> None:
    """Delete an asset, which takes the deletion of a job and of the dataset `wanted` first."""
    actions.create(parts, wanted)
    with pytest.raises(ConflictError, match=f"the {kind.value} {name!r} is needed by job {job_id}"):
        delete_asset(parts, kind, name)
    job_actions.cancel(parts, job_id)
    delete_job(parts, job_id)
    with pytest.raises(ConflictError, match=f"needed by dataset {wanted.name!r}"):
        delete_asset(parts, kind, name)
    actions.cancel(parts, wanted.name)
    plan_all(parts)
    delete_dataset(parts, wanted.name)
    delete_asset(parts, kind, name)
