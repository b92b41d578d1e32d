"""Method `learned`: a network proposes starts of fast_graspd from the object's visible points."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from graspd.baselines.learned.network import cloud_inputs, decode, flow_conditions, integrate_flow
from graspd.service.model.base import Digest
from graspd.service.model.errors import InputError, SceneError
from graspd.service.model.fidelity import Fidelity
from graspd.service.model.scene_spec import UPRIGHT
from graspd.service.model.transforms import Floats, compose, cross, invert, quat_conjugate, quat_rotate
from graspd.service.store.network_file import ProposalNetwork
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.mesh_geometry import points_on_triangles
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd.planner import plan, plan_batches
from graspd.worker.planners.fast_graspd.scene_starts import ROOM, clear_scene_starts
from graspd.worker.planners.fast_graspd.starts import CLEAR, Probe
from graspd.worker.planners.network_cache import cache_file, load_network
from graspd.worker.planners.port import BatchRequest, Method, Options, PlanRequest
from graspd.worker.simulation.data import HandState
from graspd.worker.simulation.environment import UP, Obstacle, PlacedGrasps
from graspd.worker.simulation.model import Model


class LearnedOptions(Options):
    network: Digest = Field(description="digest of the network; on the command line its file, in a job its name")
    starts: int = Field(4, ge=1, le=32, description="starts of each grasp")


@dataclass(frozen=True)
class LearnedPlanner:
    """fast_graspd with starts from a network's proposals."""

    options: LearnedOptions

    def __call__(self, hand: HandModel, obj: ObjectModel, wanted: PlanRequest, run: ExecutionContext) -> GraspSet:
        return plan(hand, obj, wanted, run, warm=self._network_starts(hand))

    def joined(self, hand: HandModel, obj: ObjectModel, asked: Sequence[BatchRequest]) -> list[GraspSet | Exception]:
        return plan_batches(hand, obj, asked, warm=self._network_starts(hand))

    def _network_starts(self, hand: HandModel) -> NetworkStarts:
        network = load_network(self.options.network)
        if network.joint_names != hand.joint_names or network.hand_digest != hand.digest:
            raise InputError(
                f"network {self.options.network[:12]} proposes grasps of {network.hand} ({network.hand_digest[:12]}), "
                f"not of {hand.name} ({hand.digest[:12]})"
            )
        return NetworkStarts(network, self.options.starts)


METHOD: Final = Method(
    summary="fast_graspd from a network's proposals for the visible points of an object on a table",
    source="unpublished; PointNet, CVPR 2017, and flow matching, ICLR 2023",
    planner=LearnedPlanner,
    joined=lambda options: LearnedPlanner(options).joined,
    in_scenes=True,
    in_parts=True,
    free=False,
    options=LearnedOptions,
    uses=tuple(name for name in Fidelity.model_fields if name not in ("name", "starts")),
    files={"network": cache_file},
)

#: Retreats along the approach that are tested for a hand in collision [m].
RETREATS: Final = (0.0, 0.01, 0.02, 0.035, 0.055, 0.08)
PROPOSALS: Final = 32  # number of proposals per grasp, computed at once and divided among its starts
FAR_M: Final = 0.15  # largest distance of a start's palm from the object's bounding ball [m]


Generators = list[np.random.Generator]


