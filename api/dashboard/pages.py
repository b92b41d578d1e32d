"""The pages: server-rendered, complete without JavaScript."""

from __future__ import annotations

from collections.abc import AsyncIterable
from datetime import UTC, datetime, timedelta
from typing import Annotated, Any, Final

from fastapi import APIRouter, Depends, FastAPI, Query, Request, Response
from fastapi.responses import HTMLResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent

from api import events
from api.dashboard import forms, session, snippets
from api.dashboard.pictures import Pictures
from api.dashboard.rendering import environment, render
from api.dependencies import CatalogOf, may_read
from api.models import STAGE_LABELS, GraspQuery, JobDetail
from api.paging import next_address
from api.problems import ERRORS
from service.domain import AssetKind, State
from service.errors import UnavailableError
from service.index.views import WorkerView

PAGE_SIZE: Final = 50
_SHOWN_PICTURES: Final = 12
_LOST_SHOWN: Final = timedelta(minutes=10)
#: Sort key, label, unit of the columns of a table of grasps.
COLUMNS: Final = (
    ("epsilon", "ε", ""),
    ("contact_area_cm2", "Contact area", "cm²"),
    ("intersection_volume_cm3", "Intersection", "cm³"),
    ("penetration_depth_mm", "Penetration", "mm"),
)
#: Metrics of which less is better: a first click sorts them upwards.
_LESS_IS_BETTER: Final = frozenset({"intersection_volume_cm3", "penetration_depth_mm"})

router = APIRouter(include_in_schema=False)


def install(app: FastAPI) -> None:
    """Add the pages to the application."""
    app.state.templates = environment()
    app.state.pictures = Pictures(app.state.catalog.store)
    app.include_router(router)
    app.include_router(forms.router)
    app.include_router(session.router)


@router.get("/", dependencies=[Depends(may_read)])
def home(
    request: Request,
    catalog: CatalogOf,
    state: str = "",
    cursor: Annotated[str | None, Query(max_length=512)] = None,
) -> HTMLResponse:
    """Health, throughput, jobs, queue, workers, failures."""
    chosen = State(state) if state in set(State) else None
    stats = catalog.stats()
    return render(
        request,
        "home.html",
        page="/",
        events="/events",
        refresh_s=5,
        chosen=chosen or "",
        stats=stats,
        minutes=catalog.valid_per_minute(),
        jobs=catalog.jobs(state=chosen, limit=PAGE_SIZE, cursor=cursor),
        stages=_stage_depths(catalog),
        workers=[worker for worker in catalog.workers() if _is_recent(worker)],
        failures=catalog.failures(limit=5),
    )


@router.get("/jobs/{job_id}", dependencies=[Depends(may_read)])
def job_page(request: Request, job_id: str, catalog: CatalogOf) -> HTMLResponse:
    """Stages, quality, views, best grasps, attempts, files of one job."""
    job = catalog.job(job_id)
    pictures = _pictures(job)
    shown = {key: (label, unit) for key, label, unit in COLUMNS}
    return render(
        request,
        "job.html",
        events="" if job.state.is_final else f"/v1/jobs/{job.id}/events",
        refresh_s=0 if job.state.is_final else 3,
        job=job,
        histograms=[(*shown[data.metric], data) for data in catalog.histograms(job_id, job.valid)] if job.valid else [],
        pictures=pictures[:_SHOWN_PICTURES],
        picture_count=len(pictures),
        rows=catalog.grasps(GraspQuery(job=job_id, valid=True), limit=10).items if job.valid else [],
        columns=COLUMNS,
        sort="epsilon",
        descending=True,
        links=None,
        show_pair=False,
        shards=job.shards,
        loader=snippets.loader(job, str(request.base_url)),
        curl=snippets.curl(job, str(request.base_url)),
    )


