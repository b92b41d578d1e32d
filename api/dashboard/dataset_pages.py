"""Pages of datasets: hand x object matrix of all jobs and of each dataset, actions, and comparison."""

from collections.abc import Callable, Iterable
from typing import Annotated, Any, Final

from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse
from pydantic import ValidationError
from starlette.datastructures import FormData

from graspd.api.catalog.assets import Assets
from graspd.api.catalog.datasets import MOST_CELLS, Datasets
from graspd.api.catalog.jobs import Jobs
from graspd.api.dashboard import figures
from graspd.api.dashboard.form_uploads import asset_choices
from graspd.api.dashboard.forms import fields_of, first_message, inputs_of, split_list
from graspd.api.dashboard.grasp_pages import COLUMNS
from graspd.api.dashboard.job_list import change_jobs
from graspd.api.dashboard.rendering import redirect, render
from graspd.api.routes.dependencies import READ, SUBMIT, AssetsOf, Cursor, DatasetsOf, JobsOf
from graspd.service.model.domain import JobRequest
from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import OFFERED
from graspd.service.model.states import AssetKind, State
from graspd.service.pipeline.datasets.spec import DatasetRequest

PAGE_SIZE: Final = 20
_CELLS_AT_ONCE: Final = 200
Fields = Annotated[FormData, fields_of(4000)]

_INPUTS: Final = inputs_of(cells=True)
_MAKE: Final = {"name": "", "grasps": "320", "fidelity": "standard"} | {one.name: one.default for one in _INPUTS}

router = APIRouter(prefix="/datasets", include_in_schema=False)


@router.get("", dependencies=READ)
def datasets_page(request: Request, datasets: DatasetsOf, assets: AssetsOf, cursor: Cursor = None) -> HTMLResponse:
    return _render_datasets(request, datasets, assets, cursor=cursor)


@router.post("", dependencies=SUBMIT, response_model=None)
def create(request: Request, datasets: DatasetsOf, assets: AssetsOf, fields: Fields) -> HTMLResponse | RedirectResponse:
    form = {key: str(fields[key]) for key in _MAKE if fields.get(key)}
    wanted = form | {"hands": fields.getlist("hands"), "objects": fields.getlist("objects")}
    neighbours = split_list(form.get("neighbours", ""))
    try:
        dataset = datasets.create(DatasetRequest.model_validate(wanted | {"neighbours": neighbours}))
    except (ValidationError, InputError) as error:
        return _render_datasets(request, datasets, assets, problem=first_message(error), form=wanted, status=422)
    return redirect(f"/datasets/{dataset.name}", f"The dataset {dataset.name} is made; its jobs start now.")


@router.post("/cells", dependencies=SUBMIT, response_model=None)
def act_on_pairs(
    request: Request, jobs: JobsOf, datasets: DatasetsOf, assets: AssetsOf, fields: Fields
) -> HTMLResponse | RedirectResponse:
    action = str(fields.get("action", ""))
    pairs = [(hand, obj) for cell in fields.getlist("cell") for hand, _, obj in [str(cell).partition("|")] if obj]
    try:
        if action == "submit":
            options = {key: str(fields[key]) for key in ("grasps", "fidelity") if fields.get(key)}
            filled = [options | {"hand": hand, "object": obj} for hand, obj in pairs]
            wanted: list[Any] = [JobRequest.model_validate(one) for one in filled]
        else:
            wanted = _jobs_of(jobs, pairs, action)
        return change_jobs(jobs, action, wanted, "/datasets", ("submit", "retry", "cancel"))
    except (ValidationError, InputError) as error:
        return _render_datasets(request, datasets, assets, problem=first_message(error), status=422)


@router.get("/{name}", dependencies=READ)
def dataset_page(
    request: Request, name: str, datasets: DatasetsOf, state: str = "", cursor: Cursor = None
) -> HTMLResponse:
    dataset = datasets.get(name)
    chosen = State(state) if state in set(State) else None
    as_matrix = dataset.cells <= MOST_CELLS and chosen is None
    page = datasets.cells(name, state=chosen, limit=MOST_CELLS if as_matrix else _CELLS_AT_ONCE, cursor=cursor)
    return render(
        request,
        "dataset.html",
        events="" if dataset.state.is_final else "/events",
        refresh_s=0 if dataset.state.is_final else 5,
        dataset=dataset,
        grid=figures.dataset_grid(dataset, page.items) if as_matrix else None,
        cells=page.items,
        chosen=chosen or "",
        next=page.next,
        snapshots=datasets.snapshots(name, limit=10).items,
    )


@router.post("/{name}/cells", dependencies=SUBMIT)
def act_on_cells(name: str, jobs: JobsOf, datasets: DatasetsOf, fields: Fields) -> RedirectResponse:
    datasets.get(name)
    return change_jobs(jobs, str(fields.get("action", "")), map(str, fields.getlist("cell")), f"/datasets/{name}")


@router.post("/{name}/{action}", dependencies=SUBMIT)
def act(name: str, action: str, datasets: DatasetsOf) -> RedirectResponse:
    do: dict[str, tuple[Callable[[str], Any], str]] = {
        "cancel": (datasets.cancel, "The dataset is cancelled; finished grasps remain."),
        "retry": (datasets.retry, "Failed and cancelled jobs of the dataset run again."),
        "snapshot": (datasets.take_snapshot, "The snapshot is taken; it lists all shards made so far."),
    }
    if action not in do:
        raise InputError(f"a dataset has no action {action!r}; there are: {', '.join(do)}")
    act, said = do[action]
    act(name)
    return redirect(f"/datasets/{name}", said)


def _jobs_of(jobs: Jobs, pairs: Iterable[tuple[str, str]], action: str) -> list[str]:
    states = (State.FAILED, State.CANCELLED) if action == "retry" else (State.QUEUED, State.RUNNING)
    return [
        job.id
        for hand, obj in pairs
        for state in states
        for job in jobs.page(state=state, hand=hand, object=obj, limit=_CELLS_AT_ONCE).items
    ]


def _render_datasets(
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
        events="/events",
        refresh_s=10,
        datasets=page.items,
        next=page.next,
        grid=figures.service_grid(datasets.matrix(), [name for name, _ in hands], [name for name, _ in objects]),
        hands=hands,
        objects=objects,
        fidelities=OFFERED,
        inputs=_INPUTS,
        form=_MAKE | {"hands": [], "objects": []} | (form or {}),
        problem=problem,
    )


_OFFERED: Final = 200

comparison_router = APIRouter(include_in_schema=False)

Named = Annotated[str, Query(max_length=64)]


@comparison_router.get("/compare", dependencies=READ)
def compare_page(request: Request, datasets: DatasetsOf, one: Named = "", other: Named = "") -> HTMLResponse:
    found = datasets.compare(one, other) if one and other else None
    shown = {key: (label, unit) for key, label, unit in COLUMNS}
    return render(
        request,
        "compare.html",
        page="/datasets",
        names=[dataset.name for dataset in datasets.page(limit=_OFFERED).items],
        chosen=(one, other),
        found=found,
        metrics=[(*shown[metric], both) for metric, both in found.metrics.items()] if found else [],
    )
