"""Generation of validated grasps: rounds of candidates until enough are valid or the budget ends.

A grasp is feasible if it passes the geometric gate, and valid if it is feasible and held by the validator. Without
validation, feasible grasps are counted instead and none is valid. If a job wants robust grasps, a valid grasp counts
only if it holds in the wanted share of perturbed models. Expensive steps come late: measurement follows validation, and
perturbed models come last."""

from __future__ import annotations

import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import TaskCancelled
from graspd.service.model.planning import sum_outcomes
from graspd.service.model.transforms import Mask
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext, parallel_map
from graspd.worker.grasps import GraspSet, join_columns, join_grasp_sets
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.pinch_postures import require_opposing
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners import NoStartFound, PlanRequest, Rollout, fitting_pairs, method, synthesize
from graspd.worker.planners.fast_graspd.antipodal_starts import narrow_reason
from graspd.worker.planners.requirements import NOTHING, Requirements
from graspd.worker.quality.diversity import POINTS, distinct_mask, hand_points
from graspd.worker.quality.gate import GATES, failed_gate, passes_gate
from graspd.worker.quality.table import measure
from graspd.worker.rounds import ROUND_STRIDE, Arrays, Round, expected_need, next_round, select_rows, split_rows
from graspd.worker.scenes.rollout import create_rollout, lift_level, outcome_masks, scene_verdicts
from graspd.worker.simulation.environment import PlacedGrasps, Scenes
from graspd.worker.validation.decomposition import ConvexPieces, decompose
from graspd.worker.validation.displacement import simulated_displacement_cm
from graspd.worker.validation.engines.registry import (
    EngineVerdicts,
    check_engines,
    engine_columns,
    validate_with_engine,
)
from graspd.worker.validation.key import verdict_key
from graspd.worker.validation.lift import LiftOutcome
from graspd.worker.validation.lifting import lift_key, validate_lifts
from graspd.worker.validation.payload import ENOUGH, PayloadLimit, payload_limit, payloads, shake_margins
from graspd.worker.validation.prefilter.prefilter import PrefilterVerdicts, prefilter_key_terms
from graspd.worker.validation.protocol import DIRECTIONS, Outcome
from graspd.worker.validation.robust import reaches_share, validate_robustness
from graspd.worker.validation.validator import prefilter_grasps, validate

#: Reasons to reject a grasp. diverged: its numbers are not finite. blocked: an obstacle of its scene is in the way.
#: dropped: the validator did not hold it. gate: it fails the geometric gate. not_robust: it holds in too few models.
#: requirements: it fails one of the job's requirements. weak: its payload is too small. alike: it is a near-duplicate
#: of a selected grasp.
REJECTIONS: Final = ("diverged", "blocked", "dropped", "gate", "requirements", "not_robust", "weak", "alike")
#: Outcomes of failed requirements.
_FAILED: Final = ("other_type", "other_digits", "other_approach", "outside_region", "other_wrist_pose")
#: Rejections whose names differ from the outcome's; failed pushes and lifts of the validator are `dropped`.
_REJECTION_OF: Final = {
    "no_place": "blocked",
    **{f"gate_{name}": "gate" for name in GATES},
    **dict.fromkeys(_FAILED, "requirements"),
}
#: Names of the outcomes of failed pushes and of failed lifts.
_PUSHED: Final = {
    Outcome.PENETRATION: "penetration",
    Outcome.LOST_WHILE_CLOSING: "lost_while_closing",
    Outcome.DISPLACED: "slipped",
    Outcome.ROTATED: "turned",
    Outcome.DIVERGED: "unstable",
}
_LIFTED: Final = {outcome: outcome.name.lower() for outcome in LiftOutcome if outcome > LiftOutcome.LIFTED} | {
    LiftOutcome.DIVERGED: "unstable"
}
#: Verdicts on candidates from the planner's rollouts, by lifts or by pushes.
Known = dict[str, Any]
#: Progress of a round after planning, validation and measurement.
PARTS: Final = (0.6, 0.8, 1.0)


