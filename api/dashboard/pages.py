"""Pages of the service: home, workers, charts, failure maps, usage, deletions, problem types, session."""

from collections import defaultdict
from collections.abc import AsyncIterable
from datetime import UTC, datetime, timedelta
from typing import Annotated, Final

from fastapi import APIRouter, FastAPI, Form, Request
from fastapi.responses import HTMLResponse, RedirectResponse
from fastapi.sse import EventSourceResponse, ServerSentEvent

from graspd.api.access.auth import SESSION_COOKIE, is_allowed
from graspd.api.access.keys import SESSION_S, KeyFile, Scope
from graspd.api.catalog import events
from graspd.api.catalog.events import Webhooks
from graspd.api.dashboard import asset_pages, dataset_pages, figures, forms, grasp_pages, job_list, job_pages, tradeoff
from graspd.api.dashboard.forms import FormEstimates
from graspd.api.dashboard.job_pages import ShardPictures
from graspd.api.dashboard.rendering import SEEN, environment, redirect, render, seen_end
from graspd.api.problems import HTTP_PROBLEMS
from graspd.api.routes import dependencies
from graspd.api.routes.system import Since, Until
from graspd.service.index.views import WorkerView
from graspd.service.model.domain import METHODS
from graspd.service.model.errors import ERRORS, InputError
from graspd.service.model.webhooks import MAX_URL, End
from graspd.service.pipeline.backends import Services
from graspd.service.store.records import What

_JOBS: Final = 8
#: Most ends of jobs and datasets on the page of notifications.
_ENDS: Final = 25
_LOST_SHOWN: Final = timedelta(minutes=10)
_DATASETS: Final = 6
#: Polling interval [s]: a study takes minutes, and no event announces its publication.
_STUDY_S: Final = 10

router = APIRouter(include_in_schema=False)


@router.get("/", dependencies=dependencies.READ)
def home(
    request: Request, overview: dependencies.OverviewOf, jobs: dependencies.JobsOf, datasets: dependencies.DatasetsOf
) -> HTMLResponse:
    return render(
        request,
        "home.html",
        events="/events",
        refresh_s=5,
        stats=overview.stats(),
        minutes=overview.valid_per_minute(),
        jobs=jobs.page(limit=_JOBS),
        stages=overview.waiting(),
        workers=[worker for worker in overview.workers() if is_recent(worker)],
        failures=overview.failures(),
        datasets=sorted(datasets.page(limit=_DATASETS).items, key=lambda dataset: dataset.state.is_final)[:4],
        damage=overview.damage(),
    )


@router.get("/workers", dependencies=dependencies.READ)
def workers_page(request: Request, overview: dependencies.OverviewOf, jobs: dependencies.JobsOf) -> HTMLResponse:
    workers = [worker for worker in overview.workers() if is_recent(worker)]
    tasks = {worker.name: task for worker in workers if (task := overview.task_of(worker)) is not None}
    return render(
        request,
        "workers.html",
        events="/events",
        refresh_s=5,
        workers=workers,
        tasks=tasks,
        jobs={job_id: jobs.get_progress(job_id) for job_id in {task.job_id for task in tasks.values()}},
        busy=sum(worker.state == "busy" for worker in workers),
        alive=sum(worker.state != "lost" for worker in workers),
        stages=overview.waiting(),
        damage=overview.damage(),
    )


@router.get("/chart", dependencies=dependencies.READ)
def chart_page(
    request: Request, store: dependencies.StoreOf, y: str = "gsr", lifts: str = "lift", hand: str = "", object: str = ""
) -> HTMLResponse:
    measured = tradeoff.load_charts(store)
    axis = {False: y if y in tradeoff.FREE else "gsr", True: lifts if lifts in tradeoff.IN_SCENES else "lift"}
    drawn = [tradeoff.draw_chart(one, axis=axis[one.scene is not None], hand=hand, object=object) for one in measured]
    return render(
        request,
        "chart.html",
        page="/engine",
        poll_s=_STUDY_S,
        charts=list(zip(measured, drawn, strict=True)),
        # For each kind of chart: title, name in the URL, accuracies, and the selected accuracy.
        choices=[
            (title, field, axes, axis[in_scene])
            for title, field, axes, in_scene in (
                ("Accuracy", "y", tradeoff.FREE, False),
                ("In scenes", "lifts", tradeoff.IN_SCENES, True),
            )
            if any((one.scene is not None) == in_scene for one in measured)
        ],
        hands=sorted({run.hand for one in measured for run in one.runs}),
        objects=sorted({run.object for one in measured for run in one.runs}),
        hand=hand,
        object=object,
    )


