"""Normals per face corner that are smooth on curved surfaces and sharp on edges."""

from __future__ import annotations

import numpy as np

from service.model.transforms import Floats
from worker.objects.model import Ints

#: Faces that meet at a larger angle [deg] keep their own normals: averaging over an edge rounds a cylinder's rim by
#: millimetres (research: the largest single effect on grasp quality).
CREASE_DEG = 40.0


def corner_normals(vertices: Floats, faces: Ints, crease_deg: float = CREASE_DEG) -> Floats:
    """(F, 3, 3) unit normals.

    The normal of a corner is the mean of the normals of the faces at its vertex, weighted by their angle there, over
    those faces that are inclined to the corner's own face by less than the crease angle.
    """
    from scipy.sparse import csr_matrix

    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    face_normals = np.cross(b - a, c - a)
    face_normals /= np.maximum(np.linalg.norm(face_normals, axis=1, keepdims=True), 1e-300)
    angles = _corner_angles(vertices[faces]).reshape(-1)
    count = 3 * len(faces)
    face_of = np.arange(count) // 3
    incidence = csr_matrix((np.ones(count), (np.arange(count), faces.reshape(-1))), shape=(count, len(vertices)))
    pairs = (incidence @ incidence.T).tocoo()
    near = np.einsum("ij,ij->i", face_normals[face_of[pairs.row]], face_normals[face_of[pairs.col]])
    keep = near > np.cos(np.deg2rad(crease_deg))
    row, column = pairs.row[keep], pairs.col[keep]
    weights = csr_matrix((angles[column], (row, face_of[column])), shape=(count, len(faces)))
    normals = weights @ face_normals
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 1e-12, normals / np.maximum(length, 1e-300), face_normals[face_of])
    return normals.reshape(-1, 3, 3)


def _corner_angles(corners: Floats) -> Floats:
    """(F, 3) angle of each triangle (F, 3, 3) at each corner [rad]."""
    out = np.roll(corners, -1, axis=1) - corners
    back = np.roll(corners, 1, axis=1) - corners
    cosine = np.einsum("ijk,ijk->ij", out, back) / np.maximum(
        np.linalg.norm(out, axis=2) * np.linalg.norm(back, axis=2), 1e-300
    )
    return np.arccos(np.clip(cosine, -1, 1))
