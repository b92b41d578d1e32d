"""Convex pieces of an object by CoACD (Wei et al. 2022), measured before use and kept on disk.

The pieces are the object as the referee's engine knows it, so a bad decomposition is a bad referee: pieces that fill a
hollow make every grasp of it wrong. Count and volume ratio go with every verdict; too large a ratio is refused.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
import subprocess
import sys
from dataclasses import dataclass
from functools import lru_cache
from importlib.metadata import version
from pathlib import Path
from typing import Any, Final

import manifold3d as m3d
import numpy as np
from numpy.typing import NDArray

from service.digests import digest_json
from service.errors import MeshError
from worker.objects.model import ObjectModel

Floats = NDArray[np.float64]

#: An object whose hull has at most this much more volume is its hull: scan noise is not worth pieces.
HULL_RATIO: Final = 1.15
#: Concavity thresholds from coarse to fine; the first whose pieces are within `GOOD_RATIO` is taken.
THRESHOLDS: Final = (0.2, 0.08, 0.04)
GOOD_RATIO: Final = 1.25
#: Pieces with more than this times the object's volume are no picture of it.
MAX_RATIO: Final = 2.5
MAX_PIECES: Final = 64
#: Preprocessing inflates near-convex scans by 9 to 17 % and takes a minute; our meshes are closed already.
_COACD: Final = {
    "preprocess_mode": "off",
    "resolution": 1000,
    "mcts_iterations": 60,
    "mcts_nodes": 10,
    "max_convex_hull": MAX_PIECES,
    "seed": 1,
}
#: One run of CoACD may take this long; without its result the coarser one stands [s].
TIMEOUT_S: Final = 300.0
#: Pieces thinner than this are splinters that the engine cannot build [m^3].
_MIN_VOLUME: Final = 1e-9


@dataclass(frozen=True)
class ConvexPieces:
    """An object as a union of convex solids."""

    vertices: tuple[Floats, ...]
    """One (V, 3) array of corners per piece, object frame [m]."""
    volume_ratio: float
    """Volume of the union over the object's."""
    digest: str
    """Of the pieces' corners: part of a verdict's key."""

    def __len__(self) -> int:
        return len(self.vertices)


def decompose(obj: ObjectModel, *, cache: Path | None = None) -> ConvexPieces:
    """Convex pieces of an object, from the cache where they were made before.

    Args:
        obj: the object.
        cache: folder to keep them in; by default `$XDG_CACHE_HOME/graspd/convex`.

    Raises:
        MeshError: the best pieces have more than `MAX_RATIO` times the object's volume, or none was found.
    """
    pieces = _load_or_make(_Key(obj), cache or default_cache())
    if not len(pieces) or pieces.volume_ratio > MAX_RATIO:
        raise MeshError(
            f"{obj.name}: its {len(pieces)} convex pieces have {pieces.volume_ratio:.2f} times its volume "
            f"(limit {MAX_RATIO}); the referee cannot judge so thin-walled an object"
        )
    return pieces


def default_cache() -> Path:
    """Folder for what can be made again."""
    home = os.environ.get("XDG_CACHE_HOME")
    return (Path(home) if home else Path.home() / ".cache") / "graspd" / "convex"


class _Key:
    """An object with the digest of all that its pieces follow from."""

    def __init__(self, obj: ObjectModel) -> None:
        self.obj = obj
        shape = hashlib.sha256(obj.vertices.tobytes() + obj.faces.tobytes()).hexdigest()
        settings = [_COACD, THRESHOLDS, HULL_RATIO, GOOD_RATIO, version("coacd")]
        self.digest = digest_json({"shape": shape, "settings": settings})

    def __hash__(self) -> int:
        return hash(self.digest)

    def __eq__(self, other: object) -> bool:
        return isinstance(other, _Key) and other.digest == self.digest


@lru_cache(maxsize=64)
def _load_or_make(key: _Key, cache: Path) -> ConvexPieces:
    file = cache / f"{key.digest}.npz"
    if file.is_file():
        with np.load(file) as stored:
            parts = tuple(stored[name] for name in sorted(stored.files))
    else:
        parts = _make(key.obj)
        _store(file, parts)
    return ConvexPieces(parts, union_volume(parts) / key.obj.volume, _digest(parts))


def _store(file: Path, parts: tuple[Floats, ...]) -> None:
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        partial = file.with_suffix(f".{os.getpid()}.tmp.npz")
        arrays: dict[str, Any] = {f"{i:04}": part for i, part in enumerate(parts)}
        np.savez(partial, **arrays)
        partial.replace(file)
    except OSError:
        # A folder that cannot be written only costs time.
        return


def _make(obj: ObjectModel) -> tuple[Floats, ...]:
    best: tuple[Floats, ...] = (obj.hull_vertices,)
    ratio = union_volume(best) / obj.volume
    if ratio <= HULL_RATIO:
        return best
    for threshold in THRESHOLDS:
        parts = tuple(part for part in _coacd(obj, threshold) if _solid(part))
        found = union_volume(parts) / obj.volume
        if parts and found < ratio:
            best, ratio = parts, found
        if ratio <= GOOD_RATIO:
            break
    return best


def _coacd(obj: ObjectModel, threshold: float) -> tuple[Floats, ...]:
    """Pieces by CoACD. It holds the interpreter lock, so it runs in a process of its own and stops no heartbeat."""
    given = io.BytesIO()
    options = json.dumps({"threshold": threshold, **_COACD})
    np.savez(given, vertices=obj.vertices, faces=obj.faces, options=np.array(options))
    command = [sys.executable, "-m", "worker.quality.referee.coacd_child"]
    try:
        done = subprocess.run(command, input=given.getvalue(), capture_output=True, timeout=TIMEOUT_S, check=True)
    except (subprocess.CalledProcessError, subprocess.TimeoutExpired):
        return ()
    with np.load(io.BytesIO(done.stdout)) as stored:
        return tuple(stored[name] for name in stored.files)


def union_volume(parts: tuple[Floats, ...]) -> float:
    """Volume of the union of the hulls of the parts [m^3]."""
    solids = [m3d.Manifold.hull_points(np.ascontiguousarray(part * 1e3, np.float32)) for part in parts]
    return float(m3d.Manifold.batch_boolean(solids, m3d.OpType.Add).volume()) * 1e-9 if solids else 0.0


def _solid(part: Floats) -> bool:
    return len(part) >= 4 and union_volume((part,)) > _MIN_VOLUME


def _digest(parts: tuple[Floats, ...]) -> str:
    return digest_json([hashlib.sha256(np.round(part, 9).tobytes()).hexdigest() for part in parts])
