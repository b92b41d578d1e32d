"""The same hand with other collision shapes, as in another author's model of it.

hull: one convex hull per link. primitive: the best-fitting box, cylinder or capsule of each hull. capsule: a capsule
for each piece whose width and thickness are similar. All of these may be grown or shrunk."""

import math
from dataclasses import replace
from itertools import groupby
from typing import Final, Literal

import numpy as np

from graspd.service.model.transforms import IDENTITY_POSE, Floats, apply, invert, quat_from_matrix
from graspd.worker.hands.collisions import collision_exempt_pairs
from graspd.worker.hands.model import ConvexPiece, HandModel
from graspd.worker.hands.primitives import hull, sample, signed_distance, tessellate, volume

Fit = Literal["own", "hull", "primitive", "capsule"]

WIDE: Final = 1.5  # a piece with a larger ratio of width to thickness than this is not replaced by a capsule
_LEFT: Final = 0.5  # a shrunk piece keeps at least this share of its half thickness
_SAMPLES: Final = 400
_SHORTEST: Final = 1e-3  # least length of a capsule over its radius
_PRIMITIVES: Final = ("box", "cylinder", "capsule")


def refit_hand(hand: HandModel, fit: Fit, grown_m: float = 0.0) -> HandModel:
    """Return the hand with its collision shapes replaced, then grown by `grown_m` [m] (negative: shrunk).
    Contacts of bodies whose new shapes touch at rest are ignored."""
    pieces = hand.pieces
    if fit == "hull":
        out: list[ConvexPiece] = []
        ordered = sorted(hand.pieces, key=lambda piece: (piece.body, piece.link))
        for _, group in groupby(ordered, key=lambda piece: (piece.body, piece.link)):
            parts = list(group)
            if len(parts) > 1:
                vertices, faces = hull(np.concatenate([part.vertices for part in parts]))
                parts = [ConvexPiece(parts[0].body, "hull", (), IDENTITY_POSE.copy(), vertices, faces, parts[0].link)]
            out += parts
        pieces = tuple(out)
    elif fit != "own":
        pieces = tuple(_fit_piece(piece, fit) for piece in pieces)
    if grown_m:
        pieces = tuple(offset_piece(piece, grown_m) for piece in pieces)
    if len(pieces) == len(hand.pieces) and all(a is b for a, b in zip(pieces, hand.pieces, strict=True)):
        return hand
    other = replace(hand, pieces=pieces)
    return replace(other, neighbours=hand.neighbours | collision_exempt_pairs(other))


def applicable_fits(hand: HandModel) -> frozenset[Fit]:
    links = {(piece.body, piece.link) for piece in hand.pieces}
    found: set[Fit] = set()
    if len(links) < len(hand.pieces):
        found.add("hull")
    if any(piece.kind == "hull" for piece in hand.pieces):
        found.add("primitive")
    if any(piece.kind not in ("capsule", "sphere") and _is_round(piece) for piece in hand.pieces):
        found.add("capsule")
    return frozenset(found)


def offset_piece(piece: ConvexPiece, by_m: float) -> ConvexPiece:
    """Return a piece with its surface offset by `by_m` [m] along all face normals (negative: inwards).
    Boxes and cylinders keep their edges; capsules and spheres are offset exactly. Corners of a hull are cut at the
    surface of the Minkowski sum with a ball. A piece too thin to shrink by this much keeps half of its thickness."""
    if piece.kind == "hull":
        vertices, faces = hull(_offset_hull(piece.vertices, by_m))
        return replace(piece, vertices=vertices, faces=faces)
    size = np.array(piece.size)
    half = size / 2 if piece.kind == "box" else np.array([size[0]])
    by = max(by_m, -_LEFT * float(half.min()))
    match piece.kind:
        case "box":
            size = size + 2 * by
        case "cylinder":
            by = max(by, -_LEFT * size[1] / 2)
            size = size + np.array([by, 2 * by])
        case _:
            size = np.concatenate([size[:1] + by, size[1:]])
    return _primitive(piece, piece.kind, tuple(float(s) for s in size), piece.pose)


def _primitive(piece: ConvexPiece, kind: str, size: tuple[float, ...], pose: Floats) -> ConvexPiece:
    vertices, faces = tessellate(kind, size)
    return replace(piece, kind=kind, size=size, pose=pose, vertices=apply(pose, vertices), faces=faces)


def _fit_piece(piece: ConvexPiece, fit: Fit) -> ConvexPiece:
    if fit == "primitive":
        if piece.kind != "hull":
            return piece
        found = [_primitive_like(piece, kind) for kind in _PRIMITIVES]
        return min(found, key=lambda one: _mean_distance(one, piece))
    return piece if piece.kind in ("capsule", "sphere") or not _is_round(piece) else _primitive_like(piece, "capsule")


