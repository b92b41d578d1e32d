"""Small meshes for tests, and damage to files."""

import numpy as np
from hypothesis import strategies as st
from manifold3d import Manifold
from numpy.typing import NDArray

from graspd.worker.objects.formats.bare import stl_bytes
from graspd.worker.objects.topology import from_manifold

Mesh = tuple[NDArray[np.float64], NDArray[np.int64]]


def box(x: float = 0.06, y: float = 0.05, z: float = 0.04, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Mesh:
    vertices, faces = from_manifold(Manifold.cube((x, y, z), True))
    return vertices + np.array(at), faces


def sphere(radius: float = 0.04, segments: int = 64, at: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> Mesh:
    vertices, faces = from_manifold(Manifold.sphere(radius, segments))
    return vertices + np.array(at), faces


def cylinder(radius: float = 0.03, height: float = 0.1, segments: int = 48) -> Mesh:
    return from_manifold(Manifold.cylinder(height, radius, -1.0, segments, True))


def join(*meshes: Mesh) -> Mesh:
    starts = np.cumsum([0, *(len(vertices) for vertices, _ in meshes[:-1])])
    faces = [faces + start for (_, faces), start in zip(meshes, starts, strict=True)]
    return np.concatenate([vertices for vertices, _ in meshes]), np.concatenate(faces)


def stl(mesh: Mesh) -> dict[str, bytes]:
    return {"m.stl": stl_bytes(*mesh)}


@st.composite
def damaged(draw: st.DrawFn, source: bytes, words: list[bytes]) -> bytes:
    """A file with a few spans replaced, dropped or repeated."""
    data = source
    for _ in range(draw(st.integers(1, 5))):
        start = draw(st.integers(0, len(data)))
        end = min(len(data), start + draw(st.integers(0, 60)))
        data = data[:start] + draw(st.sampled_from(words) | st.binary(max_size=16)) + data[end:]
    return data
