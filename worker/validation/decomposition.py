"""Convex decomposition of objects by CoACD (Wei et al. 2022), with a quality check, cached on disk.

The validator's engine simulates only the pieces. Pieces that fill a hollow therefore falsify every verdict on the
object. Count, volume ratio and excess are stored with every verdict; pieces with a large excess are refused. The excess
is the volume added by the union of the pieces, divided by the object's surface area: the mean height of the added
material."""

import hashlib
import logging
from dataclasses import dataclass, replace
from pathlib import Path
from threading import Condition
from typing import Final

import numpy as np
from cachetools import LRUCache, cached

from graspd.service.model.digests import digest_json
from graspd.service.model.errors import MeshError
from graspd.service.model.libraries import version_of
from graspd.service.model.transforms import Floats
from graspd.worker.objects import convex
from graspd.worker.objects.convex import WorkLimitExceeded, union_volume
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.topology import face_areas

log = logging.getLogger(__name__)

#: Pieces with at most this mean excess are good [m]: a smaller excess hardly changes verdicts.
GOOD_EXCESS_M: Final = 8.5e-4
MAX_EXCESS_M: Final = 2e-3  # largest accepted mean excess [m]
#: CoACD's concavity thresholds from coarse to fine; the first that gives good pieces is used.
THRESHOLDS: Final = (0.1, 0.05, 0.03)
MAX_PIECES: Final = 64
#: No preprocessing by CoACD: it inflates near-convex scans by 9 to 17 % and takes a minute. Meshes are already closed.
_COACD: Final = {
    "preprocess_mode": "off",
    "resolution": 1000,
    "mcts_iterations": 60,
    "mcts_nodes": 10,
    "max_convex_hull": MAX_PIECES,
    "seed": 1,
}
CPU_S: Final = 300  # CPU time limit of one CoACD run [s]; beyond it the coarser result is used and a warning is logged
_MIN_VOLUME: Final = 1e-9  # pieces below this volume are splinters that MuJoCo cannot build [m^3]


@dataclass(frozen=True)
class ConvexPieces:
    """Convex decomposition of an object."""

    vertices: tuple[Floats, ...]  # one (V, 3) array of corners per piece, object frame [m]
    volume_ratio: float  # ratio of the union's volume to the object's volume
    excess_m: float  # mean height of the union above the object's surface [m]
    digest: str  # digest of the pieces' corners: part of a verdict's key

    def __len__(self) -> int:
        return len(self.vertices)

    @property
    def facts(self) -> dict[str, int | float | str]:
        """Record stored with verdicts on these pieces: count, volume ratio, mean excess [mm], digest."""
        return {
            "pieces": len(self),
            "volume_ratio": round(self.volume_ratio, 6),
            "excess_mm": round(self.excess_m * 1e3, 6),
            "pieces_digest": self.digest,
        }


def decompose(obj: ObjectModel, *, cache: Path | None = None) -> ConvexPieces:
    """Return the convex pieces of an object, from the cache if possible.
    The cache folder is by default `$XDG_CACHE_HOME/graspd/convex`.
    Raises MeshError: the mean excess of the best pieces is above `MAX_EXCESS_M`."""
    pieces = _load_or_make(obj.centred, piece_file(obj, cache))
    if pieces.excess_m > MAX_EXCESS_M:
        raise MeshError(
            f"{obj.name}: its {len(pieces)} convex pieces have {pieces.volume_ratio:.2f} times its volume and "
            f"an excess of {pieces.excess_m * 1e3:.1f} mm (limit {MAX_EXCESS_M * 1e3:g} mm); it cannot be validated"
        )
    if any(obj.centre):
        pieces = replace(pieces, vertices=tuple(part + obj.centre for part in pieces.vertices))
    return pieces


def piece_file(obj: ObjectModel, cache: Path | None = None) -> Path:
    """Return the cache file of an object's pieces; its stem is a digest of all that determines them."""
    mesh = obj.centred
    shape = hashlib.sha256(mesh.vertices.tobytes() + mesh.faces.tobytes()).hexdigest()
    settings = [_COACD, THRESHOLDS, GOOD_EXCESS_M, version_of("coacd")]
    return (cache or convex.default_cache()) / f"{digest_json({'shape': shape, 'settings': settings})}.npz"


@cached(LRUCache(64), key=lambda _, file: file, condition=Condition())
def _load_or_make(obj: ObjectModel, file: Path) -> ConvexPieces:
    parts = convex.load_parts(file) if file.is_file() else None
    if parts is None:
        best: tuple[Floats, ...] = (obj.hull_vertices,)
        excess = _mean_excess_m(union_volume(best), obj)
        for threshold in THRESHOLDS:
            if excess <= GOOD_EXCESS_M:
                break
            try:
                made = convex.coacd_parts(obj.vertices, obj.faces, {"threshold": threshold, **_COACD}, CPU_S)
            except WorkLimitExceeded as error:
                name = obj.name or "an object"
                log.warning("%s: more than %d pieces need %s; the coarser ones are used", name, len(best), error)
                break
            parts = tuple(part for part in made if len(part) >= 4 and union_volume((part,)) > _MIN_VOLUME)
            found = _mean_excess_m(union_volume(parts), obj)
            if parts and found < excess:
                best, excess = parts, found
        parts = best
        convex.save_parts(file, parts)
    volume = union_volume(parts)
    digest = digest_json([hashlib.sha256(np.round(part, 9).tobytes()).hexdigest() for part in parts])
    return ConvexPieces(parts, volume / obj.volume, _mean_excess_m(volume, obj), digest)


def _mean_excess_m(volume: float, obj: ObjectModel) -> float:
    return (volume - obj.volume) / float(face_areas(obj.vertices, obj.faces).sum())
