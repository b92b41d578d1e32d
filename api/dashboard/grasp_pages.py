"""Pages of grasps: filtered list, one grasp in 3D, and forms to tag, untag and export grasps."""

import re
from collections.abc import Mapping, Sequence
from functools import partial
from typing import Annotated, Any, Final, TypeVar
from urllib.parse import parse_qsl, quote, urlencode

import numpy as np
from fastapi import APIRouter, Query, Request
from fastapi.responses import HTMLResponse, RedirectResponse, StreamingResponse
from numpy.typing import NDArray
from pydantic import TypeAdapter, ValidationError
from starlette.datastructures import FormData

from graspd.api.catalog.facets import Facets
from graspd.api.catalog.tags import Format, Tags
from graspd.api.dashboard.forms import fields_of, first_message
from graspd.api.dashboard.rendering import redirect, render
from graspd.api.formatting import metric as format_metric
from graspd.api.models import GraspName, GraspQuery, Selection
from graspd.api.routes.dependencies import READ, SUBMIT, ExportsOf, GraspsOf, ShardsOf, TagsOf, next_address
from graspd.api.routes.grasps import export_response
from graspd.service.index.views import GraspView, TagView
from graspd.service.model.base import TagName
from graspd.service.model.errors import InputError
from graspd.service.model.metrics import AXIS_MEANINGS, GRASP_METRICS, GraspType, IndexLevel, indexed_metrics

PAGE_SIZES: Final = {"cards": 24, "table": 50, "map": 200}
#: Largest number of grasps side by side, and length of shard ids in their addresses.
MOST_COMPARED: Final = 4
SHORT: Final = 12
SIMILAR: Final = 6
COLUMNS: Final = tuple((one.name, one.column_title, one.unit) for one in indexed_metrics(IndexLevel.OFFERED))
#: Metrics for which less is better: the first click sorts in ascending order.
_LESS_IS_BETTER: Final = frozenset(metric.name for metric in indexed_metrics() if metric.less_is_better)
_BESIDE_VERDICT: Final = frozenset({"contact_links", "robustness", "robust_share"})

#: Description of each axis along which models differ from the nominal one.
_WEAKEST: Final = {axis.word: words for axis, words in AXIS_MEANINGS.items()}

router = APIRouter(include_in_schema=False)
Fields = Annotated[FormData, fields_of(400)]


@router.get("/grasps", dependencies=READ, response_model=None)
def grasps_page(request: Request, grasps: GraspsOf, shards: ShardsOf, tags: TagsOf) -> HTMLResponse | RedirectResponse:
    """List grasps with facets, order and pages, all of which are in the URL, without empty fields."""
    given = {key: value for key, value in request.query_params.items() if value}
    # Forms send every field; the visible URL should be short.
    if len(given) < len(request.query_params):
        return RedirectResponse(_address(given), status_code=303)
    cursor, view = given.pop("cursor", None), given.pop("view", "cards")
    view = view if view in PAGE_SIZES else "cards"
    problem, page, facets, query = "", None, None, GraspQuery()
    rows: list[GraspView] = []
    dots: list[tuple[GraspView, list[int]]] = []
    try:
        query = GraspQuery.model_validate(given)
        facets = grasps.facets(query)
        if view == "map":
            rows, places = grasps.map(query)
            dots = list(zip(rows, _dots(places), strict=True))
        else:
            page = grasps.page(query, limit=PAGE_SIZES[view], cursor=cursor)
            rows = page.items
    except (ValueError, InputError) as error:
        problem = first_message(error)
    known, chips = tags.all(), _chips(query, facets, given)
    shown = given | ({"view": view} if view != "cards" else {})
    return render(
        request,
        "grasps.html",
        status=422 if problem else 200,
        query=query,
        given=shown,
        facets=facets,
        chips=chips,
        address=partial(_address, shown),
        problem=problem,
        **tag_choices(tags, rows, known, given),
        all_said="all that match the filters" if chips else "all grasps",
        here="/grasps",
        shown_tag=next((tag for tag in known if tag.name == query.tag), None),
        rows=rows,
        dots=dots,
        models=shards.assets_of({grasp.shard_id for grasp in rows}) if view == "cards" else {},
        columns=COLUMNS,
        sort=query.sort,
        sorts=[("" if key == GraspQuery().sort else key, label) for key, label, _ in COLUMNS],
        descending=query.order == "desc",
        links={key: _address(shown, sort=key, order=_next_order(query, key)) for key, _, _ in COLUMNS},
        show_pair=True,
        view=view,
        views=[(name, _address(given, view=None if name == "cards" else name)) for name in PAGE_SIZES],
        next=next_address(request, page.next) if page and page.next else None,
        limit=PAGE_SIZES[view],
    )


