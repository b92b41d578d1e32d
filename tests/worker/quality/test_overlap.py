"""Pieces that need no boolean of solids, against the boolean itself."""

from __future__ import annotations

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from graspd.worker.grasps import Posture
from graspd.worker.objects.model import ObjectModel
from graspd.worker.quality.overlap import Overlap
from graspd.worker.quality.probe import Probe
from graspd.worker.quality.volume import SharedVolume
from tests.worker.models import object_from_mesh
from tests.worker.quality.helpers import plate_hand

HAND = plate_hand((0.05, 0.04, 0.01))
EVERY = np.ones((1, len(HAND.pieces)), bool)


def kept_and_shared(obj: ObjectModel, postures: Posture) -> tuple[np.ndarray, np.ndarray]:
    """(B, P) what the test keeps, and the volume that each piece shares with the object by the boolean [cm^3]."""
    probe, volume = Probe(HAND, obj, hand_points=300, object_points=500), SharedVolume(HAND, obj)
    found, overlap = probe.measure(postures), Overlap(HAND, probe)
    kept = overlap.of(found, np.repeat(EVERY, len(found.bodies), axis=0))
    alone = [volume.of(found.bodies, np.arange(len(HAND.pieces)) == np.full((len(kept), 1), p)) for p in range(3)]
    return kept, np.stack(alone, axis=1)


def test_no_piece_that_shares_volume_is_left_out_and_many_others_are() -> None:
    rng = np.random.default_rng(4)
    turn = Rotation.random(200, rng=rng).as_quat(scalar_first=True)
    # Plates that slide by 0 to 0.1 m around a ball of 0.04 m: in it, at it, beside it.
    postures = Posture(np.hstack([rng.uniform(-0.05, 0.05, (200, 3)), turn]), rng.uniform(0.0, 0.1, (200, 2)))
    ball = object_from_mesh(trimesh.creation.icosphere(subdivisions=3, radius=0.04))
    kept, shared = kept_and_shared(ball, postures)
    assert not (shared[~kept] > 0).any()
    assert (shared > 0).sum() > 100 and (~kept).sum() > 100
    assert (shared[kept] > 0).mean() > 0.9, "only edges beside edges are kept for nothing"


def test_a_piece_in_the_object_and_an_object_in_a_piece_are_kept() -> None:
    at_rest = Posture(np.array([[0, 0, 0, 1.0, 0, 0, 0]]), np.zeros((1, 2)))
    around = object_from_mesh(trimesh.creation.box((0.6, 0.6, 0.6)))
    kept, shared = kept_and_shared(around, at_rest)
    assert kept.all() and (shared > 0).all()
    crumb = trimesh.creation.box((0.004, 0.004, 0.004))
    crumb.apply_translation([-0.1, 0, 0])  # in the middle of the left plate
    kept, shared = kept_and_shared(object_from_mesh(crumb), at_rest)
    assert kept.tolist() == [[False, True, False]] and shared[0, 1] > 0
