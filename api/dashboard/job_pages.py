"""Pages of a job and of a task; pictures as PNG or thumbnail."""

import io
from collections.abc import Callable
from functools import lru_cache, partial
from typing import Annotated, Any, Final, Literal

import numpy as np
from fastapi import APIRouter, Query, Request, Response
from fastapi.responses import HTMLResponse
from numpy.typing import NDArray
from PIL import Image

from graspd.api.dashboard.grasp_pages import COLUMNS, tag_choices
from graspd.api.dashboard.rendering import render
from graspd.api.models import GraspQuery, JobDetail
from graspd.api.routes.dependencies import READ, GraspsOf, JobsOf, ShardsOf, TagsOf
from graspd.service.model.errors import NotFoundError
from graspd.service.model.planning import OUTCOMES, phase_seconds
from graspd.service.settings import Settings
from graspd.service.store.columns import EXECUTED
from graspd.service.store.integrity import read_checked
from graspd.service.store.shards import open_shard
from graspd.service.store.store import Store

_SHOWN_PICTURES: Final = 8
_SHOWN_GRASPS: Final = 10

router = APIRouter(include_in_schema=False)


@router.get("/jobs/{job_id}", dependencies=READ)
def job_page(request: Request, job_id: str, jobs: JobsOf, grasps: GraspsOf, tags: TagsOf) -> HTMLResponse:
    job = jobs.get(job_id)
    eyes = ("left", "right") if job.request.stereo else ("",)
    pictures = [
        {
            "address": f"/shards/{shard.id}/pictures/{index}.png",
            "label": f"View {index // len(eyes) + 1} {eyes[index % len(eyes)]}".strip(),
            "shard": shard.id,
        }
        for shard in job.shards
        if shard.kind == "views"
        for index in range(shard.count)
    ]
    shown = {key: (label, unit) for key, label, unit in COLUMNS}
    validated = job.request.validation != "none"
    query = GraspQuery(job=job_id, valid=True if validated else None)
    rows = grasps.page(query, limit=_SHOWN_GRASPS).items if (job.valid if validated else job.grasps) else []
    where = {"job": job_id} | ({"valid": "true"} if validated else {})
    return render(
        request,
        "job.html",
        events="" if job.state.is_final else f"/v1/jobs/{job.id}/events",
        refresh_s=0 if job.state.is_final else 3,
        job=job,
        tasks=jobs.tasks(job_id),
        rejected={OUTCOMES.get(name, name): number for name, number in job.outcomes.items()},
        executed=sum(job.episodes.get(outcome, 0) for outcome in EXECUTED),
        reused=sum(stage.reused for stage in job.stages),
        task_count=sum(stage.tasks for stage in job.stages),
        expected=jobs.estimate(job),
        cost=_cost_of(request.app.state.settings, job),
        histograms=[(*shown[name], name, data) for name, data in grasps.statistics(job)[0].items()],
        where=where,
        pictures=pictures[:_SHOWN_PICTURES],
        picture_count=len(pictures),
        rows=rows,
        **tag_choices(tags, rows, tags.all(), where),
        all_said=f"all {'valid ' if validated else ''}grasps of this job",
        here=f"/jobs/{job_id}",
        view="",
        models=dict.fromkeys((grasp.shard_id for grasp in rows), (job.hand_digest, job.object_digest)),
        columns=COLUMNS,
        sort="epsilon",
        shards=job.shards,
    )


@router.get("/jobs/{job_id}/tasks/{task_id}", dependencies=READ)
def task_page(request: Request, job_id: str, task_id: str, jobs: JobsOf) -> HTMLResponse:
    """Show a task with the log of its worker, its phases and its failed attempts."""
    job, (task, info, attempts) = jobs.get_progress(job_id), jobs.task(job_id, task_id)
    ended = task.state.is_final
    return render(
        request,
        "task.html",
        events="" if ended else f"/v1/jobs/{job.id}/events",
        refresh_s=0 if ended else 3,
        job=job,
        task=task,
        log=info.get("log", ""),
        phases=phase_seconds(info),
        attempts=attempts,
    )


