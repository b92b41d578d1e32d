"""Grasps: search by metrics, distributions of a job, and details of one grasp from its base shard.

Details: postures, metrics at every threshold, the validator's verdict for each push, the scene, and the trajectory
(approach, grasp, lift).
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from functools import lru_cache
from itertools import zip_longest
from typing import Any, Final, Literal

from graspd.api.access.auth import project_scope
from graspd.api.models import (
    Diversity,
    GraspDetail,
    GraspQuery,
    GraspScene,
    Histogram,
    JobDetail,
    Neighbour,
    Posture,
    Push,
    Waypoint,
)
from graspd.service.index.queries.grasps import GraspFilter, GraspSort, Metric
from graspd.service.index.queries.statistics import GraspKinds
from graspd.service.index.views import GraspView, JobView, Page, ShardView
from graspd.service.model.errors import InputError, LimitError, NotFoundError
from graspd.service.model.metrics import (
    DIRECTION_CELLS,
    GRASP_METRICS,
    GraspType,
    IndexLevel,
    entropy_bits,
    evenness,
    indexed,
)
from graspd.service.model.records import MOST_TAGGED, Grasp
from graspd.service.model.scene_spec import supports_in
from graspd.service.pipeline.backends import Services
from graspd.service.readers.trajectories import scene_spec_of, stop_places, way_of
from graspd.service.store.columns import SCHEMAS
from graspd.service.store.integrity import read_checked
from graspd.service.store.shards import Shard, read_shard
from graspd.service.store.store import Store

_KEPT_HISTOGRAMS: Final = 256
MEAN_METRICS: Final[tuple[Metric, ...]] = tuple(metric.name for metric in indexed(IndexLevel.OFFERED))


class Grasps:
    """Grasps of the jobs in the caller's scope; they never change."""

    def __init__(self, services: Services) -> None:
        self._index = services.index
        self._files = GraspFiles(services.store)
        self._histograms: dict[tuple[str, int], list[Histogram]] = {}
        self._diversities: dict[tuple[str, int], Diversity | None] = {}

    def page(self, query: GraspQuery, *, limit: int = 50, cursor: str | None = None) -> Page[GraspView]:
        """Return the grasps that pass every filter."""
        sort = GraspSort(by=query.sort, descending=query.order == "desc")
        return self._index.grasps.page(self._filter(query), sort=sort, limit=limit, cursor=cursor)

    def members(self, query: GraspQuery) -> list[Grasp]:
        """Return identifiers of all grasps that pass every filter.

        Raises:
            LimitError: there are more than one selection may hold.
        """
        found = self._index.grasps.members(self._filter(query), limit=MOST_TAGGED + 1)
        if len(found) > MOST_TAGGED:
            raise LimitError(f"more than {MOST_TAGGED} grasps pass this filter, which is the most at once; narrow it")
        return found

    def listed(self, places: Sequence[Grasp]) -> Iterator[GraspView]:
        """Yield grasps by identifier, which must be visible to the caller; deleted ones are omitted."""
        return self._index.grasps.listed(places)

    def _filter(self, query: GraspQuery) -> GraspFilter:
        """Convert a request's parameters to the index's filter, in the caller's scope.

        Raises:
            NotFoundError: there is no such tag or dataset.
        """
        seen = project_scope()
        if query.dataset is not None:
            self._index.datasets.get(query.dataset, scope=seen)
        named = {
            "project": None if seen.everything else seen.project,
            "dataset": query.dataset,
            "tag": query.tag and self._index.tags.named(query.tag, scope=seen),
        }
        return _bounded(query).model_copy(update=named)

    def one(self, shard_id: str, row: int) -> GraspDetail:
        """Return one grasp with all data of its shard."""
        grasp, shard = self._index.grasps.get(shard_id, row, scope=project_scope()), self._index.shards.get(shard_id)
        return self._files.detail(grasp, shard)

    def histograms(self, job: JobView | JobDetail, *, bins: int = 20) -> list[Histogram]:
        """Return each metric's distribution over a job's valid grasps, or all stored ones if not validated.

        The result is cached while the number of grasps is unchanged.
        """
        validated = job.request.validation != "none"
        key = (job.id, count := job.valid if validated else job.grasps)
        if not count:
            return []
        if (found := self._histograms.get(key)) is None:
            where = GraspFilter(job=job.id, valid=True if validated else None)
            found = [
                Histogram(
                    metric=metric,
                    **vars(summary),
                    counts=self._index.statistics.histogram(where, metric, summary.low, summary.high, bins),
                )
                for metric, summary in self._index.statistics.summaries(where, MEAN_METRICS).items()
            ]
            if len(self._histograms) >= _KEPT_HISTOGRAMS:
                self._histograms.clear()
            self._histograms[key] = found
        return found

    def diversity(self, job: JobView | JobDetail) -> Diversity | None:
        """Return types and directions of the same grasps as `histograms`."""
        validated = job.request.validation != "none"
        key = (job.id, count := job.valid if validated else job.grasps)
        if not count:
            return None
        if key not in self._diversities:
            if len(self._diversities) >= _KEPT_HISTOGRAMS:
                self._diversities.clear()
            where = GraspFilter(job=job.id, valid=True if validated else None)
            self._diversities[key] = _told(self._index.statistics.kinds(where))
        return self._diversities[key]