@router.get("/grasps", dependencies=[Depends(may_read)])
def grasps_page(request: Request, catalog: CatalogOf) -> HTMLResponse:
    """Every grasp of the index: filters, order, pages. The address holds all of it."""
    given = {key: value for key, value in request.query_params.items() if value}
    cursor = given.pop("cursor", None)
    filters_given = {key: value for key, value in given.items() if key not in ("sort", "order")}
    problem, page = "", None
    query = GraspQuery()
    try:
        query = GraspQuery.model_validate(given)
        page = catalog.grasps(query, limit=PAGE_SIZE, cursor=cursor)
    except ValueError as error:
        problem = forms.first_message(error)
    return render(
        request,
        "grasps.html",
        status=422 if problem else 200,
        page="/grasps",
        filters={name: given.get(name, "") for name in GraspQuery.model_fields},
        filtered=bool(filters_given),
        problem=problem,
        hands=[asset.name for asset in catalog.assets(AssetKind.HAND, limit=200).items],
        objects=[asset.name for asset in catalog.assets(AssetKind.OBJECT, limit=200).items],
        rows=page.items if page else [],
        columns=COLUMNS,
        sort=query.sort,
        order=query.order,
        descending=query.order == "desc",
        links={key: _sort_link(request, query, key) for key, _, _ in COLUMNS},
        show_pair=True,
        next=next_address(request, page.next) if page and page.next else None,
        limit=PAGE_SIZE,
    )


@router.get("/shards/{shard_id}/pictures/{index}.png", dependencies=[Depends(may_read)])
def picture(request: Request, shard_id: str, index: int, catalog: CatalogOf) -> Response:
    """One rendered view as a PNG."""
    data = request.app.state.pictures.png(catalog.shard(shard_id).key, index)
    return Response(data, media_type="image/png", headers={"Cache-Control": "private, max-age=86400, immutable"})


@router.get("/events", dependencies=[Depends(may_read)], response_class=EventSourceResponse)
async def watch(request: Request, catalog: CatalogOf) -> AsyncIterable[ServerSentEvent]:
    """Says that something on the home page has changed."""
    async for event in events.service_events(catalog, request):
        yield event


@router.get("/problems")
@router.get("/problems/{slug}")
def problem_types(request: Request, slug: str = "") -> HTMLResponse:
    """What the types of problem documents mean."""
    types = [(name, error.status, (error.__doc__ or "").splitlines()[0]) for name, error in ERRORS.items()]
    types += [(name, status, text) for name, (status, text) in _HTTP_PROBLEMS.items()]
    return render(request, "problems.html", types=sorted(types, key=lambda row: (row[1], row[0])))


_HTTP_PROBLEMS: Final = {
    "bad-request": (400, "The body or the form cannot be read at all."),
    "unauthorized": (401, "A live key is needed."),
    "forbidden": (403, "The key's scope is too small, or the request comes from a foreign web page."),
    "method-not-allowed": (405, "This address does not take this method."),
    "range-not-satisfiable": (416, "The range of bytes lies behind the end of the file."),
    "misdirected-request": (421, "The service does not answer to this host name while it is open."),
}


def _is_recent(worker: WorkerView) -> bool:
    """A worker that is lost stays on the page for a while, so that somebody sees it."""
    age = datetime.now(UTC) - datetime.fromisoformat(worker.seen)
    return worker.state != "lost" or age < _LOST_SHOWN


def _sort_link(request: Request, query: GraspQuery, key: str) -> str:
    order = "asc" if key in _LESS_IS_BETTER else "desc"
    if query.sort == key:
        order = "asc" if query.order == "desc" else "desc"
    url = request.url.remove_query_params("cursor").include_query_params(sort=key, order=order)
    return f"{url.path}?{url.query}"


def _pictures(job: JobDetail) -> list[dict[str, Any]]:
    """Every rendered picture; of a stereo pair the left one comes first."""
    eyes = ("left", "right") if job.request.stereo else ("",)
    return [
        {
            "address": f"/shards/{shard.id}/pictures/{index}.png",
            "label": f"View {index // len(eyes) + 1} {eyes[index % len(eyes)]}".strip(),
            "shard": shard.id,
        }
        for shard in job.shards
        if shard.kind == "views"
        for index in range(shard.count)
    ]


def _stage_depths(catalog: CatalogOf) -> list[tuple[str, int]]:
    """Waiting tasks by stage; empty where Redis does not answer, which the page says elsewhere."""
    try:
        depths = catalog.depths()
    except UnavailableError:
        return []
    totals = dict.fromkeys(STAGE_LABELS, 0)
    for (_, stage), waiting in depths.items():
        totals[stage] += waiting
    return [(STAGE_LABELS[stage], waiting) for stage, waiting in totals.items()]