def _cost_of(settings: Settings, job: JobDetail) -> dict[str, float]:
    """Return the times of a job's finished tasks on CPU and GPU workers [s], and their price."""
    gpu = sum(seconds for device, seconds in job.seconds_by_device.items() if device.startswith("cuda"))
    cpu = sum(job.seconds_by_device.values()) - gpu
    price = (cpu * settings.cpu_price_per_h + gpu * settings.gpu_price_per_h) / 3600
    return {"cpu": cpu, "gpu": gpu, "all": cpu + gpu, "price": price}


Channel = Literal["rgb", "depth", "segmentation", "rgb_hand"]


@router.get("/shards/{shard_id}/pictures/{index}.png", dependencies=READ)
def picture(
    request: Request,
    shard_id: str,
    index: int,
    shards: ShardsOf,
    channel: Channel = "rgb",
    width: Annotated[int | None, Query(ge=16, le=4096)] = None,
) -> Response:
    shard = shards.get(shard_id)
    data = request.app.state.pictures.png(shard.key, shard.sha256, index, channel, width)
    return Response(data, media_type="image/png", headers={"Cache-Control": "private, max-age=86400, immutable"})


#: Number of cached shards, of a few megabytes each; a page requests several pictures of a shard.
_KEPT_SHARDS: Final = 2
#: Colours of depth, from near (light, warm) to far (dark, cool); the lightness falls monotonically.
_DEPTH_COLOURS: Final = np.array(
    [(252, 244, 190), (250, 203, 116), (240, 148, 87), (205, 92, 103), (142, 58, 121), (78, 38, 108), (24, 18, 56)],
    np.float64,
)
_NOTHING: Final = (12, 15, 20)
_CLASSES: Final = np.array(
    [(24, 29, 33), (96, 108, 118), (23, 163, 152), (227, 171, 98), (88, 134, 214), (190, 98, 160), (150, 178, 82)],
    np.uint8,
)


class ShardPictures:
    """Decoder of pictures of views shards, with a cache of recent shards."""

    def __init__(self, store: Store) -> None:
        self._fetch = lru_cache(maxsize=_KEPT_SHARDS)(partial(read_checked, store))

    def png(self, key: str, sha256: str, index: int, channel: Channel, width: int | None) -> bytes:
        """Return the picture at row `index` of a channel as PNG, at most `width` pixels wide."""
        with open_shard(self._fetch(key, sha256), name=key) as file:
            path = f"image/{channel}"
            if path not in file:
                raise NotFoundError("the shard has no pictures of this channel; only views shards have pictures")
            pictures = file[path]
            if not 0 <= index < len(pictures):
                raise NotFoundError(f"the shard has {len(pictures)} pictures; there is no picture {index}")
            pixels = _PAINTERS.get(channel, np.asarray)(pictures[index])
        image = Image.fromarray(pixels)
        if width is not None and width < image.width:
            kind = Image.Resampling.NEAREST if channel == "segmentation" else Image.Resampling.LANCZOS
            image = image.resize((width, max(1, round(image.height * width / image.width))), kind)
        buffer = io.BytesIO()
        image.save(buffer, "PNG", compress_level=3)
        return buffer.getvalue()


def paint_depth(depth: NDArray[Any]) -> NDArray[np.uint8]:
    """Colour depth (H, W) [m] as (H, W, 3) over the picture's range; pixels without a surface are dark."""
    seen = np.isfinite(depth)
    painted = np.full((*depth.shape, 3), _NOTHING, np.uint8)
    if seen.any():
        low, high = np.percentile(depth[seen], (1, 99))
        place = np.clip((depth[seen] - low) / max(high - low, 1e-6), 0, 1) * (len(_DEPTH_COLOURS) - 1)
        steps = np.arange(len(_DEPTH_COLOURS))
        painted[seen] = np.transpose([np.interp(place, steps, channel) for channel in _DEPTH_COLOURS.T])
    return painted


#: Functions that colour channels without colours.
_PAINTERS: Final[dict[str, Callable[..., NDArray[Any]]]] = {
    "depth": paint_depth,
    # Neighbours beyond the palette share its last colour.
    "segmentation": lambda labels: _CLASSES[np.minimum(labels, len(_CLASSES) - 1)],
}
