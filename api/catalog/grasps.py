"""Grasps: search by metrics, distributions of a job, and details of one grasp from its base shard."""

import math
import re
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from functools import lru_cache
from itertools import zip_longest
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

from graspd.api import models
from graspd.api.access.auth import project_scope
from graspd.api.catalog.facets import COLUMNS, PINCH, SAMPLE, Columns, Facets, columns_of, count_facets
from graspd.api.catalog.grasp_map import features, nearest, principal_components
from graspd.service import user_cache
from graspd.service.index.queries.grasps import GraspFilter, GraspSort, Metric
from graspd.service.index.queries.statistics import Distribution, GraspKinds
from graspd.service.index.views import GraspView, JobView, Page
from graspd.service.model import metrics
from graspd.service.model.errors import DamagedError, InputError, LimitError, NotFoundError, UnavailableError
from graspd.service.model.records import MOST_TAGGED, Grasp
from graspd.service.model.scene_spec import scene_supports
from graspd.service.model.version import PACKAGE_VERSION
from graspd.service.pipeline.backends import Services
from graspd.service.readers.trajectories import planned_scene_of, slider_positions, trajectory_of
from graspd.service.store.columns import EXECUTED, LIFT_OUTCOMES, PUSH_OUTCOMES
from graspd.service.store.integrity import read_checked
from graspd.service.store.shards import Shard, read_shard

_KEPT_STATISTICS: Final = 256
#: Number of cached samples for facets, of about 1 MB each, and the time after which they are read again [s].
_KEPT_SAMPLES: Final = 16
_SAMPLE_S: Final = 20.0
#: Largest numbers of grasps on a map, and of their shards: reading one takes milliseconds.
_MAPPED: Final = 200
_MAP_SHARDS: Final = 24
#: Short name of a grasp in addresses.
SHORT_NAME: Final = re.compile(r"[0-9a-f]{8,32}\.[0-9]{1,9}")
#: Number of cached base shards. A shard of 32 grasps takes about 60 kB; a page needs at most one shard per row.
_KEPT_SHARDS: Final = 64
#: Time limit of a replay [s], which takes about 2 s of CPU time, and the limit of kept replays [bytes].
_REPLAY_S: Final = 60.0
_REPLAYS_BYTES: Final = 64 << 20
_SHARED: Final = GraspFilter.model_fields.keys() & models.GraspQuery.model_fields.keys()
MEAN_METRICS: Final[tuple[Metric, ...]] = tuple(
    metric.name for metric in metrics.indexed_metrics(metrics.IndexLevel.OFFERED)
)


