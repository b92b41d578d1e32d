"""Repair the triangles of a file to one closed, outward solid, or raise an error with the fix.

Every change is reported: after silent repairs, results of a dataset could not be explained."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from graspd.service.model.errors import MeshError
from graspd.service.model.object_options import ObjectOptions
from graspd.service.model.transforms import Floats
from graspd.worker.grasps import round_to_grid
from graspd.worker.objects import mesh_geometry, topology
from graspd.worker.objects.distance import MeshDistance, surface_points
from graspd.worker.objects.formats import Soup
from graspd.worker.objects.intersections import intersecting_faces, unite_self_overlaps
from graspd.worker.objects.mesh_geometry import CentredMesh, centre_points, signed_volume
from graspd.worker.objects.options import UNITS
from graspd.worker.objects.parts import SurfaceParts, parts_of
from graspd.worker.objects.topology import Indices

MAX_EXTENT_M: Final = 3.0
MIN_EXTENT_M: Final = 1e-3
#: Range of extents of graspable objects, and the median extent of YCB objects [m], for hints on units.
HAND_SIZES_M: Final = (0.02, 0.6)
TYPICAL_SIZE_M: Final = 0.12
#: Largest gap between parts of one rigid body [m]; assemblies have such gaps between joined parts.
JOINED_M: Final = 1e-3
#: Vertices closer than this share of the longest extent are merged.
MERGE: Final = 1e-8
#: Tolerance for welding open seams, as a share of the longest extent.
WELD: Final = 1e-5
#: Largest rim of a hole that is filled, as a share of the longest extent.
HOLE: Final = 0.03
#: Volume below which components are dropped as scan debris, as a share of the largest component's volume.
DEBRIS: Final = 1e-6
#: Spacing of coordinates at the mesh's position above which there is a warning [m].
COARSE_M: Final = 1e-4
#: Mean wall thickness [m] below which a warning is given: a thinner wall can pass between hand points.
THIN_M: Final = 2.5e-3
#: Number of points besides the vertices at which the repaired surface is compared with the original.
_SAMPLES: Final = 4000


@dataclass(frozen=True)
class RepairedMesh:
    """Mesh in metres, with a list of changes and a list of accepted anomalies."""

    vertices: Floats  # (V, 3) relative to the middle of the mesh
    faces: Indices
    watertight: bool = True
    repairs: tuple[str, ...] = ()
    notes: tuple[str, ...] = ()
    self_intersections: int | None = None  # pairs of faces that still intersect; None if not checked
    moved_m: float = 0.0  # largest distance of the repaired surface from the original [m]
    centre: tuple[float, float, float] = (0.0, 0.0, 0.0)  # the middle in the file's frame [m]
    parts: SurfaceParts | None = None
    matter: Mapping[str, float] = field(default_factory=dict)  # see `Soup`
    inertial: tuple[Floats, Floats] | None = None
    """Stated centre of mass (3,) relative to the middle [m], and inertia (3, 3) about it per unit of mass [m^2]."""

    def with_faces(self, vertices: Floats, faces: Indices, repair: str) -> RepairedMesh:
        return replace(self, vertices=vertices, faces=faces, repairs=(*self.repairs, repair))


def repair(soup: Soup, options: ObjectOptions) -> RepairedMesh:
    """Convert the soup to a solid in metres.
    Raises MeshError: wrong units, no volume, holes, several components; the message states the fix."""
    try:
        given = _to_metres(soup, options)
        if soup.is_rigid and not options.keep_largest:
            options = options.model_copy(update={"rigid": True})
        mesh = _make_solid(given, options)
    except MeshError as error:
        found, unit = centre_points(soup.vertices[np.unique(soup.faces)]), UNITS[options.units]
        if found.resolution * unit <= max(COARSE_M, 1e-3 * unit * float(np.ptp(found.points, axis=0).max())):
            raise
        raise MeshError(f"{error}; {_resolution_note(found, unit)}", facts=error.facts) from None
    mesh = replace(mesh, parts=parts_of(soup, given.vertices, given.faces), matter=soup.matter)
    mesh = _with_inertial(mesh, soup)
    if not mesh.repairs:
        return mesh
    moved = MeshDistance(given.vertices, given.faces).largest(surface_points(mesh.vertices, mesh.faces, _SAMPLES))
    return replace(mesh, moved_m=moved)


def _with_inertial(mesh: RepairedMesh, soup: Soup) -> RepairedMesh:
    """Take the stated centre of mass and inertia if masses inside the mesh's bounds can have them."""
    if soup.inertial is None:
        return mesh
    extent, low, high = (f(mesh.vertices, axis=0) for f in (np.ptp, np.min, np.max))
    unit = float(extent.max() / np.ptp(soup.vertices[np.unique(soup.faces)], axis=0).max())
    centre, inertia = soup.inertial[0] * unit - mesh.centre, soup.inertial[1] * unit**2
    moments = np.linalg.eigvalsh(inertia) if np.isfinite(inertia).all() else np.zeros(3)
    reach = np.maximum(high - centre, centre - low)
    inside = bool((reach <= extent).all())
    # Half the sum of the moments is the mean squared distance; no moment exceeds the sum of the other two.
    if inside and moments[0] > 0 and moments[2] <= 1.001 * moments[:2].sum() and moments.sum() / 2 <= reach @ reach:
        return replace(mesh, inertial=(centre, inertia))
    note = "no body of this size has the stated inertia; it is computed for uniform density"
    return replace(mesh, notes=(*mesh.notes, note)) if np.isfinite(inertia).all() else mesh


