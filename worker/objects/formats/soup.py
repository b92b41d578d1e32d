"""Triangles as a file gives them, checked for what no later step could survive."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.errors import LimitError, MeshError

MAX_FACES: Final = 1_000_000
#: Coordinates beyond this are no length in any unit.
MAX_COORDINATE: Final = 1e11


@dataclass(frozen=True)
class Soup:
    """Vertices (V, 3) in the file's unit and triangles (F, 3) as indices; nothing is known of their topology."""

    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    colours: NDArray[np.float64] | None = None
    """(F, 3) sRGB colour of each face, 0 .. 1, NaN where none is stated; None: no face has one."""

    def by_colour(self) -> list[tuple[tuple[float, float, float] | None, NDArray[np.intp]]]:
        """Each colour with the indices of its faces; None for those without."""
        if self.colours is None:
            return [(None, np.arange(len(self.faces)))]
        # NaN is not equal to itself; no colour is below 0.
        known, index = np.unique(np.nan_to_num(np.round(self.colours, 3), nan=-1.0), axis=0, return_inverse=True)
        return [
            (None if rgb[0] < 0 else (float(rgb[0]), float(rgb[1]), float(rgb[2])), np.flatnonzero(index == i))
            for i, rgb in enumerate(known)
        ]


def check_soup(soup: Soup) -> Soup:
    """The soup itself if it has faces, sound indices and finite vertices."""
    vertices, faces = soup.vertices, soup.faces
    if not len(faces):
        raise MeshError("the mesh has no faces; export the surface, not points alone")
    check_face_count(len(faces))
    bad = (faces < 0) | (faces >= len(vertices))
    if bad.any():
        row = int(np.flatnonzero(bad.any(axis=1))[0])
        raise MeshError(f"face {row} has an index outside the {len(vertices)} vertices; export the mesh again")
    used = vertices[np.unique(faces)]
    if not np.isfinite(used).all():
        raise MeshError("a vertex is not finite (NaN or infinity); repair the mesh where it was made")
    if np.abs(used).max() > MAX_COORDINATE:
        raise MeshError(f"a coordinate exceeds {MAX_COORDINATE:g}; the file is damaged or in no known unit")
    return soup


def check_face_count(count: int) -> None:
    """LimitError for more faces than are taken."""
    if count > MAX_FACES:
        raise LimitError(f"{count} faces; at most {MAX_FACES} are taken: decimate the mesh first")