def _told(kinds: GraspKinds) -> Diversity | None:
    if not kinds.cells:
        return None
    return Diversity(
        grasps=sum(kinds.cells.values()),
        types={kind.name.lower(): kinds.types[kind] for kind in GraspType if kinds.types.get(kind)},
        type_entropy_bits=round(entropy_bits(kinds.types.values()), 4),
        directions_used=len(kinds.cells),
        direction_entropy_bits=round(entropy_bits(kinds.cells.values()), 4),
        evenness=round(evenness(kinds.cells.values(), DIRECTION_CELLS), 4),
    )


def _bounded(query: GraspQuery) -> GraspFilter:
    """Convert the parameters that restrict the grasps themselves."""
    bounds: dict[str, dict[Metric, float]] = {"min": {}, "max": {}}
    if query.type is not None:
        kind = float(GraspType[query.type.upper()])
        bounds = {"min": {"grasp_type": kind}, "max": {"grasp_type": kind}}
    for end, metrics in bounds.items():
        for metric in MEAN_METRICS:
            value = getattr(query, f"{end}_{metric}", None)
            if value is not None:
                metrics[metric] = value
    return GraspFilter(
        job=query.job,
        hand=query.hand,
        object=query.object,
        where=query.where,
        valid=query.valid,
        success=query.success,
        scene=query.scene,
        neighbours=query.neighbours,
        lift_hard=query.lift_hard,
        validated=query.validated,
        robust_weakest=query.robust_weakest,
        at_least=bounds["min"],
        at_most=bounds["max"],
    )


#: Cached base shards. One of 32 grasps takes about 60 kB; a page needs at most one shard per row.
_KEPT_SHARDS: Final = 64
_POSTURES: Final = ("pregrasp", "grasp", "squeeze")
_OUTCOME: Final = "quality/verdict_outcome"
#: Meaning of the column's numbers, from its description in the schema.
OUTCOMES: Final = {
    int(code): words for code, words in re.findall(r"(\d) ([a-z ]+)", SCHEMAS["base"][_OUTCOME].description)
}
DIRECTIONS: Final = ("+x", "−x", "+y", "−y", "+z", "−z")
_LIFT: Final = "quality/lift_outcome"
#: Meaning of the column's numbers, from its description in the schema.
LIFT_OUTCOMES: Final = {
    int(code): words for code, words in re.findall(r"(\d) ([a-z ]+)", SCHEMAS["base"][_LIFT].description)
}


class GraspFiles:
    """Reads base shards, with a cache of the most recent ones."""

    def __init__(self, store: Store) -> None:
        self._store = store
        self._read = lru_cache(maxsize=_KEPT_SHARDS)(self._fetch)

    def detail(self, grasp: GraspView, shard: ShardView) -> GraspDetail:
        """Return a grasp of the index with the data of its shard.

        Raises:
            NotFoundError: the shard holds no grasps.
            DamagedShard: its file is missing, or does not match its checksum.
        """
        file = self._read(shard.key, shard.sha256)
        row = grasp.row
        return GraspDetail(
            **grasp.model_dump(),
            hand_digest=shard.hand_digest,
            object_digest=shard.object_digest,
            joint_names=_texts(file.attributes.get("joint_names")),
            postures={name: _posture(file, name, row) for name in _POSTURES},
            thresholds_m=_numbers(file["quality/thresholds_m"]),
            sweep={
                metric.name: _numbers(file[metric.path][row])
                for metric in GRASP_METRICS
                if metric.swept and metric.path in file.arrays
            },
            way=way(file, row),
            scene=scene(file, row),
            pushes=_pushes(file, row),
            verdict_margin=_value(file, "quality/verdict_margin", row),
            validated_by=validated_by(file, row),
            recheck=_verdict(file, "quality/recheck", row),
            friction=_number(file.attributes.get("mu")),
        )

    def _fetch(self, key: str, sha256: str) -> Shard:
        data = read_checked(self._store, key, sha256)
        try:
            return read_shard(data, kind="base", name=key)
        except InputError as error:
            raise NotFoundError(f"{key} holds no grasps that can be shown: {error}") from None


