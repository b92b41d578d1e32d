"""Grasps with their quality and verdict: planned in rounds until enough are valid or the budget ends.

A grasp is feasible if it passes the geometric gate, and valid if the validator says besides that it holds. Where nobody
validates, feasible ones are counted in their place and none is valid. Where a share of models is wanted, valid grasps
that hold in so many count. The dear steps come last: a grasp that the validator drops is not measured, and one that is
not valid is validated in no other model.
"""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import TaskCancelled
from graspd.service.model.planning import totals
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.grasps import GraspSet, joined, joined_columns
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.pinch_postures import require_opposing
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners import NoStartFound, PlanRequest, Rollout, fitting_pairs, method, synthesize
from graspd.worker.planners.fast_graspd.antipodal_starts import why_narrow
from graspd.worker.quality.diversity import POINTS, distinct, hand_points
from graspd.worker.quality.gate import GATES, failed_gate, passes
from graspd.worker.quality.table import measure
from graspd.worker.rounds import ROUND_STRIDE, Arrays, Round, enough, lanes_of, next_round, taken
from graspd.worker.scenes.rollout import lift_level, outcomes_in_scenes, rollout_on, scene_verdicts
from graspd.worker.side_by_side import side_by_side
from graspd.worker.simulation.environment import PlacedGrasps, Scenes
from graspd.worker.validation.decomposition import ConvexPieces, decompose
from graspd.worker.validation.displacement import simulated_displacement_cm
from graspd.worker.validation.key import verdict_key
from graspd.worker.validation.lift import LiftOutcome
from graspd.worker.validation.lifting import lift_key, validate_lifts
from graspd.worker.validation.payload import ENOUGH, Limit, limit_of, payloads, shake_margins
from graspd.worker.validation.prefilter.prefilter import PrefilterVerdicts, first_terms
from graspd.worker.validation.protocol import DIRECTIONS, Outcome
from graspd.worker.validation.robust import reaches, robust, robustness
from graspd.worker.validation.validator import prefiltered, validate

#: Why a grasp is not kept: its hand is no number, something of its scene is in its way, the validator dropped it, it
#: failed the geometric gate, holds in too few models around the nominal one, lifts too little, or is as good as the
#: same as one kept.
REJECTIONS: Final = ("diverged", "blocked", "dropped", "gate", "not_robust", "weak", "alike")
#: Outcomes that are not told by the word of their rejection.
_REJECTION_OF: Final = {
    "no_place": "blocked",
    "diverged": "diverged",
    "not_robust": "not_robust",
    "weak": "weak",
    "alike": "alike",
    **{f"gate_{name}": "gate" for name in GATES},
}
#: Names of the outcomes of a push and of a lift that drops a grasp.
_PUSHED: Final = {
    Outcome.PENETRATION: "penetration",
    Outcome.LOST_WHILE_CLOSING: "lost_while_closing",
    Outcome.DISPLACED: "slipped",
    Outcome.ROTATED: "turned",
    Outcome.DIVERGED: "unstable",
}
_LIFTED: Final = {
    LiftOutcome.PENETRATION: "penetration",
    LiftOutcome.TOUCHED_ON_THE_WAY: "touched_on_the_way",
    LiftOutcome.LOST_WHILE_CLOSING: "lost_while_closing",
    LiftOutcome.NOT_LIFTED: "not_lifted",
    LiftOutcome.TURNED: "turned",
    LiftOutcome.DIVERGED: "unstable",
    LiftOutcome.NEIGHBOUR_MOVED: "neighbour_moved",
}
#: Verdicts on candidates from the planner's trial, of lifts or of pushes.
Known = dict[str, Any]
#: Shares of a round's progress: planned, validated, measured.
PARTS: Final = (0.6, 0.8, 1.0)


