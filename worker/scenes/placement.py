"""Neighbours of a scene: reduction to a few convex pieces with few faces, and placement."""

from collections.abc import Sequence
from dataclasses import replace
from itertools import combinations, product
from typing import Any, Final

import mujoco
import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import MeshError, SceneError
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.transforms import Floats
from graspd.worker.hands.primitives import convex_edges
from graspd.worker.objects.convex import union_volume
from graspd.worker.objects.memory_cache import cached_by_content
from graspd.worker.objects.mesh_geometry import to_centred_frame, to_file_frame
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.topology import outward_hull
from graspd.worker.scenes.kinds import SUNK, move_inside, require_no_penetration, rest_poses, supports_of, walled_area
from graspd.worker.scenes.neighbours import drop_together, place_neighbours
from graspd.worker.simulation.environment import Neighbour, Obstacle, Scenes
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.model import add_mesh

#: Largest number of convex pieces of a neighbour. Hollows may be filled, since no hand reaches into them.
MOST_PIECES: Final = 8


def neighbour_of(obj: ObjectModel) -> Neighbour:
    """Return an object as a neighbour: at most `MOST_PIECES` convex pieces, merged by least added volume.
    Raises MeshError: the object is flat."""
    if any(obj.centre):
        middle, by = neighbour_of(obj.centred), np.array([*obj.centre, 1.0, 0, 0, 0])
        pieces = tuple(piece + by[:3] for piece in middle.pieces)
        return Neighbour(obj, pieces, tuple(solid.moved(by) for solid in middle.solids), middle.error_m, middle)
    return replace(_build_neighbour(obj), obj=obj)  # the same mesh may have another name


@cached_by_content(32)
def _build_neighbour(obj: ObjectModel) -> Neighbour:
    try:
        pieces = decompose(obj).vertices
    except MeshError:
        pieces = (obj.hull_vertices,)  # an obstacle may be larger than the object
    pieces = merge_pieces(pieces)
    solids = [enclosing_solid(piece) for piece in pieces]
    return Neighbour(obj, pieces, tuple(solid for solid, _ in solids), max(error for _, error in solids))


def merge_pieces(pieces: Sequence[Floats], most: int = MOST_PIECES) -> tuple[Floats, ...]:
    """Merge pieces until at most `most` remain.
    Each step joins the two pieces whose common hull adds the least volume."""
    left = list(pieces)
    volume = [union_volume((piece,)) for piece in left]

    def added_volume(a: int, b: int) -> float:
        return union_volume((np.concatenate([left[a], left[b]]),)) - volume[a] - volume[b]

    cost = {(a, b): added_volume(a, b) for a, b in combinations(range(len(left)), 2)} if len(left) > most else {}
    alive = set(range(len(left)))
    while len(alive) > most:
        a, b = min(cost, key=lambda pair: cost[pair])
        left.append(np.concatenate([left[a], left[b]]))
        volume.append(union_volume((left[-1],)))
        alive -= {a, b}
        cost = {pair: value for pair, value in cost.items() if not {a, b} & set(pair)}
        cost |= {(k, len(left) - 1): added_volume(k, len(left) - 1) for k in alive}
        alive.add(len(left) - 1)
    return tuple(left[k] for k in sorted(alive))


def scenes_of(
    spec: SceneSpec, obj: ObjectModel, others: Sequence[ObjectModel] = (), *, count: int, seed: int
) -> tuple[Scenes, dict[str, Floats]]:
    """Create `count` scenes from a specification (with `faces all`, one for each stable face).
    `others` are the objects of `spec.neighbours`, in this order. Return the scenes, and `scene/object_pose` (S, 7),
    `scene/rest_probability` (S,), `scene/drop_seconds` (S,); with neighbours also `scene/neighbour_pose` (S, M, 7).
    Raises SceneError: objects overlap, or do not fit. MeshError: an object never comes to rest, or is flat."""
    middle = _centred_spec(spec, obj, others)
    whole, poses = _scenes_of(middle, obj.centred, [other.centred for other in others], count=count, seed=seed)
    poses["scene/object_pose"] = to_file_frame(poses["scene/object_pose"], obj.centre)
    if not others:
        return replace(whole, object_pose=poses["scene/object_pose"]), poses
    beside = poses["scene/neighbour_pose"]
    for number, other in enumerate(others):
        beside[:, number] = to_file_frame(beside[:, number], other.centre)
    neighbours = tuple(neighbour_of(other) for other in others)
    return Scenes(whole.supports, poses["scene/object_pose"], neighbours, beside), poses


