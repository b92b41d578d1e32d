"""The pages of grasps: the list with its filters, and one grasp in 3D."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final
from urllib.parse import urlencode

from fastapi import APIRouter, Depends, Request
from fastapi.responses import HTMLResponse, RedirectResponse

from api.catalog.assets import Assets
from api.catalog.tags import Tags
from api.dashboard import snippets
from api.dashboard.choice_forms import did
from api.dashboard.forms import first_message
from api.dashboard.rendering import base_url, render
from api.models import GraspDetail, GraspQuery
from api.routes.dependencies import AssetsOf, GraspsOf, ShardsOf, TagsOf, may_read
from api.routes.paging import next_address
from service.index.views import GraspView, TagView
from service.model.diversity import GraspType
from service.model.errors import InputError
from service.model.metrics import GRASP_METRICS, Indexed, indexed
from service.model.robust import MEANINGS
from service.model.states import AssetKind

PAGE_SIZES: Final = {"cards": 24, "table": 50}
#: Sort key, label, unit of the metrics that lists of grasps show.
COLUMNS: Final = tuple((metric.name, metric.column_title, metric.unit) for metric in indexed(Indexed.OFFERED))
#: Metrics of which less is better: a first click sorts them upwards.
_LESS_IS_BETTER: Final = frozenset(metric.name for metric in indexed() if metric.less_is_better)
#: Metrics that stand beside the verdict of a grasp.
_BESIDE_VERDICT: Final = frozenset({"contact_links", "robustness", "robust_share", "grasp_type", "approach_cell"})
#: What differs along the axes of models around the nominal one.
_WEAKEST: Final = {axis.word: words for axis, words in MEANINGS.items()}

router = APIRouter(include_in_schema=False)


@router.get("/grasps", dependencies=[Depends(may_read)], response_model=None)
def grasps_page(
    request: Request, grasps: GraspsOf, shards: ShardsOf, assets: AssetsOf, tags: TagsOf
) -> HTMLResponse | RedirectResponse:
    """Every grasp of the index: filters, order, pages. The address holds all of it, and no empty field."""
    given = {key: value for key, value in request.query_params.items() if value}
    if len(given) < len(request.query_params):
        # Forms send every field; what is shown in the browser and shared should be short.
        return RedirectResponse(f"/grasps?{urlencode(given)}" if given else "/grasps", status_code=303)
    said = did(given)
    cursor, view = given.pop("cursor", None), given.pop("view", "cards")
    view = view if view in PAGE_SIZES else "cards"
    problem, page, query = "", None, GraspQuery()
    try:
        query = GraspQuery.model_validate(given)
        page = grasps.page(query, limit=PAGE_SIZES[view], cursor=cursor)
    except ValueError as error:
        problem = first_message(error)
    except InputError as error:
        problem = str(error)
    rows = page.items if page else []
    known = tags.all()
    return render(
        request,
        "grasps.html",
        status=422 if problem else 200,
        page="/grasps",
        filters={name: given.get(name, "") for name in GraspQuery.model_fields},
        filtered=bool(set(given) - {"sort", "order"}),
        problem=problem,
        did=said,
        **choice_of(tags, rows, known, given),
        all_said="all that pass this filter" if set(given) - {"sort", "order"} else "all grasps there are",
        here="/grasps",
        shown_tag=next((tag for tag in known if tag.name == query.tag), None),
        tag_choices=[(tag.name, tag.name) for tag in known],
        hands=_names(assets, AssetKind.HAND),
        objects=_names(assets, AssetKind.OBJECT),
        rows=rows,
        models=shards.assets_of({grasp.shard_id for grasp in rows}) if view == "cards" else {},
        columns=COLUMNS,
        weakest=list(_WEAKEST.items()),
        limits={metric.name: metric.limits for metric in indexed(Indexed.OFFERED)},
        sort=query.sort,
        # The default is no part of an address.
        sorts=[("" if key == GraspQuery().sort else key, label) for key, label, _ in COLUMNS],
        descending=query.order == "desc",
        links={key: _sort_link(request, query, key) for key, _, _ in COLUMNS},
        show_pair=True,
        view=view,
        views=[(name, _view_link(request, name)) for name in PAGE_SIZES],
        next=next_address(request, page.next) if page and page.next else None,
        limit=PAGE_SIZES[view],
    )


@router.get("/grasps/{shard_id}/{row}", dependencies=[Depends(may_read)])
def grasp_page(
    request: Request, shard_id: str, row: int, grasps: GraspsOf, shards: ShardsOf, tags: TagsOf
) -> HTMLResponse:
    """One grasp: 3D, verdict, quality, tags, and where it is kept."""
    grasp, shard = grasps.one(shard_id, row), shards.one(shard_id)
    return render(
        request,
        "grasp.html",
        page="/grasps",
        grasp=grasp,
        did=did(dict(request.query_params)),
        tags=[tag.name for tag in tags.all()],
        tagged=tags.of([(shard_id, row)]),
        stops=[point.name for point in grasp.way if point.name],
        shard=shard,
        job=shards.job_of(shard_id),
        metrics=_metrics(grasp),
        type=GraspType(int(grasp.grasp_type or 0)),
        weakest=_WEAKEST.get(grasp.robust_weakest or ""),
        swept=[metric for metric in GRASP_METRICS if metric.name in grasp.sweep],
        loader=snippets.grasp_loader(grasp, base_url(request)),
    )


def choice_of(
    tags: Tags, rows: Sequence[GraspView], known: Sequence[TagView], where: Mapping[str, str]
) -> dict[str, Any]:
    """What a form that chooses grasps of a list shows: their tags, all tags, and the query of the list."""
    return {
        "tagged": tags.of([(grasp.shard_id, grasp.row) for grasp in rows]),
        "tags": known,
        "filter": urlencode(where),
    }


def _metrics(grasp: GraspDetail) -> list[tuple[str, float | None, str]]:
    return [
        (metric.title, getattr(grasp, metric.name), metric.unit)
        for metric in indexed()
        if metric.name not in _BESIDE_VERDICT
    ]


def _names(assets: Assets, kind: AssetKind) -> list[tuple[str, str]]:
    names = sorted({asset.name for asset in assets.page(kind, limit=200).items})
    return [(name, name) for name in names]


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