@dataclass(frozen=True)
class ValidatedBatch:
    """What came of a batch."""

    grasps: GraspSet
    columns: Arrays
    """The `quality/...` columns of a base shard."""
    candidates: int
    """Grasps planned up to the last one that is kept, or all where fewer were found than wanted."""
    rejected: dict[str, int]
    """Those of them that were not kept, by `REJECTIONS`."""
    outcomes: dict[str, int]
    """The same, by `service.model.planning.OUTCOMES`: what the validator saw, which gate."""
    verdict_key: str | None
    """Digest of the terms of the verdicts; None: not validated."""
    planned: int
    """Grasps planned in all."""
    seconds: dict[str, float] = field(default_factory=dict)
    """Wall time of planning, validating and measuring [s]."""
    shares: dict[str, float] = field(default_factory=dict)
    """In scenes, of all that were planned: clear_share (free of obstacles at contact, on the way and in the lift),
    lift_share (and lifted), lift_hard_share (and lifted at half the friction)."""
    narrow: str | None = None
    """In scenes where nothing is valid the geometric reason, see `why_narrow`."""
    limit: Limit | None = None
    """What the best of a round lifts, where none is kept and the weight is why."""

    def moved(self, by: Sequence[float]) -> ValidatedBatch:
        """The same with the grasps moved by a vector (3,) [m]."""
        return replace(self, grasps=self.grasps.moved(by))


def validated_grasps(
    hand: HandModel,
    obj: ObjectModel,
    request: JobOptions,
    *,
    count: int,
    batch: int = 0,
    scenes: Scenes | None = None,
    pieces: Callable[[ObjectModel], ConvexPieces] = decompose,
    run: ExecutionContext = DEFAULT_CONTEXT,
    partial: bool = False,
) -> ValidatedBatch:
    """A batch of a job: `count` valid grasps (feasible ones where nothing is validated), or as many as the budget
    finds; or `count` grasps of any kind.

    Args:
        hand: the hand.
        obj: the object.
        request: method, fidelity, seed, friction; whether valid grasps are wanted, at which level, and the budget.
        count: grasps wanted.
        batch: number of the batch within its job.
        scenes: where the grasps are to be used, in turn; valid then means lifted out of its scene. None: free.
        pieces: gives the object's convex pieces; runs beside the first round's planning.
        run: told of the share that is done; asked often whether to stop. Its device is the planner's.
        partial: if it is stopped, what was validated before is the batch.

    Raises:
        HandError: no two digits of the hand oppose each other.
        InputError: the object does not fit into the gripper.
        MeshError: the object has no usable convex pieces.
        TaskCancelled: when `run.cancelled()` answers True; with `partial`, before anything was validated.
    """
    require_graspable(hand, obj)
    with Scoring.begun(hand, obj, request, scenes=scenes, pieces=pieces, run=run) as scoring:
        work = Batch(scoring, batch, count, run)
        try:
            while work.needed is not None:
                work.add(work.made(work.needed))
        except TaskCancelled:
            if not partial or not work.rounds:
                raise
            scoring.goes_on()
        return work.finish()


def require_graspable(hand: HandModel, obj: ObjectModel) -> None:
    """
    Raises:
        HandError: no two digits of the hand oppose each other.
        InputError: the object does not fit into the gripper.
    """
    require_opposing(hand)
    fitting_pairs(hand, obj.centred)


def scored(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    request: JobOptions,
    *,
    scenes: Scenes | None = None,
    pieces: Callable[[ObjectModel], ConvexPieces] = decompose,
    run: ExecutionContext = DEFAULT_CONTEXT,
) -> ValidatedBatch:
    """Grasps that are there already, validated and measured as `request` says; all of them are kept.

    With `scenes` they are validated in these, `grasps.scene` saying in which.

    Raises:
        MeshError: the object has no usable convex pieces.
        TaskCancelled: when `run.cancelled()` answers True.
    """
    request = request.model_copy(update={"want": "candidates"})
    with Scoring.begun(hand, obj, request, scenes=scenes, pieces=pieces, run=run) as scoring:
        work = Batch(scoring, 0, len(grasps), run)
        work.add(scoring.scored(grasps.moved(np.negative(obj.centre)), run))
        return work.finish()


