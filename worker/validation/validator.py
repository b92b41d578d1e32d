"""Validation of many grasps on all cores; the model of a (hand, object) pair is built once."""

from __future__ import annotations

import logging
import time
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.errors import InputError
from graspd.service.model.transforms import Floats
from graspd.worker.execution_context import DEFAULT_CONTEXT, Count, ExecutionContext, evaluate_rows
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.disk_cache import content_digest
from graspd.worker.objects.model import ObjectModel
from graspd.worker.validation.decomposition import ConvexPieces, decompose
from graspd.worker.validation.key import Level, postures_key, verdict_key
from graspd.worker.validation.model import COARSE, MujocoOptions, Scene, scene_of
from graspd.worker.validation.prefilter.prefilter import PrefilterVerdicts, prefilter_key_terms, run_prefilter
from graspd.worker.validation.protocol import DIRECTIONS, FAST_BAND, Outcome, Rollout, Test, loss_text

log = logging.getLogger(__name__)
_CHUNK: Final = 2  # grasps per task of a process pool: few, so that many processes share one batch
LEVELS: Final = ("dexgraspbench", "standard", "fast")
KnownRollouts = dict[str, Rollout]  # finished rollouts, by `postures_key` of one grasp


@dataclass(frozen=True)
class Verdicts:
    """Verdicts of the validator on N grasps. Success rates with different terms are not comparable."""

    success: NDArray[np.int8]  # (N,) 1 held in all six directions, 0 not
    outcome: NDArray[np.uint8]
    """(N, 6) `Outcome` of each push +x -x +y -y +z -z; pushes after the first failure are not simulated."""
    margin: Floats  # (N,) largest ratio of displacement or rotation to its limit
    penetration_depth_mm: Floats  # (N,) penetration of hand and object, measured with the engine's convex pieces
    self_penetration_depth_mm: Floats
    level: str
    hard: bool
    pieces: int
    volume_ratio: float  # ratio of the volume of the convex pieces to the object's volume
    excess_m: float  # mean height of the pieces above the object's surface [m]
    terms: str  # `verdict_key`: digest of everything that affects a verdict except the grasp
    key: str  # digest of the terms and of the validated postures
    validated_by: NDArray[np.uint8]
    """(N,) `ValidatedBy`: engine of the verdict. Only MuJoCo on the CPU is the reference."""
    seconds: float
    steps: int
    rechecked: int = 0  # prefilter verdicts that the CPU rechecked; where they differ, the CPU's verdict is used

    @property
    def reasons(self) -> list[str]:
        """`held` per grasp, or the first failure and its direction."""
        return [loss_text(row) for row in self.outcome.tolist()]


def validate(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    *,
    level: Level = "standard",
    hard: bool = False,
    pieces: ConvexPieces | None = None,
    known: KnownRollouts | None = None,
    prefilter: PrefilterVerdicts | None = None,
    run: ExecutionContext = DEFAULT_CONTEXT,
) -> Verdicts:
    """Validate grasps by DexGraspBench's force-closure protocol; levels: see `worker.validation.protocol`.
    Threads can use a few cores, since MuJoCo releases the GIL while it steps; for many cores, `run` needs a pool. A
    prefilter of `run` decides clear cases (`worker.validation.prefilter.prefilter`). Raises InputError: unknown level.
    MeshError: the object has no usable convex pieces. TaskCancelled: `run.cancelled()` returned True.

    Args:
        hand: the hand; its stiffness and effort are the actuators' gains and limits.
        obj: the object, with its mass and friction; `ObjectModel.for_dexgraspbench` has those of the protocol.
        grasps: N grasps with pregrasp and squeeze postures.
        level: dexgraspbench, standard, or fast.
        hard: sliding friction halved, torsional friction a tenth.
        pieces: convex pieces of the object; by default its CoACD pieces.
        known: finished CPU rollouts with the same terms; they are reused, and new rollouts are added.
        prefilter: result of `prefilter_grasps` on these grasps with the same terms; computed if None.
        run: receives the number of finished grasps; polled for cancellation between grasps."""
    if level not in LEVELS:
        raise InputError(f"unknown level {level!r}; choose one of {', '.join(LEVELS)}")
    began = time.perf_counter()
    pieces = pieces or decompose(obj)
    prefilter_terms = prefilter_key_terms(hand, level, run)
    # The prefilter leaves only cases near a limit. For such cases, coarse physics would defer to level standard anyway.
    of_the_cpu: Level = "standard" if prefilter_terms else level
    case = _Case(hand, obj, pieces, of_the_cpu, hard)
    terms = verdict_key(hand, obj, level, hard, pieces=pieces, prefilter=prefilter_terms)
    first = prefilter or _run_prefilter(case, terms, grasps, level, run if prefilter_terms else None)
    rollouts = dict(first.stands)
    left = [row for row in range(len(grasps)) if row not in rollouts]
    keys = {row: postures_key(terms, grasps.take(slice(row, row + 1))) for row in left}
    known = {} if known is None else known
    rollouts |= {row: known[key] for row, key in keys.items() if key in known}
    _run_tests(case, grasps, [row for row in left if row not in rollouts], rollouts, run)
    known |= {key: rollouts[row] for row, key in keys.items()}
    contradicted = first.count_contradicted(rollouts)
    if not first.is_trusted(contradicted):
        counts = (contradicted, len(first.rechecked))
        log.warning("%d of %d rechecked verdicts are wrong: the CPU validates all grasps", *counts)
        _run_tests(case, grasps, list(first.stands), rollouts, run)
    ordered = [rollouts[row] for row in range(len(grasps))]
    return Verdicts(
        success=np.array([t.success for t in ordered], np.int8),
        outcome=np.array([t.outcomes for t in ordered], np.uint8).reshape(-1, len(DIRECTIONS)),
        margin=np.array([t.margin for t in ordered], float),
        penetration_depth_mm=np.array([t.penetration_m for t in ordered], float) * 1e3,
        self_penetration_depth_mm=np.array([t.self_penetration_m for t in ordered], float) * 1e3,
        validated_by=np.array([t.validated_by for t in ordered], np.uint8),
        level=level,
        hard=hard,
        pieces=len(pieces),
        volume_ratio=pieces.volume_ratio,
        excess_m=pieces.excess_m,
        terms=terms,
        key=postures_key(terms, grasps),
        seconds=time.perf_counter() - began,
        steps=sum(t.steps for t in ordered),
        rechecked=len(first.rechecked),
    )