@router.get("/stability", dependencies=dependencies.READ)
def stability_page(request: Request, store: dependencies.StoreOf) -> HTMLResponse:
    measured = figures.load_stability(store)
    maps = measured.maps if measured else ()
    return render(
        request,
        "stability.html",
        page="/engine",
        poll_s=_STUDY_S,
        measured=measured,
        maps=[(one, [figures.draw_panel(one, name) for name in one.panels]) for one in maps],
        pitch=figures.PITCH,
    )


@router.get("/engine", dependencies=dependencies.READ)
def engine_page(request: Request, store: dependencies.StoreOf, overview: dependencies.OverviewOf) -> HTMLResponse:
    workers = [worker for worker in overview.workers() if worker.state != "lost"]
    return render(
        request,
        "engine.html",
        page="/engine",
        methods=METHODS,
        devices=sorted({(one.device_name or one.device, one.version) for one in workers}),
        charts=tradeoff.load_charts(store),
        maps=figures.load_stability(store),
    )


@router.get("/notifications", dependencies=dependencies.READ)
def notifications_page(request: Request, webhooks: dependencies.WebhooksOf) -> HTMLResponse:
    return _render_notifications(request, webhooks)


@router.post("/notifications", dependencies=dependencies.SUBMIT)
def add_webhook(
    request: Request,
    webhooks: dependencies.WebhooksOf,
    url: Annotated[str, Form(max_length=MAX_URL)],
    states: Annotated[list[End] | None, Form()] = None,
) -> HTMLResponse:
    try:
        if not states:
            raise InputError("choose at least one state")
        return _render_notifications(request, webhooks, secret=webhooks.add(url, tuple(states))[1])
    except InputError as error:
        return _render_notifications(request, webhooks, problem=str(error), url=url, status=error.status)


@router.post("/notifications/{webhook_id}/delete", dependencies=dependencies.SUBMIT)
def delete_webhook(webhook_id: str, webhooks: dependencies.WebhooksOf) -> RedirectResponse:
    webhooks.delete(webhook_id)
    return redirect("/notifications", "The webhook is deleted.")


def _render_notifications(request: Request, webhooks: Webhooks, *, status: int = 200, **shown: str) -> HTMLResponse:
    """Show the visitor's ended jobs and datasets, which counts as seen, and the webhooks it may change."""
    ends = webhooks.own_ends(0, limit=_ENDS)
    hooks = webhooks.all() if is_allowed(request, Scope.SUBMIT) else []
    page = render(
        request,
        "notifications.html",
        status=status,
        **{"problem": "", "url": "", "secret": ""} | shown,
        ends=ends,
        seen=seen_end(request),
        hooks=[(hook, webhooks.deliveries(hook.id, limit=1)) for hook in hooks],
        is_on=request.app.state.settings.webhook_secret is not None,
    )
    if ends:
        page.set_cookie(SEEN, str(ends[0][0].seq), max_age=SESSION_S, httponly=True, samesite="strict")
    return page


def is_recent(worker: WorkerView) -> bool:
    """Check whether to show a worker; a lost worker is shown for 10 minutes."""
    age = datetime.now(UTC) - datetime.fromisoformat(worker.seen)
    return worker.state != "lost" or age < _LOST_SHOWN


_SUMMED = ("grasps", "valid", "tasks", "gpu_seconds", "cpu_seconds")


@router.get("/usage", dependencies=dependencies.READ)
def usage_page(request: Request, usage: dependencies.UsageOf, since: Since = None, until: Until = None) -> HTMLResponse:
    days = usage.days(since, until)
    limits = usage.limits()
    today = datetime.now(UTC).date().isoformat()
    totals: dict[str, dict[str, float]] = {name: defaultdict(float) for name in limits}
    for one in days:
        total = totals.setdefault(one.project, defaultdict(float))
        for name in _SUMMED:
            total[name] += getattr(one, name)
            if one.day == today:
                total[f"today_{name}"] += getattr(one, name)
    return render(
        request,
        "usage.html",
        poll_s=30,
        days=days,
        totals=[(name, totals[name], limits.get(name)) for name in sorted(totals)],
        has_projects=bool(limits) or any(one.project for one in days),
        csv="/v1/usage.csv" + (f"?{request.url.query}" if request.url.query else ""),
        since=since or "",
        until=until or "",
    )


#: Number of characters of a job's id that its page shows, and that confirm its deletion.
SHORT_ID = 12
Typed = Annotated[str, Form(max_length=64)]