def _moments(piece: ConvexPiece) -> tuple[float, Floats, Floats, Floats]:
    """Return volume, centre, principal variances (3,) in ascending order, and the axes as columns."""
    import trimesh  # slow to import, as SciPy below

    solid = trimesh.Trimesh(piece.vertices, piece.faces, process=False)
    inertia = np.asarray(solid.moment_inertia)
    spread, axes = np.linalg.eigh((np.trace(inertia) / 2 * np.eye(3) - inertia) / solid.volume)
    if np.linalg.det(axes) < 0:
        axes[:, 0] *= -1
    return float(solid.volume), np.asarray(solid.center_mass), spread, axes


def _is_round(piece: ConvexPiece) -> bool:
    """Check whether a box of the same second moments has a section of similar width and thickness."""
    low, middle, _ = np.sqrt(3 * _moments(piece)[2])
    return bool(middle <= WIDE * low)


def _primitive_like(piece: ConvexPiece, kind: str) -> ConvexPiece:
    """Return a primitive with a piece's centre, principal axes and volume, proportioned by second moments."""
    solid, centre, spread, axes = _moments(piece)
    long = 2
    if kind == "cylinder" and spread[2] - spread[1] < spread[1] - spread[0]:
        # A disc: its short axis is the symmetry axis.
        long = 0
    order = [(long + 1) % 3, (long + 2) % 3, long]
    spread, axes = spread[order], axes[:, order]
    across = float(spread[:2].mean())
    radius = 2 * math.sqrt(across)
    size = {
        "box": tuple(float(side) for side in np.sqrt(12 * spread)),
        "cylinder": (radius, math.sqrt(12 * float(spread[2]))),
        "capsule": _capsule_size(solid, across),
    }[kind]
    scale = (solid / volume(kind, size, *tessellate(kind, size))) ** (1 / 3)
    pose = np.concatenate([centre, quat_from_matrix(axes)])
    return _primitive(piece, kind, tuple(scale * side for side in size), pose)


def _capsule_size(solid: float, across: float) -> tuple[float, float]:
    """Return radius and length of a capsule of a volume [m^3] and a variance across its axis [m^2].
    The variance is r^2 (1 / 4 - s / 20), where s is the caps' share of the volume: 1 for a ball. The solution iterates,
    since s grows with r^3 and has little effect on r."""
    radius = 2 * math.sqrt(across)
    for _ in range(20):
        caps = min(1.0, 4 / 3 * math.pi * radius**3 / solid)
        radius = math.sqrt(across / (0.25 - caps / 20))
    return radius, max(_SHORTEST * radius, solid / (math.pi * radius**2) - 4 * radius / 3)


def _mean_distance(one: ConvexPiece, piece: ConvexPiece) -> float:
    """Return the mean distance of a piece's surface from the surface of a primitive [m]."""
    points, _ = sample("hull", (), piece.vertices, piece.faces, _SAMPLES, np.random.default_rng(0))
    local = apply(invert(one.pose), points)
    return float(np.abs(signed_distance(one.kind, one.size, one.vertices, one.faces, local)).mean())


def _offset_hull(vertices: Floats, by_m: float) -> Floats:
    """Return the corners of a convex solid with its faces moved outward by `by_m` [m].
    The result is the intersection of half-spaces along the face normals and, if growing, the mean normals at corners.
    In these directions it has the support function of the Minkowski sum with a ball."""
    from scipy.spatial import ConvexHull, HalfspaceIntersection

    scale = float(np.ptp(vertices, axis=0).max())
    points, by = (vertices - vertices.mean(axis=0)) / scale, by_m / scale
    solid = ConvexHull(points)
    normals = np.unique(np.round(solid.equations[:, :3], 9), axis=0)
    inside = points.mean(axis=0)
    if by < 0:
        inside, depth = _largest_ball(solid.equations)
        by = max(by, -_LEFT * depth)
    else:
        corner = np.zeros_like(points)
        for face, normal in zip(solid.simplices, solid.equations[:, :3], strict=True):
            corner[face] += normal
        corner = corner[solid.vertices]
        normals = np.concatenate([normals, corner / np.linalg.norm(corner, axis=1, keepdims=True)])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    reach = (normals @ points.T).max(axis=1) + by
    found = HalfspaceIntersection(np.column_stack([normals, -reach]), inside).intersections
    return np.asarray(found * scale + vertices.mean(axis=0))


def _largest_ball(planes: Floats) -> tuple[Floats, float]:
    """Return centre and radius of the largest ball in a convex solid of unit planes (F, 4): n x + b <= 0."""
    from scipy.optimize import linprog

    found = linprog([0, 0, 0, -1], np.column_stack([planes[:, :3], np.ones(len(planes))]), -planes[:, 3],
                    bounds=[(None, None)] * 3 + [(0, None)])  # fmt: skip
    assert found.x is not None, "a convex solid holds a ball"
    return np.asarray(found.x[:3]), float(found.x[3])