class Scoring:
    """Verdicts and metrics of grasps of one job, whichever of its batches they are of; a grasp's do not depend on what
    is scored with it."""

    def __init__(
        self, hand: HandModel, obj: ObjectModel, request: JobOptions, scenes: Scenes | None, run: ExecutionContext
    ) -> None:
        self.hand, self.obj, self.request, self.run = hand, obj.centred, request, run
        self.centre = obj.centre
        self.scenes = None if scenes is None else scenes.centred(obj)
        self.pieces: Future[ConvexPieces] | None = None
        self.beside: ThreadPoolExecutor
        """A thread for what need not be waited for."""

    @classmethod
    @contextmanager
    def begun(
        cls,
        hand: HandModel,
        obj: ObjectModel,
        request: JobOptions,
        *,
        scenes: Scenes | None,
        pieces: Callable[[ObjectModel], ConvexPieces],
        run: ExecutionContext,
    ) -> Iterator[Scoring]:
        """With the object's convex pieces on their way, where somebody validates."""
        made = cls(hand, obj, request, scenes, run)
        with ThreadPoolExecutor(1, thread_name_prefix="beside") as made.beside:
            made.pieces = made.beside.submit(pieces, made.obj) if request.validation != "none" else None
            yield made

    def goes_on(self) -> None:
        """From here on nobody stops it."""
        self.run = replace(self.run, cancelled=DEFAULT_CONTEXT.cancelled)

    def rollout(self, known: Known) -> Rollout | None:
        """What candidates go through, where there is a validator; verdicts of the validator's own level become
        `known`."""
        if self.pieces is None:
            return None
        return rollout_on(
            self.run,
            self.hand,
            self.obj,
            self.pieces.result,
            in_scenes=self.scenes is not None,
            known=known,
            level=self._level,
        )

    def key(self) -> str:
        """Digest of the terms of the verdicts."""
        assert self.pieces is not None
        pieces = self.pieces.result()
        if self.scenes is None:
            prefilter = first_terms(self.hand, self._level, self.run)
            return verdict_key(self.hand, self.obj, self._level, False, pieces=pieces, prefilter=prefilter)
        placed = self.scenes.placed(np.zeros(0, int))
        return lift_key(self.hand, self.obj, placed, lift_level(self.request.validation), False, pieces=pieces)

    @property
    def _level(self) -> Any:
        return self.request.validation

    def prefiltered(self, planned: GraspSet) -> PrefilterVerdicts | None:
        """What the GPU prefilter says of those of the grasps that are numbers; None: it has no part in this."""
        if self.pieces is None or self.scenes is not None or not first_terms(self.hand, self._level, self.run):
            return None
        finite = planned.take(np.flatnonzero(planned.finite))
        return prefiltered(
            self.hand, self.obj, finite, level=self._level, pieces=self.pieces.result(), run=self.run.quiet()
        )

    def scored(
        self,
        planned: GraspSet,
        run: ExecutionContext,
        known: Known | None = None,
        prefilter: PrefilterVerdicts | None = None,
    ) -> Round:
        """Validate and measure grasps, and keep those that are wanted or like others; a hand that is no number is never
        one of them. `known` are verdicts on candidates, `prefilter` what the GPU prefilter said of them before."""
        fates = np.where(planned.finite, "kept", "diverged").astype(object)
        seconds = {"planner": 0.0, "validation": 0.0, "quality": 0.0}
        finite = np.flatnonzero(fates == "kept")
        planned = planned.take(finite)
        size, every = len(planned), self.request.want == "candidates"
        in_scene: dict[str, NDArray[np.bool_]] = {}
        if self.scenes is None:
            columns = self._validated(planned, run, seconds, known, prefilter)
        else:
            planned, columns = self._validated_in_scenes(planned, self.scenes, run, seconds, known)
            fates[finite[columns["quality/success"] < 0]] = "no_place"
            for name, those in outcomes_in_scenes(columns).items():
                in_scene[name] = np.zeros(len(fates), bool)
                in_scene[name][finite] = those
        why = _why(columns, size)
        rows = np.arange(size) if every or not columns else np.flatnonzero(columns["quality/success"] == 1)
        grasps = planned.take(rows)
        columns = {path: array[rows] for path, array in columns.items()} | self._measured(grasps, run, seconds)
        columns["quality/feasible"] = passes(columns)
        feasible = columns["quality/feasible"] == 1
        held = columns.get("quality/success", np.zeros(len(rows), np.int8)) == 1
        columns["quality/valid"] = (feasible & held).astype(np.uint8)
        if self.request.models:
            columns |= self._in_models(grasps, held if every else feasible & held, run, seconds)
        if self.request.measures_payload:
            columns["quality/payload_kg"] = self._payloads(grasps, feasible & held, run, seconds)
        if self.request.shake:
            columns["quality/shake_margin"] = self._shaken(grasps, feasible & held, run, seconds)
        if not every:
            wanted = feasible if self.pieces is None else feasible & held
            lost = np.setdiff1d(np.arange(size), rows)
            lost = lost[fates[finite[lost]] == "kept"]
            fates[finite[lost]] = why[lost]
            fates[finite[rows[~wanted]]] = [f"gate_{name}" for name in np.asarray(failed_gate(columns))[~wanted]]
            if self.request.robust:
                enough = reaches(columns["quality/robust_share"], self.request.robust)
                fates[finite[rows[wanted & ~enough]]] = "not_robust"
                wanted &= enough
            if least := self.request.min_payload:
                enough = columns["quality/payload_kg"] >= least
                fates[finite[rows[wanted & ~enough]]] = "weak"
                wanted &= enough
            grasps, columns = taken(grasps, columns, np.flatnonzero(wanted))
            rows = rows[wanted]
        return Round(grasps, columns, finite[rows], fates, in_scene, seconds)

    def _validated_in_scenes(
        self, grasps: GraspSet, scenes: Scenes, run: ExecutionContext, seconds: dict[str, float], known: Known | None
    ) -> tuple[GraspSet, Arrays]:
        """The grasps with their ways, and their verdicts."""
        began = time.perf_counter()
        found = scene_verdicts(
            self.hand,
            self.obj,
            grasps,
            scenes,
            level=lift_level(self.request.validation),
            pieces=None if self.pieces is None else self.pieces.result(),
            known=known,
            run=run.part(*PARTS[:2]),
        )
        seconds["validation"] += time.perf_counter() - began
        return found

    def _validated(
        self,
        grasps: GraspSet,
        run: ExecutionContext,
        seconds: dict[str, float],
        known: Known | None,
        prefilter: PrefilterVerdicts | None,
    ) -> Arrays:
        if self.pieces is None:
            return {}
        verdicts = validate(
            self.hand,
            self.obj,
            grasps,
            level=self._level,
            pieces=self.pieces.result(),
            known=known,
            prefilter=prefilter,
            run=run.part(*PARTS[:2]),
        )
        seconds["validation"] += verdicts.seconds
        return {
            "quality/success": verdicts.success,
            "quality/verdict_outcome": verdicts.outcome.reshape(-1, len(DIRECTIONS)),
            "quality/verdict_margin": verdicts.margin,
            **(
                {"quality/validated_by": verdicts.validated_by} if first_terms(self.hand, self._level, self.run) else {}
            ),
        }

    def _in_models(
        self, grasps: GraspSet, held: NDArray[np.bool_], run: ExecutionContext, seconds: dict[str, float]
    ) -> Arrays:
        """Share of the models in which those that hold do, told whole of candidates, and what they fail first of."""
        assert self.pieces is not None
        wish = self.request
        found = robust(
            self.hand,
            self.obj,
            grasps,
            held=held,
            placed=self.placed(grasps),
            level=lift_level(wish.validation),
            models=wish.models,
            seed=wish.seed,
            pieces=self.pieces.result(),
            wanted=wish.robust if wish.want == "valid" else 0,
            run=run.quiet(),
        )
        seconds["validation"] += found.seconds
        return found.columns

    def placed(self, grasps: GraspSet) -> PlacedGrasps | None:
        """The grasps' scenes; None: the object is free."""
        if self.scenes is None:
            return None
        assert grasps.scene is not None
        return self.scenes.placed(grasps.scene)

    def _payloads(
        self, grasps: GraspSet, held: NDArray[np.bool_], run: ExecutionContext, seconds: dict[str, float]
    ) -> NDArray[np.float64]:
        """(N,) payloads of those that are `held` [kg]: the object's own mass at least, which they were seen to lift."""
        assert self.pieces is not None
        began = time.perf_counter()
        found = payloads(
            self.hand,
            self.obj,
            grasps,
            pieces=self.pieces.result(),
            placed=self.placed(grasps),
            held=held,
            run=run.quiet(),
        )
        seconds["validation"] += time.perf_counter() - began
        return np.where(held & np.isnan(found), self.obj.mass, found)

    def _shaken(
        self, grasps: GraspSet, held: NDArray[np.bool_], run: ExecutionContext, seconds: dict[str, float]
    ) -> NDArray[np.float64]:
        """(N,) margins of those that are `held`, shaken after the lift."""
        assert self.pieces is not None
        began, placed = time.perf_counter(), self.placed(grasps)
        assert placed is not None, "shake goes with a scene"
        found = shake_margins(
            self.hand, self.obj, grasps, placed, pieces=self.pieces.result(), held=held, run=run.quiet()
        )
        seconds["validation"] += time.perf_counter() - began
        return found

    def _measured(self, grasps: GraspSet, run: ExecutionContext, seconds: dict[str, float]) -> Arrays:
        began = time.perf_counter()
        columns = measure(self.hand, self.obj, grasps, friction=self.request.friction, run=run.part(*PARTS[1:]))
        seconds["quality"] += time.perf_counter() - began
        return dict(columns)


