"""The page of what projects used, day by day."""

from __future__ import annotations

from collections import defaultdict
from datetime import UTC, datetime

from fastapi import APIRouter, Depends, Request
from fastapi.responses import HTMLResponse

from api.dashboard.rendering import render
from api.routes.dependencies import UsageOf, may_read
from api.routes.usage import Since, Until

router = APIRouter(include_in_schema=False)
_SUMMED = ("grasps", "valid", "tasks", "gpu_seconds", "cpu_seconds")


@router.get("/usage", dependencies=[Depends(may_read)])
def usage_page(
    request: Request,
    usage: UsageOf,
    since: Since = None,
    until: Until = None,
) -> HTMLResponse:
    """Use of each project: in sum, against its quotas, and day by day."""
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
    given = request.url.query
    return render(
        request,
        "usage.html",
        page="/usage",
        poll_s=30,
        days=days,
        totals=[(name, totals[name], limits.get(name)) for name in sorted(totals)],
        has_projects=bool(limits) or any(one.project for one in days),
        csv="/v1/usage.csv" + (f"?{given}" if given else ""),
        since=since or "",
        until=until or "",
    )
