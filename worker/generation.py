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
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
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
from graspd.worker.scenes.rollout import lift_level, rollout_on, scene_verdicts
from graspd.worker.side_by_side import side_by_side
from graspd.worker.simulation.environment import PlacedGrasps, Scenes
from graspd.worker.validation.decomposition import ConvexPieces, decompose
from graspd.worker.validation.displacement import simulated_displacement_cm
from graspd.worker.validation.key import verdict_key
from graspd.worker.validation.lift import LiftOutcome
from graspd.worker.validation.lifting import lift_key, validate_lifts
from graspd.worker.validation.payload import ENOUGH, Limit, limit_of, payloads, shake_margins
from graspd.worker.validation.prefilter.prefilter import first_terms
from graspd.worker.validation.protocol import DIRECTIONS, Outcome
from graspd.worker.validation.robust import reaches, robust, robustness
from graspd.worker.validation.validator import validate

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
#: Shares of a round's progress: planned, validated, measured.
_PARTS: Final = (0.6, 0.8, 1.0)


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
    require_opposing(hand)
    work = _Work(hand, obj.centred, request, batch, run)
    fitting_pairs(hand, work.obj)
    work.scenes = None if scenes is None else scenes.centred(obj)
    with ThreadPoolExecutor(1, thread_name_prefix="beside") as work.beside:
        work.pieces = work.beside.submit(pieces, work.obj) if request.validation != "none" else None
        rounds: list[Round] = []
        try:
            work.until(count, rounds)
        except TaskCancelled:
            if not partial or not rounds:
                raise
            work.goes_on()
        return work.finish(rounds, count).moved(obj.centre)


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
    work = _Work(hand, obj.centred, request.model_copy(update={"want": "candidates"}), 0, run)
    work.scenes = None if scenes is None else scenes.centred(obj)
    with ThreadPoolExecutor(1, thread_name_prefix="beside") as work.beside:
        work.pieces = work.beside.submit(pieces, work.obj) if request.validation != "none" else None
        work.candidates = len(grasps)
        return work.finish([work.score(grasps.moved(np.negative(obj.centre)))], len(grasps)).moved(obj.centre)


