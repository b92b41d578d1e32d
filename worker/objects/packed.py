"""A prepared object as bytes and back, bit for bit; no code is ever read from them."""

from __future__ import annotations

import io
import json
from dataclasses import fields
from typing import Any, Final

import numpy as np

from worker.objects.model import ObjectModel

_ARRAYS: Final = (
    "vertices",
    "faces",
    "corner_normals",
    "centre_of_mass",
    "inertia",
    "hull_vertices",
    "hull_faces",
)
_NAMES: Final = ("name", "digest", "about_centre")


def to_bytes(obj: ObjectModel) -> bytes:
    """All of an object but its name and digest, bit for bit."""
    plain = {f.name: getattr(obj, f.name) for f in fields(obj) if f.name not in (*_ARRAYS, *_NAMES)}
    arrays: dict[str, Any] = {name: getattr(obj.centred, name) for name in _ARRAYS}
    buffer = io.BytesIO()
    np.savez_compressed(buffer, **arrays, plain=np.frombuffer(json.dumps(plain).encode(), np.uint8))
    return buffer.getvalue()


def from_bytes(data: bytes, *, name: str, digest: str) -> ObjectModel:
    """An object from `to_bytes`; ValueError, KeyError, OSError, EOFError or BadZipFile if they are none."""
    with np.load(io.BytesIO(data), allow_pickle=False) as stored:
        plain = json.loads(stored["plain"].tobytes())
        arrays = {field: stored[field] for field in _ARRAYS}
    x, y, z = plain.pop("centre")
    middle = ObjectModel(name=name, digest=digest, **arrays, **plain | {"repairs": tuple(plain["repairs"])})
    return middle.at((x, y, z))
