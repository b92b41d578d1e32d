"""Pages of datasets: hand x object matrix of all jobs and of each dataset, actions, and comparison."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Annotated, Any, Final
from urllib.parse import urlencode

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse
from pydantic import ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import FormData

from graspd.api.access.auth import ForeignResource
from graspd.api.catalog.assets import Assets
from graspd.api.catalog.datasets import Datasets
from graspd.api.catalog.jobs import Jobs
from graspd.api.dashboard import figures
from graspd.api.dashboard.figures import twins
from graspd.api.dashboard.form_uploads import asset_choices
from graspd.api.dashboard.forms import first_message, inputs_of, listed
from graspd.api.dashboard.grasp_pages import COLUMNS
from graspd.api.dashboard.rendering import render
from graspd.api.routes.dependencies import AssetsOf, ComparisonsOf, DatasetsOf, JobsOf, may_read, may_submit
from graspd.service.index.views import CellView
from graspd.service.model.domain import JobRequest
from graspd.service.model.errors import ConflictError, InputError
from graspd.service.model.fidelity import OFFERED
from graspd.service.model.states import AssetKind, State
from graspd.service.pipeline.datasets.spec import DatasetRequest

PAGE_SIZE: Final = 20
#: Largest matrix shown as a table; larger ones are shown as a paginated list, which is easier to read.
MATRIX_CELLS: Final = 1000
_CELLS_AT_ONCE: Final = 200
_MAX_FIELDS: Final = 4000
_DONE: Final = {"submit": "submitted", "retry": "retried", "cancel": "cancelled", "snapshot": "taken as a snapshot"}

#: Fields of a dataset's form, and their initial values.
_MAKE: Final = {"name": "", "grasps": "320", "fidelity": "standard"} | {
    one.name: one.default for one in inputs_of(cells=True)
}

router = APIRouter(prefix="/datasets", include_in_schema=False)


@router.get("", dependencies=[Depends(may_read)])
def datasets_page(
    request: Request,
    datasets: DatasetsOf,
    assets: AssetsOf,
    cursor: Annotated[str | None, Query(max_length=512)] = None,
) -> HTMLResponse:
    """Show all datasets, and all hands and objects of the service as a matrix."""
    return _overview(request, datasets, assets, cursor=cursor)


@router.post("", dependencies=[Depends(may_submit)], response_model=None)
async def create(request: Request, datasets: DatasetsOf, assets: AssetsOf) -> HTMLResponse | RedirectResponse:
    """Make a dataset from the form."""
    async with request.form(max_fields=_MAX_FIELDS) as fields:
        return await run_in_threadpool(_create, request, datasets, assets, fields)


@router.post("/cells", dependencies=[Depends(may_submit)], response_model=None)
async def act_on_pairs(
    request: Request, jobs: JobsOf, datasets: DatasetsOf, assets: AssetsOf
) -> HTMLResponse | RedirectResponse:
    """Submit, retry or cancel the jobs of selected pairs."""
    async with request.form(max_fields=_MAX_FIELDS) as fields:
        return await run_in_threadpool(_act_on_pairs, request, jobs, datasets, assets, fields)


@router.get("/{name}", dependencies=[Depends(may_read)])
def dataset_page(
    request: Request,
    name: str,
    datasets: DatasetsOf,
    state: str = "",
    cursor: Annotated[str | None, Query(max_length=512)] = None,
) -> HTMLResponse:
    """Show one dataset: matrix, progress and snapshots."""
    dataset = datasets.one(name)
    chosen = State(state) if state in set(State) else None
    as_matrix = dataset.cells <= MATRIX_CELLS and chosen is None
    page = None if as_matrix else datasets.cells(name, state=chosen, limit=_CELLS_AT_ONCE, cursor=cursor)
    cells = _all_cells(datasets, name) if page is None else page.items
    return render(
        request,
        "dataset.html",
        page="/datasets",
        events="" if dataset.state.is_final else "/events",
        refresh_s=0 if dataset.state.is_final else 5,
        dataset=dataset,
        grid=figures.of_dataset(dataset, cells) if as_matrix else None,
        cells=cells,
        chosen=chosen or "",
        next=page.next if page else None,
        snapshots=datasets.snapshots(name, limit=10).items,
        did=_did(request),
    )


@router.post("/{name}/cells", dependencies=[Depends(may_submit)])
async def act_on_cells(request: Request, name: str, jobs: JobsOf) -> RedirectResponse:
    """Retry or cancel the jobs of selected cells of a dataset."""
    async with request.form(max_fields=_MAX_FIELDS) as fields:
        return await run_in_threadpool(_act_on_cells, jobs, name, fields)


@router.post("/{name}/{action}", dependencies=[Depends(may_submit)], response_model=None)
def act(request: Request, name: str, action: str, datasets: DatasetsOf) -> RedirectResponse | HTMLResponse:
    """Cancel or retry a whole dataset, or take a snapshot of it."""
    do: dict[str, Callable[[], Any]] = {
        "cancel": lambda: datasets.cancel(name),
        "retry": lambda: datasets.retry(name),
        "snapshot": lambda: datasets.take_snapshot(name),
    }
    if action not in do:
        raise InputError(f"a dataset has no action {action!r}; there are: {', '.join(do)}")
    do[action]()
    return _redirect(f"/datasets/{name}", action, done=1)


def _create(request: Request, datasets: Datasets, assets: Assets, fields: FormData) -> HTMLResponse | RedirectResponse:
    form = {key: str(fields[key]) for key in _MAKE if fields.get(key)}
    wanted = form | {"hands": fields.getlist("hands"), "objects": fields.getlist("objects")}
    beside = {"neighbours": listed(form.get("neighbours", ""))}
    try:
        dataset = datasets.create(DatasetRequest.model_validate(wanted | beside))
    except (ValidationError, InputError) as error:
        message = first_message(error) if isinstance(error, ValidationError) else str(error)
        return _overview(request, datasets, assets, problem=message, form=wanted, status=422)
    return RedirectResponse(f"/datasets/{dataset.name}", status_code=303)


def _act_on_pairs(
    request: Request, jobs: Jobs, datasets: Datasets, assets: Assets, fields: FormData
) -> HTMLResponse | RedirectResponse:
    action = str(fields.get("action", ""))
    pairs = [(hand, obj) for cell in fields.getlist("cell") for hand, _, obj in [str(cell).partition("|")] if obj]
    try:
        if action == "submit":
            options = {key: str(fields[key]) for key in ("grasps", "fidelity") if fields.get(key)}
            wanted = [JobRequest.model_validate(options | {"hand": hand, "object": obj}) for hand, obj in pairs]
            done, left = _each(jobs.submit, wanted)
        else:
            done, left = _each(_job_action(jobs, action), _jobs_of(jobs, pairs, action))
    except (ValidationError, InputError) as error:
        message = first_message(error) if isinstance(error, ValidationError) else str(error)
        return _overview(request, datasets, assets, problem=message, status=422)
    return _redirect("/datasets", action, done=done, left=left)


def _act_on_cells(jobs: Jobs, name: str, fields: FormData) -> RedirectResponse:
    action = str(fields.get("action", ""))
    done, left = _each(_job_action(jobs, action), [str(cell) for cell in fields.getlist("cell")])
    return _redirect(f"/datasets/{name}", action, done=done, left=left)


def _job_action(jobs: Jobs, action: str) -> Callable[[str], Any]:
    if action == "retry":
        return jobs.retry
    if action == "cancel":
        return jobs.cancel
    raise InputError(f"cells have no action {action!r}; they can be submitted, retried or cancelled")


def _jobs_of(jobs: Jobs, pairs: Iterable[tuple[str, str]], action: str) -> list[str]:
    states = (State.FAILED, State.CANCELLED) if action == "retry" else (State.QUEUED, State.RUNNING)
    return [
        job.id
        for hand, obj in pairs
        for state in states
        for job in jobs.page(state=state, hand=hand, object=obj, limit=_CELLS_AT_ONCE).items
    ]


def _each(do: Callable[[Any], Any], wanted: Iterable[Any]) -> tuple[int, int]:
    """Apply an action; return how often it succeeded, and how often owner or state did not allow it."""
    done = left = 0
    for one in wanted:
        try:
            do(one)
            done += 1
        except (ConflictError, ForeignResource):
            left += 1
    return done, left


def _redirect(address: str, action: str, *, done: int, left: int = 0) -> RedirectResponse:
    return RedirectResponse(f"{address}?{urlencode({'did': action, 'done': done, 'left': left})}", status_code=303)


def _did(request: Request) -> str:
    """Describe the result of the last action."""
    given = request.query_params
    done, left = given.get("done", ""), given.get("left", "0")
    if given.get("did") not in _DONE or not done.isdigit() or not left.isdigit():
        return ""
    if given["did"] == "snapshot":
        return "The snapshot is taken; it lists all present shards."
    what = "job" if done == "1" else "jobs"
    words = f"{done} {what} {_DONE[given['did']]}"
    return (
        words + (f"; {left} unchanged: owned by another key, or not in a suitable state" if left != "0" else "") + "."
    )


def _all_cells(datasets: Datasets, name: str) -> list[CellView]:
    cells: list[CellView] = []
    cursor = None
    while True:
        page = datasets.cells(name, limit=_CELLS_AT_ONCE, cursor=cursor)
        cells += page.items
        cursor = page.next
        if cursor is None:
            return cells


def _overview(
    request: Request,
    datasets: Datasets,
    assets: Assets,
    *,
    cursor: str | None = None,
    problem: str = "",
    form: dict[str, Any] | None = None,
    status: int = 200,
) -> HTMLResponse:
    hands, objects = (asset_choices(assets, kind) for kind in (AssetKind.HAND, AssetKind.OBJECT))
    page = datasets.page(limit=PAGE_SIZE, cursor=cursor)
    return render(
        request,
        "datasets.html",
        status=status,
        page="/datasets",
        events="/events",
        refresh_s=10,
        datasets=page.items,
        next=page.next,
        grid=figures.of_service(datasets.matrix(), [name for name, _ in hands], [name for name, _ in objects]),
        hands=hands,
        objects=objects,
        fidelities=OFFERED,
        inputs=inputs_of(cells=True),
        form=_MAKE | {"hands": [], "objects": []} | (form or {}),
        problem=problem,
        did=_did(request),
    )


#: Datasets offered for comparison, newest first.
_OFFERED: Final = 200

comparison_router = APIRouter(include_in_schema=False)

Named = Annotated[str, Query(max_length=64)]


@comparison_router.get("/compare", dependencies=[Depends(may_read)])
def compare_page(
    request: Request, datasets: DatasetsOf, comparisons: ComparisonsOf, one: Named = "", other: Named = ""
) -> HTMLResponse:
    """Compare two datasets: options, yields of cells, metrics of grasps. The URL can be shared."""
    found = comparisons.of(one, other) if one and other else None
    shown = {key: (label, unit) for key, label, unit in COLUMNS}
    return render(
        request,
        "compare.html",
        page="/datasets",
        names=[dataset.name for dataset in datasets.page(limit=_OFFERED).items],
        chosen=(one, other),
        found=found,
        metrics=[(*shown[metric], both, twins(both)) for metric, both in found.metrics.items()] if found else [],
    )
