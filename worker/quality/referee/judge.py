"""Verdicts of the referee on many grasps, all cores used; the model of a (hand, object) pair is built once."""

from __future__ import annotations

import logging
import queue
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.errors import InputError
from service.model.transforms import Floats
from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.disk_cache import content_of
from worker.objects.model import ObjectModel
from worker.quality.referee.compiled import scene_of
from worker.quality.referee.decomposition import ConvexPieces, decompose
from worker.quality.referee.first.screening import Screened, first_terms, screened
from worker.quality.referee.key import Level, postures_key, verdict_key
from worker.quality.referee.model import COARSE, MujocoOptions, Scene
from worker.quality.referee.protocol import DIRECTIONS, SCREEN_BAND, Outcome, Test, Trial
from worker.run import ALONE, Count, Run

log = logging.getLogger(__name__)
#: Grasps that a process of a pool judges at a time: few, so that those of one batch are shared by many processes.
_CHUNK: Final = 2
LEVELS: Final = ("letter", "certificate", "screen")
#: Trials that were done, by `postures_key` of one grasp.
KnownTrials = dict[str, Trial]


@dataclass(frozen=True)
class Verdicts:
    """What the referee says of N grasps. Verdicts of different terms must not be mixed in one number."""

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
    terms: str
    """`verdict_key`: digest of all that moves a verdict but the grasp. Rates of different terms do not compare."""
    key: str
    """Digest of the terms and of the postures that were judged."""
    judged_by: NDArray[np.uint8]
    """(N,) `JudgedBy`: whose verdict it is. Only those of MuJoCo on the CPU are certificates."""
    seconds: float
    """Wall time."""
    steps: int
    """Simulation steps of all trials."""
    audited: int = 0
    """Verdicts of the first judge that the CPU was asked for as well; where they differ the CPU's stands."""
    contradicted: int = 0
    """How many of them differed."""

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
    pieces: ConvexPieces | None = None,
    cache: Path | None = None,
    known: KnownTrials | None = None,
    prefilter: Screened | None = None,
    run: Run = ALONE,
) -> Verdicts:
    """Test grasps by the DexGraspBench force-closure protocol; see `worker.quality.referee.protocol` for the levels.

    MuJoCo releases the interpreter lock while it steps, so threads use a few cores; for many `run` has a pool. Where
    `run` has a first judge it gives the clear verdicts, see `worker.quality.referee.first.screening`.

    Args:
        hand: the hand; its stiffness and effort are the actuators' gains and limits.
        obj: the object, with its mass and friction; `ObjectModel.published` has those of the protocol.
        grasps: N grasps with pregrasp and squeeze postures.
        level: letter, certificate or screen.
        hard: sliding friction halved, torsional friction a tenth.
        pieces: convex pieces of the object; by default its CoACD pieces.
        cache: folder of the pieces, see `decompose`.
        known: trials of the CPU on these terms that are not done again; others are added.
        prefilter: what `prefiltered` says of these grasps on these terms; None: it is asked.
        run: told of grasps done; asked between grasps whether to stop.

    Raises:
        InputError: unknown level.
        MeshError: the object has no usable convex pieces.
        TaskCancelled: when `run.cancelled()` answers True.
    """
    if level not in LEVELS:
        raise InputError(f"unknown level {level!r}; choose one of {', '.join(LEVELS)}")
    began = time.perf_counter()
    pieces = pieces or decompose(obj, cache=cache)
    first_judge = first_terms(hand, level, run)
    # What the first judge leaves over is near a limit: coarse physics would ask the certificate as well.
    of_the_cpu: Level = "certificate" if first_judge else level
    case = _Case(hand, obj, pieces, of_the_cpu, hard)
    terms = verdict_key(hand, obj, level, hard, pieces=pieces, first_judge=first_judge)
    first = prefilter or _screened(case, terms, grasps, level, run if first_judge else None)
    trials = dict(first.stands)
    left = [row for row in range(len(grasps)) if row not in trials]
    keys = {} if known is None else {row: postures_key(terms, grasps.take(slice(row, row + 1))) for row in left}
    if known is not None:
        trials |= {row: known[key] for row, key in keys.items() if key in known}
    _try(case, grasps, [row for row in left if row not in trials], trials, run)
    if known is not None:
        known |= {key: trials[row] for row, key in keys.items()}
    contradicted = first.contradicted(trials)
    if not first.believed(contradicted):
        log.warning("%d of %d audited verdicts are contradicted: the CPU judges all", contradicted, len(first.audited))
        _try(case, grasps, list(first.stands), trials, run)
    ordered = [trials[row] for row in range(len(grasps))]
    found = _verdicts(ordered, case, terms, postures_key(terms, grasps), time.perf_counter() - began)
    return replace(found, level=level, audited=len(first.audited), contradicted=contradicted)