class Grasps:
    """Grasps of the jobs in the caller's scope; they never change."""

    def __init__(self, services: Services) -> None:
        self._index = services.index
        self._store = services.store
        self._shard = lru_cache(maxsize=_KEPT_SHARDS)(self._read_shard)
        self._sample = lru_cache(maxsize=_KEPT_SAMPLES)(self._read_sample)
        self._statistics = lru_cache(maxsize=_KEPT_STATISTICS)(self._read_statistics)

    def page(self, query: models.GraspQuery, *, limit: int = 50, cursor: str | None = None) -> Page[GraspView]:
        sort = GraspSort(by=query.sort, descending=query.order == "desc")
        return self._index.grasps.page(self._filter(query), sort=sort, limit=limit, cursor=cursor)

    def matching_grasps(self, query: models.GraspQuery) -> list[Grasp]:
        """Return identifiers of all grasps that pass every filter; raise LimitError beyond MOST_TAGGED."""
        found = self._index.grasps.matching_grasps(self._filter(query), limit=MOST_TAGGED + 1)
        if len(found) > MOST_TAGGED:
            raise LimitError(f"more than {MOST_TAGGED} grasps pass this filter, the maximum of a selection; narrow it")
        return found

    def facets(self, query: models.GraspQuery) -> Facets:
        """Return counts of facets and distributions of metrics under the filters of a list."""
        plain = models.GraspQuery(job=query.job, dataset=query.dataset, tag=query.tag, where=query.where)
        now = time.monotonic() // _SAMPLE_S
        pairs = self._sample(self._filter(plain).model_dump_json(), now)
        shown = pairs
        if pairs[1] < 1 and (query.hand or query.object):
            of_pair = plain.model_copy(update={"hand": query.hand, "object": query.object})
            shown = self._sample(self._filter(of_pair).model_dump_json(), now)
        return count_facets(query, *shown, pairs)

    def _read_sample(self, where: str, now: float) -> tuple[Columns, float]:
        """Read a sample for facets; `where` is a filter as JSON, and `now` limits the time in the cache."""
        rows, share = self._index.statistics.sample(GraspFilter.model_validate_json(where), COLUMNS, SAMPLE)
        return columns_of(rows), share

    def similar(self, grasp: GraspView, count: int) -> list[GraspView]:
        """Return grasps of the same hand and object with the most similar pose and contacts."""
        found = self.page(models.GraspQuery(hand=grasp.hand, object=grasp.object), limit=_MAPPED).items
        known = [grasp, *(one for one in found if (one.shard_id, one.row) != (grasp.shard_id, grasp.row))]
        kept, shards = self._with_shards(known)
        return [kept[row] for row in nearest(features(kept, shards), 0, count)]

    def map(self, query: models.GraspQuery) -> tuple[list[GraspView], NDArray[np.float64]]:
        """Return the first grasps of a list, and their positions (N, 2) on a map of poses and contacts."""
        kept, shards = self._with_shards(self.page(query, limit=_MAPPED).items)
        return kept, principal_components(features(kept, shards)) if kept else np.zeros((0, 2))

    def _with_shards(self, found: Sequence[GraspView]) -> tuple[list[GraspView], list[Shard]]:
        """Return the grasps of the first one's shard and of the most frequent shards, and the shard of each."""
        common = Counter(one.shard_id for one in found).most_common(_MAP_SHARDS)
        shards = {}
        for name in {one.shard_id for one in found[:1]} | {*dict(common)}:
            # Grasps of a damaged file have no place on the map.
            with suppress(NotFoundError, DamagedError):
                shard = self._index.shards.get(name)
                shards[name] = self._shard(shard.key, shard.sha256)
        kept = [one for one in found if one.shard_id in shards]
        return kept, [shards[one.shard_id] for one in kept]

    def get_short(self, name: str) -> models.GraspDetail:
        """Return the grasp of a short name: first digits of the shard id, a dot, and the row."""
        shard, _, row = name.partition(".")
        if not SHORT_NAME.fullmatch(name):
            raise NotFoundError(f"{name[:40]!r} names no grasp; names are like 1a2b3c4d5e6f.7")
        return self.get(self._index.grasps.shard_of(shard), int(row))

    def get_many(self, places: Sequence[Grasp]) -> Iterator[GraspView]:
        """Yield grasps by identifier, without deleted ones; the caller must have access to all of them."""
        return self._index.grasps.get_many(places)

    def _filter(self, query: models.GraspQuery) -> GraspFilter:
        seen = project_scope()
        if query.dataset is not None:
            self._index.datasets.get(query.dataset, scope=seen)
        found = query.model_dump(include=_SHARED) | {
            "project": None if seen.everything else seen.project,
            "tag": query.tag and self._index.tags.id_of(query.tag, scope=seen),
            "digits": PINCH if query.type == "pinch" else (),
            "at_least": _metric_bounds(query, "min"),
            "at_most": _metric_bounds(query, "max"),
        }
        return GraspFilter(**found)

    def get(self, shard_id: str, row: int) -> models.GraspDetail:
        grasp, shard = self._index.grasps.get(shard_id, row, scope=project_scope()), self._index.shards.get(shard_id)
        file = self._shard(shard.key, shard.sha256)
        names = file.attributes.get("joint_names")
        return models.GraspDetail(
            **grasp.model_dump(),
            hand_digest=shard.hand_digest,
            object_digest=shard.object_digest,
            joint_names=names if isinstance(names, list) else [],
            postures={name: _read_posture(file, name, row) for name in _POSTURES},
            thresholds_m=_finite_list(file["quality/thresholds_m"]),
            sweep={
                metric.name: _finite_list(file[metric.path][row])
                for metric in metrics.GRASP_METRICS
                if metric.swept and metric.path in file.arrays
            },
            way=_read_waypoints(file, row),
            scene=_read_scene(file, row),
            pushes=_read_pushes(file, row),
            verdict_margin=_optional_float(file, "quality/verdict_margin", row),
            validated_by=validated_by(file, row),
            recheck=_optional_flag(file, "quality/recheck", row),
            friction=_finite_or_none(file.attributes.get("mu")),
        )

    def episodes(self, shard_id: str, row: int) -> list[models.GraspEpisode]:
        """Return the episodes of a grasp, newest first."""
        self._index.grasps.get(shard_id, row, scope=project_scope())
        found = []
        for shard in self._index.shards.episodes_of(shard_id, scope=project_scope()):
            request, outcomes = (shard.manifest.get(name, {}) for name in ("request", "episodes"))
            if outcome := outcomes.get(str(row)):
                cameras = request.get("film", ()) if outcome in EXECUTED else ()
                films = {camera: f"/v1/shards/{shard.id}/films/{row}/{camera}" for camera in cameras}
                robot = request["episodes"]
                found.append(models.GraspEpisode(shard_id=shard.id, robot=robot, outcome=outcome, films=films))
        return found

    def _read_shard(self, key: str, sha256: str) -> Shard:
        data = read_checked(self._store, key, sha256)
        try:
            return read_shard(data, kind="base", name=key)
        except InputError as error:
            raise NotFoundError(f"{key} holds no grasps that can be shown: {error}") from None

    def replay(self, shard_id: str, row: int) -> bytes:
        """Return the JSON of a `GraspReplay`, simulated by a child process or kept from an earlier call.
        Raises UnavailableError: this machine lacks the engine, or the simulation failed or took too long."""
        self._index.grasps.get(shard_id, row, scope=project_scope())
        kept = user_cache.cache_folder("replays") / f"{shard_id}-{row}-{PACKAGE_VERSION}.json"
        if (known := user_cache.load(kept)) is not None:
            return known
        command = [sys.executable, "-m", "graspd.worker.stages.replay", self._store.url, shard_id, str(row)]
        try:
            found = subprocess.run(
                command, stdin=subprocess.DEVNULL, capture_output=True, timeout=_REPLAY_S, check=True
            )
        except subprocess.CalledProcessError as error:
            why = error.stderr.decode(errors="replace").strip().splitlines()[-1:] or [str(error)]
            raise UnavailableError(f"the API's machine cannot simulate this grasp: {why[0][:300]}") from None
        except subprocess.TimeoutExpired:
            raise UnavailableError(f"the simulation takes longer than {_REPLAY_S:.0f} s; try again later") from None
        user_cache.store(kept, found.stdout, limit_bytes=_REPLAYS_BYTES)
        return found.stdout

    def statistics(self, job: JobView | models.JobDetail) -> tuple[dict[Metric, Distribution], models.Diversity | None]:
        """Return distributions and diversity of a job's valid grasps; without validation, of all stored ones."""
        validated = job.request.validation != "none"
        count = job.valid if validated else job.grasps
        return self._statistics(job.id, validated, count) if count else ({}, None)

    def _read_statistics(
        self, job_id: str, validated: bool, count: int
    ) -> tuple[dict[Metric, Distribution], models.Diversity | None]:
        """Read the statistics of a job; `count` is only part of the cache key."""
        where, known = GraspFilter(job=job_id, valid=True if validated else None), self._index.statistics
        found = known.compare_distributions([where], MEAN_METRICS)
        return {name: one for name, (one,) in found.items() if one}, _diversity(known.kinds(where))