def _posture(file: Shard, name: str, row: int) -> Posture:
    pose, joints = file[f"{name}/hand_pose"][row], file[f"{name}/joint_positions"][row]
    return Posture(hand_pose=pose.tolist(), joint_positions=joints.tolist())


def validated_by(file: Shard, row: int) -> Literal["mujoco", "mujoco_warp"] | None:
    """Return the validator of a grasp in a base shard; None: not validated."""
    if "quality/success" not in file.arrays:
        return None
    validated = file.arrays.get("quality/validated_by")
    return "mujoco_warp" if validated is not None and validated[row] == 1 else "mujoco"


def _pushes(file: Shard, row: int) -> list[Push]:
    outcomes = file.arrays.get(_OUTCOME)
    if outcomes is None or _verdict(file, "quality/success", row) is None:
        return []
    codes = outcomes[row].tolist()
    return [
        Push(direction=direction, outcome=OUTCOMES.get(code, "unknown"))
        for direction, code in zip(DIRECTIONS, codes, strict=False)
    ]


def _verdict(file: Shard, path: str, row: int) -> bool | None:
    column = file.arrays.get(path)
    return None if column is None or column[row] < 0 else bool(column[row])


def _value(file: Shard, path: str, row: int) -> float | None:
    column = file.arrays.get(path)
    return None if column is None else _number(column[row])


def _numbers(values: Any) -> list[Any]:
    return [_number(value) for value in values.tolist()]


def _number(value: Any) -> float | None:
    return None if value is None or not math.isfinite(float(value)) else float(value)


def _texts(value: Any) -> list[str]:
    return [str(name) for name in value] if isinstance(value, list) else []


def way(file: Shard, row: int) -> list[Waypoint]:
    """Return the postures of a grasp in order."""
    points = way_of(file, row)
    return [
        Waypoint(
            name=point.name,
            place=place,
            hand_pose=point.hand_pose.tolist(),
            joint_positions=point.joint_positions.tolist(),
            carried=point.carried.tolist(),
        )
        for point, place in zip(points, stop_places(points).tolist(), strict=True)
    ]


def scene(file: Shard, row: int) -> GraspScene | None:
    """Return the scene of a grasp; None if it was planned around a free object.

    Raises:
        InputError: the shard's scene is invalid.
    """
    spec = scene_spec_of(file)
    if spec is None or spec.kind == "free" or "grasp/scene_index" not in file.arrays:
        return None
    number = int(file["grasp/scene_index"][row])
    tried = int(file[_LIFT][row]) if _LIFT in file.arrays else 0
    clearance = float(file["quality/clearance_m"][row]) if "quality/clearance_m" in file.arrays else math.nan
    return GraspScene(
        kind=spec.kind,
        number=number,
        object_pose=file["scene/object_pose"][number].tolist(),
        supports=list(supports_in(spec)),
        neighbours=_neighbours(file, number),
        clearance_m=clearance if math.isfinite(clearance) else None,
        lift=LIFT_OUTCOMES.get(tried, "unknown") if tried else None,
        lift_hard=_verdict(file, "quality/lift_hard", row),
    )


def _neighbours(file: Shard, number: int) -> list[Neighbour]:
    if "scene/neighbour_pose" not in file.arrays:
        return []
    names, digests = (file.attributes.get(key) for key in ("neighbours", "neighbour_digests"))
    poses = file["scene/neighbour_pose"][number].tolist()
    known = zip_longest(names if isinstance(names, list) else [], digests if isinstance(digests, list) else [])
    return [
        Neighbour(name=str(name), digest=str(digest), pose=pose)
        for (name, digest), pose in zip(known, poses, strict=False)
    ]
