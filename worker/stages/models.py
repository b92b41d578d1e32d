"""Models for viewers: hands and objects as binary glTF, made with an upload's check or at first use.

``python -m graspd.worker.stages.models`` writes the models of built-in hands and objects to `service/builtin/models/`.

Node `extras` contain the joint tree: a node's pose is parent * rest pose * motion about `axis`. Points of the hand's
surface are POINTS primitives. For a body drawn with visual meshes, `extras` name the mesh of its collision shapes,
which no node draws. The document's `extras` contain facts, link frames, joint drives and pads of the hand."""

from pathlib import Path
from typing import Any, Final

import numpy as np

from graspd.service.model import names
from graspd.service.model.colours import Colour, linear_rgb
from graspd.service.model.fidelity import Fidelity
from graspd.service.model.states import AssetKind
from graspd.service.model.transforms import Floats
from graspd.service.store.assets import builtin_files, builtin_names
from graspd.service.store.integrity import put_sealed
from graspd.service.store.store import Store
from graspd.worker.hands.check import model_facts
from graspd.worker.hands.jaws import pads_of
from graspd.worker.hands.load import load_hand
from graspd.worker.hands.model import HandModel, JointType
from graspd.worker.hands.robot import Ints
from graspd.worker.hands.surface import sample_surface
from graspd.worker.hands.visuals import thin_mesh
from graspd.worker.objects.glb_document import Document, rounded_values
from graspd.worker.objects.mesh_geometry import corner_normals
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import load_object

SHOWN_ERROR_M: Final = Fidelity().face_error_m  # tolerance of a displayed object [m]: that of fidelity standard
_BUILTIN: Final = Path(__file__).parents[2] / "service" / "builtin" / "models"


def model_glb(kind: AssetKind, name: str, files: dict[str, bytes]) -> bytes:
    """Return the hand or object in `files` as binary glTF; raises the errors of loading it."""
    if kind is AssetKind.HAND:
        return hand_glb(load_hand(files, name=name, digest=""))
    return object_glb(load_object(files, name=name, digest="", face_error_m=SHOWN_ERROR_M))


def publish_model(store: Store, kind: AssetKind, model: HandModel | ObjectModel) -> None:
    """Store the glTF of a loaded hand or object unless it exists."""
    key = names.asset_key(kind, model.digest, "model.glb")
    if not store.exists(key):
        put_sealed(store, key, hand_glb(model) if isinstance(model, HandModel) else object_glb(model))


def write_builtins() -> None:
    """Write the models of all built-in hands and objects."""
    _BUILTIN.mkdir(exist_ok=True)
    for kind in AssetKind:
        for name in builtin_names(kind):
            (_BUILTIN / f"{kind.value}-{name}.glb").write_bytes(model_glb(kind, name, builtin_files(kind, name)))


SURFACE_POINTS: Final = 3000  # hand points from which a viewer measures the distance to the object
MAX_FACES: Final = 60_000  # largest number of triangles of a hand, so that a browser draws them at once
PAD_POINTS: Final = 60  # largest number of points of a pad
_GREY: Final = (0.45, 0.5, 0.55)  # sRGB of parts without a colour, if other parts have one