def _centred_spec(spec: SceneSpec, obj: ObjectModel, others: Sequence[ObjectModel]) -> SceneSpec:
    """Return the specification with poses of the objects' centres instead of their mesh origins."""

    def centred(pose: Any, thing: ObjectModel) -> Any:
        return None if pose is None else tuple(to_centred_frame(pose, thing.centre).tolist())

    pairs = zip(spec.neighbours, others, strict=False)
    beside = tuple(one.model_copy(update={"pose": centred(one.pose, other)}) for one, other in pairs)
    return spec.model_copy(update={"target": centred(spec.target, obj), "neighbours": beside})


def _scenes_of(
    spec: SceneSpec, obj: ObjectModel, others: Sequence[ObjectModel], *, count: int, seed: int
) -> tuple[Scenes, dict[str, Floats]]:
    supports = supports_of(spec)
    given = [one.pose for one in spec.neighbours if one.pose is not None]
    if given or not others:
        poses = rest_poses(spec, obj, count=count, seed=seed)
        if not others:
            return Scenes(supports, poses["scene/object_pose"]), poses
        poses["scene/neighbour_pose"] = np.tile(np.asarray(given, float), (len(poses["scene/object_pose"]), 1, 1))
    elif spec.faces == "drawn" and walled_area(spec) is None:
        try:
            poses = drop_together(obj, others, count=count, seed=seed)
        except MeshError:
            # With too many objects, no drop ends with all of them apart.
            poses = _place_objects(SceneSpec(kind="table"), obj, others, supports, count=count, seed=seed)
        require_no_penetration(obj, poses["scene/object_pose"], supports)
    else:
        poses = _place_objects(spec, obj, others, supports, count=count, seed=seed)
    beside = tuple(neighbour_of(other) for other in others)
    for number, other in enumerate(others):
        require_no_penetration(other, poses["scene/neighbour_pose"][:, number], supports)
    if given:
        whole = np.concatenate([poses["scene/object_pose"][:, None], poses["scene/neighbour_pose"]], axis=1)
        things = [neighbour_of(obj), *beside]
        for (a, b), gap in gaps_between(things, whole).items():
            if -gap.min() > SUNK:
                overlap = f"overlap by {-1e3 * gap.min():.1f} mm in scene {int(gap.argmin())}; move one of them"
                raise SceneError(f"{things[a].obj.name} and {things[b].obj.name} {overlap}")
    return Scenes(supports, poses["scene/object_pose"], beside, poses["scene/neighbour_pose"]), poses


def _place_objects(
    spec: SceneSpec,
    obj: ObjectModel,
    others: Sequence[ObjectModel],
    supports: Sequence[Obstacle],
    *,
    count: int,
    seed: int,
) -> dict[str, Floats]:
    """Place the object in its rest pose and the neighbours beside it; move the object if they do not fit."""
    poses = rest_poses(spec, obj, count=count, seed=seed)
    alone, size = poses["scene/object_pose"], walled_area(spec)

    def draw_pose(scene: int, draw: int) -> Floats:
        if size is None or not draw:
            return alone[scene]
        return move_inside(obj, alone[scene], size, np.random.default_rng([seed, scene, draw]))

    found, beside = place_neighbours(obj, draw_pose, others, supports, within=size, count=len(alone), seed=seed)
    return {**poses, "scene/object_pose": found, "scene/neighbour_pose": beside}


