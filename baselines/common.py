"""Common parts of the baselines: hand and object, collision-free starts, inner surfaces, grasp sets.

Baselines use flat triangles of the object (no Phong smoothing). Pregrasp and squeeze come from the same code as in
`fast_graspd`, and so do starts that a publication does not define."""

import threading
import time
from collections.abc import Callable
from types import ModuleType
from typing import Any, Final, TypeVar

import numpy as np
import warp as wp
from cachetools import LRUCache
from numpy.typing import NDArray

from graspd.service.model.fidelity import Fidelity
from graspd.service.model.transforms import Floats
from graspd.worker.control.postures import pregrasp, squeeze
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.jaws import posed_points
from graspd.worker.hands.model import HandModel, SurfacePoints
from graspd.worker.hands.surface import farthest_points, sample_surface
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd.candidates import posture_of
from graspd.worker.planners.fast_graspd.pairs import Pair, pair_of
from graspd.worker.planners.fast_graspd.starts import sample_starts
from graspd.worker.simulation.data import HandState

T = TypeVar("T")

#: Resolution of hand and object for baselines whose publication states none.
GROUND: Final = Fidelity(
    name="peers", coarse_points=400, fine_points=1000, object_points=4000, polish_iterations=0, phong_alpha=0.0
)
_searches: Final[LRUCache[tuple[object, ...], Any]] = LRUCache(8)
_lock: Final = threading.Lock()


def cached_search(make: Callable[..., T], pair: Pair, *options: object) -> T:
    """Return `make(pair, *options)`; cache the eight most recent results."""
    key = (make, id(pair), *options)
    with _lock:
        if key not in _searches:
            # The cached reference to the pair prevents reuse of its id.
            _searches[key] = (pair, make(pair, *options))
        return _searches[key][1]


def load_pair(hand: HandModel, obj: ObjectModel, device: str, *kernels: ModuleType) -> Pair:
    """Return hand and object on a device; compile the modules `kernels`, in one thread at a time."""
    pair = pair_of(hand, obj, GROUND, device)
    with _lock:
        for module in kernels:
            wp.load_module(module=module, device=device)
    return pair


def collision_free_starts(pair: Pair, *, seed: int, batch: int, indices: range) -> HandState:
    """Sample a collision-free start per grasp, with the palm towards a random surface point (Grasp'D)."""
    return sample_starts(pair.model(pair.coarse), seed=seed, batch=batch, indices=indices, each=1)


def frame_along(z: Floats) -> Floats:
    """Return a rotation matrix whose third column is `z`."""
    x = np.cross(np.eye(3)[int(np.argmin(np.abs(z)))], z)
    x /= np.linalg.norm(x)
    return np.column_stack([x, np.cross(z, x), z])


def create_grasp_set(pair: Pair, state: HandState, began: float, info: dict[str, object]) -> GraspSet:
    """Return hands as grasps with pregrasp and squeeze.
    `began` is the planner's start by `time.perf_counter` [s]."""
    hand, obj, device = pair.hand.model, pair.fine.obj.model, pair.hand.device
    seconds = time.perf_counter() - began
    grasp = posture_of(hand, obj, state)
    opened, pressed = (pose(hand, obj, grasp, device=device) for pose in (pregrasp, squeeze))
    return GraspSet(grasp, opened, pressed, np.full(len(grasp), np.nan), seconds=seconds, info=info)


#: Cosine of the angle between normal and closing motion, or approach for the palm, above which a point is inside.
INSIDE_COS: Final = 0.7
SAMPLES: Final = 1200
STEP: Final = 1e-4


def inner_side_points(hand: HandModel, *, each: int, on_palm: int) -> SurfacePoints:
    """Spread points evenly on the surfaces that close.
    There are at most `each` points per closing link, and at most `on_palm` on the palm."""
    points = sample_surface(hand, SAMPLES)
    before, after = (posed_points(hand, points, hand.preshape + t * hand.closing) for t in (0.0, STEP))
    motion = after[0] - before[0]
    speed = np.linalg.norm(motion, axis=1)
    along = np.einsum("ni,ni->n", motion, before[1]) / np.maximum(speed, 1e-12)
    ahead = before[1] @ hand.palm.approach
    inside = np.where(speed > 1e-3 * STEP, along > INSIDE_COS, (points.body == 0) & (ahead > INSIDE_COS))
    chosen: list[NDArray[np.intp]] = []
    for body in range(hand.bodies):
        mine = np.flatnonzero((points.body == body) & inside)
        if len(mine):
            count = min(len(mine), each if body else on_palm)
            chosen.append(mine[farthest_points(points.position[mine], count)])
    index = np.sort(np.concatenate(chosen)) if chosen else np.zeros(0, np.intp)
    return SurfacePoints(points.body[index], points.position[index], points.normal[index], points.area[index])
