"""Named and coloured parts of an uploaded mesh: labelled samples of its surface, voxels of a region."""

from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.contact_region import RegionSpec
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import Floats
from graspd.worker.objects.disk_cache import content_digest
from graspd.worker.objects.distance import sample_faces
from graspd.worker.objects.formats import Soup
from graspd.worker.objects.memory_cache import cached_by_content
from graspd.worker.objects.topology import Indices, face_areas

#: Edge of a voxel [m], and largest number of voxels along a side of the object's box.
CELL_M: Final = 0.002
MOST_CELLS: Final = 128
#: Fewest and most samples of a surface; their mean spacing is half a voxel, unless there would be too many.
FEWEST: Final = 2000
MOST: Final = 200_000
#: Voxels farther from the surface than this are in no region [voxels].
REACH: Final = 4.0
#: Largest difference of a channel, 0 .. 1, between equal colours: colours of an OBJ are multiples of 1/8.
TOLERANCE: Final = 0.07
#: Largest number of names or colours in a list.
LISTED: Final = 20


@dataclass(frozen=True)
class SurfaceParts:
    """S even samples of an uploaded surface with the names and colours of their faces."""

    points: NDArray[np.float32]  # (S, 3) relative to the middle of the mesh [m]
    index: NDArray[np.uint16]  # (S,) row of `names`
    colours: NDArray[np.uint8]  # (S, 4) sRGB, and 1 for a known colour
    names: tuple[tuple[str, ...], ...]

    @cached_property
    def content(self) -> str:
        return content_digest(self)

    @property
    def listed(self) -> list[str]:
        """Names of the parts, at most `LISTED`."""
        return sorted({name for row in np.unique(self.index) for name in self.names[row]})[:LISTED]

    @property
    def listed_colours(self) -> list[str]:
        """Colours as #rrggbb by decreasing area, at most `LISTED`."""
        known, count = np.unique(self.colours[self.colours[:, 3] == 1, :3], axis=0, return_counts=True)
        order = np.argsort(-count, kind="stable")[:LISTED]
        return [f"#{r:02x}{g:02x}{b:02x}" for r, g, b in known[order].tolist()]

    def select(self, region: RegionSpec) -> NDArray[np.bool_]:
        """Return a mask (S,) of the samples in a part or of a colour."""
        if region.part:
            return np.isin(self.index, [row for row, names in enumerate(self.names) if region.part in names])
        wanted = np.frombuffer(bytes.fromhex(region.colour[1:]), np.uint8).astype(int)
        near = (np.abs(self.colours[:, :3] - wanted) <= 255 * TOLERANCE).all(axis=1)
        return near & (self.colours[:, 3] == 1)


def parts_of(soup: Soup, vertices: Floats, faces: Indices) -> SurfaceParts | None:
    """Return samples of a mesh in metres, with the soup's faces; None for one part in one colour."""
    paint = soup.colours if soup.paint is None else soup.paint
    colours = np.zeros((len(faces), 4), np.uint8)
    if paint is not None:
        known = np.isfinite(paint).all(axis=1)
        colours[known, :3] = np.round(255 * paint[known])
        colours[known, 3] = 1
    index = np.zeros(len(faces), np.int64) if soup.names is None else soup.names.index
    if (index == index[0]).all() and (colours == colours[0]).all():
        return None
    spacing = _cell(np.ptp(vertices, axis=0)) / 2
    count = int(np.clip(face_areas(vertices, faces).sum() / spacing**2, FEWEST, MOST))
    points, face = sample_faces(vertices, faces, count)
    names = ((),) if soup.names is None else soup.names.sets
    return SurfaceParts(points.astype(np.float32), index[face].astype(np.uint16), colours[face], names)


@dataclass(frozen=True)
class Voxels:
    """Voxels of a region in an object's box; a place beside it has the value of the nearest voxel."""

    inside: NDArray[np.bool_]  # (X, Y, Z)
    origin: Floats  # (3,) lowest corner of the first voxel, object frame [m]
    cell: float  # edge of a voxel [m]

    @cached_property
    def content(self) -> str:
        return content_digest(self)

    def contains(self, points: Floats) -> NDArray[np.bool_]:
        """Return a mask (...) of the points (..., 3) in the region."""
        number = np.floor((points - self.origin) / self.cell)
        x, y, z = np.moveaxis(np.clip(number, 0, np.array(self.inside.shape) - 1).astype(int), -1, 0)
        return np.asarray(self.inside[x, y, z])


@cached_by_content(8)
def voxels_of(parts: SurfaceParts | None, region: RegionSpec, low: Floats, high: Floats, name: str) -> Voxels:
    """Return the voxels of a part or colour in a box from `low` to `high` (3,) about the middle [m].
    A voxel is inside if the sample nearest to its centre is. Raises InputError: object `name` has no such part."""
    from scipy.spatial import cKDTree

    if parts is None or not parts.select(region).any():
        known = [] if parts is None else parts.listed_colours if region.colour else parts.listed
        kind = "colours" if region.colour else "named parts"
        what = f"its {kind} are {', '.join(known)}" if known else f"its mesh has no {kind} to choose from"
        raise InputError(f"{name} has no {region}: {what}")
    cell = _cell(high - low)
    shape = np.maximum(np.ceil((high - low) / cell - 1e-6), 1).astype(int)
    centres = low + (np.stack(np.meshgrid(*map(np.arange, shape), indexing="ij"), axis=-1) + 0.5) * cell
    _, nearest = cKDTree(parts.points).query(centres.reshape(-1, 3), distance_upper_bound=REACH * cell)
    inside = np.append(parts.select(region), False)[nearest].reshape(shape)
    return Voxels(inside, low, cell)


def _cell(extents: Floats) -> float:
    return max(CELL_M, float(extents.max()) / MOST_CELLS)