@router.get("/deleted", dependencies=dependencies.READ)
def deleted_page(request: Request, deletions: dependencies.DeletionsOf, done: str = "") -> HTMLResponse:
    """Show the deletions that can be undone; `done` is the id of the latest deletion."""
    found = deletions.list_restorable()
    return render(request, "deleted.html", found=found, just_now=next((one for one in found if one.id == done), None))


@router.post("/deleted/{what}/{name}/restore", dependencies=dependencies.SUBMIT)
def restore(what: What, name: str, deletions: dependencies.DeletionsOf) -> RedirectResponse:
    found = deletions.restore(what, name)
    pages = {"job": f"/jobs/{found.id}", "dataset": f"/datasets/{found.id}", "hand": f"/hands/{found.name}"}
    where = pages.get(what, "/grasps" if what == "tag" else "/deleted")
    return redirect(where, f"The {what} {found.name} is restored.")


@router.post("/datasets/{name}/delete", dependencies=dependencies.SUBMIT)
def delete_dataset(
    name: str, datasets: dependencies.DatasetsOf, typed: Typed = "", with_snapshots: Annotated[bool, Form()] = False
) -> RedirectResponse:
    _require_confirmation(typed, name)
    datasets.delete(name, with_snapshots=with_snapshots)
    return _redirect_to_deletions(name)


@router.post("/jobs/{job_id}/delete", dependencies=dependencies.SUBMIT)
def delete_job(job_id: str, jobs: dependencies.JobsOf, typed: Typed = "") -> RedirectResponse:
    _require_confirmation(typed, job_id, job_id[:SHORT_ID])
    jobs.delete(job_id)
    return _redirect_to_deletions(job_id)


@router.post("/tags/{name}/delete", dependencies=dependencies.SUBMIT)
def delete_tag(name: str, tags: dependencies.TagsOf, typed: Typed = "") -> RedirectResponse:
    _require_confirmation(typed, name)
    tag = tags.get(name)
    tags.delete(name)
    return _redirect_to_deletions(tag.id)


def _require_confirmation(typed: str, *names: str) -> None:
    if typed.strip() not in names:
        raise InputError(f"nothing was deleted; to confirm the deletion, type {names[-1]}")


def _redirect_to_deletions(id: str) -> RedirectResponse:
    return RedirectResponse(f"/deleted?done={id}", status_code=303)


routers: Final = (
    *(router, job_list.search_router, job_list.router, job_pages.router, grasp_pages.router, asset_pages.router),
    *(dataset_pages.router, dataset_pages.comparison_router, forms.router),
)


def install_dashboard(app: FastAPI, services: Services) -> None:
    app.state.templates = environment()
    app.state.pictures = ShardPictures(services.store)
    app.state.expectations = FormEstimates(services.index)


@router.get("/events", dependencies=dependencies.READ, response_class=EventSourceResponse)
async def watch(request: Request, overview: dependencies.OverviewOf) -> AsyncIterable[ServerSentEvent]:
    async for event in events.service_events(overview, request):
        yield event


@router.get("/docs", dependencies=dependencies.READ)
def explorer(request: Request) -> HTMLResponse:
    return render(request, "explorer.html")


@router.get("/problems")
@router.get("/problems/{slug}")
def problem_types(request: Request, slug: str = "") -> HTMLResponse:
    types = [(name, error.status, (error.__doc__ or "").splitlines()[0]) for name, error in ERRORS.items()]
    types += [(slug, status, meaning) for status, (slug, meaning) in HTTP_PROBLEMS.items()]
    return render(request, "problems.html", types=sorted(types, key=lambda row: (row[1], row[0])))


@router.get("/login")
def login_page(request: Request) -> HTMLResponse:
    key = request.scope["state"].get("key") if SESSION_COOKIE in request.cookies else None
    return render(request, "login.html", problem="", health=None, session=key.name if key else "")


@router.post("/logout")
def logout(request: Request) -> RedirectResponse:
    """End the session of this browser. Other sessions of the key continue; revoking it ends all of them."""
    response = RedirectResponse("/login", status_code=303)
    response.delete_cookie(SESSION_COOKIE, httponly=True, samesite="strict", secure=request.url.scheme == "https")
    return response


@router.post("/login", response_model=None)
def login(request: Request, key: Annotated[str, Form(max_length=200)]) -> HTMLResponse | RedirectResponse:
    keys: KeyFile = request.app.state.keys
    found = keys.find(key.strip())
    if found is None:
        return render(request, "login.html", session="", problem="The key is not valid.", health=None, status=401)
    response = RedirectResponse("/", status_code=303)
    response.set_cookie(
        SESSION_COOKIE,
        keys.open_session(found),
        max_age=SESSION_S,
        httponly=True,
        samesite="strict",
        secure=request.url.scheme == "https",
    )
    return response
