"""What is done with chosen grasps: tagged, no longer tagged, taken home. Forms that work without JavaScript."""

from __future__ import annotations

import re
from typing import Final, TypeVar
from urllib.parse import parse_qsl, urlencode

from fastapi import APIRouter, Depends, Request
from fastapi.responses import RedirectResponse, StreamingResponse
from pydantic import TypeAdapter, ValidationError
from starlette.concurrency import run_in_threadpool
from starlette.datastructures import FormData

from api.catalog.grasp_exports import Format
from api.catalog.tags import Tags
from api.dashboard.forms import first_message
from api.models import GraspName, GraspQuery, Selection
from api.routes.dependencies import ExportsOf, TagsOf, may_read, may_submit
from api.routes.grasps import exported
from service.model.base import TagName
from service.model.errors import InputError

_MAX_FIELDS: Final = 400
#: Longest query of a list that a form gives back.
_LONGEST_FILTER: Final = 40_000
_PAGES: Final = re.compile(r"/grasps(/[0-9a-f]{32}/[0-9]{1,10})?|/jobs/[0-9a-f]{32}")
_NAME: Final[TypeAdapter[str]] = TypeAdapter(TagName)
_FORMAT: Final[TypeAdapter[Format]] = TypeAdapter(Format)
_DONE: Final = {
    "tagged": "{done} {grasps} given the tag {tag}.",
    "untagged": "The tag {tag} taken off {done} {grasps}.",
}

T = TypeVar("T")

router = APIRouter(include_in_schema=False)


@router.post("/grasps/tag", dependencies=[Depends(may_submit)])
async def tag(request: Request, tags: TagsOf) -> RedirectResponse:
    """Give a tag to the chosen grasps and show the list again."""
    async with request.form(max_fields=_MAX_FIELDS) as fields:
        return await run_in_threadpool(_tag, tags, fields, on=True)


@router.post("/grasps/untag", dependencies=[Depends(may_submit)])
async def untag(request: Request, tags: TagsOf) -> RedirectResponse:
    """Take a tag off the chosen grasps and show the list again."""
    async with request.form(max_fields=_MAX_FIELDS) as fields:
        return await run_in_threadpool(_tag, tags, fields, on=False)


@router.post("/grasps/export", dependencies=[Depends(may_read)])
async def export(request: Request, tags: TagsOf, exports: ExportsOf) -> StreamingResponse:
    """The chosen grasps as a file."""
    async with request.form(max_fields=_MAX_FIELDS) as fields:
        wanted = _checked(_FORMAT, fields.get("format") or "zip", "format")
        return await exported(request, tags, exports, _selection(fields), wanted)


def did(given: dict[str, str]) -> str:
    """What the last action did, in words; takes its parameters out of those of the address."""
    what, done, name = (given.pop(key, "") for key in ("did", "done", "named"))
    if what not in _DONE or not (done.isascii() and done.isdigit()) or len(done) > 9:
        return ""
    try:
        _NAME.validate_python(name)
    except ValidationError:
        return ""
    return _DONE[what].format(done=f"{int(done):,}", grasps="grasp" if int(done) == 1 else "grasps", tag=name)


def _tag(tags: Tags, fields: FormData, *, on: bool) -> RedirectResponse:
    name = _checked(_NAME, fields.get("tag"), "tag")
    selection = _selection(fields)
    change = tags.give(name, selection) if on else tags.take_off(name, selection)
    said = {"did": "tagged" if on else "untagged", "done": change.changed, "named": name}
    here = str(fields.get("here", ""))
    here = here if _PAGES.fullmatch(here) else "/grasps"
    kept = dict(_filter(fields)) if here == "/grasps" else {}
    if here == "/grasps" and fields.get("view") == "table":
        kept["view"] = "table"
    return RedirectResponse(f"{here}?{urlencode(kept | said)}", status_code=303)


def _selection(fields: FormData) -> Selection:
    """The grasps whose boxes are ticked, or all of the list.

    Raises:
        InputError: there are none, or they cannot be read.
    """
    try:
        if fields.get("all"):
            return Selection(filter=GraspQuery.model_validate(dict(_filter(fields))))
        places = [str(one).partition(":") for one in fields.getlist("grasp")]
        if not places:
            raise InputError("no grasp is chosen; tick some, or all that pass the filter")
        grasps = [{"shard_id": shard, "row": row} for shard, _, row in places]
        return Selection(grasps=TypeAdapter(list[GraspName]).validate_python(grasps))
    except ValidationError as error:
        raise InputError(first_message(error)) from None


def _filter(fields: FormData) -> list[tuple[str, str]]:
    text = str(fields.get("filter", ""))
    try:
        # One that is cut off would choose more than the list shows.
        if len(text) > _LONGEST_FILTER:
            raise ValueError
        return parse_qsl(text, max_num_fields=100)
    except ValueError:
        raise InputError("the filter of the list cannot be read") from None


def _checked(what: TypeAdapter[T], value: object, name: str) -> T:
    try:
        return what.validate_python(value)
    except ValidationError as error:
        raise InputError(f"{name}: {first_message(error)}") from None