def prefiltered(
    hand: HandModel, obj: ObjectModel, grasps: GraspSet, *, level: Level, pieces: ConvexPieces, run: Run
) -> Screened:
    """What `judge` asks of the GPU prefilter, for whoever has the device before."""
    first_judge = first_terms(hand, level, run)
    terms = verdict_key(hand, obj, level, False, pieces=pieces, first_judge=first_judge)
    return _screened(_Case(hand, obj, pieces, "certificate", False), terms, grasps, level, run if first_judge else None)


def _screened(case: _Case, terms: str, grasps: GraspSet, level: Level, run: Run | None) -> Screened:
    return Screened({}, {}) if run is None else screened(case.scene, terms, grasps, level=level, run=run)


@dataclass(frozen=True)
class _Case:
    """What is judged, and how."""

    hand: HandModel
    obj: ObjectModel
    pieces: ConvexPieces
    level: Level
    hard: bool

    @cached_property
    def scene(self) -> Scene:
        """Of the certificate."""
        return self._scene(MujocoOptions())

    @property
    def coarse(self) -> Scene | None:
        return self._scene(COARSE) if self.level == "screen" else None

    def _scene(self, physics: MujocoOptions) -> Scene:
        return scene_of(self.hand, self.obj, self.pieces, physics.hardened() if self.hard else physics)

    @cached_property
    def bench(self) -> _Bench:
        """Of a process of a pool, which keeps it with the case."""
        return _Bench(self, 1)


def _try(case: _Case, grasps: GraspSet, rows: list[int], trials: dict[int, Trial], run: Run) -> None:
    """Put the trials of some grasps among those that are there."""
    if run.pool is None:
        _Bench(case, run.cores).judge(grasps, rows, trials, run)
        return
    bare = GraspSet(grasps.grasp, grasps.pregrasp, grasps.squeeze, grasps.stability_loss)
    parts = [bare.take(np.array(rows[k : k + _CHUNK], np.intp)) for k in range(0, len(rows), _CHUNK)]
    done = Count(len(grasps), run, "referee", len(grasps) - len(rows))
    made = run.pool.map(
        _trials, content_of(case), case, parts, cancelled=run.cancelled, done=lambda k: done.add(len(parts[k]))
    )
    trials.update(zip(rows, (trial for part in made for trial in part), strict=True))


def _trials(case: _Case, grasps: GraspSet) -> list[Trial]:
    """Of some grasps, one after the other."""
    return [case.bench.trial(grasps, row) for row in range(len(grasps))]


class _Bench:
    """A test for each thread."""

    def __init__(self, case: _Case, threads: int) -> None:
        self.level, self.threads = case.level, threads
        self._full: queue.SimpleQueue[Test] = queue.SimpleQueue()
        self._coarse: queue.SimpleQueue[Test] = queue.SimpleQueue()
        full, coarse = case.scene, case.coarse
        for _ in range(threads):
            self._full.put(Test(full))
            if coarse is not None:
                self._coarse.put(Test(coarse))

    def judge(self, grasps: GraspSet, rows: list[int], trials: dict[int, Trial], run: Run) -> None:
        """Put the trials of some grasps among those that are there."""
        done = Count(len(grasps), run, "referee", len(grasps) - len(rows))

        def work(row: int) -> None:
            run.check("the referee")
            trials[row] = self.trial(grasps, row)
            done.add(1)

        with ThreadPoolExecutor(self.threads, thread_name_prefix="referee") as pool:
            list(pool.map(work, rows))

    def trial(self, grasps: GraspSet, row: int) -> Trial:
        if self.level == "screen":
            trial = self._with(self._coarse, grasps, row)
            low, high = SCREEN_BAND
            # A penetration has no margin: it is a fact of geometry, the same in either physics.
            clear = trial.outcomes[0] is Outcome.PENETRATION or not low < trial.margin < high
            if clear and Outcome.DIVERGED not in trial.outcomes:
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


def _verdicts(trials: list[Trial], case: _Case, terms: str, key: str, seconds: float) -> Verdicts:
    return Verdicts(
        success=np.array([t.success for t in trials], np.int8),
        outcome=np.array([t.outcomes for t in trials], np.uint8).reshape(-1, len(DIRECTIONS)),
        margin=np.array([t.margin for t in trials], float),
        penetration_depth_mm=np.array([t.penetration_m for t in trials], float) * 1e3,
        self_penetration_depth_mm=np.array([t.self_penetration_m for t in trials], float) * 1e3,
        judged_by=np.array([t.judged_by for t in trials], np.uint8),
        level=case.level,
        hard=case.hard,
        pieces=len(case.pieces),
        volume_ratio=case.pieces.volume_ratio,
        excess_m=case.pieces.excess_m,
        terms=terms,
        key=key,
        seconds=seconds,
        steps=sum(t.steps for t in trials),
    )