@dataclass(frozen=True)
class ValidatedBatch:
    grasps: GraspSet
    columns: Arrays
    candidates: int
    """Number of candidates up to the last selected grasp; all candidates if too few grasps were found."""
    rejected: dict[str, int]
    """Number of rejected candidates, by `REJECTIONS`."""
    outcomes: dict[str, int]
    """Number of rejected candidates, by outcome or failed gate (`service.model.planning.OUTCOMES`)."""
    verdict_key: str | None
    """Digest of all settings that affect verdicts; None without validation."""
    planned: int
    seconds: dict[str, float] = field(default_factory=dict)
    shares: dict[str, float] = field(default_factory=dict)
    """In scenes, shares of all candidates. clear_share: no obstacle at contact, on the approach and in the lift.
    lift_share: also lifted. lift_hard_share: also lifted at half friction."""
    narrow: str | None = None
    """In scenes without a valid grasp, the geometric reason; see `narrow_reason`."""
    limit: PayloadLimit | None = None
    """Payload limit of the tested grasps, if no grasp is selected because the object is too heavy."""

    def moved(self, by: Sequence[float]) -> ValidatedBatch:
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
    """Plan batch number `batch` of a job: `count` valid grasps, or fewer if the budget is used up.
    Without validation, feasible grasps count. `scenes` are used in turn; valid then means lifted out of the scene.
    `pieces` runs while the first round is planned. With `partial`, a cancellation returns the grasps validated so far.
    Raises errors of `require_graspable`. MeshError: no usable convex pieces. TaskCancelled: no grasps so far."""
    require_graspable(hand, obj)
    with Scoring(hand, obj, request, scenes=scenes, pieces=pieces, run=run) as scoring:
        work = Batch(scoring, batch, count, run)
        try:
            while work.needed is not None:
                work.add(work.run_round(work.needed))
        except TaskCancelled:
            if not partial or not work.rounds:
                raise
            scoring.ignore_cancellation()
        return work.finish()


def require_graspable(hand: HandModel, obj: ObjectModel) -> None:
    """Raise HandError if no two digits oppose, InputError if the object does not fit into the gripper."""
    require_opposing(hand)
    fitting_pairs(hand, obj.centred)


def score_grasps(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    request: JobOptions,
    *,
    scenes: Scenes | None = None,
    pieces: Callable[[ObjectModel], ConvexPieces] = decompose,
    run: ExecutionContext = DEFAULT_CONTEXT,
) -> ValidatedBatch:
    """Validate and measure existing grasps as `request` specifies; return all of them.
    With `scenes`, each is validated in scene `grasps.scene`. Raises MeshError: no usable convex pieces."""
    request = request.model_copy(update={"want": "candidates"})
    with Scoring(hand, obj, request, scenes=scenes, pieces=pieces, run=run) as scoring:
        work = Batch(scoring, 0, len(grasps), run)
        work.add(scoring.evaluate(grasps.moved(np.negative(obj.centre)), run))
        return work.finish()


