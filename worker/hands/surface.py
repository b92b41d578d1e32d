"""Fixed, even sample of the hand's outer surface, with normals and the area of each point."""

import sys
from dataclasses import dataclass
from functools import cached_property, partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model import transforms
from graspd.service.model.errors import HandError
from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, invert, quat_rotate
from graspd.worker.hands import kinematics, primitives
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.model import ConvexPiece, HandModel, SurfacePoints
from graspd.worker.objects.disk_cache import cached_arrays, content_digest
from graspd.worker.objects.memory_cache import cached_by_content

#: Candidates per point. Thinning keeps one in five, evenly spread.
OVERSAMPLING: Final = 5
#: Least number of candidates on the whole hand, which determine the exterior area.
MIN_CANDIDATES: Final = 30_000
#: A point this deep inside another body at rest can never touch an object [m].
BURIED_M: Final = 5e-4
#: Two faces of one body closer than this are one face [m].
COINCIDENT_M: Final = 1e-6


def sample_surface(hand: HandModel, count: int, *, seed: int = 0) -> SurfacePoints:
    """Sample exactly `count` points on the union of the hand's pieces.
    Area-uniform candidates are thinned body by body by farthest-point selection. Each point gets the area of its
    Voronoi cell among the candidates, so the areas sum to the exterior area. Parts inside another piece have no points.
    Raises HandError: the hand has no outer surface."""
    # The cache key excludes closing and palm, since these are derived from such points.
    rest = body_poses(hand, IDENTITY_POSE, hand.expand(hand.preshape))[0]
    return _cached_samples(_Shapes(hand.pieces, rest), count, seed)


@dataclass(frozen=True)
class _Shapes:
    pieces: tuple[ConvexPiece, ...]
    rest: Floats  # (L, 7) poses of the hand's bodies

    @cached_property
    def content(self) -> str:
        return content_digest(self)


@cached_by_content(64)
def _cached_samples(shapes: _Shapes, count: int, seed: int) -> SurfacePoints:
    code = (sys.modules[__name__], primitives, kinematics, transforms)
    make = partial(_sample, shapes, count, seed)
    return SurfacePoints(**cached_arrays("hand_samples", (shapes.content, count, seed), code, lambda: vars(make())))


def _sample(shapes: _Shapes, count: int, seed: int) -> SurfacePoints:
    from scipy.spatial import cKDTree

    bodies, candidates = len(shapes.rest), _exposed_points(shapes, max(OVERSAMPLING * count, MIN_CANDIDATES), seed)
    if len(candidates) < count:
        # Most of the surface is hidden inside other pieces: sample once more, in proportion.
        more = max(OVERSAMPLING * count, MIN_CANDIDATES) * count * OVERSAMPLING // max(len(candidates), 1)
        candidates = _exposed_points(shapes, min(more, 5_000_000), seed)
    if len(candidates) < count:
        raise HandError(
            f"the outer surface of the hand gives {len(candidates)} points where {count} are needed: its pieces lie "
            "inside one another; correct its collision shapes"
        )
    area_of_body = np.bincount(candidates.body, candidates.area, minlength=bodies).astype(float)
    available = np.bincount(candidates.body, minlength=bodies)
    quota = apportion(area_of_body, count, available)
    chosen, areas = [], []
    for body in np.flatnonzero(quota):
        mine = np.flatnonzero(candidates.body == body)
        spacing = np.sqrt(area_of_body[body] / quota[body])
        # Normals are part of the distance, so that the two sides of a thin plate do not thin each other out.
        place = np.hstack([candidates.position[mine], 0.5 * spacing * candidates.normal[mine]])
        picked = farthest_points(place, int(quota[body]))
        _, owner = cKDTree(place[picked]).query(place)
        areas.append(np.bincount(owner, candidates.area[mine], minlength=len(picked)).astype(float))
        chosen.append(mine[picked])
    index = np.concatenate(chosen)
    return SurfacePoints(
        candidates.body[index], candidates.position[index], candidates.normal[index], np.concatenate(areas)
    )


