"""`/v1/datasets` and `/v1/object-sets`: matrices of jobs, and named sets of objects."""

from typing import Annotated, Any

from fastapi import APIRouter, Path, Query, Response
from pydantic import BaseModel, ConfigDict, Field
from starlette.routing import Route
from starlette.types import Receive, Scope, Send

from graspd.api.problems import ApiError
from graspd.api.routes.dependencies import READ, SUBMIT, DatasetsOf, PagingOf
from graspd.service.index.views import CellView, DatasetView, ObjectSetView, Page, SnapshotView
from graspd.service.model.base import Name
from graspd.service.model.records import Snapshot
from graspd.service.model.states import State
from graspd.service.pipeline.datasets.spec import DatasetRequest, Estimate, Matrix, Names

router = APIRouter(prefix="/v1/datasets", tags=["datasets"])
sets_router = APIRouter(prefix="/v1/object-sets", tags=["object sets"])
routers = (router, sets_router)

DatasetName = Annotated[str, Path(max_length=64)]
SnapshotDigest = Annotated[str, Path(pattern=r"^[0-9a-f]{32}$")]
_ENDED: dict[int | str, dict[str, Any]] = {200: {"model": DatasetView, "description": "The dataset has ended already"}}


class ObjectSetRequest(BaseModel):
    """Objects of a named set."""

    model_config = ConfigDict(extra="forbid")

    name: Name
    objects: Names = Field(min_length=1, max_length=100_000)


@router.post("", status_code=202, dependencies=SUBMIT, responses=_ENDED)
def create_dataset(body: DatasetRequest, response: Response, datasets: DatasetsOf) -> DatasetView:
    """Create a dataset. Identical content gives the same dataset; existing results are reused."""
    dataset = datasets.create(body)
    if dataset.state.is_final:
        response.status_code = 200
    return _with_location(dataset, response)


@router.post("/estimate", dependencies=READ)
def estimate_dataset(body: Matrix, datasets: DatasetsOf) -> Estimate:
    """Estimate a dataset's storage, and its time and traffic for 1, 8 and 64 workers. Nothing is recorded."""
    return datasets.estimate(body)


class _NoDataset:
    """Path of the estimate, for methods other than POST; no dataset may be named `estimate`."""

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        raise ApiError(405, "request an estimate with POST", headers={"Allow": "POST"})


# A class accepts every method; a function would have to list them.
router.routes.append(Route("/v1/datasets/estimate", _NoDataset(), include_in_schema=False))


@router.get("", dependencies=READ)
def list_datasets(datasets: DatasetsOf, paging: PagingOf) -> Page[DatasetView]:
    """List datasets, newest first."""
    return paging.add_next_link(datasets.page(limit=paging.limit, cursor=paging.cursor))


@router.get("/{name}", dependencies=READ)
def get_dataset(name: DatasetName, datasets: DatasetsOf) -> DatasetView:
    """Return a dataset's numbers: cells by state, grasps, progress, time, bytes."""
    return datasets.get(name)


@router.get("/{name}/cells", dependencies=READ)
def list_cells(name: DatasetName, datasets: DatasetsOf, paging: PagingOf, state: State | None = None) -> Page[CellView]:
    """List each cell (hand x object) with its job, state, yield and failures, ordered by hand."""
    return paging.add_next_link(datasets.cells(name, state=state, limit=paging.limit, cursor=paging.cursor))


@router.post("/{name}/cancel", status_code=202, dependencies=SUBMIT)
def cancel_dataset(name: DatasetName, response: Response, datasets: DatasetsOf) -> DatasetView:
    """Cancel a dataset and its unfinished jobs; results remain, and jobs of other datasets continue."""
    return _with_location(datasets.cancel(name), response)


@router.post("/{name}/retry", status_code=202, dependencies=SUBMIT)
def retry_dataset(name: DatasetName, response: Response, datasets: DatasetsOf) -> DatasetView:
    """Restart failed and cancelled cells; existing results are not made again."""
    return _with_location(datasets.retry(name), response)


@router.delete("/{name}", status_code=204, dependencies=SUBMIT)
def delete_dataset(
    name: DatasetName,
    datasets: DatasetsOf,
    with_snapshots: Annotated[bool, Query(description="delete its snapshots too; otherwise they protect it")] = False,
) -> None:
    """Delete an ended dataset, and jobs that belong to it alone; `POST .../restore` restores them."""
    datasets.delete(name, with_snapshots=with_snapshots)


@router.post(
    "/{name}/snapshots",
    status_code=201,
    dependencies=SUBMIT,
    responses={200: {"model": SnapshotView, "description": "A snapshot of these shards existed already"}},
)
def take_snapshot(name: DatasetName, response: Response, datasets: DatasetsOf) -> SnapshotView:
    """Record the dataset's present shards as a snapshot. The same shards give the same snapshot."""
    taken, new = datasets.take_snapshot(name)
    response.headers["Location"] = f"/v1/datasets/{name}/snapshots/{taken.digest}"
    if not new:
        response.status_code = 200
    return SnapshotView(**taken.model_dump(exclude={"shards", "version", "dataset_digest"}), shards=len(taken.shards))


@router.get("/{name}/snapshots", dependencies=READ)
def list_snapshots(name: DatasetName, datasets: DatasetsOf, paging: PagingOf) -> Page[SnapshotView]:
    """List snapshots of a dataset, newest first."""
    return paging.add_next_link(datasets.snapshots(name, limit=paging.limit, cursor=paging.cursor))


@router.get("/{name}/snapshots/{digest}", dependencies=READ)
def get_snapshot(name: DatasetName, digest: SnapshotDigest, datasets: DatasetsOf) -> Snapshot:
    """Return a snapshot with its list of shards and their checksums."""
    return datasets.snapshot(name, digest)


@sets_router.post("", status_code=201, dependencies=SUBMIT)
def add_object_set(body: ObjectSetRequest, response: Response, datasets: DatasetsOf) -> ObjectSetView:
    """Name a set of objects. Its owner or an admin may store other objects as the set's next version."""
    found = datasets.add_object_set(body.name, body.objects)
    response.headers["Location"] = f"/v1/object-sets/{found.name}"
    return found


@sets_router.get("", dependencies=READ)
def list_object_sets(datasets: DatasetsOf) -> list[ObjectSetView]:
    """List the newest version of each set, by name."""
    return datasets.object_sets()


@sets_router.get("/{name}", dependencies=READ)
def get_object_set(name: DatasetName, datasets: DatasetsOf) -> ObjectSetView:
    """Return the newest version of a set."""
    return datasets.object_set(name)


def _with_location(dataset: DatasetView, response: Response) -> DatasetView:
    response.headers["Location"] = f"/v1/datasets/{dataset.name}"
    if not dataset.state.is_final:
        response.headers["Retry-After"] = "1"
    return dataset
