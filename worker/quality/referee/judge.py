"""Verdicts of the referee on many grasps, all cores used; the model of a (hand, object) pair is built once."""

from __future__ import annotations

import os
import queue
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final, Literal

import mujoco
import numpy as np
from numpy.typing import NDArray

from service.digests import digest_bytes, digest_json
from service.errors import InputError, TaskCancelled
from worker.grasps import GraspSet, Posture
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.quality.referee import protocol
from worker.quality.referee.decomposition import ConvexPieces, decompose
from worker.quality.referee.model import DAMPING_TIME, FRICTION, HARD, OBJECT_MASS, Physics, build
from worker.quality.referee.protocol import DIRECTIONS, SCREEN_BAND, Outcome, Test, Trial
from worker.transforms import compose, invert, quat_from_axis_angle

Floats = NDArray[np.float64]
Level = Literal["letter", "certificate", "screen"]
Progress = Callable[[float, float, str], None]
Cancelled = Callable[[], bool]

LEVELS: Final = ("letter", "certificate", "screen")
_SCREEN: Final = Physics(timestep=0.008, noslip_iterations=0, root="fixed")


@dataclass(frozen=True)
class Verdicts:
    """What the referee says of N grasps. Verdicts of different keys must not be mixed in one number."""

    success: NDArray[np.int8]
    """(N,) 1 held in all six directions, 0 not."""
    outcome: NDArray[np.uint8]
    """(N, 6) `Outcome` of each push +x -x +y -y +z -z; pushes after the first failure are not tried."""
    margin: Floats
    """(N,) worst displacement or rotation over its limit."""
    penetration_depth_mm: Floats
    """(N,) hand-object, as the engine's convex pieces have it."""
    self_penetration_depth_mm: Floats
    """(N,)"""
    level: str
    hard: bool
    pieces: int
    volume_ratio: float
    """Volume of the object's convex pieces over its own."""
    excess_m: float
    """Mean height of the pieces above the object's surface [m]."""
    key: str
    """Digest of everything that moves a verdict: hand, object, pieces, postures, protocol, engine version."""
    seconds: float
    """Wall time."""
    steps: int
    """Simulation steps of all trials."""

    @property
    def reasons(self) -> list[str]:
        """Per grasp: `held`, or the first thing that went wrong and where."""
        axes = ("+x", "-x", "+y", "-y", "+z", "-z")
        found: list[str] = []
        for row in self.outcome:
            bad = [k for k, value in enumerate(row) if value not in (Outcome.HELD, Outcome.NOT_TRIED)]
            name = Outcome(int(row[bad[0]])).name.lower().replace("_", " ") if bad else "held"
            pushed = bad and row[bad[0]] in (Outcome.DISPLACED, Outcome.ROTATED)
            found.append(f"{name} under {axes[bad[0]]}" if pushed else name)
        return found


def judge(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    *,
    level: Level = "certificate",
    hard: bool = False,
    threads: int = 0,
    pieces: ConvexPieces | None = None,
    cache: Path | None = None,
    progress: Progress = lambda done, total, message: None,
    cancelled: Cancelled = lambda: False,
) -> Verdicts:
    """Test grasps by the DexGraspBench force-closure protocol; see `worker.quality.referee.protocol` for the levels.

    MuJoCo releases the interpreter lock while it steps, so threads use all cores.

    Args:
        hand: the hand; its stiffness and effort are the actuators' gains and limits.
        obj: the object, 0.1 kg whatever it is made of.
        grasps: N grasps with pregrasp and squeeze postures.
        level: letter, certificate or screen.
        hard: sliding friction halved, torsional friction a tenth.
        threads: 0: all cores.
        pieces: convex pieces of the object; by default its CoACD pieces.
        cache: folder of the pieces, see `decompose`.
        progress: called with grasps done.
        cancelled: polled between grasps.

    Raises:
        InputError: unknown level.
        MeshError: the object has no usable convex pieces.
        TaskCancelled: when `cancelled()` answers True.
    """
    if level not in LEVELS:
        raise InputError(f"unknown level {level!r}; choose one of {', '.join(LEVELS)}")
    began = time.perf_counter()
    pieces = pieces or decompose(obj, cache=cache)
    bench = _Bench(hand, obj, pieces, level, hard, threads or os.cpu_count() or 1)
    done = 0

    def work(row: int) -> Trial:
        nonlocal done
        if cancelled():
            raise TaskCancelled("the referee was cancelled")
        trial = bench.trial(grasps, row)
        done += 1
        progress(done, len(grasps), "referee")
        return trial

    with ThreadPoolExecutor(bench.threads, thread_name_prefix="referee") as pool:
        trials = list(pool.map(work, range(len(grasps))))
    return _verdicts(trials, bench, _key(hand, obj, grasps, pieces, level, hard), time.perf_counter() - began)


