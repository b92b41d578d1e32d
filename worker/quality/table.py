"""The quality table: every metric of every grasp of one hand on one object."""

from __future__ import annotations

import atexit
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from cachetools import LRUCache
from numpy.typing import NDArray

from graspd.service.model.errors import InputError
from graspd.service.model.metrics import GRASP_METRICS
from graspd.service.model.transforms import Floats
from graspd.service.store.manifests import INDEX_THRESHOLD_M
from graspd.worker.execution_context import DEFAULT_CONTEXT, Count, ExecutionContext
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.disk_cache import content_digest
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.region import WHOLE, ContactRegion
from graspd.worker.quality.contact import MAX_CONTACTS, contact_area_cm2, contact_links, spread_contacts
from graspd.worker.quality.diversity import approach_cells
from graspd.worker.quality.grasp_type import ContactPattern
from graspd.worker.quality.probe import HAND_POINTS, OBJECT_POINTS, REACH_M, Distances, probe_of
from graspd.worker.quality.volume import Overlap, SharedVolume, penetration_depth
from graspd.worker.quality.wrench_space import contact_wrenches, measure_spaces

Columns = dict[str, NDArray[np.generic]]

#: Contact thresholds [m]: a small one from the literature, that of the paper (Table 2), and that of DDGC.
DEFAULT_THRESHOLDS_M: Final = (0.002, 0.005, 0.009)
DEFAULT_FRICTION: Final = 1.0
CHUNK: Final = 16  # grasps per thread at a time: few enough for a quick cancellation, enough to fill a kernel launch


class _Pair:
    def __init__(self, terms: _Terms) -> None:
        hand, obj = terms.hand, terms.obj
        self.obj, self.friction = obj, terms.friction
        self.thresholds = np.array(terms.thresholds)
        indexed = np.argmin(np.abs(self.thresholds - INDEX_THRESHOLD_M))
        self.with_volume = (np.arange(len(self.thresholds)) == indexed) | terms.every_volume
        self.probe = probe_of(hand, obj, hand_points=HAND_POINTS, object_points=OBJECT_POINTS)
        self.region, self.measures = terms.region, terms.measures
        self.volume = SharedVolume(hand, obj)
        self.overlap = Overlap(hand, self.probe)

    def columns(self, posture: Posture) -> Columns:
        chunk = _Chunk(self, self.probe.measure(posture))
        return {f"quality/{name}": measured(chunk) for name, measured in self.measures.items()}


_pairs: LRUCache[str, _Pair] = LRUCache(4)
_lock = threading.Lock()
# manifold3d reports solids that outlive the interpreter as leaks.
atexit.register(_pairs.clear)


def measure(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    *,
    friction: float = DEFAULT_FRICTION,
    thresholds_m: Sequence[float] = DEFAULT_THRESHOLDS_M,
    every_volume: bool = False,
    region: ContactRegion = WHOLE,
    run: ExecutionContext = DEFAULT_CONTEXT,
) -> dict[str, NDArray[np.generic]]:
    """Compute the quality columns of a base shard for N grasps at contact.
    They are `MEASURES`, the thresholds, and the planner's stability loss. Raises InputError: no thresholds, or a
    threshold outside 0 to `REACH_M`. TaskCancelled: `run.cancelled()` returned True.

    Args:
        friction: Coulomb coefficient of the wrench space.
        thresholds_m: T contact thresholds, at most `REACH_M` [m].
        every_volume: compute the volume at all thresholds; otherwise only at the threshold nearest to
            `INDEX_THRESHOLD_M`, nan at the others. A volume takes ten times as long as an epsilon.
        region: region whose share of the contact is measured; without one the column is missing.
        run: receives the number of finished grasps; polled for cancellation between chunks."""
    thresholds = np.asarray(thresholds_m, float)
    if thresholds.ndim != 1 or not len(thresholds) or (thresholds <= 0).any() or (thresholds > REACH_M).any():
        limit = f"above 0 and at most {REACH_M * 1e3:g} mm"
        raise InputError(f"contact thresholds must be {limit}; got {list(thresholds_m)}")
    terms = _Terms(hand, obj, friction, tuple(thresholds.tolist()), every_volume, region)
    chunks = [slice(i, min(i + CHUNK, len(grasps))) for i in range(0, len(grasps), CHUNK)]
    postures = [Posture(grasps.grasp.hand_pose[chunk], grasps.grasp.joint_positions[chunk]) for chunk in chunks]
    parts = _measure_chunks(terms, postures, Count(len(grasps), run, "quality"), run)
    columns = {name: np.concatenate([part[name] for part in parts]) for name in parts[0]} if parts else terms.empty()
    columns["quality/thresholds_m"] = thresholds
    columns["quality/stability_loss"] = np.asarray(grasps.stability_loss, float)
    return columns