@dataclass(frozen=True)
class Needed:
    """Grasps that a batch needs next."""

    number: int
    """Of the round."""
    rows: range
    """Of the round."""
    begun: int
    """Grasps of the batch that were planned before the round."""
    progress: tuple[float, float]
    """Share of the batch before them, and as far as they bring it as the rate so far lets hope."""


class Batch:
    """One batch in the making: what it needs next, and what came of it."""

    def __init__(
        self, scoring: Scoring, number: int, count: int, run: ExecutionContext, scenes: range | None = None
    ) -> None:
        """`run` is told of the batch alone; `scenes` are those of the job that are the batch's, None: all of them."""
        self.scoring, self.number, self.count, self.run = scoring, number, count, run
        self.request = scoring.request
        self.rounds: list[Round] = []
        self.candidates = self.repeated = 0
        self.limit: Limit | None = None
        self.seconds: dict[str, float] = {"planner": 0.0, "validation": 0.0, "quality": 0.0}
        every = range(0 if scoring.scenes is None else len(scoring.scenes.object_pose))
        self._scenes = every if scenes is None else scenes
        self._rechecks: Future[NDArray[np.int8]] | None = None
        self._kept = np.zeros((0, POINTS, 3))
        self._needs = self._all_needed()
        self.needed = next(self._needs, None)
        """What is to be made and added next; None: the batch can be finished."""

    def _all_needed(self) -> Iterator[Needed]:
        """What is needed until `count` grasps are there or the budget is used up, one after the other is added."""
        wish, count = self.request, self.count
        if wish.want == "candidates":
            yield Needed(0, range(count), self.candidates, (0.0, 1.0))
            return
        budget, number, valid = math.ceil(wish.budget * count), 0, 0
        # In scenes a grasp that sets out again costs as much as another grasp.
        while size := next_round(count, valid, self.candidates, budget - self.repeated):
            first = 0
            while first < size and valid < count:
                share = min(size - first, enough(count, valid, self.candidates) if self._in_parts else size)
                done = valid / count
                hoped = done + (1 - done) * min(1.0, share / (count - valid)) * 0.9
                yield Needed(number, range(first, first + share), self.candidates - first, (done, hoped))
                first += share
                valid = sum(len(one.grasps) for one in self.rounds)
            if not valid and self._hopeless():
                return
            number += 1

    def add(self, made: Round) -> None:
        """Add what was needed, without grasps too near to one that is kept."""
        self.candidates += len(made.fates)
        self.repeated += made.repeated
        for name in self.seconds:
            self.seconds[name] += made.seconds[name]
        if self.request.want != "candidates":
            points = np.concatenate([self._kept, hand_points(self.scoring.hand, made.grasps.grasp)])
            kept = distinct(points, self.request.min_distance, given=len(self._kept))
            wanted, self._kept = kept[len(self._kept) :], points[kept]
            made.fates[made.rows[~wanted]] = "alike"
            made.grasps, made.columns = taken(made.grasps, made.columns, np.flatnonzero(wanted))
        self.rounds.append(made)
        self.needed = next(self._needs, None)

    def _hopeless(self) -> bool:
        """Whether the latest grasps, none of which is kept, show that the hand lifts far less than is wanted."""
        scoring = self.scoring
        if scoring.pieces is None or (self.limit is not None and self.limit.grasps >= ENOUGH):
            return False
        planned = joined([grasps for one in self.rounds for grasps in one.planned])
        latest = max(ENOUGH, sum(map(len, self.rounds[-1].planned)))
        planned = planned.take(slice(max(0, len(planned) - latest), None))
        self.limit = limit_of(
            scoring.hand,
            scoring.obj,
            planned,
            wanted=max(scoring.obj.mass, self.request.min_payload),
            pieces=scoring.pieces.result(),
            placed=scoring.placed(planned),
            run=scoring.run.quiet(),
        )
        return self.limit is not None and self.limit.hopeless

    @property
    def _in_parts(self) -> bool:
        """Whether the grasps of a round may be made apart from each other: it ends as soon as enough are found, and has
        several lanes. A GPU makes all of it at once, in the time of a few."""
        return not self.scoring.run.device.startswith("cuda") and method(self.request.method).in_parts

    def made(self, asked: Needed) -> Round:
        """What is needed, planned, validated and measured: on the CPU in lanes."""
        known: Known = {}
        run = self.run.part(*asked.progress)
        rollout = self.scoring.rollout(known)  # one for all lanes
        parts = lanes_of(asked.rows, run.cores if self._in_parts and run.pool is None else 1)

        def planned(part: range, own: ExecutionContext, others: bool) -> Round:
            wanted = self.wanted(replace(asked, rows=part), rollout, others_have_place=others)
            request = self.request
            found = synthesize(
                self.scoring.hand,
                self.scoring.obj,
                wanted,
                own.part(0.0, PARTS[0]),
                method=request.method,
                options=request.options,
            )
            told = self.told(wanted, found)
            # Verdicts and metrics are many short pieces of work: all cores may take them, whatever other priorities are
            # at.
            made = self.scoring.scored(told, replace(own, lanes=None), known)
            return self.noted(replace(asked, rows=part), made, told)

        def lane(part: range, own: ExecutionContext) -> Round | NoStartFound:
            try:
                return planned(part, own, self.candidates > 0)
            except NoStartFound as error:
                return error

        found = side_by_side(parts, lane, run, size=len)
        if len(refused := [one for one in found if isinstance(one, NoStartFound)]) == len(found):
            raise self.refused(refused[0])
        made = [
            planned(part, run.quiet(), True) if isinstance(one, NoStartFound) else one
            for part, one in zip(parts, found, strict=True)
        ]
        whole = Round.joined(made)
        whole.seconds = {name: value / len(made) for name, value in whole.seconds.items()}
        return whole

    def wanted(self, asked: Needed, rollout: Rollout | None, *, others_have_place: bool) -> PlanRequest:
        """The grasps that are asked for, as a planner takes it."""
        number = self.number + asked.number * ROUND_STRIDE
        rows, scenes, placed = asked.rows, self.scoring.scenes, None
        if scenes is not None:
            poses, own = scenes, slice(self._scenes.start, self._scenes.stop)
            beside = poses.neighbour_pose[own] if poses.neighbours else poses.neighbour_pose
            mine = replace(poses, object_pose=poses.object_pose[own], neighbour_pose=beside)
            placed = mine.placed((asked.begun + np.array(rows)) % len(self._scenes))
        knobs, seed = self.request.knobs, self.request.seed
        return PlanRequest(len(rows), knobs, seed, number, placed, rollout, rows.start, others_have_place)

    def told(self, wanted: PlanRequest, planned: GraspSet) -> GraspSet:
        """What is validated, which is what is told: positions are on the grid before; scenes are numbered as the
        job's."""
        index = None if wanted.placed is None else self._scenes.start + wanted.placed.index
        return replace(planned, scene=index).moved(np.zeros(3))

    def noted(self, asked: Needed, made: Round, told: GraspSet) -> Round:
        """The round with what the planner said; the rechecks of the batch's first grasps begin."""
        made.planned = [told]
        made.grasps = replace(made.grasps, info=told.info, seconds=told.seconds)
        made.seconds["planner"] += told.seconds
        made.repeated = max(0, told.attempts - len(asked.rows)) if self.scoring.scenes is not None else 0
        if asked.number == 0 and asked.rows.start == 0:
            self._begin_rechecks(made)
        return made

    def refused(self, error: NoStartFound) -> NoStartFound:
        """The same with the geometric reason, where there is one."""
        why = self._narrow()
        return NoStartFound(f"{error}: {why}") if why else error

    def finish(self) -> ValidatedBatch:
        """The rounds as one batch, cut to `count`, with rechecks and robustness."""
        scoring, rounds, count = self.scoring, self.rounds, self.count
        grasps = joined([part.grasps for part in rounds])
        columns = joined_columns([part.columns for part in rounds])
        fates = np.concatenate([part.fates for part in rounds])
        # The last round may find more than were missing: its tries count up to the last grasp that is kept, or else
        # the share of valid ones would look worse than it is.
        places = np.flatnonzero(fates == "kept")
        candidates = int(places[count - 1]) + 1 if len(places) >= count else len(fates)
        absent = {"blocked"} if scoring.scenes is None else set()
        absent |= set() if self.request.robust else {"not_robust"}
        absent |= set() if self.request.min_payload else {"weak"}
        reasons = [name for name in REJECTIONS if name not in absent]
        outcomes = totals([Counter(fate for fate in fates[:candidates].tolist() if fate != "kept")])
        rejected = dict.fromkeys(reasons, 0)
        for name, number in outcomes.items():
            rejected[_REJECTION_OF.get(name, "dropped")] += number
        grasps, columns = taken(grasps, columns, np.arange(min(count, len(grasps))))
        if self.repeated:
            outcomes["repeated"] = self.repeated
        found = ValidatedBatch(
            grasps,
            columns,
            candidates,
            rejected,
            outcomes,
            None,
            len(fates),
            self.seconds,
            self._shares(),
            limit=None if len(grasps) else self.limit,
        )
        if scoring.pieces is not None:
            columns |= self._second_opinions(grasps, columns["quality/valid"])
            narrow = None if columns["quality/valid"].any() else self._narrow()
            found = replace(found, columns=columns, verdict_key=scoring.key(), narrow=narrow)
        scene = None if grasps.scene is None else grasps.scene - self._scenes.start
        return replace(found, grasps=replace(grasps, scene=scene)).moved(scoring.centre)

    def _narrow(self) -> str | None:
        if self.scoring.scenes is None:
            return None
        around = self.scoring.scenes.placed(np.zeros(0, int)).scenes
        return why_narrow(self.scoring.hand, self.scoring.obj, around[self._scenes.start : self._scenes.stop])

    def _shares(self) -> dict[str, float]:
        planned = max(1, sum(len(part.fates) for part in self.rounds))
        return {
            f"{name}_share": float(sum(int(part.in_scene[name].sum()) for part in self.rounds)) / planned
            for name in self.rounds[0].in_scene
        }

    def _second_opinions(self, grasps: GraspSet, valid: NDArray[np.uint8]) -> Arrays:
        """Displacement of all grasps; as far as wished rechecks of the first valid ones under the DexGraspBench
        protocol, and robustness."""
        scoring = self.scoring
        assert scoring.pieces is not None
        columns: Arrays = {
            "quality/simulated_displacement_cm": simulated_displacement_cm(
                scoring.hand, scoring.obj, grasps.grasp, pieces=scoring.pieces.result(), run=scoring.run
            )
        }
        began = time.perf_counter()
        if count := self.request.rechecks_of(self.number):
            rechecked, recheck = np.flatnonzero(valid)[:count], np.full(len(grasps), -1, np.int8)
            if len(rechecked):
                known = (
                    self._rechecks.result() if self._rechecks is not None else self._rechecked(grasps.take(rechecked))
                )
                recheck[rechecked] = known[: len(rechecked)]
            columns["quality/recheck"] = recheck
        if repeats := self.request.robustness:
            columns["quality/robustness"] = robustness(
                scoring.hand,
                scoring.obj,
                grasps,
                held=valid,
                repeats=repeats,
                seed=self.request.seed,
                pieces=scoring.pieces.result(),
                run=scoring.run.quiet(),
            )
        self.seconds["validation"] += time.perf_counter() - began
        return columns

    def _begin_rechecks(self, first: Round) -> None:
        """Rechecks of the first grasps of a batch, which are its first ones whatever comes after them: they take one
        thread, and the others wait for them at its end."""
        count = self.request.rechecks_of(self.number)
        if self.scoring.pieces is None or not count:
            return
        valid = np.flatnonzero(first.columns["quality/valid"])
        if self.request.want != "candidates":
            points = hand_points(self.scoring.hand, first.grasps.grasp.take(valid))
            valid = valid[distinct(points, self.request.min_distance)]
        if len(valid) >= count:
            self._rechecks = self.scoring.beside.submit(self._rechecked, first.grasps.take(valid[:count]))

    def _rechecked(self, grasps: GraspSet) -> NDArray[np.int8]:
        """What the DexGraspBench protocol says of grasps."""
        scoring = self.scoring
        assert scoring.pieces is not None
        run, pieces = scoring.run.quiet(), scoring.pieces.result()
        if (placed := scoring.placed(grasps)) is None:
            return validate(scoring.hand, scoring.obj, grasps, level="dexgraspbench", pieces=pieces, run=run).success
        return validate_lifts(
            scoring.hand, scoring.obj, grasps, placed, level="dexgraspbench", pieces=pieces, run=run
        ).success


def _why(columns: Arrays, count: int) -> NDArray[np.object_]:
    """(N,) what the validator saw of each grasp that it drops."""
    found = np.full(count, "not_lifted", object)
    if "quality/lift_outcome" in columns:
        for lift, name in _LIFTED.items():
            found[np.asarray(columns["quality/lift_outcome"]) == lift] = name
    elif "quality/verdict_outcome" in columns:
        pushes = np.asarray(columns["quality/verdict_outcome"])
        bad = (pushes != Outcome.HELD) & (pushes != Outcome.NOT_TRIED)
        first = pushes[np.arange(count), bad.argmax(axis=1)] if count else np.zeros(0, np.uint8)
        for push, name in _PUSHED.items():
            found[first == push] = name
    return found