def _make_solid(mesh: RepairedMesh, options: ObjectOptions) -> RepairedMesh:
    mesh = _close_surface(_clean(mesh))
    if not topology.is_closed(mesh.faces):
        return _accept_open(mesh, options)
    mesh = _resolve_self_intersections(_resolve_components(mesh, options))
    area = float(topology.face_areas(mesh.vertices, mesh.faces).sum())
    wall = 2 * signed_volume(mesh.vertices, mesh.faces) / area
    if wall < THIN_M:
        note = f"thin: walls of {wall * 1e3:.1f} mm on average; use a fine fidelity"
        mesh = replace(mesh, notes=(*mesh.notes, note))
    return mesh


def _to_metres(soup: Soup, options: ObjectOptions) -> RepairedMesh:
    used, inverse = np.unique(soup.faces, return_inverse=True)
    given, faces, unit = centre_points(soup.vertices[used]), inverse.reshape(-1, 3), UNITS[options.units]
    extents = np.ptp(given.points, axis=0) * unit
    extent = float(extents.max())
    if float(extents.min()) <= 1e-7 * extent:
        raise MeshError("the mesh encloses no volume: it is flat; give the surface a thickness")
    if options.scale_to is not None:
        unit, extent = unit * (options.scale_to / extent), options.scale_to
    if not MIN_EXTENT_M <= extent <= MAX_EXTENT_M:
        size = f"{extent:.4g} m long, too large" if extent > MAX_EXTENT_M else f"{1e3 * extent:.3g} mm long, too small"
        fitting = _fitting_units(extent / unit)
        hints = "; ".join(f"--units {name} makes it {_length_text(metres)} long" for name, metres in fitting.items())
        raise MeshError.with_fixes(
            f"the mesh is {size} to grasp",
            f"{hints or 'check its units'} (or give a size: --scale-to 0.1)",
            {"scale_to": None},
            units_suggested=list(fitting),
            lengths_m=fitting,
        )
    notes = (_resolution_note(given, unit),) if given.resolution * unit > COARSE_M else ()
    x, y, z = (float(value) for value in round_to_grid(given.centre * unit))
    return RepairedMesh(given.points * unit, faces, notes=notes, centre=(x, y, z))


def _resolution_note(given: CentredMesh, unit: float) -> str:
    return (
        f"the mesh lies {float(np.linalg.norm(given.centre)) * unit:.4g} m from its origin, where the file's numbers "
        f"are {1e3 * given.resolution * unit:.2g} mm apart; move it nearer, or write 64-bit numbers (OBJ, PLY)"
    )


def _fitting_units(extent: float) -> dict[str, float]:
    """Return the units in which `extent` suits a hand, each with the extent [m]; the likeliest first."""
    sizes = {unit: extent * metres for unit, metres in UNITS.items()}
    low, high = HAND_SIZES_M
    fitting = {unit: size for unit, size in sizes.items() if low <= size <= high}
    fitting = fitting or {unit: size for unit, size in sizes.items() if MIN_EXTENT_M <= size <= MAX_EXTENT_M}
    return dict(sorted(fitting.items(), key=lambda item: abs(math.log(item[1] / TYPICAL_SIZE_M))))


def _length_text(metres: float) -> str:
    return f"{1e3 * metres:.3g} mm" if metres < 0.1 else f"{1e2 * metres:.3g} cm"