def _exposed_points(hand: _Shapes, count: int, seed: int) -> SurfacePoints:
    """Return about `count` area-uniform points on the pieces, without buried ones."""
    rng = np.random.default_rng([seed, 0x5EED])
    shares = np.array([primitives.area(p.kind, p.size, p.vertices, p.faces) for p in hand.pieces])
    numbers = np.maximum(np.ceil(count * shares / shares.sum()).astype(int), 8)
    parts = []
    for i, (piece, number) in enumerate(zip(hand.pieces, numbers, strict=True)):
        vertices = _local_vertices(piece)
        local, direction = primitives.sample(piece.kind, piece.size, vertices, piece.faces, int(number), rng)
        position, normal = apply(piece.pose, local), quat_rotate(piece.pose[3:], direction)
        keep = ~_buried_mask(hand, i, position, normal)
        body, area = np.full(len(keep), piece.body, np.int32), np.full(len(keep), shares[i] / number)
        parts.append((body[keep], position[keep], normal[keep], area[keep]))
    return SurfacePoints(*(np.concatenate(columns) for columns in zip(*parts, strict=True)))


def _local_vertices(piece: ConvexPiece) -> Floats:
    return apply(invert(piece.pose), piece.vertices)


def piece_distance(piece: ConvexPiece, points: Floats) -> Floats:
    """Return the signed distance (N,) of points (N, 3) in the body frame to a piece, negative inside [m]."""
    local = apply(invert(piece.pose), points)
    return primitives.signed_distance(piece.kind, piece.size, _local_vertices(piece), piece.faces, local)


def _buried_mask(hand: _Shapes, own: int, position: Floats, normal: Floats) -> NDArray[np.bool_]:
    """Return a mask (N,) of points of piece `own` inside another piece or on a face of an earlier piece."""
    mine = hand.pieces[own]
    above, below = position + COINCIDENT_M * normal, position - COINCIDENT_M * normal
    world = apply(hand.rest[mine.body], position)
    low, high = world.min(axis=0), world.max(axis=0)
    buried = np.zeros(len(position), dtype=bool)
    for other, piece in enumerate(hand.pieces):
        if other == own:
            continue
        corners = apply(hand.rest[piece.body], piece.vertices)
        if (corners.min(axis=0) > high + BURIED_M).any() or (corners.max(axis=0) < low - BURIED_M).any():
            continue
        if piece.body != mine.body:
            local = apply(invert(hand.rest[piece.body]), world)
            buried |= piece_distance(piece, local) < -BURIED_M
            continue
        buried |= piece_distance(piece, above) < 0
        if other < own:
            buried |= (piece_distance(piece, below) < 0) & (np.abs(piece_distance(piece, position)) < COINCIDENT_M)
    return buried


def apportion(weights: Floats, count: int, available: NDArray[np.intp]) -> NDArray[np.int64]:
    """Distribute `count` by largest remainder in proportion to weights (L,), up to `available` (L,) each."""
    seats = np.zeros(len(weights), dtype=np.int64)
    while (left := count - int(seats.sum())) > 0:
        open_weights = np.where(seats < available, weights, 0.0)
        if open_weights.sum() <= 0:
            open_weights = (seats < available).astype(float)
        exact = left * open_weights / open_weights.sum()
        more = np.floor(exact).astype(np.int64)
        order = np.argsort(more - exact, kind="stable")
        more[order[: left - int(more.sum())]] += 1
        seats = np.minimum(seats + more, available)
    return seats


def farthest_points(points: Floats, count: int) -> NDArray[np.intp]:
    """Return indices of `count` points of (N, K), each farthest from those before it (Gonzalez 1985)."""
    chosen = np.empty(count, dtype=np.intp)
    chosen[0] = int(np.argmax(((points - points.mean(axis=0)) ** 2).sum(axis=1)))
    nearest = np.full(len(points), np.inf)
    squares = np.einsum("ij,ij->i", points, points)
    for i in range(1, count):
        last = points[chosen[i - 1]]
        np.minimum(nearest, squares - 2 * (points @ last) + last @ last, out=nearest)
        # Rounding may leave a chosen point a small distance, but it must not be chosen twice.
        nearest[chosen[i - 1]] = -1.0
        chosen[i] = int(np.argmax(nearest))
    return chosen
