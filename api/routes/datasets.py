"""`/v1/datasets` and `/v1/object-sets`: matrices of jobs, and objects that go by one name."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Request, Response
from pydantic import BaseModel, ConfigDict, Field

from api.access.auth import caller, must_own
from api.catalog import dataset_quota
from api.problems import ApiError, responses
from api.routes.dependencies import CatalogOf, Cursor, Limit, may_read, may_submit
from api.routes.paging import link_next
from service.index.dataset_views import CellView, DatasetView, ObjectSetView, SnapshotView
from service.index.views import Page
from service.model.dataset_records import Snapshot
from service.model.domain import Name, State
from service.pipeline.datasets import actions
from service.pipeline.datasets.cost import Estimate, estimate
from service.pipeline.datasets.spec import DatasetRequest, Matrix, Names
from service.pipeline.fidelity_choice import Resolver
from service.store.datasets import load_snapshot

router = APIRouter(prefix="/v1/datasets", tags=["datasets"])
sets_router = APIRouter(prefix="/v1/object-sets", tags=["object sets"])
routers = (router, sets_router)

DatasetName = Annotated[str, Path(max_length=64)]
SnapshotDigest = Annotated[str, Path(pattern=r"^[0-9a-f]{32}$")]
_ENDED: dict[int | str, dict[str, Any]] = {200: {"model": DatasetView, "description": "It has ended"}}


class ObjectSetRequest(BaseModel):
    """Objects that shall go by one name."""

    model_config = ConfigDict(extra="forbid")

    name: Name
    objects: Names = Field(min_length=1, max_length=100_000)


@router.post(
    "",
    status_code=202,
    dependencies=[Depends(may_submit)],
    responses=responses(400, 401, 403, 404, 409, 413, 422, 503, others=_ENDED),
)
def create_dataset(body: DatasetRequest, response: Response, catalog: CatalogOf) -> DatasetView:
    """Create a dataset. The same name with the same content is the same dataset: what is made is not made again."""
    dataset, _ = dataset_quota.create(catalog, body)
    if dataset.state.is_final:
        response.status_code = 200
    return _placed(dataset, response)


@router.post("/estimate", dependencies=[Depends(may_read)], responses=responses(400, 401, 403, 404, 413, 422, 503))
def estimate_dataset(body: Matrix, catalog: CatalogOf) -> Estimate:
    """What a dataset will cost: time for 1, 8 and 64 workers, storage, network. Nothing is recorded."""
    return estimate(catalog.parts.index, body, Resolver(catalog.parts.store))


@router.api_route("/estimate", methods=["GET", "HEAD", "PUT", "PATCH", "DELETE"], include_in_schema=False)
def no_dataset() -> None:
    """`estimate` is the name of no dataset, so only POST has a meaning here."""
    raise ApiError(405, "an estimate is asked for with POST", headers={"Allow": "POST"})


@router.get("", dependencies=[Depends(may_read)], responses=responses(401, 403, 422, 503))
def list_datasets(
    request: Request, response: Response, catalog: CatalogOf, limit: Limit = 50, cursor: Cursor = None
) -> Page[DatasetView]:
    """Datasets, the newest first."""
    page = catalog.parts.index.datasets(limit=limit, cursor=cursor)
    link_next(request, response, page.next)
    return page


@router.get("/{name}", dependencies=[Depends(may_read)], responses=responses(401, 403, 404, 503))
def get_dataset(name: DatasetName, catalog: CatalogOf) -> DatasetView:
    """A dataset in numbers: cells by state, grasps, progress, time, bytes."""
    return catalog.parts.index.dataset(name)


@router.get("/{name}/cells", dependencies=[Depends(may_read)], responses=responses(401, 403, 404, 422, 503))
def list_cells(
    name: DatasetName,
    request: Request,
    response: Response,
    catalog: CatalogOf,
    state: State | None = None,
    limit: Limit = 50,
    cursor: Cursor = None,
) -> Page[CellView]:
    """Each hand x object with its job, state, yield and failures, hand by hand."""
    page = catalog.parts.index.dataset_cells(name, state=state, limit=limit, cursor=cursor)
    link_next(request, response, page.next)
    return page


@router.post(
    "/{name}/cancel",
    status_code=202,
    dependencies=[Depends(may_submit)],
    responses=responses(401, 403, 404, 409, 503),
)
def cancel_dataset(name: DatasetName, response: Response, catalog: CatalogOf) -> DatasetView:
    """Stop a dataset and its unfinished jobs; what is written stays, and jobs that another dataset wants go on."""
    return _placed(dataset_quota.cancel(catalog, name), response)


@router.post(
    "/{name}/retry",
    status_code=202,
    dependencies=[Depends(may_submit)],
    responses=responses(401, 403, 404, 409, 503),
)
def retry_dataset(name: DatasetName, response: Response, catalog: CatalogOf) -> DatasetView:
    """Start the cells again that failed or were cancelled; what is written is not made twice."""
    return _placed(dataset_quota.retry(catalog, name), response)


@router.delete(
    "/{name}",
    status_code=204,
    dependencies=[Depends(may_submit)],
    responses=responses(401, 403, 404, 409, 503),
)
def delete_dataset(name: DatasetName, catalog: CatalogOf) -> None:
    """Take away a dataset that has ended, its snapshots, and those of its jobs that were planned for it alone."""
    catalog.delete_dataset(name)


@router.post(
    "/{name}/snapshots",
    status_code=201,
    dependencies=[Depends(may_submit)],
    responses=responses(
        401, 403, 404, 409, 503, others={200: {"model": SnapshotView, "description": "There was one of these shards"}}
    ),
)
def take_snapshot(name: DatasetName, response: Response, catalog: CatalogOf) -> SnapshotView:
    """Write down which shards the dataset holds now. The same shards again are the same snapshot."""
    taken, new = actions.snapshot(catalog.parts, name)
    response.headers["Location"] = f"/v1/datasets/{name}/snapshots/{taken.digest}"
    if not new:
        response.status_code = 200
    return SnapshotView(**taken.model_dump(exclude={"shards", "version", "dataset_digest"}), shards=len(taken.shards))


@router.get("/{name}/snapshots", dependencies=[Depends(may_read)], responses=responses(401, 403, 404, 422, 503))
def list_snapshots(
    name: DatasetName,
    request: Request,
    response: Response,
    catalog: CatalogOf,
    limit: Limit = 50,
    cursor: Cursor = None,
) -> Page[SnapshotView]:
    """Snapshots of a dataset, the newest first."""
    page = catalog.parts.index.snapshots(name, limit=limit, cursor=cursor)
    link_next(request, response, page.next)
    return page


@router.get(
    "/{name}/snapshots/{digest}", dependencies=[Depends(may_read)], responses=responses(401, 403, 404, 422, 503)
)
def get_snapshot(name: DatasetName, digest: SnapshotDigest, catalog: CatalogOf) -> Snapshot:
    """A snapshot with its list of shards and their checksums."""
    return load_snapshot(catalog.store, name, digest)


@sets_router.post(
    "",
    status_code=201,
    dependencies=[Depends(may_submit)],
    responses=responses(400, 401, 403, 404, 413, 422, 503),
)
def add_object_set(body: ObjectSetRequest, response: Response, catalog: CatalogOf) -> ObjectSetView:
    """Give objects a name together. Others under the same name are its next version: for its owner, or an admin."""
    key = caller.get()
    found = actions.add_object_set(
        catalog.parts,
        body.name,
        body.objects,
        owner=key.id if key else "",
        may_follow=lambda owner: must_own(owner, f"the set {body.name!r}"),
    )
    response.headers["Location"] = f"/v1/object-sets/{found.name}"
    return found


@sets_router.get("", dependencies=[Depends(may_read)], responses=responses(401, 403, 503))
def list_object_sets(catalog: CatalogOf) -> list[ObjectSetView]:
    """The newest version of each set, by name."""
    return catalog.parts.index.object_sets()


@sets_router.get("/{name}", dependencies=[Depends(may_read)], responses=responses(401, 403, 404, 503))
def get_object_set(name: DatasetName, catalog: CatalogOf) -> ObjectSetView:
    """The newest version of a set."""
    return catalog.parts.index.object_set(name)


def _placed(dataset: DatasetView, response: Response) -> DatasetView:
    response.headers["Location"] = f"/v1/datasets/{dataset.name}"
    if not dataset.state.is_final:
        response.headers["Retry-After"] = "1"
    return dataset