@dataclass(frozen=True)
class _Terms:
    hand: HandModel
    obj: ObjectModel
    friction: float
    thresholds: tuple[float, ...]
    every_volume: bool
    region: ContactRegion

    @cached_property
    def pair(self) -> _Pair:
        """Prepared hand and object, cached because a batch is measured in chunks of a few grasps."""
        content = content_digest(self)
        with _lock:
            if content not in _pairs:
                _pairs[content] = _Pair(self)
            return _pairs[content]

    @property
    def measures(self) -> dict[str, Callable[[_Chunk], NDArray[np.generic]]]:
        return {name: one for name, one in MEASURES.items() if name != "region_share" or not self.region.is_whole}

    def empty(self) -> Columns:
        swept = {metric.name for metric in GRASP_METRICS if metric.swept}
        return {
            f"quality/{name}": np.zeros((0, len(self.thresholds)) if name in swept else 0) for name in self.measures
        }


def _measure_chunks(terms: _Terms, postures: Sequence[Posture], done: Count, run: ExecutionContext) -> list[Columns]:
    if run.pool is not None:
        return run.pool.map(
            _columns,
            content_digest(terms),
            terms,
            postures,
            cancelled=run.cancelled,
            done=lambda k: done.add(len(postures[k])),
        )
    pair = terms.pair

    def work(posture: Posture) -> Columns:
        run.check("the quality table")
        columns = pair.columns(posture)
        done.add(len(posture))
        return columns

    with ThreadPoolExecutor(run.cores, thread_name_prefix="quality") as pool:
        return list(pool.map(work, postures))


def _columns(terms: _Terms, posture: Posture) -> Columns:
    return terms.pair.columns(posture)


@dataclass(frozen=True)
class _Chunk:
    pair: _Pair
    found: Distances

    @cached_property
    def body_distance(self) -> Floats:
        return self.pair.probe.body_distance(self.found)

    @cached_property
    def pattern(self) -> ContactPattern:
        return ContactPattern.of(self.pair.probe, self.found, self.body_distance)

    @cached_property
    def spaces(self) -> tuple[Floats, Floats]:
        """Epsilon and volume (B, T) of the wrench spaces of B grasps."""
        pair, found, obj = self.pair, self.found, self.pair.obj
        near = pair.probe.facing_mask(found)[:, None] & (np.abs(found.distance)[:, None] < pair.thresholds[:, None])
        chosen, count = spread_contacts(near, found.closest, found.normal, scale=obj.radius, limit=MAX_CONTACTS)
        rows = np.arange(len(chosen))[:, None, None]
        counts = (np.arange(MAX_CONTACTS) < count[..., None])[..., None]
        place, inward = found.closest[rows, chosen], np.where(counts, -found.normal[rows, chosen], [0.0, 0.0, 1.0])
        edges = contact_wrenches(place, inward, friction=pair.friction, centre=obj.centre_of_mass, radius=obj.radius)
        wanted = np.broadcast_to(pair.with_volume, count.shape)
        epsilon, volume = measure_spaces(edges.reshape(-1, *edges.shape[2:]), count.ravel(), wanted.ravel())
        return epsilon.reshape(count.shape), volume.reshape(count.shape)

    def shared_volume(self) -> Floats:
        # A face may enter a piece between object points, but a point is within half a diagonal of their grid.
        near = self.found.piece_distance < self.pair.probe.sample_spacing
        if self.pair.volume.is_exact:
            near = self.pair.overlap.overlapping_pieces(self.found, near)
        return self.pair.volume.volumes(self.found.bodies, near)


#: Metrics of B grasps: (B, T) if swept over thresholds, else (B,). `GRASP_METRICS` has their units.
MEASURES: Final[dict[str, Callable[[_Chunk], NDArray[np.generic]]]] = {
    "contact_area_cm2": lambda chunk: contact_area_cm2(
        chunk.found.distance, chunk.pair.probe.points.area, chunk.pair.thresholds
    ),
    "intersection_volume_cm3": _Chunk.shared_volume,
    "epsilon": lambda chunk: chunk.spaces[0],
    "wrench_volume": lambda chunk: chunk.spaces[1],
    "penetration_depth_mm": lambda chunk: penetration_depth(chunk.found) * 1e3,
    "self_penetration_depth_mm": lambda chunk: chunk.found.self_depth * 1e3,
    "contact_links": lambda chunk: contact_links(chunk.body_distance),
    "grasp_type": lambda chunk: chunk.pattern.types,
    "taxonomy_type": lambda chunk: chunk.pattern.taxonomy(),
    "digits": lambda chunk: chunk.pattern.digits,
    "region_share": lambda chunk: chunk.pair.probe.region_share(chunk.found, chunk.pair.region),
    "approach_cell": lambda chunk: approach_cells(chunk.pair.probe.hand, chunk.found.bodies[:, 0, 3:]),
}
