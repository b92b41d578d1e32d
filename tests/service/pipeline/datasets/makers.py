"""Hands and objects without content, datasets on them, and their tasks done or failed on the spot."""

from typing import Any

from graspd.service.index.views import CellView
from graspd.service.model.planning import plan_tasks
from graspd.service.model.states import AssetKind, Stage
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.spec import DatasetRequest
from tests.fakes import ACCEPTED, fail_task, finish, plan_all, put_asset, record_of


def add_asset(services: Services, kind: str, name: str, *, content: str = "", verdict: str | None = "accept") -> str:
    """A hand or object; returns its digest."""
    files = {"asset.json": b'{"file": "it"}', "it": f"{name} {content}".encode()}
    found = ACCEPTED | {"verdict": verdict, "message": "as it is"} if verdict else None
    return put_asset(services, AssetKind(kind), name, files, found)


def wanted(name: str = "grasps", **changes: Any) -> DatasetRequest:
    given = {"hands": ("gripper", "claw"), "objects": ("ball", "cube"), "grasps": 32, "validation": "standard"}
    return DatasetRequest.model_validate({"name": name, **given, **changes})


def done(services: Services, name: str = "grasps", **changes: Any) -> None:
    """A dataset whose tasks are all done."""
    actions.create(services, wanted(name, **changes))
    plan_all(services)
    for job in jobs_of(services, name):
        finish(services, job)


def fail(services: Services, job: str, reason: str = "it broke") -> None:
    for task in plan_tasks(record_of(services, job)):
        if task.stage is Stage.SYNTHESIZE:
            fail_task(services, job, task, services.index.jobs.task(task.id).attempt, reason=reason)


def cells_of(services: Services, name: str = "grasps") -> list[CellView]:
    return list(services.index.datasets.cells(name, limit=200).items)


def jobs_of(services: Services, name: str) -> list[str]:
    return [cell.job_id for cell in cells_of(services, name)]