def hand_glb(hand: HandModel) -> bytes:
    """Return the hand as glTF [m] at joint positions zero, with its root link at the origin."""
    document = Document()
    points = sample_surface(hand, SURFACE_POINTS)
    nodes: list[dict[str, Any]] = []
    visuals = hand.visuals.meshes
    if (excess := sum(len(mesh.faces) for mesh in visuals) / MAX_FACES) > 1:
        visuals = tuple(thin_mesh(mesh, excess) for mesh in visuals)
    joint_of_body = dict(zip(hand.joint_body.tolist(), hand.joint_names, strict=True))
    for body in range(hand.bodies):
        node: dict[str, Any] = {"name": hand.body_names[body], "extras": {"fingertip": body in hand.fingertips}}
        if body:
            node["translation"] = rounded_values(hand.origin[body, :3])
            node["rotation"] = rounded_values(np.roll(hand.origin[body, 3:], -1))  # glTF: x y z w
            kind = "prismatic" if hand.joint_type[body] == JointType.PRISMATIC else "revolute"
            node["extras"] |= {"joint": joint_of_body[body], "type": kind, "axis": rounded_values(hand.axis[body])}
        meshes: list[tuple[Floats, Ints, Colour | None]] = [
            (mesh.vertices, mesh.faces, mesh.colour) for mesh in visuals if mesh.body == body
        ]
        primitive = _join_meshes(document, meshes) if meshes else _piece_primitive(document, hand, body)
        primitives = [primitive] if primitive else []
        if any(mesh.body == body for mesh in visuals) and (pieces := _piece_primitive(document, hand, body)):
            node["extras"]["collision"] = document.add_mesh([pieces])
        if (on_body := points.position[points.body == body]).size:
            primitives.append(document.add_points(on_body))
        if primitives:
            node["mesh"] = document.add_mesh(primitives)
        if children := [child for child in range(1, hand.bodies) if hand.parent[child] == body]:
            node["children"] = children
        nodes.append(node)
    preshape = dict(zip(hand.joint_names, rounded_values(hand.expand(hand.preshape)), strict=True))
    palm = {"centre": rounded_values(hand.palm.centre), "approach": rounded_values(hand.palm.approach)}
    extras = {"kind": "hand", "name": hand.name, "preshape": preshape, "palm": palm, **_document_facts(hand)}
    return document.to_bytes(nodes, extras)


def object_glb(obj: ObjectModel) -> bytes:
    """Return the prepared mesh as glTF [m]; its node is translated to the middle, for 32-bit coordinates."""
    document = Document()
    primitive = document.add_triangles(obj.centred.vertices, obj.faces, obj.corner_normals)
    extras: dict[str, Any] = {"kind": "object", "name": obj.name, "centre_of_mass": rounded_values(obj.centre_of_mass)}
    extras |= {"extents_m": rounded_values(np.ptp(obj.vertices, axis=0)), "mass_kg": obj.mass}
    node = {"name": obj.name, "mesh": document.add_mesh([primitive]), "translation": list(obj.centre)}
    return document.to_bytes([node], extras)


def _document_facts(hand: HandModel) -> dict[str, Any]:
    drives = {}
    for body, joint in zip(hand.joint_body.tolist(), hand.joint_names, strict=True):
        times, plus = float(hand.multiplier[body]), float(hand.offset[body])
        drives[joint] = {"dof": hand.dof_names[hand.dof[body]], "times": times, "plus": plus}
    pads = []
    for pad in pads_of(hand):
        points = [rounded_values(point) for point in pad.points[:: max(1, -(-len(pad.points) // PAD_POINTS))]]
        pads.append({"body": pad.body, "normal": rounded_values(pad.normal), "points": points})
    links = {link: {"body": body, "pose": rounded_values(pose)} for link, (body, pose) in hand.frames.items()}
    return {"facts": model_facts(hand), "links": links, "drives": drives, "pads": pads}


def _piece_primitive(document: Document, hand: HandModel, body: int) -> dict[str, Any] | None:
    return _join_meshes(document, [(p.vertices, p.faces, None) for p in hand.pieces if p.body == body])


def _join_meshes(document: Document, meshes: list[tuple[Floats, Ints, Colour | None]]) -> dict[str, Any] | None:
    if not meshes:
        return None
    starts = np.cumsum([0, *(len(vertices) for vertices, _, _ in meshes)])
    colours = None
    if any(colour for _, _, colour in meshes):
        colours = np.concatenate(
            [np.tile(linear_rgb(*(colour or _GREY)), (len(faces), 1)) for _, faces, colour in meshes]
        )
    return document.add_triangles(
        np.concatenate([vertices for vertices, _, _ in meshes]),
        np.concatenate([faces + start for (_, faces, _), start in zip(meshes, starts, strict=False)]),
        np.concatenate([corner_normals(vertices, faces) for vertices, faces, _ in meshes]),
        face_colours=colours,
    )


if __name__ == "__main__":
    write_builtins()