def gaps_between(things: Sequence[Neighbour], poses: Floats, farthest: float = 0.1) -> dict[tuple[int, int], Floats]:
    """Return signed distances (S,) of each pair of objects at poses (S, T, 7), at most `farthest` [m]."""
    spec: Any = mujoco.MjSpec()
    first = [0]
    for number, thing in enumerate(things):
        body = spec.worldbody.add_body(mocap=True)
        for k, corners in enumerate(thing.pieces):
            add_mesh(spec, body.add_geom(), corners, f"{number}-{k}")
        first.append(first[-1] + len(thing.pieces))
    model = spec.compile()
    data = mujoco.MjData(model)
    pairs = list(combinations(range(len(things)), 2))
    gaps = {pair: np.full(len(poses), farthest) for pair in pairs}
    for number, scene in enumerate(poses):
        data.mocap_pos[:], data.mocap_quat[:] = scene[:, :3], scene[:, 3:]
        mujoco.mj_kinematics(model, data)
        for a, b in pairs:
            geoms = product(range(first[a], first[a + 1]), range(first[b], first[b + 1]))
            gaps[a, b][number] = min(mujoco.mj_geomDistance(model, data, i, j, farthest, None) for i, j in geoms)
    return gaps


#: Largest number of faces of a simplified hull, and excess over its piece [m] that needs no further faces.
MOST_PLANES: Final = 48
ENOUGH_M: Final = 1e-3
#: Corners closer than this are merged [m].
_SAME_M: Final = 1e-7


def enclosing_solid(corners: Floats) -> tuple[Obstacle, float]:
    """Return a convex solid of at most `MOST_PLANES` faces around points (V, 3), and its excess [m].
    The excess is the largest distance of a corner from the points' hull. The solid begins as the points' bounding box.
    While the excess is above `ENOUGH_M`, the farthest corner is cut off along the hull's farthest face.
    Raises MeshError: the points lie in a plane."""
    from scipy.spatial import ConvexHull, HalfspaceIntersection, QhullError

    try:
        hull = ConvexHull(corners)
        faces = np.column_stack([hull.equations[:, :3], -hull.equations[:, 3]])
        axes = np.concatenate([np.eye(3), -np.eye(3)])
        planes = np.column_stack([axes, (corners @ axes.T).max(axis=0)])
        middle = corners[hull.vertices].mean(axis=0)
        found = HalfspaceIntersection(_as_qhull(planes), middle, incremental=True)
        while len(planes) < MOST_PLANES:
            depth = found.intersections @ faces[:, :3].T - faces[:, 3]
            out = depth.max(axis=1)
            worst = int(np.argmax(out))
            if out[worst] <= ENOUGH_M:
                break
            planes = np.vstack([planes, faces[int(np.argmax(depth[worst]))]])
            found.add_halfspaces(_as_qhull(planes[-1:]))
        solid = Obstacle(planes, *_corners_and_edges(found.intersections))
        found.close()
    except QhullError:
        raise MeshError("a convex piece of this object is flat; an object needs some thickness") from None
    import trimesh  # slow to load, seldom needed

    mesh = trimesh.Trimesh(corners, hull.simplices, process=False)
    _, distance, _ = trimesh.proximity.closest_point_naive(mesh, solid.corners)
    outside = (solid.corners @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1) > 0
    return solid, float(np.where(outside, distance, 0.0).max(initial=0.0))


def _as_qhull(planes: Floats) -> Floats:
    return np.column_stack([planes[:, :3], -planes[:, 3]])


def _corners_and_edges(points: Floats) -> tuple[Floats, NDArray[np.intp]]:
    """Return the distinct corners of a convex solid and the edges between them."""
    from scipy.spatial import ConvexHull

    _, first = np.unique(np.round(points / _SAME_M).astype(np.int64), axis=0, return_index=True)
    hull = ConvexHull(points[np.sort(first)])
    corners, triangles = outward_hull(hull.points, hull.simplices, hull.equations[:, :3])
    return corners, convex_edges(corners, triangles)
