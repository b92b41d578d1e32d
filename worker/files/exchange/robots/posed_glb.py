"""Grasps as binary glTF, one file each: hand and object as they touch, in metres, turned so that +y is up."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Final

import numpy as np

from service.model.transforms import Floats
from worker.files.exchange.robots.bundle import Bundle
from worker.files.exchange.robots.solids import Solid, hand_meshes, object_mesh, support_meshes
from worker.objects.glb_document import Document, plain
from worker.robots.execution import posed_bodies

#: From z up to glTF's y up: a quarter turn about x, as x y z w.
_UPRIGHT: Final = [-float(np.sqrt(0.5)), 0.0, 0.0, float(np.sqrt(0.5))]


def write(bundle: Bundle, folder: Path) -> list[Path]:
    """Write `GRASP.glb`: nodes bear the names of the hand's links, of the object, of supports, and `tool_frame`."""
    folder.mkdir(parents=True, exist_ok=True)
    found, written = bundle.found, []
    moving, thing, standing = hand_meshes(found), object_mesh(found), support_meshes(found)
    for row in range(len(found)):
        document = Document()
        nodes: list[dict[str, Any]] = [{"name": bundle.name(row), "rotation": _UPRIGHT}]

        def add(solid: Solid, pose: Floats | None, document: Document = document, nodes: list[Any] = nodes) -> None:
            primitive = document.triangles(solid.vertices, solid.faces, solid.normals, solid.colour)
            nodes.append({"name": solid.name, "mesh": document.mesh([primitive]), **_placed(pose)})

        bodies = posed_bodies(found, "grasp", row)
        for solid in moving:
            add(solid, bodies[solid.body])
        add(thing, found.object_pose[row])
        for solid in standing:
            add(solid, None)
        nodes.append({"name": "tool_frame", **_placed(found.tool_pose("grasp")[row])})
        nodes[0]["children"] = list(range(1, len(nodes)))
        said = {"kind": "grasp", "row": int(found.rows[row]), "frame": found.frame, "tool_frame": found.tool.name}
        written.append(folder / f"{bundle.name(row)}.glb")
        written[-1].write_bytes(document.bytes(nodes, said))
    return written


def _placed(pose: Floats | None) -> dict[str, Any]:
    if pose is None:
        return {}
    return {"translation": plain(pose[:3]), "rotation": plain(np.roll(pose[3:], -1))}