def _chips(query: GraspQuery, facets: Facets | None, given: Mapping[str, str]) -> list[tuple[str, dict[str, None]]]:
    """Return each chosen filter in words, and the fields without which it is removed."""
    found: list[tuple[str, dict[str, None]]] = []
    for facet in facets.values if facets else ():
        values = [value for value in facet.values if value.chosen]
        found += [(f"{facet.title}: {one.words.partition(':')[0]}", dict.fromkeys(one.change)) for one in values]
    for metric in indexed_metrics(IndexLevel.OFFERED):
        low, high = (getattr(query, f"{end}_{metric.name}") for end in ("min", "max"))
        text = " to ".join(format_metric(bound) for bound in (low, high) if bound is not None)
        words = "" if low is not None and high is not None else "≥ " if low is not None else "≤ "
        if text:
            fields = dict.fromkeys(f"{end}_{metric.name}" for end in ("min", "max"))
            found.append((f"{metric.column_title} {words}{text} {metric.unit}".strip(), fields))
    seen = {field for _, fields in found for field in fields}
    left = given.keys() - seen - {"sort", "order"}
    return found + [(f"{name}: {given[name][:24]}", {name: None}) for name in GraspQuery.model_fields if name in left]


def _dots(places: NDArray[np.float64]) -> list[list[int]]:
    """Return positions (N, 2) of a map in a drawing of 960 x 560."""
    low, high = (places.min(axis=0), places.max(axis=0)) if len(places) else (0.0, 1.0)
    return np.rint(16 + (places - low) / (high - low + 1e-9) * (928, 528)).astype(int).tolist()


def _address(given: Mapping[str, str], changes: Mapping[str, str | None] | None = None, **more: str | None) -> str:
    """Return the address of the list with changed fields; None removes a field."""
    fields = {key: value for key, value in {**given, **(changes or {}), **more}.items() if value}
    return f"/grasps?{urlencode(fields)}" if fields else "/grasps"


def _next_order(query: GraspQuery, key: str) -> str:
    if query.sort == key:
        return "asc" if query.order == "desc" else "desc"
    return "asc" if key in _LESS_IS_BETTER else "desc"


@router.post("/grasps/compare", dependencies=READ)
def compare(fields: Fields) -> RedirectResponse:
    """Show the selected grasps side by side at a short address."""
    chosen = [str(one).partition(":") for one in fields.getlist("grasp")]
    if not 1 < len(chosen) <= MOST_COMPARED:
        raise InputError(f"select 2 to {MOST_COMPARED} grasps to compare; {len(chosen)} are selected")
    names = ",".join(f"{shard[:SHORT]}.{row}" for shard, _, row in chosen)
    return RedirectResponse(f"/grasps/compare?g={quote(names, safe=',')}", status_code=303)


@router.get("/grasps/compare", dependencies=READ)
def compare_page(request: Request, grasps: GraspsOf, g: Annotated[str, Query(max_length=200)]) -> HTMLResponse:
    """Show up to four grasps side by side, with their metrics."""
    return render(
        request,
        "grasp_compare.html",
        grasps=[grasps.get_short(name) for name in g.split(",")[:MOST_COMPARED]],
        metrics=indexed_metrics(),
    )


