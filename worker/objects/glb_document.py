"""Writer of binary glTF 2.0 documents with triangles and points."""

import json
import struct
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

_FLOAT, _BYTE, _UBYTE, _U32 = 5126, 5120, 5121, 5125
_POINTS: Final = 0
_ARRAY, _ELEMENTS = 34962, 34963


class Document:
    """A glTF 2.0 document with one buffer, under construction."""

    def __init__(self) -> None:
        self._chunks: list[bytes] = []
        self._size = 0
        self._views: list[dict[str, Any]] = []
        self._accessors: list[dict[str, Any]] = []
        self._meshes: list[dict[str, Any]] = []
        self._materials: list[dict[str, Any]] = []

    def add_triangles(
        self,
        vertices: NDArray[Any],
        faces: NDArray[Any],
        normals: NDArray[Any],
        colour: tuple[float, float, float] | None = None,
        face_colours: NDArray[Any] | None = None,
    ) -> dict[str, Any]:
        """Add a primitive of vertices (V, 3), faces (F, 3) and unit normals per face corner (F, 3, 3).
        Colours are linear RGB: one for all faces, or one for each face (F, 3)."""
        # A vertex on a crease is repeated for each of its normals. Normals of 8 bits err by less than half a degree.
        small = np.round(127 * normals.reshape(-1, 3)).astype(np.int8)
        corners = np.concatenate([faces.reshape(-1, 1), small], axis=1)
        if face_colours is not None:
            shades = np.round(255 * np.repeat(face_colours, 3, axis=0)).astype(np.int64)
            corners = np.concatenate([corners, shades], axis=1)
        unique, index = np.unique(corners, axis=0, return_inverse=True)
        padded = np.zeros((len(unique), 4), np.int8)
        padded[:, :3] = unique[:, 1:4]
        quantised: Any = {"byteStride": 4}, {"normalized": True}
        attributes = {
            "POSITION": self.add_vectors(vertices[unique[:, 0]]),
            "NORMAL": self._add_accessor(padded, _BYTE, "VEC3", _ARRAY, *quantised),
        }
        if face_colours is not None:
            tinted = np.zeros((len(unique), 4), np.uint8)
            tinted[:, :3] = unique[:, 4:]
            attributes["COLOR_0"] = self._add_accessor(tinted, _UBYTE, "VEC3", _ARRAY, *quantised)
        indices = self._add_accessor(index.reshape(-1).astype(np.uint32), _U32, "SCALAR", _ELEMENTS, {}, {})
        primitive: dict[str, Any] = {"attributes": attributes, "indices": indices}
        return primitive if colour is None else primitive | {"material": self._add_material(colour)}

    def add_points(self, values: NDArray[Any]) -> dict[str, Any]:
        return {"attributes": {"POSITION": self.add_vectors(values)}, "mode": _POINTS}

    def _add_material(self, colour: tuple[float, float, float]) -> int:
        look = {"baseColorFactor": [*rounded_values(colour), 1.0], "metallicFactor": 0.1, "roughnessFactor": 0.6}
        material = {"pbrMetallicRoughness": look, "doubleSided": True}
        if material not in self._materials:
            self._materials.append(material)
        return self._materials.index(material)

    def add_vectors(self, values: NDArray[Any]) -> int:
        data = np.ascontiguousarray(values, np.float32)
        bounds = {"min": data.min(axis=0).tolist(), "max": data.max(axis=0).tolist()}
        return self._add_accessor(data, _FLOAT, "VEC3", _ARRAY, {}, bounds)

    def add_mesh(self, primitives: list[dict[str, Any]]) -> int:
        self._meshes.append({"primitives": primitives})
        return len(self._meshes) - 1

    def to_bytes(self, nodes: list[dict[str, Any]], extras: dict[str, Any]) -> bytes:
        """Return the file; node 0 is the root of the scene."""
        document = {
            "asset": {"version": "2.0", "generator": "graspd", "extras": extras},
            "extensionsUsed": ["KHR_mesh_quantization"],
            "extensionsRequired": ["KHR_mesh_quantization"],
            "scene": 0,
            "scenes": [{"nodes": [0]}],
            "nodes": nodes,
            "meshes": self._meshes,
            **({"materials": self._materials} if self._materials else {}),
            "accessors": self._accessors,
            "bufferViews": self._views,
            "buffers": [{"byteLength": self._size}],
        }
        text = json.dumps(document, separators=(",", ":")).encode()
        text += b" " * (-len(text) % 4)
        binary = b"".join(self._chunks)
        parts = struct.pack("<I4s", len(text), b"JSON") + text + struct.pack("<I4s", len(binary), b"BIN\0") + binary
        return struct.pack("<4sII", b"glTF", 2, 12 + len(parts)) + parts

    def _add_accessor(
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


def rounded_values(values: Any) -> list[float]:
    """Return rounded numbers for a node."""
    return [round(float(value), 7) for value in values]