def _clean(mesh: RepairedMesh) -> RepairedMesh:
    """Merge vertices; drop duplicates and faces without area."""
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    vertices, faces = topology.merge_vertices(mesh.vertices, mesh.faces, MERGE * extent)
    given = len(faces)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    faces = faces[~topology.repeated_faces(faces)] if len(faces) else faces
    # A face without area may join a long edge with two short ones. It is dropped only if no edge opens.
    wide = faces[~topology.degenerate_faces(vertices, faces)] if len(faces) else faces
    if topology.count_open_edges(wide) <= topology.count_open_edges(faces):
        faces = wide
    if not len(faces):
        raise MeshError("the mesh encloses no volume: its faces have no area or cover each other; give it a thickness")
    if dropped := given - len(faces):
        kept = topology.drop_unused_vertices(vertices, faces)
        return mesh.with_faces(*kept, f"dropped {dropped} degenerate or duplicate faces")
    return replace(mesh, vertices=vertices, faces=faces)


def _close_surface(mesh: RepairedMesh) -> RepairedMesh:
    if topology.count_open_edges(mesh.faces):
        mesh = _weld(mesh)
    faces, orientable = topology.unify_winding(mesh.faces)
    if not orientable:
        return mesh
    if turned := int((faces != mesh.faces).any(axis=1).sum()):
        mesh = mesh.with_faces(mesh.vertices, faces, f"winding of {turned} faces made consistent with their neighbours")
    if crowded := int((topology.edge_faces(mesh.faces)[1] > 2).sum()):
        split = topology.separate_double_edges(*topology.split_edges(mesh.vertices, mesh.faces))
        if topology.count_open_edges(split[1]) <= topology.count_open_edges(mesh.faces):
            mesh = mesh.with_faces(*split, f"split {crowded} non-manifold edges")
    if topology.count_open_edges(mesh.faces):
        mesh = _fill_pinholes(mesh)
    return mesh


def _weld(mesh: RepairedMesh) -> RepairedMesh:
    from scipy.spatial import cKDTree

    extent = float(np.ptp(mesh.vertices, axis=0).max())
    pairs = cKDTree(mesh.vertices).query_pairs(WELD * extent, output_type="ndarray")
    if not len(pairs) or len(pairs) > 10 * len(mesh.vertices):
        return mesh
    label = topology.connected_parts(pairs[:, 0], pairs[:, 1], len(mesh.vertices))
    _, first = np.unique(label, return_index=True)
    faces = label[mesh.faces].astype(np.int64)
    faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
    if not len(faces) or topology.count_open_edges(faces) >= topology.count_open_edges(mesh.faces):
        return mesh
    welded = topology.drop_unused_vertices(mesh.vertices[first], faces)
    return mesh.with_faces(*welded, f"welded {len(pairs)} pairs of vertices at a seam")


def _fill_pinholes(mesh: RepairedMesh) -> RepairedMesh:
    """Fill each small hole with a fan; if one hole is large, all holes stay open."""
    extent = float(np.ptp(mesh.vertices, axis=0).max())
    loops = [loop for loop in _rim_loops(mesh.faces) or [] if len(loop) > 2]
    if not loops or any(np.ptp(mesh.vertices[loop], axis=0).max() > HOLE * extent for loop in loops):
        return mesh
    fans = [[loop[0], loop[i + 1], loop[i]] for loop in loops for i in range(1, len(loop) - 1)]
    faces = np.concatenate([mesh.faces, np.array(fans, dtype=np.int64)])
    return mesh.with_faces(mesh.vertices, faces, f"filled {len(loops)} small holes")


def _rim_loops(faces: Indices) -> list[list[int]] | None:
    """Return closed loops of open edges in the direction of their faces; None if they cross."""
    index, counts = topology.edge_faces(faces)
    rim = topology.directed_edges(faces)[counts[index] == 1]
    after = {int(a): int(b) for a, b in rim}
    if len(after) != len(rim):
        return None
    loops: list[list[int]] = []
    while after:
        start, at = after.popitem()
        loop = [start]
        while at != start:
            if at not in after:
                return None
            loop.append(at)
            at = after.pop(at)
        loops.append(loop)
    return loops


def _accept_open(mesh: RepairedMesh, options: ObjectOptions) -> RepairedMesh:
    holes = topology.count_open_edges(mesh.faces)
    if options.allow_open:
        note = f"not watertight: {holes} open edges; volume, centre of mass and inertia are those of the convex hull"
        return replace(mesh, watertight=False, notes=(*mesh.notes, note))
    what = f"{holes} open edges" if holes else "faces that no winding makes consistent"
    raise MeshError.with_fixes(
        f"the mesh is not watertight ({what})",
        "close it in your modelling tool, or accept it as it is: --allow-open",
        {"allow_open": True},
    )


