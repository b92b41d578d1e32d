"""Hands and objects as binary glTF for viewers: one node a body, with what moves it; opened by any glTF tool.

The joint tree stands in the `extras` of the nodes, so a viewer poses the hand from the joint positions of a shard:
a node's pose is parent * rest pose * motion about `axis`. Points of the hand's surface come as POINTS primitives.
"""

from __future__ import annotations

import json
import struct
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from worker.hands.model import HandModel, JointType
from worker.hands.surface import sample_surface
from worker.objects.model import ObjectModel
from worker.objects.normals import corner_normals

#: Points on the hand from which a viewer measures its distance to the object.
SURFACE_POINTS: Final = 3000
_FLOAT, _BYTE, _U32 = 5126, 5120, 5125
_POINTS: Final = 0
_ARRAY, _ELEMENTS = 34962, 34963


def hand_glb(hand: HandModel) -> bytes:
    """The hand at joint positions zero, root link at the origin; metres."""
    document = _Document()
    points = sample_surface(hand, SURFACE_POINTS)
    nodes: list[dict[str, Any]] = []
    joint_of_body = dict(zip(hand.joint_body.tolist(), hand.joint_names, strict=True))
    for body in range(hand.bodies):
        node: dict[str, Any] = {"name": hand.body_names[body], "extras": {"fingertip": body in hand.fingertips}}
        if body:
            node["translation"] = _plain(hand.origin[body, :3])
            node["rotation"] = _plain(np.roll(hand.origin[body, 3:], -1))  # glTF: x y z w
            kind = "prismatic" if hand.joint_type[body] == JointType.PRISMATIC else "revolute"
            node["extras"] |= {"joint": joint_of_body[body], "type": kind, "axis": _plain(hand.axis[body])}
        primitives = _body_primitives(document, hand, body)
        if (on_body := points.position[points.body == body]).size:
            primitives.append({"attributes": {"POSITION": document.vectors(on_body)}, "mode": _POINTS})
        if primitives:
            node["mesh"] = document.mesh(primitives)
        if children := [child for child in range(1, hand.bodies) if hand.parent[child] == body]:
            node["children"] = children
        nodes.append(node)
    preshape = dict(zip(hand.joint_names, _plain(hand.expand(hand.preshape)), strict=True))
    palm = {"centre": _plain(hand.palm.centre), "approach": _plain(hand.palm.approach)}
    return document.bytes(nodes, {"kind": "hand", "name": hand.name, "preshape": preshape, "palm": palm})


def object_glb(obj: ObjectModel) -> bytes:
    """The prepared mesh in the object's own frame; metres."""
    document = _Document()
    primitive = document.triangles(obj.vertices, obj.faces, obj.corner_normals)
    extras = {"kind": "object", "name": obj.name, "centre_of_mass": _plain(obj.centre_of_mass)}
    return document.bytes([{"name": obj.name, "mesh": document.mesh([primitive])}], extras)


def _body_primitives(document: _Document, hand: HandModel, body: int) -> list[dict[str, Any]]:
    vertices, faces, normals, count = [], [], [], 0
    for piece in hand.pieces:
        if piece.body == body:
            vertices.append(piece.vertices)
            faces.append(piece.faces + count)
            normals.append(corner_normals(piece.vertices, piece.faces))
            count += len(piece.vertices)
    if not vertices:
        return []
    return [document.triangles(np.concatenate(vertices), np.concatenate(faces), np.concatenate(normals))]


class _Document:
    """A glTF 2.0 document with one buffer, under construction."""

    def __init__(self) -> None:
        self._chunks: list[bytes] = []
        self._size = 0
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._meshes: list[dict[str, Any]] = []

    def triangles(self, vertices: NDArray[Any], faces: NDArray[Any], normals: NDArray[Any]) -> dict[str, Any]:
        """A primitive of vertices (V, 3), faces (F, 3) and unit normals per face corner (F, 3, 3)."""
        # A vertex on a crease becomes as many as it has normals; 127 steps a half axis are under half a degree.
        small = np.round(127 * normals.reshape(-1, 3)).astype(np.int8)
        corners = np.concatenate([faces.reshape(-1, 1), small], axis=1)
        unique, index = np.unique(corners, axis=0, return_inverse=True)
        padded = np.zeros((len(unique), 4), np.int8)
        padded[:, :3] = unique[:, 1:]
        attributes = {
            "POSITION": self.vectors(vertices[unique[:, 0]]),
            "NORMAL": self._accessor(padded, _BYTE, "VEC3", _ARRAY, {"byteStride": 4}, {"normalized": True}),
        }
        indices = self._accessor(index.reshape(-1).astype(np.uint32), _U32, "SCALAR", _ELEMENTS, {}, {})
        return {"attributes": attributes, "indices": indices}

    def vectors(self, values: NDArray[Any]) -> int:
        """An accessor of points (N, 3)."""
        data = np.ascontiguousarray(values, np.float32)
        bounds = {"min": data.min(axis=0).tolist(), "max": data.max(axis=0).tolist()}
        return self._accessor(data, _FLOAT, "VEC3", _ARRAY, {}, bounds)

    def mesh(self, primitives: list[dict[str, Any]]) -> int:
        self._meshes.append({"primitives": primitives})
        return len(self._meshes) - 1

    def bytes(self, nodes: list[dict[str, Any]], extras: dict[str, Any]) -> bytes:
        """The file; node 0 is the root of the scene."""
        document = {
            "asset": {"version": "2.0", "generator": "graspd", "extras": extras},
            "extensionsUsed": ["KHR_mesh_quantization"],
            "extensionsRequired": ["KHR_mesh_quantization"],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": nodes,
            "meshes": self._meshes,
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": self._size}],
        }
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        binary = b"".join(self._chunks)
        parts = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
        return struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts

    def _accessor(
        self, data: NDArray[Any], component: int, kind: str, target: int, view: dict[str, Any], facts: dict[str, Any]
    ) -> int:
        chunk = data.tobytes()
        span = {"buffer": 0, "byteOffset": self._size, "byteLength": len(chunk), "target": target}
        self._views.append(span | view)
        self._accessors.append(
            {"bufferView": len(self._views) - 1, "componentType": component, "count": len(data), "type": kind} | facts
        )
        chunk += b"\0" * (-len(chunk) % 4)
        self._chunks.append(chunk)
        self._size += len(chunk)
        return len(self._accessors) - 1


def _plain(values: Any) -> list[float]:
    return [round(float(value), 7) for value in values]