class Scoring(AbstractContextManager["Scoring"]):
    """Verdicts and metrics of a job's grasps; each grasp is scored independently of the others."""

    def __init__(
        self,
        hand: HandModel,
        obj: ObjectModel,
        request: JobOptions,
        *,
        scenes: Scenes | None,
        pieces: Callable[[ObjectModel], ConvexPieces],
        run: ExecutionContext,
    ) -> None:
        """Start the decomposition of the object, if grasps are validated.
        Raises InputError: a second engine is not installed."""
        check_engines(request.second_engines)
        self.hand, self.obj, self.request, self.run = hand, obj.centred, request, run
        self.centre = obj.centre
        self.scenes = None if scenes is None else scenes.centred(obj)
        self.beside = ThreadPoolExecutor(1, thread_name_prefix="beside")
        self.pieces = self.beside.submit(pieces, self.obj) if request.validation != "none" else None

    def __exit__(self, *error: object) -> None:
        self.beside.shutdown()

    def ignore_cancellation(self) -> None:
        self.run = replace(self.run, cancelled=DEFAULT_CONTEXT.cancelled)

    def rollout(self, known: Known) -> Rollout | None:
        """Return the rollout of candidates; None without validation, or if the planner's loss decides.
        Verdicts of rollouts at the job's level are added to `known`."""
        if self.pieces is None:
            return None
        pieces, in_scenes = self.pieces.result, self.scenes is not None
        return create_rollout(
            self.run, self.hand, self.obj, pieces, in_scenes=in_scenes, known=known, level=self._level
        )

    def key(self) -> str:
        assert self.pieces is not None
        pieces = self.pieces.result()
        if self.scenes is None:
            prefilter = prefilter_key_terms(self.hand, self._level, self.run)
            return verdict_key(self.hand, self.obj, self._level, False, pieces=pieces, prefilter=prefilter)
        placed = self.scenes.placed(np.zeros(0, int))
        return lift_key(self.hand, self.obj, placed, lift_level(self.request.validation), False, pieces=pieces)

    @property
    def _level(self) -> Any:
        return self.request.validation

    def run_prefilter(self, planned: GraspSet) -> PrefilterVerdicts | None:
        """Return the GPU prefilter's verdicts on the finite grasps; None if the prefilter is not used."""
        if self.pieces is None or self.scenes is not None or not prefilter_key_terms(self.hand, self._level, self.run):
            return None
        finite = planned.take(np.flatnonzero(planned.is_finite))
        return prefilter_grasps(
            self.hand, self.obj, finite, level=self._level, pieces=self.pieces.result(), run=self.run.without_progress()
        )

    def evaluate(
        self,
        planned: GraspSet,
        run: ExecutionContext,
        known: Known | None = None,
        prefilter: PrefilterVerdicts | None = None,
        required: Requirements = NOTHING,
    ) -> Round:
        """Validate and measure grasps, and select the wanted ones, near-duplicates included.
        Grasps with numbers that are not finite are rejected. `known` has verdicts on candidates, `prefilter` has
        verdicts of the GPU prefilter."""
        fates = np.where(planned.is_finite, "kept", "diverged").astype(object)
        seconds = {"planner": 0.0, "validation": 0.0, "quality": 0.0}
        finite = np.flatnonzero(fates == "kept")
        planned = planned.take(finite)
        size, every = len(planned), self.request.want == "candidates"
        in_scene: dict[str, Mask] = {}
        with _timed(seconds, "validation"):
            planned, columns = self._validate(planned, run.with_progress_range(*PARTS[:2]), known, prefilter)
        if self.scenes is not None:
            fates[finite[columns["quality/success"] < 0]] = "no_place"
            for name, those in outcome_masks(columns).items():
                in_scene[name] = np.zeros(len(fates), bool)
                in_scene[name][finite] = those
        why = _rejection_reasons(columns, size)
        rows = np.arange(size) if every or not columns else np.flatnonzero(columns["quality/success"] == 1)
        grasps = planned.take(rows)
        columns = {path: array[rows] for path, array in columns.items()}
        with _timed(seconds, "quality"):
            friction = self.request.friction
            measured = run.with_progress_range(*PARTS[1:])
            columns |= measure(self.hand, self.obj, grasps, friction=friction, region=required.region, run=measured)
            columns |= required.like_columns(grasps.grasp)
        columns["quality/feasible"] = passes_gate(columns)
        feasible = columns["quality/feasible"] == 1
        held = columns.get("quality/success", np.zeros(len(rows), np.int8)) == 1
        columns["quality/valid"] = (feasible & held).astype(np.uint8)
        with _timed(seconds, "validation"):
            failed = np.full(len(grasps), "", object)
            if required.is_set and not every:
                failed = required.failed(self.hand, grasps.grasp, self.placed(grasps), columns)
            valid = feasible & held & (failed == "")
            columns |= self._further_tests(grasps, held if every else valid, valid, run.without_progress())
        if not every:
            wanted = feasible if self.pieces is None else feasible & held
            lost = np.setdiff1d(np.arange(size), rows)
            lost = lost[fates[finite[lost]] == "kept"]
            fates[finite[lost]] = why[lost]
            fates[finite[rows[~wanted]]] = [f"gate_{name}" for name in np.asarray(failed_gate(columns))[~wanted]]
            fates[finite[rows[wanted & (failed != "")]]] = failed[wanted & (failed != "")]
            wanted &= failed == ""
            if self.request.robust:
                enough = reaches_share(columns["quality/robust_share"], self.request.robust)
                if self.request.second_engines:
                    enough &= columns["quality/agreement"] == 1
                fates[finite[rows[wanted & ~enough]]] = "not_robust"
                wanted &= enough
            if least := self.request.min_payload:
                enough = columns["quality/payload_kg"] >= least
                fates[finite[rows[wanted & ~enough]]] = "weak"
                wanted &= enough
            grasps, columns = select_rows(grasps, columns, np.flatnonzero(wanted))
            rows = rows[wanted]
        return Round(grasps, columns, finite[rows], fates, in_scene, seconds)

    def _validate(
        self, grasps: GraspSet, run: ExecutionContext, known: Known | None, prefilter: PrefilterVerdicts | None
    ) -> tuple[GraspSet, Arrays]:
        pieces = None if self.pieces is None else self.pieces.result()
        if self.scenes is not None:
            level = lift_level(self._level)
            return scene_verdicts(
                self.hand, self.obj, grasps, self.scenes, level=level, pieces=pieces, known=known, run=run
            )
        if pieces is None:
            return grasps, {}
        verdicts = validate(
            self.hand, self.obj, grasps, level=self._level, pieces=pieces, known=known, prefilter=prefilter, run=run
        )
        columns: Arrays = {
            "quality/success": verdicts.success,
            "quality/verdict_outcome": verdicts.outcome.reshape(-1, len(DIRECTIONS)),
            "quality/verdict_margin": verdicts.margin,
        }
        if prefilter_key_terms(self.hand, self._level, self.run):
            columns["quality/validated_by"] = verdicts.validated_by
        return grasps, columns

    def _further_tests(self, grasps: GraspSet, in_models: Mask, valid: Mask, run: ExecutionContext) -> Arrays:
        """Return columns of the further tests that the request specifies.
        Grasps `in_models` (N,) are tested for robustness, `valid` grasps (N,) for payload and in the shake test."""
        request, columns = self.request, dict[str, NDArray[Any]]()
        if not (request.model_count or request.measures_payload or request.shake):
            return columns
        assert self.pieces is not None
        common: dict[str, Any] = {"pieces": self.pieces.result(), "run": run}
        placed = self.placed(grasps)
        if request.model_count:
            columns |= validate_robustness(
                self.hand,
                self.obj,
                grasps,
                held=in_models,
                placed=placed,
                level=lift_level(request.validation),
                models=request.model_count,
                seed=request.seed,
                wanted=request.robust if request.want == "valid" else 0,
                **common,
            ).columns
        if request.second_engines and request.robust:
            robust = np.flatnonzero(valid & reaches_share(columns["quality/robust_share"], request.robust))
            columns |= self.second_verdicts(grasps, in_models, robust, run)
        if request.measures_payload:
            found = payloads(self.hand, self.obj, grasps, placed=placed, held=valid, **common)
            # A valid grasp has lifted at least the object's own mass.
            columns["quality/payload_kg"] = np.where(valid & np.isnan(found), self.obj.mass, found)
        if request.shake:
            assert placed is not None, "a shake test needs a scene"
            columns["quality/shake_margin"] = shake_margins(self.hand, self.obj, grasps, placed, held=valid, **common)
        return columns

    def second_verdicts(
        self, grasps: GraspSet, held: NDArray[np.bool_], rows: NDArray[np.intp], run: ExecutionContext
    ) -> Arrays:
        """Return `engine_columns`; second engines validate `rows` of the grasps `held` (N,) in MuJoCo.
        Raises InputError: an engine cannot simulate the hand."""
        assert self.pieces is not None
        columns: Arrays = {"quality/held_in": held.astype(np.uint8), "quality/agreement": np.full(len(grasps), np.nan)}
        if len(rows):
            chosen, level = grasps.take(rows), self.request.validation
            common: dict[str, Any] = {"level": level, "pieces": self.pieces.result(), "run": run}
            verdicts = [EngineVerdicts("mujoco", np.ones(len(rows), np.int8), (), np.zeros(len(rows)), 0.0)]
            for name in self.request.second_engines:
                placed = self.placed(chosen)
                verdicts.append(validate_with_engine(name, self.hand, self.obj, chosen, placed, **common))
            for path, values in engine_columns(verdicts).items():
                columns[path][rows] = values
        return columns

    def placed(self, grasps: GraspSet) -> PlacedGrasps | None:
        """Return the grasps with their scenes; None for a free object."""
        if self.scenes is None:
            return None
        assert grasps.scene is not None
        return self.scenes.placed(grasps.scene)