class _Work:
    """One batch in the making."""

    def __init__(
        self, hand: HandModel, obj: ObjectModel, request: JobOptions, batch: int, run: ExecutionContext
    ) -> None:
        self.hand, self.obj, self.request, self.batch = hand, obj, request, batch
        self.beside: ThreadPoolExecutor
        """A thread for what need not be waited for."""
        self.pieces: Future[ConvexPieces] | None = None
        self.scenes: Scenes | None = None
        self.candidates = self.repeated = 0
        self.limit: Limit | None = None
        self._rollouts: Rollout | None = None
        self._known: dict[str, Any] = {}
        """Verdicts on candidates from the planner's trial, of lifts or of pushes."""
        self._rechecks: Future[NDArray[np.int8]] | None = None
        self._kept = np.zeros((0, POINTS, 3))
        self.seconds: dict[str, float] = {"planner": 0.0, "validation": 0.0, "quality": 0.0}
        self._run = run

    def goes_on(self) -> None:
        """From here on nobody stops it."""
        self._run = replace(self._run, cancelled=DEFAULT_CONTEXT.cancelled)

    def until(self, count: int, parts: list[Round]) -> None:
        """Adds rounds until `count` grasps are there or the budget is used up."""
        wish = self.request
        if wish.want == "candidates":
            parts.append(self._round(0, range(count), self._run))
            return
        budget, number, valid = math.ceil(wish.budget * count), 0, 0
        # In scenes a grasp that sets out again costs as much as another grasp.
        while size := next_round(count, valid, self.candidates, budget - self.repeated):
            first = 0
            while first < size and valid < count:
                share = min(size - first, enough(count, valid, self.candidates) if self._in_parts else size)
                # It brings the batch as far as the rate so far lets hope.
                begun = valid / count
                run = self._run.part(begun, begun + (1 - begun) * min(1.0, share / (count - valid)) * 0.9)
                parts.append(self._round(number, range(first, first + share), run))
                first, valid = first + share, valid + len(parts[-1].grasps)
            if not valid and self._hopeless(parts):
                return
            number += 1

    def _hopeless(self, made: Sequence[Round]) -> bool:
        """Whether the latest grasps of these rounds, none of which is kept, show that the hand lifts far less than is
        wanted."""
        if self.pieces is None or (self.limit is not None and self.limit.grasps >= ENOUGH):
            return False
        planned = joined([grasps for one in made for grasps in one.planned])
        latest = max(ENOUGH, sum(map(len, made[-1].planned)))
        planned = planned.take(slice(max(0, len(planned) - latest), None))
        self.limit = limit_of(
            self.hand,
            self.obj,
            planned,
            wanted=max(self.obj.mass, self.request.min_payload),
            pieces=self.pieces.result(),
            placed=self._placed(planned),
            run=self._run.quiet(),
        )
        return self.limit is not None and self.limit.hopeless

    @property
    def _in_parts(self) -> bool:
        """Whether the grasps of a round may be made apart from each other: it ends as soon as enough are found, and has
        several lanes. A GPU makes all of it at once, in the time of a few."""
        return not self._run.device.startswith("cuda") and method(self.request.method).in_parts

    def _round(self, number: int, rows: range, run: ExecutionContext) -> Round:
        """Some grasps of a round, planned, validated and measured."""
        begun = self.candidates - rows.start
        apart = self._in_parts and run.meeting is None and run.pool is None
        parts = lanes_of(rows, run.cores if apart else 1)
        self._rollout()  # once, and not by every lane
        known = self.candidates > 0

        def lane(part: range, own: ExecutionContext) -> Round | NoStartFound:
            try:
                return self._lane(number, part, begun, known, own)
            except NoStartFound as error:
                return error

        found = side_by_side(parts, lane, run, size=len)
        if len(refused := [one for one in found if isinstance(one, NoStartFound)]) == len(found):
            why = self._narrow()
            raise NoStartFound(f"{refused[0]}: {why}") if why else refused[0]
        made = [
            self._lane(number, part, begun, True, run.quiet()) if isinstance(one, NoStartFound) else one
            for part, one in zip(parts, found, strict=True)
        ]
        self.candidates += len(rows)
        self.repeated += sum(lane.repeated for lane in made)
        for name in self.seconds:
            self.seconds[name] += sum(lane.seconds[name] for lane in made) / len(made)
        return self._without_alike(Round.joined(made))

    def _lane(self, number: int, rows: range, begun: int, known: bool, run: ExecutionContext) -> Round:
        """The same by one lane: `begun` grasps were tried before the round; `known`: others have a place to start.

        Raises:
            NoPlace: in scenes, none of its grasps has.
        """
        request = self.request
        index = None if self.scenes is None else (begun + np.array(rows)) % len(self.scenes.object_pose)
        placed = self.scenes.placed(index) if self.scenes is not None and index is not None else None
        number_of_batch = self.batch + number * ROUND_STRIDE
        wanted = PlanRequest(
            len(rows), request.knobs, request.seed, number_of_batch, placed, self._rollout(), rows.start, known
        )
        planned = synthesize(
            self.hand, self.obj, wanted, run.part(0.0, _PARTS[0]), method=request.method, options=request.options
        )
        # Verdicts and metrics are many short pieces of work: all cores may take them, whatever other priorities are at.
        # What is validated is what is told: positions are on the grid before.
        planned = replace(planned, scene=index).moved(np.zeros(3))
        made = self._scored(planned, replace(run, lanes=None))
        made.seconds["planner"] += planned.seconds
        made.repeated = max(0, planned.attempts - len(rows)) if placed is not None else 0
        made.planned = [planned]
        if number == 0 and rows.start == 0:
            self._begin_rechecks(made)
        return made

    def finish(self, rounds: list[Round], count: int) -> ValidatedBatch:
        """The rounds as one batch, cut to `count`, with rechecks and robustness."""
        grasps = joined([part.grasps for part in rounds])
        columns = joined_columns([part.columns for part in rounds])
        fates = np.concatenate([part.fates for part in rounds])
        # The last round may find more than were missing: its tries count up to the last grasp that is kept, or else
        # the share of valid ones would look worse than it is.
        places = np.flatnonzero(fates == "kept")
        candidates = int(places[count - 1]) + 1 if len(places) >= count else len(fates)
        absent = {"blocked"} if self.scenes is None else set()
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
            self._shares(rounds),
            limit=None if len(grasps) else self.limit,
        )
        if self.pieces is None:
            return found
        columns |= self._second_opinions(grasps, columns["quality/valid"])
        narrow = None if columns["quality/valid"].any() else self._narrow()
        return replace(found, columns=columns, verdict_key=self._key(self.pieces.result()), narrow=narrow)

    def _narrow(self) -> str | None:
        if self.scenes is None:
            return None
        return why_narrow(self.hand, self.obj, self.scenes.placed(np.zeros(0, int)).scenes)

    def _key(self, pieces: ConvexPieces) -> str:
        if self.scenes is None:
            return verdict_key(
                self.hand,
                self.obj,
                self._level,
                False,
                pieces=pieces,
                prefilter=first_terms(self.hand, self._level, self._run),
            )
        placed = self.scenes.placed(np.zeros(0, int))
        return lift_key(self.hand, self.obj, placed, lift_level(self.request.validation), False, pieces=pieces)

    def _shares(self, rounds: list[Round]) -> dict[str, float]:
        if self.scenes is None:
            return {}
        planned = max(1, sum(len(part.fates) for part in rounds))
        return {
            f"{name}_share": sum(part.in_scene.get(name, 0) for part in rounds) / planned
            for name in ("clear", "lift", "lift_hard")
        }

    @property
    def _level(self) -> Any:
        return self.request.validation

    def _rollout(self) -> Rollout | None:
        """What candidates go through, where there is a validator; the same one in all rounds."""
        if self._rollouts is None and self.pieces is not None:
            in_scenes = self.scenes is not None
            self._rollouts = rollout_on(
                self._run,
                self.hand,
                self.obj,
                self.pieces.result,
                in_scenes=in_scenes,
                known=self._known,
                level=self._level,
            )
        return self._rollouts

    def score(self, planned: GraspSet) -> Round:
        """Validate and measure grasps, and keep those that are wanted."""
        made = self._scored(planned, self._run)
        for name in self.seconds:
            self.seconds[name] += made.seconds[name]
        return self._without_alike(made)

    def _scored(self, planned: GraspSet, run: ExecutionContext) -> Round:
        """Validate and measure grasps, and keep those that are wanted or like others; a hand that is no number is never
        one of them."""
        fates = np.where(planned.finite, "kept", "diverged").astype(object)
        seconds = dict.fromkeys(self.seconds, 0.0)
        finite = np.flatnonzero(fates == "kept")
        planned = planned.take(finite)
        size, every = len(planned), self.request.want == "candidates"
        if self.scenes is None:
            columns, in_scene = self._validated(planned, run, seconds), dict[str, int]()
        else:
            planned, columns, in_scene = self._validated_in_scenes(planned, self.scenes, run, seconds)
            fates[finite[columns["quality/success"] < 0]] = "no_place"
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
        return Round(grasps, columns, fates, in_scene, seconds)

    def _without_alike(self, made: Round) -> Round:
        """Without grasps that are too near to one of the batch that is kept."""
        if self.request.want == "candidates":
            return made
        points = np.concatenate([self._kept, hand_points(self.hand, made.grasps.grasp)])
        kept = distinct(points, self.request.min_distance, given=len(self._kept))
        wanted, self._kept = kept[len(self._kept) :], points[kept]
        made.fates[np.flatnonzero(made.fates == "kept")[~wanted]] = "alike"
        made.grasps, made.columns = taken(made.grasps, made.columns, np.flatnonzero(wanted))
        return made

    def _validated_in_scenes(
        self, grasps: GraspSet, scenes: Scenes, run: ExecutionContext, seconds: dict[str, float]
    ) -> tuple[GraspSet, Arrays, dict[str, int]]:
        """The grasps with their ways, their verdicts, and how many were clear and lifted."""
        assert grasps.scene is not None
        pieces = None if self.pieces is None else self.pieces.result()
        began = time.perf_counter()
        grasps, columns, counts = scene_verdicts(
            self.hand,
            self.obj,
            grasps,
            scenes,
            level=lift_level(self.request.validation),
            pieces=pieces,
            known=self._known,
            run=run.part(*_PARTS[:2]),
        )
        seconds["validation"] += time.perf_counter() - began
        return grasps, columns, counts

    def _validated(self, grasps: GraspSet, run: ExecutionContext, seconds: dict[str, float]) -> Arrays:
        if self.pieces is None:
            return {}
        verdicts = validate(
            self.hand,
            self.obj,
            grasps,
            level=self._level,
            pieces=self.pieces.result(),
            known=self._known,
            run=run.part(*_PARTS[:2]),
        )
        seconds["validation"] += verdicts.seconds
        return {
            "quality/success": verdicts.success,
            "quality/verdict_outcome": verdicts.outcome.reshape(-1, len(DIRECTIONS)),
            "quality/verdict_margin": verdicts.margin,
            **(
                {"quality/validated_by": verdicts.validated_by}
                if first_terms(self.hand, self._level, self._run)
                else {}
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
            placed=self._placed(grasps),
            level=lift_level(wish.validation),
            models=wish.models,
            seed=wish.seed,
            pieces=self.pieces.result(),
            wanted=wish.robust if wish.want == "valid" else 0,
            run=run.quiet(),
        )
        seconds["validation"] += found.seconds
        return found.columns

    def _placed(self, grasps: GraspSet) -> PlacedGrasps | None:
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
            placed=self._placed(grasps),
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
        began, placed = time.perf_counter(), self._placed(grasps)
        assert placed is not None, "shake goes with a scene"
        found = shake_margins(
            self.hand, self.obj, grasps, placed, pieces=self.pieces.result(), held=held, run=run.quiet()
        )
        seconds["validation"] += time.perf_counter() - began
        return found

    def _measured(self, grasps: GraspSet, run: ExecutionContext, seconds: dict[str, float]) -> Arrays:
        began = time.perf_counter()
        columns = measure(self.hand, self.obj, grasps, friction=self.request.friction, run=run.part(*_PARTS[1:]))
        seconds["quality"] += time.perf_counter() - began
        return dict(columns)

    def _second_opinions(self, grasps: GraspSet, valid: NDArray[np.uint8]) -> Arrays:
        """Displacement of all grasps; as far as wished rechecks of the first valid ones under the DexGraspBench
        protocol, and robustness."""
        assert self.pieces is not None
        columns: Arrays = {
            "quality/simulated_displacement_cm": simulated_displacement_cm(
                self.hand, self.obj, grasps.grasp, pieces=self.pieces.result(), run=self._run
            )
        }
        began = time.perf_counter()
        if count := self.request.rechecks_of(self.batch):
            rechecked, recheck = np.flatnonzero(valid)[:count], np.full(len(grasps), -1, np.int8)
            if len(rechecked):
                known = (
                    self._rechecks.result() if self._rechecks is not None else self._rechecked(grasps.take(rechecked))
                )
                recheck[rechecked] = known[: len(rechecked)]
            columns["quality/recheck"] = recheck
        if repeats := self.request.robustness:
            columns["quality/robustness"] = robustness(
                self.hand,
                self.obj,
                grasps,
                held=valid,
                repeats=repeats,
                seed=self.request.seed,
                pieces=self.pieces.result(),
                run=self._run.quiet(),
            )
        self.seconds["validation"] += time.perf_counter() - began
        return columns

    def _begin_rechecks(self, first: Round) -> None:
        """Rechecks of the first grasps of a batch, which are its first ones whatever comes after them: they take one
        thread, and the others wait for them at its end."""
        count = self.request.rechecks_of(self.batch)
        if self.pieces is None or not count:
            return
        valid = np.flatnonzero(first.columns["quality/valid"])
        if self.request.want != "candidates":
            points = hand_points(self.hand, first.grasps.grasp.take(valid))
            valid = valid[distinct(points, self.request.min_distance)]
        if len(valid) >= count:
            self._rechecks = self.beside.submit(self._rechecked, first.grasps.take(valid[:count]))

    def _rechecked(self, grasps: GraspSet) -> NDArray[np.int8]:
        """What the DexGraspBench protocol says of grasps."""
        assert self.pieces is not None
        run, pieces = self._run.quiet(), self.pieces.result()
        if (placed := self._placed(grasps)) is None:
            return validate(self.hand, self.obj, grasps, level="dexgraspbench", pieces=pieces, run=run).success
        return validate_lifts(
            self.hand, self.obj, grasps, placed, level="dexgraspbench", pieces=pieces, run=run
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