def _diversity(kinds: GraspKinds) -> models.Diversity | None:
    if not kinds.cells:
        return None
    return models.Diversity(
        grasps=sum(kinds.cells.values()),
        types={kind.name.lower(): kinds.types[kind] for kind in metrics.GraspType if kinds.types.get(kind)},
        type_entropy_bits=round(metrics.entropy_bits(kinds.types.values()), 4),
        directions_used=len(kinds.cells),
        direction_entropy_bits=round(metrics.entropy_bits(kinds.cells.values()), 4),
        evenness=round(metrics.evenness(kinds.cells.values(), metrics.DIRECTION_CELLS), 4),
    )


def _metric_bounds(query: models.GraspQuery, end: Literal["min", "max"]) -> dict[Metric, float]:
    values = {metric: getattr(query, f"{end}_{metric}", None) for metric in MEAN_METRICS}
    found = {metric: value for metric, value in values.items() if value is not None}
    if query.type is None:
        return found
    kind = metrics.GraspType.PRECISION if query.type == "pinch" else metrics.GraspType[query.type.upper()]
    return {"grasp_type": float(kind)} | found


_POSTURES: Final = ("pregrasp", "grasp", "squeeze")
_OUTCOME: Final = "quality/verdict_outcome"
_LIFT: Final = "quality/lift_outcome"
_DIRECTIONS: Final = ("+x", "−x", "+y", "−y", "+z", "−z")


