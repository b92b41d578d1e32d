"""Check of an uploaded object: accepted, accepted with repairs, or refused with the reason."""

from collections.abc import Mapping
from typing import Any

import numpy as np

from graspd.service.model.errors import InputError
from graspd.service.model.object_options import ObjectOptions
from graspd.worker.objects.options import parse_options
from graspd.worker.objects.prepare import apply_options, build_model, main_mesh, repaired_mesh
from graspd.worker.objects.repair import RepairedMesh
from graspd.worker.objects.shapes import shape_facts

#: Simplification bound of the prepared mesh in the report [m]: that of the standard fidelity.
REPORT_ERROR_M = 3e-4
#: Distance of an object from its origin, in multiples of its size, above which a note is added.
FAR = 10


def check_object(
    files: Mapping[str, bytes], name: str, *, face_error_m: float = REPORT_ERROR_M, **options: Any
) -> dict[str, Any]:
    """Check whether the files describe a usable object; options that are not None override `asset.json`.
    Return verdict (accept, repair or refuse), message (one line), repairs (changes), and facts (measurements in SI
    units). If options can fix a refusal, facts have `problem` and `options_suggested`: keys of `ObjectOptions`, with
    None for a value to choose. If the size is wrong, facts have `units_suggested`, the likeliest first, and
    `lengths_m`, the longest extent in each unit [m]."""
    try:
        settings = parse_options(files, options)
        mesh = repaired_mesh(*main_mesh(files, settings), settings)
        facts = _facts(mesh, face_error_m, settings)
    except InputError as error:
        return {"verdict": "refuse", "message": str(error), "repairs": [], "facts": getattr(error, "facts", {})}
    size = " x ".join(f"{1e3 * extent:.0f}" for extent in facts["extents_m"])
    parts = [
        f"{name}: {size} mm, {facts['faces']} faces, {1e6 * facts['volume_m3']:.1f} cm3, {facts['mass_kg']:.3g} kg"
        + ("" if facts["mass_stated"] else " assumed"),
        *mesh.repairs,
        *(["parts: " + ", ".join(facts["parts"])] if facts["parts"] else []),
        *facts["notes"],
    ]
    verdict = "repair" if mesh.repairs else "accept"
    return {"verdict": verdict, "message": "; ".join(parts), "repairs": list(mesh.repairs), "facts": facts}


def _facts(mesh: RepairedMesh, face_error_m: float, options: ObjectOptions) -> dict[str, Any]:
    model = apply_options(build_model(mesh, face_error_m), options)
    away, extents = float(np.linalg.norm(mesh.centre)), np.ptp(mesh.vertices, axis=0)
    notes = list(mesh.notes)
    if away > FAR * extents.max():
        notes.append(f"its origin lies {away:.4g} m from the middle of the mesh; poses of hands refer to this origin")
    return {
        "faces": len(mesh.faces),
        "prepared_faces": len(model.faces),
        "deviation_m": model.deviation_m,
        "repair_deviation_m": mesh.moved_m,
        "self_intersections": mesh.self_intersections,
        "extents_m": [float(extent) for extent in extents],
        "volume_m3": model.volume,
        "mass_kg": model.mass,
        "mass_stated": bool((options.mass or options.density) or mesh.matter.keys() - {"friction"}),
        "friction": model.friction,
        "centre_of_mass_m": [float(value) for value in model.centre_of_mass],
        "origin_distance_m": away,
        "radius_m": model.radius,
        "watertight": model.watertight,
        "shape": shape_facts(model),
        "units": options.units,
        "parts": mesh.parts.listed if mesh.parts else [],
        "colours": mesh.parts.listed_colours if mesh.parts else [],
        "notes": notes,
    }
