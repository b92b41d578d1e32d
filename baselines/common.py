"""Common parts of the baselines: hand and object on a device, free starts, inner surfaces, the way from hands to
grasps.

Peers see the object as flat triangles (no Phong smoothing) and take their starts, postures around the grasp and
quality from the same code as `fast_graspd`, so that what is compared is the search alone.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import ModuleType
from typing import Final, Generic, TypeVar

import numpy as np
import warp as wp
from cachetools import LRUCache
from numpy.typing import NDArray

from graspd.service.model.fidelity import Fidelity
from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, quat_rotate
from graspd.worker.control.postures import pregrasp, squeeze
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import HandModel, SurfacePoints
from graspd.worker.hands.surface import farthest_points, sample_surface
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd.candidates import posture_of
from graspd.worker.planners.fast_graspd.pairs import Pair, pair_of
from graspd.worker.planners.fast_graspd.starts import sample_starts
from graspd.worker.simulation.data import HandState

T = TypeVar("T")

#: How finely peers see hand and object where their source does not say.
GROUND: Final = Fidelity(
    name="peers", coarse_points=400, fine_points=1000, object_points=4000, polish_iterations=0, phong_alpha=0.0
)
_lock = threading.Lock()


class PairCache(Generic[T]):
    """What a method makes once of a pair and its options, kept for the pairs used last."""

    def __init__(self, make: Callable[..., T], size: int = 4) -> None:
        self._make = make
        self._found: LRUCache[tuple[object, ...], tuple[Pair, T]] = LRUCache(size)
        self._lock = threading.Lock()

    def __call__(self, pair: Pair, *options: object) -> T:
        """`make(pair, *options)`, from memory where it was used lately."""
        key = (id(pair), *options)
        with self._lock:
            if key not in self._found:
                # The pair is kept beside it: its id is not given to another one meanwhile.
                self._found[key] = (pair, self._make(pair, *options))
            return self._found[key][1]


def ground_of(hand: HandModel, obj: ObjectModel, device: str, *kernels: ModuleType) -> Pair:
    """The pair on a device, with the kernel modules that the caller will launch: only one thread may load a module."""
    pair = pair_of(hand, obj, GROUND, device)
    with _lock:
        for module in kernels:
            wp.load_module(module=module, device=device)
    return pair


def free_starts(pair: Pair, *, seed: int, batch: int, indices: range) -> HandState:
    """A start for each grasp whose palm looks at a random place of the surface, touching nothing (Grasp'D, 2022)."""
    return sample_starts(pair.model(pair.coarse), seed=seed, batch=batch, indices=indices, each=1)


def joined(states: list[HandState]) -> HandState:
    """The hands of all parts of a batch, in order."""
    return HandState(*(np.concatenate([getattr(s, name) for s in states]) for name in ("pivot", "rotation", "q")))


def grasp_set(
    pair: Pair, state: HandState, began: float, info: dict[str, object], loss: Floats | None = None
) -> GraspSet:
    """Hands as grasps with the postures around them; `began` is the planner's start by `time.perf_counter`."""
    hand, obj = pair.hand.model, pair.fine.obj.model
    seconds = time.perf_counter() - began
    grasp = posture_of(hand, obj, state)
    return GraspSet(
        grasp=grasp,
        pregrasp=pregrasp(hand, obj, grasp, device=pair.hand.device),
        squeeze=squeeze(hand, obj, grasp, device=pair.hand.device),
        stability_loss=np.full(len(grasp), np.nan) if loss is None else loss,
        seconds=seconds,
        info=info,
    )


#: Inside: the surface moves along its normal to within 45 degrees when the fingers close; the palm looks ahead.
INSIDE_COS: Final = 0.7
SAMPLES: Final = 1200
STEP: Final = 1e-4


def inside_points(hand: HandModel, *, each: int, on_palm: int) -> SurfacePoints:
    """At most `each` points on every link that closes and `on_palm` on the palm, spread widely; none on other links."""
    points = sample_surface(hand, SAMPLES)
    inside = _inside(hand, points)
    chosen: list[NDArray[np.intp]] = []
    for body in range(hand.bodies):
        mine = np.flatnonzero((points.body == body) & inside)
        if len(mine):
            count = min(len(mine), each if body else on_palm)
            chosen.append(mine[farthest_points(points.position[mine], count)])
    index = np.sort(np.concatenate(chosen)) if chosen else np.zeros(0, np.intp)
    return SurfacePoints(points.body[index], points.position[index], points.normal[index], points.area[index])


def _inside(hand: HandModel, points: SurfacePoints) -> NDArray[np.bool_]:
    """(N,) whether a point lies on the inside of its link."""
    before, after = (_posed(hand, points, hand.preshape + t * hand.closing) for t in (0.0, STEP))
    motion = after[0] - before[0]
    speed = np.linalg.norm(motion, axis=1)
    along = np.einsum("ni,ni->n", motion, before[1]) / np.maximum(speed, 1e-12)
    ahead = before[1] @ hand.palm.approach
    return np.where(speed > 1e-3 * STEP, along > INSIDE_COS, (points.body == 0) & (ahead > INSIDE_COS))


def _posed(hand: HandModel, points: SurfacePoints, q: Floats) -> tuple[Floats, Floats]:
    pose = body_poses(hand, IDENTITY_POSE, hand.expand(q))[0][points.body]
    return apply(pose, points.position), quat_rotate(pose[:, 3:], points.normal)
