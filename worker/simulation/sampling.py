"""Even samples of a mesh's surface."""

import sys

import numpy as np

from graspd.service.model.transforms import Floats
from graspd.worker.hands import surface
from graspd.worker.hands.surface import farthest_points
from graspd.worker.objects import mesh_geometry, topology
from graspd.worker.objects.disk_cache import cached_arrays
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.topology import directed_edges, face_vectors

#: Edges whose faces turn by more than 35 degrees have samples of their own: such an edge may enter a link unseen.
SHARP_EDGE_COS = np.cos(np.radians(35.0))
#: Random points per selected sample, fewer for more than `MANY` samples: the cost grows with both numbers' product.
CANDIDATES, FEWER_CANDIDATES, MANY = 6, 3, 8_000


def object_samples(obj: ObjectModel, count: int, *, seed: int = 0) -> Floats:
    """Return evenly spread points (count, 3) of the surface, its sharp edges included [m]; deterministic."""
    code = (sys.modules[__name__], mesh_geometry, surface, topology)
    terms = (obj.content, count, seed)
    return cached_arrays("object_samples", terms, code, lambda: {"points": _sample_surface(obj, count, seed)})["points"]


def _sample_surface(obj: ObjectModel, count: int, seed: int) -> Floats:
    rng = np.random.default_rng(seed)
    candidates = (CANDIDATES if count <= MANY else FEWER_CANDIDATES) * count
    cross = face_vectors(obj.vertices, obj.faces)
    area = np.linalg.norm(cross, axis=1)
    faces = rng.choice(len(area), size=candidates, p=area / area.sum())
    u, v = rng.random((2, candidates, 1))
    inner = mesh_geometry.points_on_triangles(obj.vertices[obj.faces[faces]], u, v)
    edges = _edge_samples(obj, cross / area[:, None].clip(1e-18), count, rng)
    points = np.concatenate([edges, inner])
    return points[farthest_points(points, count)]


def _edge_samples(obj: ObjectModel, normals: Floats, count: int, rng: np.random.Generator) -> Floats:
    """Return up to count / 2 random points on sharp edges, uniform in length."""
    edges = np.sort(directed_edges(obj.faces.astype(np.int64)), axis=1)
    face = np.tile(np.arange(len(obj.faces)), 3)
    order = np.lexsort((edges[:, 1], edges[:, 0]))
    edges, face = edges[order], face[order]
    twin = np.flatnonzero((edges[:-1] == edges[1:]).all(axis=1))
    sharp = np.einsum("ij,ij->i", normals[face[twin]], normals[face[twin + 1]]) < SHARP_EDGE_COS
    ends = obj.vertices[edges[twin[sharp]]]
    if len(ends) == 0:
        return np.zeros((0, 3))
    length = np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1)
    pick = rng.choice(len(ends), size=count // 2, p=length / length.sum())
    t = rng.random((len(pick), 1))
    return ends[pick, 0] * (1 - t) + ends[pick, 1] * t