@router.get("/grasps/{shard_id}/{row}", dependencies=READ)
def grasp_page(
    request: Request, shard_id: str, row: int, grasps: GraspsOf, shards: ShardsOf, tags: TagsOf
) -> HTMLResponse:
    grasp, shard = grasps.get(shard_id, row), shards.get(shard_id)
    return render(
        request,
        "grasp.html",
        grasp=grasp,
        tags=[tag.name for tag in tags.all()],
        tagged=tags.names_by_grasp([(shard_id, row)]),
        similar=(similar := grasps.similar(grasp, SIMILAR)),
        models=shards.assets_of({one.shard_id for one in similar}),
        shard=shard,
        job=shards.job_of(shard_id),
        metrics=[
            (metric.title, getattr(grasp, metric.name), metric.unit)
            for metric in indexed_metrics()
            if not metric.code and metric.name not in _BESIDE_VERDICT
        ],
        type=GraspType(int(grasp.grasp_type or 0)),
        weakest=_WEAKEST.get(grasp.robust_weakest or ""),
        episodes=grasps.episodes(shard_id, row),
        swept=[metric for metric in GRASP_METRICS if metric.name in grasp.sweep],
    )


def tag_choices(
    tags: Tags, rows: Sequence[GraspView], known: Sequence[TagView], where: Mapping[str, str]
) -> dict[str, Any]:
    tagged = tags.names_by_grasp([(grasp.shard_id, grasp.row) for grasp in rows])
    return {"tagged": tagged, "tags": known, "filter": urlencode(where)}


_LONGEST_FILTER: Final = 40_000
_PAGES: Final = re.compile(r"/grasps(/[0-9a-f]{32}/[0-9]{1,10})?|/jobs/[0-9a-f]{32}")
_NAME: Final[TypeAdapter[str]] = TypeAdapter(TagName)
_FORMAT: Final[TypeAdapter[Format]] = TypeAdapter(Format)
T = TypeVar("T")


@router.post("/grasps/tag", dependencies=SUBMIT)
@router.post("/grasps/untag", dependencies=SUBMIT)
def change_tag(request: Request, tags: TagsOf, fields: Fields) -> RedirectResponse:
    name, on = _validate(_NAME, fields.get("tag"), "tag"), request.url.path.endswith("/tag")
    selection = _selection(fields)
    change = tags.tag_grasps(name, selection) if on else tags.untag_grasps(name, selection)
    grasps = f"{change.changed:,} {'grasp' if change.changed == 1 else 'grasps'}"
    said = f"{grasps} tagged {name}." if on else f"Tag {name} removed from {grasps}."
    here = str(fields.get("here", ""))
    if _PAGES.fullmatch(here) and here != "/grasps":
        return redirect(here, said)
    view = {"view": str(fields["view"])} if fields.get("view") in ("table", "map") else {}
    return redirect(_address(dict(_filter_fields(fields)) | view), said)


@router.post("/grasps/export", dependencies=READ)
async def export(request: Request, tags: TagsOf, exports: ExportsOf, fields: Fields) -> StreamingResponse:
    wanted = _validate(_FORMAT, fields.get("format") or "zip", "format")
    return await export_response(request, tags, exports, _selection(fields), wanted)


def _selection(fields: FormData) -> Selection:
    try:
        if fields.get("all"):
            return Selection(filter=GraspQuery.model_validate(dict(_filter_fields(fields))))
        places = [str(one).partition(":") for one in fields.getlist("grasp")]
        if not places:
            raise InputError("no grasp is selected; select some, or all that match the filters")
        grasps = [{"shard_id": shard, "row": row} for shard, _, row in places]
        return Selection(grasps=TypeAdapter(list[GraspName]).validate_python(grasps))
    except ValidationError as error:
        raise InputError(first_message(error)) from None


def _filter_fields(fields: FormData) -> list[tuple[str, str]]:
    text = str(fields.get("filter", ""))
    try:
        # A truncated filter would select more grasps than the list shows.
        if len(text) > _LONGEST_FILTER:
            raise ValueError
        return parse_qsl(text, max_num_fields=100)
    except ValueError:
        raise InputError("the filter of the list cannot be read") from None


def _validate(what: TypeAdapter[T], value: object, name: str) -> T:
    try:
        return what.validate_python(value)
    except ValidationError as error:
        raise InputError(f"{name}: {first_message(error)}") from None
