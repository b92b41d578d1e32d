"""Two datasets side by side."""

from __future__ import annotations

from typing import Annotated, Final

from fastapi import APIRouter, Depends, Query, Request
from fastapi.responses import HTMLResponse

from api.dashboard.figures.charts import twins
from api.dashboard.grasp_pages import COLUMNS
from api.dashboard.rendering import render
from api.routes.dependencies import ComparisonsOf, DatasetsOf, may_read

#: Datasets that the fields of the page offer, the newest first.
_OFFERED: Final = 200

router = APIRouter(include_in_schema=False)

Named = Annotated[str, Query(max_length=64)]


@router.get("/compare", dependencies=[Depends(may_read)])
def compare_page(
    request: Request, datasets: DatasetsOf, comparisons: ComparisonsOf, one: Named = "", other: Named = ""
) -> HTMLResponse:
    """What two datasets asked for, what each cell came to, how good their grasps are; the address can be shared."""
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