def _resolve_components(mesh: RepairedMesh, options: ObjectOptions) -> RepairedMesh:
    """Drop debris, orient components outward, and unite overlapping ones; options select among several."""
    shells = topology.components(mesh.faces)
    parts = [topology.drop_unused_vertices(mesh.vertices, mesh.faces[shells == k]) for k in range(shells.max() + 1)]
    volumes = np.array([signed_volume(*part) for part in parts])
    largest = int(np.argmax(np.abs(volumes)))
    solid_parts = np.abs(volumes) > DEBRIS * abs(volumes[largest])
    if abs(volumes[largest]) < 1e-9 * np.ptp(parts[largest][0], axis=0).max() ** 3:
        raise MeshError("the mesh encloses no volume; give the surface a thickness")
    sign = np.sign(volumes[largest])
    if dropped := int((~solid_parts).sum()):
        parts = [part for part, keep in zip(parts, solid_parts, strict=True) if keep]
        volumes = volumes[solid_parts]
        mesh = mesh.with_faces(*topology.join_meshes(parts), f"dropped {dropped} components without volume")
    outward = [part if v > 0 else (part[0], part[1][:, ::-1]) for part, v in zip(parts, volumes, strict=True)]
    if len(parts) == 1:
        if sign < 0:
            mesh = mesh.with_faces(*outward[0], "winding turned outward")
        return mesh
    return _unite(mesh, outward, np.sign(volumes) != sign, turned=bool(sign < 0), options=options)


def _unite(
    mesh: RepairedMesh, parts: list[tuple[Floats, Indices]], against: np.ndarray, turned: bool, options: ObjectOptions
) -> RepairedMesh:
    """Unite outward shells to one solid; shells wound `against` the largest one inside it are cavities."""
    if turned:
        mesh = mesh.with_faces(mesh.vertices, mesh.faces[:, ::-1], "winding turned outward")
    boxes = [(p[0].min(axis=0), p[0].max(axis=0)) for p in parts]
    main = int(np.argmax([signed_volume(*part) for part in parts]))
    hollow = [
        bool(flip and (low > boxes[main][0]).all() and (high < boxes[main][1]).all())
        for flip, (low, high) in zip(against, boxes, strict=True)
    ]
    turned_parts = sum(bool(a) and not c for a, c in zip(against, hollow, strict=True))
    positives = [p for p, hole in zip(parts, hollow, strict=True) if not hole]
    holes = [p for p, hole in zip(parts, hollow, strict=True) if hole]
    united = mesh_geometry.unite(positives, holes)
    if turned_parts:
        mesh = replace(mesh, repairs=(*mesh.repairs, f"winding of {turned_parts} components turned outward"))
    # A cavity is its own shell, of negative volume.
    pieces = [piece for piece in united.decompose() if piece.volume() > 0]
    groups = mesh_geometry.group_solids(pieces, JOINED_M)
    if len(groups) > 1 and not options.rigid:
        if not options.keep_largest:
            raise MeshError.with_fixes(
                f"the mesh has {len(groups)} separate components",
                "take them as one rigid body: --rigid, keep the largest: --keep-largest, or upload each alone",
                {"rigid": True},
                {"keep_largest": True},
            )
        best = united - mesh_geometry.union([piece for group in groups[1:] for piece in group])
        return mesh.with_faces(*topology.from_manifold(best), f"kept the largest of {len(groups)} components")
    if len(pieces) > 1:
        how = "lie apart" if len(groups) > 1 else f"touch or lie within {1e3 * JOINED_M:g} mm"
        mesh = replace(mesh, notes=(*mesh.notes, f"{len(pieces)} parts that {how} are one rigid body"))
    before = sum(signed_volume(*p) for p in positives) - sum(signed_volume(*p) for p in holes)
    # Parts that only share a face keep their volume when united, but their faces inside the solid are removed.
    if abs(united.volume() - before) > 1e-6 * before or len(pieces) < len(positives):
        found = topology.from_manifold(united)
        return mesh.with_faces(*found, f"united {len(parts)} touching or intersecting components")
    vertices, faces = topology.join_meshes(positives + [(corners, cavity[:, ::-1]) for corners, cavity in holes])
    return replace(mesh, vertices=vertices, faces=faces)


def _resolve_self_intersections(mesh: RepairedMesh) -> RepairedMesh:
    """Count doubly enclosed volume once if the outer surface stays unchanged; else add a note."""
    found = intersecting_faces(mesh.vertices, mesh.faces)
    if found is None or not len(found):
        return replace(mesh, self_intersections=None if found is None else 0)
    united = unite_self_overlaps(mesh.vertices, mesh.faces)
    if united is None:
        note = f"{len(found)} pairs of faces pass through each other; volume and mass may err there"
        return replace(mesh, self_intersections=len(found), notes=(*mesh.notes, note))
    mesh = mesh.with_faces(*united, f"united the mesh with itself where {len(found)} pairs of faces intersected")
    return replace(mesh, self_intersections=0)