def _read_posture(file: Shard, name: str, row: int) -> models.Posture:
    pose, joints = file[f"{name}/hand_pose"][row], file[f"{name}/joint_positions"][row]
    return models.Posture(hand_pose=pose.tolist(), joint_positions=joints.tolist())


def validated_by(file: Shard, row: int) -> Literal["mujoco", "mujoco_warp"] | None:
    """Return the validator of a grasp in a base shard; None if the shard has no verdicts."""
    if "quality/success" not in file.arrays:
        return None
    validated = file.arrays.get("quality/validated_by")
    return "mujoco_warp" if validated is not None and validated[row] == 1 else "mujoco"


def _read_pushes(file: Shard, row: int) -> list[models.Push]:
    outcomes = file.arrays.get(_OUTCOME)
    if outcomes is None or _optional_flag(file, "quality/success", row) is None:
        return []
    return [
        models.Push(direction=direction, outcome=PUSH_OUTCOMES.get(code, "unknown"))
        for direction, code in zip(_DIRECTIONS, outcomes[row].tolist(), strict=False)
    ]


def _optional_flag(file: Shard, path: str, row: int) -> bool | None:
    column = file.arrays.get(path)
    return None if column is None or column[row] < 0 else bool(column[row])


def _optional_float(file: Shard, path: str, row: int) -> float | None:
    column = file.arrays.get(path)
    return None if column is None else _finite_or_none(column[row])


def _finite_list(values: Any) -> list[Any]:
    return [_finite_or_none(value) for value in values.tolist()]


def _finite_or_none(value: Any) -> float | None:
    return None if value is None or not math.isfinite(float(value)) else float(value)


def _read_waypoints(file: Shard, row: int) -> list[models.Waypoint]:
    points = trajectory_of(file, row)
    return [
        models.Waypoint(
            name=point.name,
            place=place,
            hand_pose=point.hand_pose.tolist(),
            joint_positions=point.joint_positions.tolist(),
            carried=point.carried.tolist(),
        )
        for point, place in zip(points, slider_positions(points).tolist(), strict=True)
    ]


def _read_scene(file: Shard, row: int) -> models.GraspScene | None:
    """Return the scene of a grasp; None if it was planned around a free object."""
    if (spec := planned_scene_of(file)) is None:
        return None
    number = int(file["grasp/scene_index"][row])
    tried = int(file[_LIFT][row]) if _LIFT in file.arrays else 0
    return models.GraspScene(
        kind=spec.kind,
        number=number,
        object_pose=file["scene/object_pose"][number].tolist(),
        supports=list(scene_supports(spec)),
        neighbours=_read_neighbours(file, number),
        clearance_m=_optional_float(file, "quality/clearance_m", row),
        lift=LIFT_OUTCOMES.get(tried, "unknown") if tried else None,
        lift_hard=_optional_flag(file, "quality/lift_hard", row),
    )


def _read_neighbours(file: Shard, number: int) -> list[models.Neighbour]:
    if "scene/neighbour_pose" not in file.arrays:
        return []
    names, digests = (file.attributes.get(key) for key in ("neighbours", "neighbour_digests"))
    poses = file["scene/neighbour_pose"][number].tolist()
    known = zip_longest(names if isinstance(names, list) else [], digests if isinstance(digests, list) else [])
    pairs = zip(known, poses, strict=False)
    return [models.Neighbour(name=str(name), digest=str(digest), pose=pose) for (name, digest), pose in pairs]
