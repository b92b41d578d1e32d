"""The page of one job: stages, loss, quality, views, best grasps, attempts, files; and the pictures it shows."""

from __future__ import annotations

from typing import Annotated, Any, Final

from fastapi import APIRouter, Depends, Query, Request, Response
from fastapi.responses import HTMLResponse

from api.dashboard import snippets
from api.dashboard.choice_forms import did
from api.dashboard.figures import charts
from api.dashboard.grasp_pages import COLUMNS, choice_of
from api.dashboard.pictures import Channel
from api.dashboard.rendering import base_url, render
from api.models import GraspQuery, JobDetail, LossCurve
from api.routes.dependencies import GraspsOf, JobsOf, ShardsOf, TagsOf, may_read

_SHOWN_PICTURES: Final = 8
_SHOWN_GRASPS: Final = 10

router = APIRouter(include_in_schema=False)


@router.get("/jobs/{job_id}", dependencies=[Depends(may_read)])
def job_page(request: Request, job_id: str, jobs: JobsOf, grasps: GraspsOf, tags: TagsOf) -> HTMLResponse:
    """All of one job."""
    job = jobs.one(job_id)
    pictures = _pictures(job)
    shown = {key: (label, unit) for key, label, unit in COLUMNS}
    judged = job.request.referee != "none"
    query = GraspQuery(job=job_id, valid=True if judged else None)
    rows = grasps.page(query, limit=_SHOWN_GRASPS).items if (job.valid if judged else job.grasps) else []
    where = {"job": job_id} | ({"valid": "true"} if judged else {})
    return render(
        request,
        "job.html",
        events="" if job.state.is_final else f"/v1/jobs/{job.id}/events",
        refresh_s=0 if job.state.is_final else 3,
        job=job,
        histograms=[
            (*shown[data.metric], data, charts.bars(data, "/grasps", where)) for data in grasps.histograms(job)
        ],
        loss=_loss(jobs.loss_curve(job)),
        pictures=pictures[:_SHOWN_PICTURES],
        picture_count=len(pictures),
        rows=rows,
        did=did(dict(request.query_params)),
        **choice_of(tags, rows, tags.all(), where),
        all_said=f"all {'valid ' if judged else ''}grasps of this job",
        here=f"/jobs/{job_id}",
        view="",
        models=dict.fromkeys((grasp.shard_id for grasp in rows), (job.hand_digest, job.object_digest)),
        columns=COLUMNS,
        sort="epsilon",
        shards=job.shards,
        loader=snippets.loader(job, base_url(request)),
        curl=snippets.curl(job, base_url(request)),
    )


@router.get("/shards/{shard_id}/pictures/{index}.png", dependencies=[Depends(may_read)])
def picture(
    request: Request,
    shard_id: str,
    index: int,
    shards: ShardsOf,
    channel: Channel = "rgb",
    width: Annotated[int | None, Query(ge=16, le=4096)] = None,
) -> Response:
    """One rendered view as a PNG: colour, depth or segmentation, whole or no wider than `width` pixels."""
    shard = shards.one(shard_id)
    data = request.app.state.pictures.png(shard.key, shard.sha256, index, channel, width)
    return Response(data, media_type="image/png", headers={"Cache-Control": "private, max-age=86400, immutable"})


def _loss(curve: LossCurve | None) -> charts.Plot | None:
    if curve is None:
        return None
    return charts.line(curve.iterations, curve.losses, x="iteration", y="Loss", log=True)


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