@dataclass(frozen=True)
class NetworkStarts:
    """A `WarmStart` from a network's proposals.
    Starts of fast_graspd replace those without a free proposal."""

    network: ProposalNetwork
    starts: int  # starts per grasp

    def adapted(self, fidelity: Fidelity) -> Fidelity:
        finalists = min(fidelity.finalists, self.starts)
        return fidelity.model_copy(update={"starts": self.starts, "finalists": finalists})

    def __call__(
        self, model: Model, generators: Generators, *, each: int, placed: PlacedGrasps, ways: Sequence[Floats]
    ) -> tuple[HandState, Floats]:
        """Return starts and depths [m], see `clear_scene_starts`. Raises SceneError: the scenes have no table."""
        scene = np.repeat(placed.index, each)
        drawn, away = self._proposed(model, generators, each, placed)
        state, depth = _retreat_until_clear(model, drawn, away, scene, placed)
        rest = np.flatnonzero(depth > CLEAR)
        if len(rest):
            own, depth[rest] = clear_scene_starts(
                model, [generators[i] for i in rest], each=1, placed=placed.take(rest // each), ways=ways
            )
            state.pivot[rest], state.rotation[rest], state.q[rest] = own.pivot, own.rotation, own.q
        return state, depth

    def _proposed(
        self, model: Model, generators: Generators, each: int, placed: PlacedGrasps
    ) -> tuple[HandState, Floats]:
        """Return open hands (n * draws) and their retreat directions (n * draws, 3) by start; object frame."""
        hand, obj, table = model.hand.model, model.obj.model, table_height(placed.supports)
        seen, draws = SurfaceView.from_object(obj), max(1, PROPOSALS // each)
        pivot, rotation, q, away = [], [], [], []
        for number, scene in enumerate(placed.index.tolist()):
            mine = generators[number * each : (number + 1) * each]
            pose = np.asarray(placed.object_pose[scene], float)
            cloud = seen.cloud(pose, seen.camera(pose, mine[0]), self.network.points, mine[0])
            inputs, anchor = cloud_inputs(*cloud, table)
            condition = flow_conditions(self.network, inputs[None], anchor[2:] - table)
            # Proposals of each grasp are computed separately, so that grasps are independent.
            noise = np.concatenate([g.standard_normal((draws, self.network.row_size)) for g in mine])
            rows = integrate_flow(self.network, noise.astype(np.float32), np.repeat(condition, len(noise), axis=0))
            found = decode(rows, anchor)
            at = compose(invert(pose), found.hand_pose)
            pivot.append(at[:, :3] + quat_rotate(at[:, 3:], hand.palm.centre) - obj.centre_of_mass)
            rotation.append(at[:, 3:])
            q.append(np.clip(hand.reduce(found.pregrasp), hand.lower, hand.upper))
            away.append(-quat_rotate(quat_conjugate(pose[3:]), found.approach))
        return HandState(*map(np.concatenate, (pivot, rotation, q))), np.concatenate(away)


def table_height(supports: Sequence[Obstacle]) -> float:
    """Return z of the table among a scene's supports [m]: the highest half-space below a horizontal plane.
    Raises SceneError: there is none."""
    heights = [float(o.planes[0, 3]) for o in supports if len(o.planes) == 1 and o.planes[0, :3] @ UP > UPRIGHT]
    if not heights:
        raise SceneError("method learned needs a table, but this scene has none; choose fast_graspd")
    return max(heights)


def _retreat_until_clear(
    model: Model, drawn: HandState, away: Floats, scene: NDArray[np.intp], placed: PlacedGrasps
) -> tuple[HandState, Floats]:
    """Return for each of n starts the free hand that retreats least, and its depth [m].
    The depth is inf if no hand is free. Hands without clearance from obstacles are first moved up."""
    count, probe = len(scene), Probe(model, len(scene), room=ROOM)
    draws = len(drawn.pivot) // count
    near = (np.linalg.norm(drawn.pivot, axis=1) < model.obj.model.radius + FAR_M).reshape(count, draws)
    up = np.array([s.up for s in placed.scenes])[scene]
    raised = np.zeros_like(drawn.pivot)
    for draw in range(draws):
        rows = np.arange(count) * draws + draw
        probe.data.set_scenes(scene)
        probe.depths(drawn[rows])
        raised[rows] = probe.data.depths.obstacles.numpy()[:count, None].astype(float) * up
    best, depth = drawn[np.arange(count) * draws], np.full(count, np.inf)
    for back, draw in product(RETREATS, range(draws)):
        left = np.flatnonzero((depth > CLEAR) & near[:, draw])
        if not len(left):
            continue
        rows = left * draws + draw
        states = drawn[rows]
        states.pivot[:] += raised[rows] + back * away[rows]
        probe.data.set_scenes(scene[left])
        found = probe.depths(states)
        clear = np.flatnonzero(found <= CLEAR)
        taken = left[clear]
        depth[taken] = found[clear]
        best.pivot[taken], best.rotation[taken], best.q[taken] = (
            part[clear] for part in (states.pivot, states.rotation, states.q)
        )
    return best, depth


#: Cameras as in the pictures of a job: elevation above the table [rad]; half of the field of view [rad]; share of this
#: angle that the object's bounding ball fills; least distance to the ball [m].
ELEVATION: Final = (np.radians(18.0), np.radians(62.0))
HALF_FIELD: Final = np.radians(20.0)
FILL: Final = (0.7, 1.0)
NEAREST_M: Final = 0.25
#: Number of surface points, and of pixels across the bounding ball; each pixel shows its nearest point. About five
#: visible points per pixel hide nearly all points behind them.
DENSE: Final = 32768
PIXELS: Final = 48


@dataclass(frozen=True)
class SurfaceView:
    """Surface of an object for simulated cameras."""

    obj: ObjectModel
    points: Floats  # (DENSE, 3) in the object frame [m]
    normals: Floats  # (DENSE, 3) unit outward normals

    @classmethod
    def from_object(cls, obj: ObjectModel) -> SurfaceView:
        """Sample points uniformly over the surface's area; equal objects have equal points."""
        rng = np.random.default_rng(0)
        corners = obj.vertices[obj.faces]
        cross = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = np.linalg.norm(cross, axis=1)
        sums = np.cumsum(area)
        face = np.minimum(np.searchsorted(sums, sums[-1] * rng.random(DENSE)), len(area) - 1)
        points = points_on_triangles(corners[face], *rng.random((2, DENSE, 1)))
        return cls(obj, points, cross[face] / np.maximum(area[face, None], 1e-20))

    def camera(self, pose: Floats, rng: np.random.Generator) -> Floats:
        """Sample a camera position (3,) that views the object at `pose` (7,), z up [m]."""
        azimuth, fill = rng.uniform(0, 2 * np.pi), rng.uniform(*FILL)
        elevation = np.arcsin(rng.uniform(*np.sin(ELEVATION)))  # uniform over the sphere
        level = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        toward = np.cos(elevation) * level + np.sin(elevation) * np.array([0, 0, 1.0])
        distance = max(NEAREST_M + self.obj.radius, self.obj.radius / np.sin(fill * HALF_FIELD))
        return np.asarray(self._object_centre(pose) + distance * toward)

    def cloud(self, pose: Floats, camera: Floats, count: int, rng: np.random.Generator) -> tuple[Floats, Floats]:
        """Sample points (count, 3) [m] and normals among the nearest points of a camera's pixels.
        The object is at `pose` (7,)."""
        points, normals = quat_rotate(pose[3:], self.points) + pose[:3], quat_rotate(pose[3:], self.normals)
        rays = points - camera
        facing = np.flatnonzero((normals * rays).sum(axis=1) < 0)
        toward = camera - self._object_centre(pose)
        distance = float(np.linalg.norm(toward))
        toward = toward / distance
        right = cross(np.array([0, 0, 1.0]), toward)
        right = right / np.linalg.norm(right)
        depth = -(rays[facing] @ toward)
        slopes = np.stack([rays[facing] @ right, rays[facing] @ cross(toward, right)], axis=1) / depth[:, None]
        widest = np.tan(np.arcsin(self.obj.radius / distance))
        pixel = np.clip((0.5 * (slopes / widest + 1) * PIXELS).astype(int), 0, PIXELS - 1) @ np.array([1, PIXELS])
        order = np.lexsort((depth, pixel))
        shown = facing[order[np.unique(pixel[order], return_index=True)[1]]]
        drawn = shown[rng.choice(len(shown), count, replace=len(shown) < count)]
        return points[drawn], normals[drawn]

    def _object_centre(self, pose: Floats) -> Floats:
        return np.asarray(quat_rotate(pose[3:], self.obj.centre_of_mass) + pose[:3])
