"""How many verdicts survive when the object is not quite where it was thought to be."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.transforms import Floats, compose, invert, quat_from_axis_angle
from worker.grasps import GraspSet, Posture
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.quality.referee.decomposition import ConvexPieces
from worker.quality.referee.judge import judge
from worker.quality.referee.key import Level
from worker.run import ALONE, Run

NOISE_M: Final = 1e-3
NOISE_RAD: Final = float(np.radians(1.0))


def robustness(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    *,
    held: NDArray[np.generic] | None = None,
    repeats: int = 5,
    noise_m: float = NOISE_M,
    noise_rad: float = NOISE_RAD,
    seed: int = 0,
    level: Level = "screen",
    hard: bool = False,
    pieces: ConvexPieces | None = None,
    cache: Path | None = None,
    run: Run = ALONE,
) -> Floats:
    """(N,) share of `repeats` in which a grasp still holds with noise on the object's pose; nan: not tried.

    The object is moved by `noise_m` in a random direction and turned by `noise_rad` about a random axis through its
    centre of mass; a grasp's noise follows from `seed`, the repeat and its place in the set.

    Args:
        hand: the hand.
        obj: the object.
        grasps: N grasps.
        held: (N,) verdicts without noise; only grasps with 1 are tried. By default all.
        repeats: noisy verdicts for each grasp.
        noise_m: size of the shift [m].
        noise_rad: size of the turn [rad].
        seed: of the noise.
        level: what a noisy verdict costs; a share is no rate of success, so the cheap level does.
        hard: the hard protocol's friction.
        pieces: convex pieces of the object; by default its CoACD pieces.
        cache: folder of the pieces, see `decompose`.
        run: told of noisy verdicts done; asked between them whether to stop.

    Raises:
        MeshError: the object has no usable convex pieces.
        TaskCancelled: when `run.cancelled()` answers True.
    """
    out = np.full(len(grasps), np.nan)
    tried = np.arange(len(grasps)) if held is None else np.flatnonzero(np.asarray(held) == 1)
    if not len(tried) or repeats < 1:
        return out
    moves = np.array([_noise(obj, noise_m, noise_rad, (seed, k, int(i))) for k in range(repeats) for i in tried])
    noisy = _moved(grasps, np.tile(tried, repeats), invert(moves))
    verdicts = judge(hand, obj, noisy, level=level, hard=hard, pieces=pieces, cache=cache, run=run)
    out[tried] = verdicts.success.reshape(repeats, len(tried)).mean(axis=0)
    return out


def _noise(obj: ObjectModel, noise_m: float, noise_rad: float, seed: tuple[int, ...]) -> Floats:
    """(7,) motion of the object."""
    rng = np.random.default_rng(seed)
    shift, axis = rng.normal(size=(2, 3))
    rotation = quat_from_axis_angle(axis / np.linalg.norm(axis), np.array(noise_rad))
    about = np.concatenate([obj.centre_of_mass + noise_m * shift / np.linalg.norm(shift), rotation])
    return compose(about, np.concatenate([-obj.centre_of_mass, [1.0, 0, 0, 0]]))


def _moved(grasps: GraspSet, rows: NDArray[np.intp], motion: Floats) -> GraspSet:
    """The rows of the grasps with the hand moved by one motion (K, 7) each."""

    def moved(part: Posture) -> Posture:
        pose, joints = np.asarray(part.hand_pose, float), np.asarray(part.joint_positions, float)
        return Posture(compose(motion, pose[rows]), joints[rows])

    loss = np.asarray(grasps.stability_loss)[rows]
    return GraspSet(moved(grasps.grasp), moved(grasps.pregrasp), moved(grasps.squeeze), loss)