def prefilter_grasps(
    hand: HandModel, obj: ObjectModel, grasps: GraspSet, *, level: Level, pieces: ConvexPieces, run: ExecutionContext
) -> PrefilterVerdicts:
    """Run the GPU prefilter for `validate` beforehand, in the thread that owns the device."""
    prefilter_terms = prefilter_key_terms(hand, level, run)
    terms = verdict_key(hand, obj, level, False, pieces=pieces, prefilter=prefilter_terms)
    case = _Case(hand, obj, pieces, "standard", False)
    return _run_prefilter(case, terms, grasps, level, run if prefilter_terms else None)


def _run_prefilter(
    case: _Case, terms: str, grasps: GraspSet, level: Level, run: ExecutionContext | None
) -> PrefilterVerdicts:
    return PrefilterVerdicts({}, {}) if run is None else run_prefilter(case.scene, terms, grasps, level=level, run=run)


@dataclass(frozen=True)
class _Case:
    hand: HandModel
    obj: ObjectModel
    pieces: ConvexPieces
    level: Level
    hard: bool

    @cached_property
    def scene(self) -> Scene:
        return self._scene(MujocoOptions())

    @property
    def coarse(self) -> Scene | None:
        return self._scene(COARSE) if self.level == "fast" else None

    def _scene(self, physics: MujocoOptions) -> Scene:
        return scene_of(self.hand, self.obj, self.pieces, physics.hardened() if self.hard else physics)

    @cached_property
    def tests(self) -> _Tests:
        return _Tests(self)


def _run_tests(
    case: _Case, grasps: GraspSet, rows: list[int], rollouts: dict[int, Rollout], run: ExecutionContext
) -> None:
    done = Count(len(grasps), run, "validation", len(grasps) - len(rows))
    if run.pool is None:

        def ask(tests: _Tests, row: int) -> Rollout:
            run.check("the validator")
            rollout = tests.rollout(grasps, row)
            done.add(1)
            return rollout

        found = evaluate_rows(rows, lambda: _Tests(case), ask, threads=run.cores, name="validation")
        rollouts.update(zip(rows, found, strict=True))
        return
    bare = GraspSet(grasps.grasp, grasps.pregrasp, grasps.squeeze, grasps.stability_loss)
    parts = [bare.take(np.array(rows[k : k + _CHUNK], np.intp)) for k in range(0, len(rows), _CHUNK)]
    made = run.pool.map(
        _rollouts, content_digest(case), case, parts, cancelled=run.cancelled, done=lambda k: done.add(len(parts[k]))
    )
    rollouts.update(zip(rows, (rollout for part in made for rollout in part), strict=True))


def _rollouts(case: _Case, grasps: GraspSet) -> list[Rollout]:
    return [case.tests.rollout(grasps, row) for row in range(len(grasps))]


class _Tests:
    """Tests of one thread."""

    def __init__(self, case: _Case) -> None:
        self.level, coarse = case.level, case.coarse
        self._full = Test(case.scene)
        self._coarse = None if coarse is None else Test(coarse)

    def rollout(self, grasps: GraspSet, row: int) -> Rollout:
        if self.level == "dexgraspbench":
            return self._full.dexgraspbench(grasps, row)
        if self._coarse is None:
            return self._full.standard(grasps, row)
        rollout = self._coarse.standard(grasps, row)
        low, high = FAST_BAND
        # Penetration has no margin: it is geometric, and equal in coarse and full physics.
        clear = rollout.outcomes[0] is Outcome.PENETRATION or not low < rollout.margin < high
        if clear and Outcome.DIVERGED not in rollout.outcomes:
            return rollout
        second = self._full.standard(grasps, row)
        second.steps += rollout.steps
        return second
