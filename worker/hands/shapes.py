"""Collision elements of a robot as convex pieces: primitives stay exact, meshes become reduced hulls."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from service.model.errors import HandError, MeshError
from service.model.transforms import IDENTITY_POSE, Floats, apply
from worker.hands.hollows import parts_of
from worker.hands.model import ConvexPiece
from worker.hands.primitives import new_hull, signed_distance, tessellate, volume
from worker.hands.references import find_mesh
from worker.hands.robot import Ints, Shape
from worker.objects.formats import read_mesh
from worker.objects.kept_arrays import recalled

#: A hull of V corners has at most 2 V - 4 triangles: 96 here. Every plane costs time in each distance query.
MAX_HULL_VERTICES: Final = 50
#: A link longer than this [m] is a mesh in millimetres without a scale.
MAX_PIECE_M: Final = 2.0


Hulls = dict[tuple[str, tuple[float, ...]], list[tuple[Floats, Ints]]]


def make_pieces(
    shape: Shape, *, body: int, pose: Floats, link: str, files: Mapping[str, bytes], base: str, hulls: Hulls
) -> list[ConvexPiece]:
    """The convex pieces of a collision element: one, but of a mesh with hollows several.

    Args:
        shape: the element.
        body: index of the body it moves with.
        pose: (7,) pose of the element's frame in the body frame.
        link: link it comes from.
        files: all files of the hand.
        base: folder of the robot's description inside `files`.
        hulls: hulls of this hand's meshes so far, by name and scale: a fingertip is often used for every finger.

    Raises:
        HandError: a mesh is missing, outside the upload, unreadable, flat or far too large.
    """
    if shape.kind != "mesh":
        vertices, faces = tessellate(shape.kind, shape.size)
        return [ConvexPiece(body, shape.kind, shape.size, pose, apply(pose, vertices), faces, link)]
    name = ""
    try:
        if shape.mesh is not None:
            found = _hulls(*shape.mesh)
        else:
            name = find_mesh(shape.filename, files, base, link)
            key = (name, shape.size)
            if key not in hulls:
                hulls[key] = _mesh_hulls(name, shape.size, files[name], link)
            found = hulls[key]
    except HandError as error:
        if repr(link) in str(error):
            raise
        raise HandError(f"collision mesh {f'{name!r} ' if name else ''}of link {link!r}: {error}") from None
    return [
        ConvexPiece(body, "hull", (), IDENTITY_POSE.copy(), apply(pose, vertices), faces, link)
        for vertices, faces in found
    ]


def _mesh_hulls(name: str, scale: tuple[float, ...], data: bytes, link: str) -> list[tuple[Floats, Ints]]:
    try:
        soup = read_mesh(name, data)
    except MeshError as error:
        raise HandError(f"collision mesh of link {link!r}: {error}") from None
    points = soup.vertices * np.asarray(scale)
    if np.ptp(points, axis=0).max() > MAX_PIECE_M:
        raise HandError(
            f"collision mesh {name!r} of link {link!r} is {np.ptp(points, axis=0).max():.3g} m long; "
            'if it is in millimetres give it scale="0.001 0.001 0.001"'
        )
    return _hulls(points, soup.faces.astype(np.int32))


def _hulls(points: Floats, faces: Ints) -> list[tuple[Floats, Ints]]:
    parts = parts_of(points, faces)
    # A hull is that of all points of a file; some have points that no face names.
    return [reduce_hull(part) for part in (parts if len(parts) > 1 else (points,))]


def reduce_hull(points: Floats, limit: int = MAX_HULL_VERTICES) -> tuple[Floats, Ints]:
    """Convex hull of points (N, 3) with at most `limit` corners and the volume of the full hull.

    The corners are chosen one by one where the hull so far is farthest from the full one, then grown about their
    centroid until the volumes agree: the surface errs to both sides by half of what an inscribed hull would.
    """
    made = recalled("reduced hull", [points, np.array(limit)], lambda: _reduced(points, limit))
    return made["0"], made["1"]


def _reduced(points: Floats, limit: int) -> tuple[Floats, Ints]:
    vertices, faces = new_hull(points)
    if len(vertices) <= limit:
        return vertices, faces
    full = volume("hull", (), vertices, faces)
    directions = np.concatenate([np.eye(3), -np.eye(3)])
    chosen = list(dict.fromkeys(np.argmax(vertices @ directions.T, axis=0).tolist()))
    while len(chosen) < limit:
        farthest = int(np.argmax(_outside(vertices, vertices[chosen])))
        if farthest in chosen:
            break
        chosen.append(farthest)
    corners, faces = new_hull(vertices[chosen])
    centre = corners.mean(axis=0)
    growth = (full / volume("hull", (), corners, faces)) ** (1 / 3)
    return centre + (corners - centre) * growth, faces


def _outside(points: Floats, corners: Floats) -> Floats:
    """(N,) how far points (N, 3) lie outside the hull of a few of them; from the nearest corner while that is flat."""
    spread = np.linalg.svd(corners - corners.mean(axis=0), compute_uv=False)
    if len(corners) < 4 or spread[2] < 1e-6 * spread[0]:
        return np.linalg.norm(points[:, None] - corners[None], axis=2).min(axis=1)
    return signed_distance("hull", (), *new_hull(corners), points)