class _Bench:
    """The compiled scenes of one pair, and a test for each thread."""

    def __init__(
        self, hand: HandModel, obj: ObjectModel, pieces: ConvexPieces, level: Level, hard: bool, threads: int
    ) -> None:
        self.level, self.hard, self.pieces, self.threads = level, hard, pieces, threads
        self._full: queue.SimpleQueue[Test] = queue.SimpleQueue()
        self._coarse: queue.SimpleQueue[Test] = queue.SimpleQueue()
        levels = [Physics().hardened(), _SCREEN.hardened()] if hard else [Physics(), _SCREEN]
        full = build(hand, obj, pieces, levels[0])
        coarse = build(hand, obj, pieces, levels[1]) if level == "screen" else None
        for _ in range(threads):
            self._full.put(Test(full))
            if coarse is not None:
                self._coarse.put(Test(coarse))

    def trial(self, grasps: GraspSet, row: int) -> Trial:
        if self.level == "screen":
            trial = self._with(self._coarse, grasps, row)
            low, high = SCREEN_BAND
            # A penetration has no margin: it is a fact of geometry, the same in either physics.
            if trial.outcomes[0] is Outcome.PENETRATION or not low < trial.margin < high:
                return trial
            second = self._with(self._full, grasps, row)
            second.steps += trial.steps
            return second
        return self._with(self._full, grasps, row)

    def _with(self, tests: queue.SimpleQueue[Test], grasps: GraspSet, row: int) -> Trial:
        test = tests.get()
        try:
            return test.letter(grasps, row) if self.level == "letter" else test.certificate(grasps, row)
        finally:
            tests.put(test)


def _verdicts(trials: list[Trial], bench: _Bench, key: str, seconds: float) -> Verdicts:
    return Verdicts(
        success=np.array([t.success for t in trials], np.int8),
        outcome=np.array([t.outcomes for t in trials], np.uint8).reshape(-1, len(DIRECTIONS)),
        margin=np.array([t.margin for t in trials], float),
        penetration_depth_mm=np.array([t.penetration_m for t in trials], float) * 1e3,
        self_penetration_depth_mm=np.array([t.self_penetration_m for t in trials], float) * 1e3,
        level=bench.level,
        hard=bench.hard,
        pieces=len(bench.pieces),
        volume_ratio=bench.pieces.volume_ratio,
        excess_m=bench.pieces.excess_m,
        key=key,
        seconds=seconds,
        steps=sum(t.steps for t in trials),
    )


def _key(hand: HandModel, obj: ObjectModel, grasps: GraspSet, pieces: ConvexPieces, level: Level, hard: bool) -> str:
    postures = b"".join(
        np.ascontiguousarray(array, float).tobytes()
        for posture in (grasps.pregrasp, grasps.grasp, grasps.squeeze)
        for array in (posture.hand_pose, posture.joint_positions)
    )
    constants = {name: value for name, value in vars(protocol).items() if name.isupper()}
    return digest_json(
        {
            "hand": [hand.digest, hand.stiffness.tolist(), hand.effort.tolist()],
            "object": obj.digest,
            "pieces": pieces.digest,
            "postures": digest_bytes(postures),
            "protocol": constants,
            "scene": [FRICTION, HARD, OBJECT_MASS, DAMPING_TIME, asdict(_SCREEN)],
            "level": level,
            "hard": hard,
            "engine": mujoco.__version__,
        }
    )


def robustness(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    *,
    repeats: int = 5,
    noise_m: float = 1e-3,
    noise_rad: float = float(np.radians(1.0)),
    seed: int = 0,
    level: Level = "certificate",
    hard: bool = False,
    threads: int = 0,
    pieces: ConvexPieces | None = None,
) -> Floats:
    """(N,) share of `repeats` in which a grasp still holds when the object is not quite where it was thought.

    The object is moved by `noise_m` in a random direction and turned by `noise_rad` about a random axis through its
    centre of mass; grasp i in repeat k gets the same noise in every set.
    """
    held = np.zeros(len(grasps))
    for repeat in range(repeats):
        moves = np.array([_noise(obj, noise_m, noise_rad, (seed, repeat, i)) for i in range(len(grasps))])
        moved = _moved(grasps, invert(moves.reshape(-1, 7)))
        held += judge(hand, obj, moved, level=level, hard=hard, threads=threads, pieces=pieces).success
    return held / max(1, repeats)


def _noise(obj: ObjectModel, noise_m: float, noise_rad: float, seed: tuple[int, ...]) -> Floats:
    """(7,) motion of the object."""
    rng = np.random.default_rng(seed)
    shift, axis = rng.normal(size=(2, 3))
    rotation = quat_from_axis_angle(axis / np.linalg.norm(axis), np.array(noise_rad))
    about = np.concatenate([obj.centre_of_mass + noise_m * shift / np.linalg.norm(shift), rotation])
    return compose(about, np.concatenate([-obj.centre_of_mass, [1.0, 0, 0, 0]]))


def _moved(grasps: GraspSet, motion: Floats) -> GraspSet:
    """The grasps with the hand moved by one motion (N, 7) each."""

    def moved(part: Posture) -> Posture:
        return Posture(compose(motion, part.hand_pose), part.joint_positions)

    return GraspSet(moved(grasps.grasp), moved(grasps.pregrasp), moved(grasps.squeeze), grasps.stability_loss)
