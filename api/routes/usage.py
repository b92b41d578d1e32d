"""`/v1/usage`: what projects used, day by day."""

from __future__ import annotations

import re
from datetime import date
from typing import Annotated

from fastapi import APIRouter, Depends, Query, Response
from pydantic import BeforeValidator

from api.catalog.usage import as_csv
from api.problems import responses
from api.routes.dependencies import UsageOf, may_read
from service.index.views import UsageDay

router = APIRouter(tags=["usage"])


def _day(said: object) -> object:
    """A number would be read as seconds since 1970, and of a time its day would be taken."""
    if isinstance(said, str) and not re.fullmatch(r"[0-9]{4}-[0-9]{2}-[0-9]{2}", said):
        raise ValueError("a day is written as 2026-01-31")
    return said


Day = Annotated[date, BeforeValidator(_day)]
Since = Annotated[Day | None, Query(description="first day (UTC); default: a month before the last")]
Until = Annotated[Day | None, Query(description="last day (UTC); default: today")]


@router.get("/v1/usage", dependencies=[Depends(may_read)], responses=responses(400, 401, 403, 422, 503))
def get_usage(usage: UsageOf, since: Since = None, until: Until = None) -> list[UsageDay]:
    """Grasps and seconds of each project on each day, the newest first: of the key's project, with `admin` of all."""
    return usage.days(since, until)


@router.get(
    "/v1/usage.csv",
    dependencies=[Depends(may_read)],
    response_class=Response,
    responses=responses(
        400,
        401,
        403,
        422,
        503,
        others={200: {"content": {"text/csv": {}}, "description": "One line a day and project"}},
    ),
)
def get_usage_csv(usage: UsageOf, since: Since = None, until: Until = None) -> Response:
    """The same as a table."""
    headers = {"Content-Disposition": 'attachment; filename="usage.csv"'}
    return Response(as_csv(usage.days(since, until)), media_type="text/csv", headers=headers)
