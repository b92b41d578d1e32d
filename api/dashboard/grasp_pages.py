"""Pages of grasps: filtered list, one grasp in 3D, and forms to tag, untag and export grasps."""

import re
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Final, TypeVar
from urllib.parse import parse_qsl, urlencode

from fastapi import APIRouter, Request
from fastapi.responses import HTMLResponse, RedirectResponse, StreamingResponse
from pydantic import TypeAdapter, ValidationError
from starlette.datastructures import FormData

from graspd.api.catalog.assets import Assets
from graspd.api.catalog.tags import Format, Tags
from graspd.api.dashboard.forms import fields_of, first_message
from graspd.api.dashboard.rendering import render
from graspd.api.models import GraspName, GraspQuery, Selection
from graspd.api.routes.dependencies import READ, SUBMIT, AssetsOf, ExportsOf, GraspsOf, ShardsOf, TagsOf, next_address
from graspd.api.routes.grasps import export_response
from graspd.service.index.views import GraspView, TagView
from graspd.service.model.base import TagName
from graspd.service.model.errors import InputError
from graspd.service.model.metrics import AXIS_MEANINGS, GRASP_METRICS, GraspType, IndexLevel, indexed_metrics
from graspd.service.model.states import AssetKind

PAGE_SIZES: Final = {"cards": 24, "table": 50}
COLUMNS: Final = tuple((one.name, one.column_title, one.unit) for one in indexed_metrics(IndexLevel.OFFERED))
#: Metrics for which less is better: the first click sorts in ascending order.
_LESS_IS_BETTER: Final = frozenset(metric.name for metric in indexed_metrics() if metric.less_is_better)
_BESIDE_VERDICT: Final = frozenset({"contact_links", "robustness", "robust_share", "grasp_type", "approach_cell"})

#: Description of each axis along which models differ from the nominal one.
_WEAKEST: Final = {axis.word: words for axis, words in AXIS_MEANINGS.items()}

router = APIRouter(include_in_schema=False)


@router.get("/grasps", dependencies=READ, response_model=None)
def grasps_page(
    request: Request, grasps: GraspsOf, shards: ShardsOf, assets: AssetsOf, tags: TagsOf
) -> HTMLResponse | RedirectResponse:
    """List grasps with filters, order and pages, all of which are in the URL, without empty fields."""
    given = {key: value for key, value in request.query_params.items() if value}
    # Forms send every field; the visible URL should be short.
    if len(given) < len(request.query_params):
        return RedirectResponse(f"/grasps?{urlencode(given)}" if given else "/grasps", status_code=303)
    said = action_summary(given)
    cursor, view = given.pop("cursor", None), given.pop("view", "cards")
    view = view if view in PAGE_SIZES else "cards"
    problem, page, query = "", None, GraspQuery()
    try:
        query = GraspQuery.model_validate(given)
        page = grasps.page(query, limit=PAGE_SIZES[view], cursor=cursor)
    except (ValueError, InputError) as error:
        problem = first_message(error)
    rows = page.items if page else []
    known, is_filtered = tags.all(), bool(given.keys() - {"sort", "order"})
    return render(
        request,
        "grasps.html",
        status=422 if problem else 200,
        page="/grasps",
        filters={name: given.get(name, "") for name in GraspQuery.model_fields},
        filtered=is_filtered,
        problem=problem,
        did=said,
        **tag_choices(tags, rows, known, given),
        all_said="all that match the filters" if is_filtered else "all grasps",
        here="/grasps",
        shown_tag=next((tag for tag in known if tag.name == query.tag), None),
        tag_choices=[(tag.name, tag.name) for tag in known],
        hands=_asset_names(assets, AssetKind.HAND),
        objects=_asset_names(assets, AssetKind.OBJECT),
        rows=rows,
        models=shards.assets_of({grasp.shard_id for grasp in rows}) if view == "cards" else {},
        columns=COLUMNS,
        weakest=list(_WEAKEST.items()),
        limits={metric.name: metric.limits for metric in indexed_metrics(IndexLevel.OFFERED)},
        sort=query.sort,
        sorts=[("" if key == GraspQuery().sort else key, label) for key, label, _ in COLUMNS],
        descending=query.order == "desc",
        links={key: _sort_link(request, query, key) for key, _, _ in COLUMNS},
        show_pair=True,
        view=view,
        views=[(name, _view_link(request, name)) for name in PAGE_SIZES],
        next=next_address(request, page.next) if page and page.next else None,
        limit=PAGE_SIZES[view],
    )