@contextmanager
def _timed(seconds: dict[str, float], name: str) -> Iterator[None]:
    began = time.perf_counter()
    yield
    seconds[name] += time.perf_counter() - began


@dataclass(frozen=True)
class RoundRequest:
    number: int
    rows: range
    begun: int
    """Number of the batch's candidates that were planned before this round."""
    progress: tuple[float, float]
    """Progress of the batch before these rows, and the expected progress after them."""


class Batch:
    """A batch in progress: the candidates that it needs next, and the rounds so far."""

    def __init__(
        self, scoring: Scoring, number: int, count: int, run: ExecutionContext, scenes: range | None = None
    ) -> None:
        """Begin a batch. `run` reports its progress; `scenes` is its part of the job's scenes, None for all."""
        self.scoring, self.number, self.count, self.run = scoring, number, count, run
        self.request = scoring.request
        self.requirements = Requirements.of(self.request, scoring.hand, number, obj=scoring.obj, origin=scoring.centre)
        self.requirements.check(scoring.hand, scoring.obj)
        self.rounds: list[Round] = []
        self.candidates = self.repeated = 0
        self.limit: PayloadLimit | None = None
        self.seconds: dict[str, float] = {"planner": 0.0, "validation": 0.0, "quality": 0.0}
        every = range(0 if scoring.scenes is None else len(scoring.scenes.object_pose))
        self._scenes = every if scenes is None else scenes
        room = np.ones(len(self._scenes), bool)
        if scoring.scenes is not None:
            room = self.requirements.has_room(scoring.hand, scoring.scenes.placed(np.zeros(0, int)))
            room = room[self._scenes.start : self._scenes.stop]
        self._used = np.flatnonzero(room if room.any() else ~room)
        """Scenes that grasps use in turn, relative to the batch's first: those with room for a demonstrated pose."""
        self._rechecks: Future[NDArray[np.int8]] | None = None
        self._kept = np.zeros((0, POINTS, 3))
        self._needs = self._round_requests()
        self.needed = next(self._needs, None)
        """Candidates to make and add next; None once the batch is ready for `finish`."""

    def _round_requests(self) -> Iterator[RoundRequest]:
        """Yield requests until `count` grasps are found or the budget is used up; call `add` after each."""
        wish, count = self.request, self.count
        if wish.want == "candidates":
            yield RoundRequest(0, range(count), self.candidates, (0.0, 1.0))
            return
        budget, number, valid = math.ceil(wish.budget * count), 0, 0
        # In scenes a retry has the cost of another candidate.
        while size := next_round(count, valid, self.candidates, budget - self.repeated):
            first = 0
            while first < size and valid < count:
                share = min(size - first, expected_need(count, valid, self.candidates) if self._is_divisible else size)
                done = valid / count
                hoped = done + (1 - done) * min(1.0, share / (count - valid)) * 0.9
                yield RoundRequest(number, range(first, first + share), self.candidates - first, (done, hoped))
                first += share
                valid = sum(len(one.grasps) for one in self.rounds)
            if not valid and self._has_unreachable_payload():
                return
            number += 1

    def add(self, made: Round) -> None:
        self.candidates += len(made.fates)
        self.repeated += made.repeated
        for name in self.seconds:
            self.seconds[name] += made.seconds[name]
        if self.request.want != "candidates":
            points = np.concatenate([self._kept, hand_points(self.scoring.hand, made.grasps.grasp)])
            kept = distinct_mask(points, self.request.min_distance, given=len(self._kept))
            wanted, self._kept = kept[len(self._kept) :], points[kept]
            made.fates[made.rows[~wanted]] = "alike"
            made.grasps, made.columns = select_rows(made.grasps, made.columns, np.flatnonzero(wanted))
        self.rounds.append(made)
        self.needed = next(self._needs, None)

    def _has_unreachable_payload(self) -> bool:
        """Check whether the latest grasps show that the hand lifts far less than the wanted payload."""
        scoring = self.scoring
        if scoring.pieces is None or (self.limit is not None and self.limit.grasps >= ENOUGH):
            return False
        planned = join_grasp_sets([grasps for one in self.rounds for grasps in one.planned])
        latest = max(ENOUGH, sum(map(len, self.rounds[-1].planned)))
        planned = planned.take(slice(max(0, len(planned) - latest), None))
        hand, obj, placed = scoring.hand, scoring.obj, scoring.placed(planned)
        pieces, run, wanted = (
            scoring.pieces.result(),
            scoring.run.without_progress(),
            max(obj.mass, self.request.min_payload),
        )
        self.limit = payload_limit(hand, obj, planned, wanted=wanted, pieces=pieces, placed=placed, run=run)
        return self.limit is not None and self.limit.is_far_exceeded

    @property
    def _is_divisible(self) -> bool:
        """Whether a round may be made in parts, so that it ends as soon as enough grasps are found.
        The CPU runs the parts in parallel; a GPU makes the whole round in the time of a few grasps."""
        return not self.scoring.run.device.startswith("cuda") and method(self.request.method).in_parts

    def run_round(self, asked: RoundRequest) -> Round:
        known: Known = {}
        run = self.run.with_progress_range(*asked.progress)
        rollout = self.scoring.rollout(known)  # one for all parts
        parts = split_rows(asked.rows, run.cores if self._is_divisible and run.pool is None else 1)

        def planned(part: range, own: ExecutionContext, others: bool) -> Round:
            wanted = self.plan_request(replace(asked, rows=part), rollout, others_have_place=others)
            hand, obj, request, run = (
                self.scoring.hand,
                self.scoring.obj,
                self.request,
                own.with_progress_range(0.0, PARTS[0]),
            )
            found = synthesize(hand, obj, wanted, run, method=request.method, options=request.options)
            told = self.grasps_to_store(wanted, found)
            # Verdicts and metrics are many short tasks: they may use all cores, also while other parts run.
            made = self.scoring.evaluate(told, replace(own, sharing=None), known, required=self.requirements)
            return self.complete_round(replace(asked, rows=part), made, told)

        def run_part(part: range, own: ExecutionContext) -> Round | NoStartFound:
            try:
                return planned(part, own, self.candidates > 0)
            except NoStartFound as error:
                return error

        found = parallel_map(parts, run_part, run, size=len)
        if len(refused := [one for one in found if isinstance(one, NoStartFound)]) == len(found):
            raise self.explain_refusal(refused[0])
        made = [
            planned(part, run.without_progress(), True) if isinstance(one, NoStartFound) else one
            for part, one in zip(parts, found, strict=True)
        ]
        whole = Round.concatenate(made)
        whole.seconds = {name: value / len(made) for name, value in whole.seconds.items()}
        return whole

    def plan_request(self, asked: RoundRequest, rollout: Rollout | None, *, others_have_place: bool) -> PlanRequest:
        number = self.number + asked.number * ROUND_STRIDE
        rows, scenes, placed = asked.rows, self.scoring.scenes, None
        if scenes is not None:
            poses, own = scenes, slice(self._scenes.start, self._scenes.stop)
            beside = poses.neighbour_pose[own] if poses.neighbours else poses.neighbour_pose
            mine = replace(poses, object_pose=poses.object_pose[own], neighbour_pose=beside)
            placed = mine.placed(self._used[(asked.begun + np.array(rows)) % len(self._used)])
        knobs, seed = self.request.resolved_fidelity, self.request.seed
        wanted = self.requirements
        return PlanRequest(len(rows), knobs, seed, number, placed, rollout, rows.start, wanted, others_have_place)

    def grasps_to_store(self, wanted: PlanRequest, planned: GraspSet) -> GraspSet:
        """Return the grasps to validate and store, with rounded positions and the job's scene numbers."""
        index = None if wanted.placed is None else self._scenes.start + wanted.placed.index
        return replace(planned, scene=index).moved(np.zeros(3))

    def complete_round(self, asked: RoundRequest, made: Round, told: GraspSet) -> Round:
        """Return the round with the planner's info; the batch's first grasps also start the rechecks."""
        made.planned = [told]
        made.grasps = replace(made.grasps, info=told.info, seconds=told.seconds)
        made.seconds["planner"] += told.seconds
        made.repeated = max(0, told.attempts - len(asked.rows)) if self.scoring.scenes is not None else 0
        if asked.number == 0 and asked.rows.start == 0:
            self._begin_rechecks(made)
        return made

    def explain_refusal(self, error: NoStartFound) -> NoStartFound:
        why = self._narrow_reason()
        return NoStartFound(f"{error}: {why}") if why else error

    def finish(self) -> ValidatedBatch:
        """Join the rounds to one batch of at most `count` grasps, with rechecks."""
        scoring, rounds, count = self.scoring, self.rounds, self.count
        grasps = join_grasp_sets([part.grasps for part in rounds])
        columns = join_columns([part.columns for part in rounds])
        fates = np.concatenate([part.fates for part in rounds])
        # The last round may find more grasps than needed. Only candidates up to the last selected grasp count; with the
        # others the share of valid ones would be too low.
        places = np.flatnonzero(fates == "kept")
        candidates = int(places[count - 1]) + 1 if len(places) >= count else len(fates)
        absent = {"blocked"} if scoring.scenes is None else set()
        absent |= set() if self.request.robust else {"not_robust"}
        absent |= set() if self.request.min_payload else {"weak"}
        absent |= set() if self.requirements.is_set else {"requirements"}
        reasons = [name for name in REJECTIONS if name not in absent]
        outcomes = sum_outcomes([Counter(fate for fate in fates[:candidates].tolist() if fate != "kept")])
        rejected = dict.fromkeys(reasons, 0)
        for name, number in outcomes.items():
            rejected[_REJECTION_OF.get(name, name if name in reasons else "dropped")] += number
        grasps, columns = select_rows(grasps, columns, np.arange(min(count, len(grasps))))
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
            held = columns["quality/success"] == 1
            columns |= self._further_columns(grasps, columns["quality/valid"], held)
            narrow = None if columns["quality/valid"].any() else self._narrow_reason()
            found = replace(found, columns=columns, verdict_key=scoring.key(), narrow=narrow)
        scene = None if grasps.scene is None else grasps.scene - self._scenes.start
        return replace(found, grasps=replace(grasps, scene=scene)).moved(scoring.centre)

    def _narrow_reason(self) -> str | None:
        if self.scoring.scenes is None:
            return None
        around = self.scoring.scenes.placed(np.zeros(0, int)).scenes
        return narrow_reason(self.scoring.hand, self.scoring.obj, around[self._scenes.start : self._scenes.stop])

    def _shares(self) -> dict[str, float]:
        planned = max(1, sum(len(part.fates) for part in self.rounds))
        return {
            f"{name}_share": float(sum(int(part.in_scene[name].sum()) for part in self.rounds)) / planned
            for name in self.rounds[0].in_scene
        }

    def _further_columns(self, grasps: GraspSet, valid: NDArray[np.uint8], held: NDArray[np.bool_]) -> Arrays:
        """Return displacements of all grasps and, if wanted, rechecks and verdicts of second engines.
        Rechecks validate the first valid grasps at level `dexgraspbench`, second engines an evenly spaced share."""
        scoring = self.scoring
        assert scoring.pieces is not None
        hand, obj, run, pieces = scoring.hand, scoring.obj, scoring.run, scoring.pieces.result()
        displacement = simulated_displacement_cm(hand, obj, grasps.grasp, pieces=pieces, run=run)
        columns: Arrays = {"quality/simulated_displacement_cm": displacement}
        with _timed(self.seconds, "validation"):
            if count := self.request.rechecks_of(self.number):
                rechecked, recheck = np.flatnonzero(valid)[:count], np.full(len(grasps), -1, np.int8)
                if len(rechecked):
                    known = self._rechecks.result() if self._rechecks else self._recheck(grasps.take(rechecked))
                    recheck[rechecked] = known[: len(rechecked)]
                columns["quality/recheck"] = recheck
            if self.request.second_engines and not self.request.robust:
                rows = np.flatnonzero(valid)
                tried = math.ceil(len(rows) * self.request.second_engine_share - 1e-9)
                rows = rows[np.arange(tried) * len(rows) // max(1, tried)]
                columns |= scoring.second_verdicts(grasps, held, rows, run.without_progress())
        return columns

    def _begin_rechecks(self, first: Round) -> None:
        """Start rechecks of a batch's first grasps, which later rounds do not change.
        They run in the background thread; `finish` waits for them."""
        count = self.request.rechecks_of(self.number)
        if self.scoring.pieces is None or not count:
            return
        valid = np.flatnonzero(first.columns["quality/valid"])
        if self.request.want != "candidates":
            points = hand_points(self.scoring.hand, first.grasps.grasp.take(valid))
            valid = valid[distinct_mask(points, self.request.min_distance)]
        if len(valid) >= count:
            self._rechecks = self.scoring.beside.submit(self._recheck, first.grasps.take(valid[:count]))

    def _recheck(self, grasps: GraspSet) -> NDArray[np.int8]:
        scoring = self.scoring
        assert scoring.pieces is not None
        run, pieces = scoring.run.without_progress(), scoring.pieces.result()
        if (placed := scoring.placed(grasps)) is None:
            return validate(scoring.hand, scoring.obj, grasps, level="dexgraspbench", pieces=pieces, run=run).success
        return validate_lifts(
            scoring.hand, scoring.obj, grasps, placed, level="dexgraspbench", pieces=pieces, run=run
        ).success


def _rejection_reasons(columns: Arrays, count: int) -> NDArray[np.object_]:
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
