"""The quality table: every metric of every grasp of one hand on one object, and the grasp types.

Types are those of Napier (1956) and of the GRASP taxonomy (Feix et al., IEEE THMS 2016), by opposition (Iberall 1987),
tested in this order:

- power, palm opposition: the palm touches, or at least two digits wrap: with more than their last link, not by a side;
- lateral, side opposition: at least half of the touching digits touch by a side;
- precision, pad opposition: two digits touch.

A *digit* is a chain of bodies that ends in a fingertip; all other bodies are palm. It touches *by a side* if most of
its surface within 2 mm of the object faces along its axis of flexion, within 45 degrees. A jaw has no side."""

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
from graspd.service.model.metrics import GRASP_METRICS, GraspType
from graspd.service.model.transforms import Floats
from graspd.service.store.manifests import INDEX_THRESHOLD_M
from graspd.worker.execution_context import DEFAULT_CONTEXT, Count, ExecutionContext
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.model import HandModel, JointType
from graspd.worker.objects.disk_cache import content_digest
from graspd.worker.objects.model import ObjectModel
from graspd.worker.quality.contact import (
    LINK_CONTACT_M,
    MAX_CONTACTS,
    contact_area_cm2,
    contact_links,
    finger_of_body,
    spread_contacts,
)
from graspd.worker.quality.diversity import approach_cells
from graspd.worker.quality.probe import HAND_POINTS, OBJECT_POINTS, REACH_M, Distances, Probe, probe_of
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
        self.volume = SharedVolume(hand, obj)
        self.overlap = Overlap(hand, self.probe)

    def columns(self, posture: Posture) -> Columns:
        chunk = _Chunk(self, self.probe.measure(posture))
        return {f"quality/{name}": measured(chunk) for name, measured in MEASURES.items()}


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
        run: receives the number of finished grasps; polled for cancellation between chunks."""
    thresholds = np.asarray(thresholds_m, float)
    if thresholds.ndim != 1 or not len(thresholds) or (thresholds <= 0).any() or (thresholds > REACH_M).any():
        limit = f"above 0 and at most {REACH_M * 1e3:g} mm"
        raise InputError(f"contact thresholds must be {limit}; got {list(thresholds_m)}")
    terms = _Terms(hand, obj, friction, tuple(thresholds.tolist()), every_volume)
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

    @cached_property
    def pair(self) -> _Pair:
        """Prepared hand and object, cached because a batch is measured in chunks of a few grasps."""
        content = content_digest(self)
        with _lock:
            if content not in _pairs:
                _pairs[content] = _Pair(self)
            return _pairs[content]

    def empty(self) -> Columns:
        swept = {metric.name for metric in GRASP_METRICS if metric.swept}
        return {f"quality/{name}": np.zeros((0, len(self.thresholds)) if name in swept else 0) for name in MEASURES}


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
    "contact_links": lambda chunk: contact_links(chunk.pair.probe.body_distance(chunk.found)),
    "grasp_type": lambda chunk: grasp_types(chunk.pair.probe, chunk.found),
    "approach_cell": lambda chunk: approach_cells(chunk.pair.probe.hand, chunk.found.bodies[:, 0, 3:]),
}

#: Cosine between a digit's surface normal and its axis of flexion above which the surface is a side: 45 degrees.
SIDE_COS: Final = float(np.sqrt(0.5))
ENVELOPING: Final = 2  # least number of wrapping digits of a power grasp if the palm does not touch


def grasp_types(probe: Probe, found: Distances) -> NDArray[np.int32]:
    """Return the `GraspType` (B,) of each grasp, as defined in the docstring of the module."""
    hand = probe.hand
    finger = finger_of_body(hand)
    touching = probe.body_distance(found) < LINK_CONTACT_M
    digits = np.array(sorted(set(finger[finger >= 0].tolist())), finger.dtype)
    inner = np.array([body for body in np.flatnonzero(finger >= 0) if body not in hand.fingertips], np.intp)
    palm = touching[:, finger < 0].any(axis=1)
    touches = np.stack([touching[:, finger == digit].any(axis=1) for digit in digits], axis=1)
    wraps = np.stack([touching[:, inner[finger[inner] == digit]].any(axis=1) for digit in digits], axis=1)
    sides = touches & _touching_with_sides(probe, found, finger, digits)
    count = touches.sum(axis=1)
    lateral = sides.any(axis=1) & (2 * sides.sum(axis=1) >= count)
    power = palm | ((wraps & ~sides).sum(axis=1) >= ENVELOPING)
    kind = np.where(lateral, GraspType.LATERAL, GraspType.PRECISION)
    kind = np.where(power, GraspType.POWER, kind)
    return np.where(count + palm < 2, GraspType.NONE, kind).astype(np.int32)


def _touching_with_sides(
    probe: Probe, found: Distances, finger: NDArray[np.int32], digits: NDArray[np.int32]
) -> NDArray[np.bool_]:
    """Return a mask (B, digits) of digits with more than half of their near points on their sides."""
    hand, points = probe.hand, probe.points
    near = np.where(np.abs(found.distance) < LINK_CONTACT_M, points.area, 0.0)
    # Axes about which bodies close, 0 for other bodies. The axis of a body's joint is constant in the body's frame.
    bends = (hand.joint_type == JointType.REVOLUTE) & (hand.dof >= 0)
    bends &= np.where(hand.dof >= 0, hand.closing[hand.dof], 0.0) != 0
    axes = np.where(bends[:, None], hand.axis, 0.0)
    side = np.abs(np.einsum("ni,ni->n", points.normal, axes[points.body])) > SIDE_COS
    mine = finger[points.body][:, None] == digits
    return np.asarray(near @ (mine & side[:, None]) > 0.5 * (near @ mine))