@router.get("/grasps/{shard_id}/{row}", dependencies=READ)
def grasp_page(
    request: Request, shard_id: str, row: int, grasps: GraspsOf, shards: ShardsOf, tags: TagsOf
) -> HTMLResponse:
    grasp, shard = grasps.get(shard_id, row), shards.get(shard_id)
    return render(
        request,
        "grasp.html",
        page="/grasps",
        grasp=grasp,
        did=action_summary(dict(request.query_params)),
        tags=[tag.name for tag in tags.all()],
        tagged=tags.names_by_grasp([(shard_id, row)]),
        stops=[point.name for point in grasp.way if point.name],
        shard=shard,
        job=shards.job_of(shard_id),
        metrics=[
            (metric.title, getattr(grasp, metric.name), metric.unit)
            for metric in indexed_metrics()
            if metric.name not in _BESIDE_VERDICT
        ],
        type=GraspType(int(grasp.grasp_type or 0)),
        weakest=_WEAKEST.get(grasp.robust_weakest or ""),
        swept=[metric for metric in GRASP_METRICS if metric.name in grasp.sweep],
    )


def tag_choices(
    tags: Tags, rows: Sequence[GraspView], known: Sequence[TagView], where: Mapping[str, str]
) -> dict[str, Any]:
    tagged = tags.names_by_grasp([(grasp.shard_id, grasp.row) for grasp in rows])
    return {"tagged": tagged, "tags": known, "filter": urlencode(where)}


def _asset_names(assets: Assets, kind: AssetKind) -> list[tuple[str, str]]:
    return [(name, name) for name in sorted({asset.name for asset in assets.page(kind, limit=200).items})]


def _sort_link(request: Request, query: GraspQuery, key: str) -> str:
    order = "asc" if key in _LESS_IS_BETTER else "desc"
    if query.sort == key:
        order = "asc" if query.order == "desc" else "desc"
    url = request.url.remove_query_params("cursor").include_query_params(sort=key, order=order)
    return f"{url.path}?{url.query}"


def _view_link(request: Request, view: str) -> str:
    url: Any = request.url.remove_query_params(["cursor", "view"])
    if view != "cards":
        url = url.include_query_params(view=view)
    return f"{url.path}?{url.query}" if url.query else str(url.path)


Fields = Annotated[FormData, fields_of(400)]
_LONGEST_FILTER: Final = 40_000
_PAGES: Final = re.compile(r"/grasps(/[0-9a-f]{32}/[0-9]{1,10})?|/jobs/[0-9a-f]{32}")
_NAME: Final[TypeAdapter[str]] = TypeAdapter(TagName)
_FORMAT: Final[TypeAdapter[Format]] = TypeAdapter(Format)
_DONE: Final = {"tagged": "{done} {grasps} tagged {tag}.", "untagged": "Tag {tag} removed from {done} {grasps}."}
T = TypeVar("T")


@router.post("/grasps/tag", dependencies=SUBMIT)
def tag(tags: TagsOf, fields: Fields) -> RedirectResponse:
    return _change_tag(tags, fields, on=True)


@router.post("/grasps/untag", dependencies=SUBMIT)
def untag(tags: TagsOf, fields: Fields) -> RedirectResponse:
    return _change_tag(tags, fields, on=False)


@router.post("/grasps/export", dependencies=READ)
async def export(request: Request, tags: TagsOf, exports: ExportsOf, fields: Fields) -> StreamingResponse:
    wanted = _validate(_FORMAT, fields.get("format") or "zip", "format")
    return await export_response(request, tags, exports, _selection(fields), wanted)


def action_summary(given: dict[str, str]) -> str:
    """Describe the result of the last action; remove the action's parameters from `given`."""
    what, done, name = (given.pop(key, "") for key in ("did", "done", "named"))
    if what not in _DONE or not (done.isascii() and done.isdigit()) or len(done) > 9:
        return ""
    try:
        _NAME.validate_python(name)
    except ValidationError:
        return ""
    return _DONE[what].format(done=f"{int(done):,}", grasps="grasp" if int(done) == 1 else "grasps", tag=name)


def _change_tag(tags: Tags, fields: FormData, *, on: bool) -> RedirectResponse:
    name = _validate(_NAME, fields.get("tag"), "tag")
    selection = _selection(fields)
    change = tags.tag_grasps(name, selection) if on else tags.untag_grasps(name, selection)
    said = {"did": "tagged" if on else "untagged", "done": change.changed, "named": name}
    here = str(fields.get("here", ""))
    if _PAGES.fullmatch(here) and here != "/grasps":
        return RedirectResponse(f"{here}?{urlencode(said)}", status_code=303)
    view = {"view": "table"} if fields.get("view") == "table" else {}
    return RedirectResponse(f"/grasps?{urlencode(dict(_filter_fields(fields)) | view | said)}", status_code=303)


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
