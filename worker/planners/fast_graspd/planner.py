"""The planner: starts, coarse phase, fine phase and projection of batches in one launch.

A launch is divided into one part per CPU thread. A grasp is independent of the other grasps of its launch.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import partial, reduce
from typing import Final

import numpy as np
import warp as wp
from numpy.typing import NDArray

from graspd.service.model.fidelity import Fidelity
from graspd.service.model.transforms import Floats
from graspd.worker.control.postures import STANDS_OFF_M, close_fingers, fingers_off_object, touching_links
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet, join_grasp_sets
from graspd.worker.hands.digits import digit_names, finger_of_body
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners.fast_graspd import candidates, scene_starts, starts
from graspd.worker.planners.fast_graspd.batches import Batches, finalist_count
from graspd.worker.planners.fast_graspd.pairs import Pair, pair_of
from graspd.worker.planners.fast_graspd.schedule import AROUND, DILATION, WarmStart, coarse_schedule, fine_schedule
from graspd.worker.planners.fast_graspd.starts import NO_PLACE, Probe
from graspd.worker.planners.port import BatchRequest, Method, PlanRequest
from graspd.worker.planners.threads import run_parts, split_batch
from graspd.worker.quality.gate import MAX_PENETRATION_MM, MIN_CONTACT_LINKS
from graspd.worker.simulation.data import Data, HandState
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.simulation.launches import Launches
from graspd.worker.simulation.model import Model
from graspd.worker.simulation.obstacles import DeviceObstacles
from graspd.worker.simulation.projection import Projection, ProjectionOptions
from graspd.worker.simulation.record import record_iteration

Rows = NDArray[np.intp]

#: Number of iterations between two checks for cancellation.
CHUNK: Final = 10
#: Fewest grasps per thread.
PART: Final = 4
#: Grasps with a larger merit are retried. A fifth (Shadow) to a half of them hold; of the others, most hold.
SET_OUT_AGAIN: Final = 0.05
#: Grasps with a larger rollout score (`worker.planners.port.Rollout`) are retried. A tenth to a quarter of them hold.
FAILED: Final = 2.0
#: Least score of a free grasp with a finger off the object.
STANDS: Final = 1.99
#: Free grasps with larger scores are retried; one limit for each attempt. Grasps that may slip at half friction exceed
#: the first limit; grasps with a finger off the object also exceed the second. Later attempts are as productive as the
#: first. They hardly change the yield per second, but fewer grasps of hard pairs of hand and object fail.
FREE: Final = (candidates.GOOD, STANDS, *(FAILED,) * 18)
#: Grasps in scenes with larger scores are retried; one limit for each attempt. A grasp with a finger off the object
#: exceeds only the first limit; a grasp that fails only at half friction exceeds the first five. Five attempts instead
#: of two raise the share that lifts at half friction from .63 to .67 at 3 % more time (Allegro, 12 objects, own mass).
IN_SCENES: Final = (candidates.GOOD_IN_SCENES, *(1.0,) * 4, FAILED)
#: Range of the distance at which a digit that must touch is closed [m].
MUST_TOUCH_M: Final = (0.001, 0.06)
#: The same for fingertips out of line. Three quarters of the hands with a digit off have it so near. Distances up to
#: `probe.REACH_M` cost a fifth of larger ones.
OUT_OF_LINE_M: Final = (0.001, 0.007)
#: Weight with which the projection holds these fingertips. With the default weight, .57 of Allegro hands lose one of
#: three digits (mug, bottle, drill), with this weight .45.
HOLD_WEIGHT: Final = 0.1
#: Cosine between the normals of fingers after the coarse phase above which they will hardly touch out of line. Of 221
#: Shadow hands that ended in line, more than half exceed it; of 160 tripods, less than a tenth.
IN_LINE_COS: Final = 0.94
#: Added to the merit of such hands: they are refined last.
UNLIKE: Final = 10.0
#: Largest number of attempts of one grasp at once.
AHEAD: Final = 4


@dataclass
class LaunchPart:
    """Grasps of a launch that one thread works on."""

    rows: Rows
    state: HandState
    loss: Floats
    merit: Floats
    """(n,) merit or rollout score of the selected hand; 0 if there was no selection."""
    curve: list[Floats] = field(default_factory=list)
    """(n,) mean L_stable of each grasp's hands, every `CHUNK` iterations."""
    grasps: GraspSet | None = None
    """Grasps with their postures, if requested or needed by a rollout."""
    attempts: Rows = field(default_factory=lambda: np.zeros(0, int))

    def __post_init__(self) -> None:
        if len(self.attempts) != len(self.rows):
            self.attempts = np.ones(len(self.rows), int)

    def take(self, which: NDArray[np.intp]) -> LaunchPart:
        grasps = None if self.grasps is None else self.grasps.take(which)
        curve = [one[which] for one in self.curve]
        parts = (self.rows[which], self.state[which], self.loss[which], self.merit[which], curve, grasps)
        return LaunchPart(*parts, self.attempts[which])

    def followed_by(self, other: LaunchPart) -> LaunchPart:
        curve = [np.concatenate(both) for both in zip(self.curve, other.curve, strict=True)]
        both = [part.grasps for part in (self, other) if part.grasps is not None]
        rows, loss, merit, attempts = (
            np.concatenate([getattr(part, name) for part in (self, other)])
            for name in ("rows", "loss", "merit", "attempts")
        )
        state = HandState.concatenate([self.state, other.state])
        return LaunchPart(rows, state, loss, merit, curve, join_grasp_sets(both) if both else None, attempts)


def plan(
    hand: HandModel, obj: ObjectModel, wanted: PlanRequest, run: ExecutionContext, *, warm: WarmStart | None = None
) -> GraspSet:
    """Plan one batch, see `worker.planners.Planner`; for `warm` see `Batches`."""
    (found,) = plan_batches(hand, obj, [BatchRequest(wanted, run)], warm=warm)
    if isinstance(found, Exception):
        raise found
    return found


def plan_batches(
    hand: HandModel, obj: ObjectModel, asked: Sequence[BatchRequest], *, warm: WarmStart | None = None
) -> list[GraspSet | Exception]:
    """Plan batches, see `worker.planners.BatchPlanner`; for `warm` see `Batches`."""
    began = time.perf_counter()
    whole, hand = hand, asked[0].wanted.requirements.hand(hand)
    batches = Batches(asked, obj, warm, whole)
    run = asked[0].run
    try:
        parts = optimise(_pair(whole, obj, asked[0].wanted, run), batches, run, postures=True)
    except Exception:
        if len(batches.errors) < len(asked):
            raise
        parts = []
    each = (time.perf_counter() - began) / len(batches.owner)
    found: list[GraspSet | Exception] = []
    for owner, one in enumerate(asked):
        if owner in batches.errors:
            found.append(batches.errors[owner])
            continue
        own = [part.take(np.flatnonzero(batches.owner[part.rows] == owner)) for part in parts]
        own = [part for part in own if len(part.rows)]
        found.append(grasps_of(hand, obj, own, each * one.wanted.count, one.wanted.placed))
    return found


def _pair(hand: HandModel, obj: ObjectModel, wanted: PlanRequest, run: ExecutionContext) -> Pair:
    allowed, hand = wanted.requirements.allowed(hand), wanted.requirements.hand(hand)
    return pair_of(hand, obj, wanted.fidelity, run.device, in_scenes=wanted.placed is not None, allowed=allowed)


def optimise_batch(hand: HandModel, obj: ObjectModel, wanted: PlanRequest, run: ExecutionContext) -> list[LaunchPart]:
    """Run starts, optimisation and projection of a batch, without pregrasp and squeeze postures."""
    return optimise_pair(_pair(hand, obj, wanted, run), wanted, run)


def optimise_pair(pair: Pair, wanted: PlanRequest, run: ExecutionContext) -> list[LaunchPart]:
    """Run `optimise_batch` for a pair on `run.device`; the pair's geometry may differ from the fidelity's."""
    batches = Batches([BatchRequest(wanted, run)], pair.fine.obj.model)
    parts = optimise(pair, batches, run)
    batches.active_rows()
    return parts


def optimise(pair: Pair, batches: Batches, run: ExecutionContext, *, postures: bool = False) -> list[LaunchPart]:
    """Run several batches; the returned parts contain all batches that did not stop, and possibly others.
    `postures` adds the pregrasp and squeeze postures. Raise the first batch's error if all have stopped."""
    launch = _Launch(pair, batches)
    begun = _draw_all_starts(launch, batches.active_rows(), run)
    rows = _rows_with_starts(launch, begun)
    begun = begun.take(np.flatnonzero(np.isin(begun.rows, rows)), batches.fidelity.starts)

    def work(which: range) -> LaunchPart:
        return _optimise_part(launch, begun.take(np.arange(which.start, which.stop), batches.fidelity.starts))

    parts = run_parts(split_batch(len(rows), run, least=PART), work)
    if batches.placed is None or batches.has_rollout:
        parts = [_retry(launch, reduce(LaunchPart.followed_by, parts), run)]
    if not postures or batches.has_rollout:
        return parts
    whole = reduce(LaunchPart.followed_by, parts)
    return run_parts(
        split_batch(len(rows), run, least=PART),
        lambda which: _add_postures(launch, whole.take(np.arange(which.start, which.stop))),
    )


@dataclass(frozen=True)
class _Launch:
    """Models of a pair for each phase, and the batches planned with them; shared by all threads."""

    pair: Pair
    batches: Batches
    pulled: bool = True
    """Whether the attraction term is on; only for free objects."""
    coarse: Model = field(init=False)
    fine: Model = field(init=False)

    def __post_init__(self) -> None:
        placed, centre = self.batches.placed, self.pair.fine.obj.model.centre_of_mass
        hand, obstacles = self.pair.hand, None
        if placed is not None:
            obstacles = DeviceObstacles.create(hand.model, placed.scenes, centre, hand.device)
        object.__setattr__(self, "coarse", self.pair.model(self.pair.coarse, obstacles, pulled=self.pulled))
        object.__setattr__(self, "fine", self.pair.model(self.pair.fine, obstacles, pulled=self.pulled))

    def placed(self, rows: Rows) -> PlacedGrasps | None:
        return self.batches.placed.take(rows) if self.batches.placed is not None else None

    def pair_on_device(self) -> tuple[HandModel, ObjectModel, str]:
        return self.pair.hand.model, self.pair.fine.obj.model, self.pair.hand.device

    def merits(self, state: HandState, losses: Floats, depths: Floats | None = None) -> Floats:
        hand, obj, device = self.pair_on_device()
        friction = candidates.FRICTION if self.batches.placed is None else candidates.SCENE_FRICTION
        return candidates.merits(hand, obj, state, losses, depths, friction=friction, device=device)

    def closed(self, state: HandState, rows: Rows) -> HandState:
        """Close fingers that stand off the object; `rows` (n,) are the grasps of the hands.
        Free grasps are closed only if a certain number of digits must touch."""
        required = self.batches.requirements.links > MIN_CONTACT_LINKS
        if self.batches.placed is None and not required:
            return state
        hand, obj, device = self.pair_on_device()
        off_m = MUST_TOUCH_M if required else STANDS_OFF_M
        off_m = OUT_OF_LINE_M if self.batches.requirements.out_of_line else off_m
        posture = candidates.posture_of(hand, obj, state)
        grasp = close_fingers(hand, obj, posture, self.placed(rows), off_m=off_m, device=device)
        return HandState(state.pivot, state.rotation, hand.reduce(grasp.joint_positions))

    def stand_off(self, state: HandState) -> NDArray[np.bool_]:
        """Return a mask (n,) of hands in scenes with a finger that stands off the object."""
        if self.batches.placed is None or not self.batches.has_rollout:
            return np.zeros(len(state.pivot), bool)
        hand, obj, device = self.pair_on_device()
        return fingers_off_object(hand, obj, candidates.posture_of(hand, obj, state), device=device)

    def unlike(self, data: Data, count: int) -> NDArray[np.bool_]:
        """Return a mask (count,) of coarse hands that will hardly have the required arrangement."""
        wanted, hand = self.batches.requirements, self.batches.hand
        if hand is None or not wanted.out_of_line:
            return np.zeros(count, bool)
        names, finger = digit_names(hand), finger_of_body(hand)
        used = [names.index(name) for name in wanted.digits if name != "thumb"]
        found, number = data.contacts, data.contacts.count.numpy()[:count]
        body, distance, normal = (array.numpy()[:count] for array in (found.body, found.distance, found.normal))
        there = np.arange(body.shape[1]) < number[:, None]
        own = [np.where(there & (finger[np.where(there, body, 0)] == digit), distance, np.inf) for digit in used]
        normals = np.stack([normal[np.arange(count), gap.argmin(axis=1)] for gap in own], axis=1)
        near = np.all([np.isfinite(gap).any(axis=1) for gap in own], axis=0)
        return near & (np.einsum("bfi,bgi->bfg", normals, normals).min(axis=(1, 2)) > IN_LINE_COS)

    def infeasible(self, state: HandState, depths: Floats, rows: Rows) -> NDArray[np.bool_]:
        """Return a mask (n,) of hands of grasps `rows` that get no rollout; `depths` (n,) [m].
        They fail the geometric gate or the requirements."""
        if not self.batches.has_rollout:
            return np.zeros(len(depths), bool)
        hand, obj, device = self.pair_on_device()
        posture, wanted = candidates.posture_of(hand, obj, state), self.batches.requirements
        links = touching_links(hand, obj, posture, device=device)
        bad = (depths > 1e-3 * MAX_PENETRATION_MM) | (links < max(MIN_CONTACT_LINKS, wanted.links))
        if wanted.is_set and not bad.all():
            fair = np.flatnonzero(~bad)
            whole, placed = self.batches.hand or hand, self.placed(rows[fair])
            bad[fair] = ~wanted.fulfilled(whole, obj, posture.take(fair), placed, device)
        return bad


@dataclass(frozen=True)
class _Starts:
    """Starts of the hands of grasps; hands of one grasp are adjacent."""

    rows: Rows
    state: HandState
    depth: Floats
    touch: Floats | None
    """Initial dilation with which the object just touches each hand, as a share of `DILATION`; 1 if None."""

    def take(self, which: NDArray[np.intp], each: int) -> _Starts:
        hands = (which[:, None] * each + np.arange(each)).ravel()
        touch = None if self.touch is None else self.touch[hands]
        return _Starts(self.rows[which], self.state[hands], self.depth[hands], touch)


def _draw_all_starts(launch: _Launch, rows: Rows, run: ExecutionContext) -> _Starts:
    def work(which: range) -> _Starts:
        some = rows[which.start : which.stop]
        found = _draw_starts(launch, some, np.zeros(len(some), int))
        launch.batches.step(some, 1, "starts")
        return found

    parts = run_parts(split_batch(len(rows), run, least=PART), work)
    touch = (
        np.concatenate([part.touch for part in parts if part.touch is not None]) if parts[0].touch is not None else None
    )
    depth = np.concatenate([part.depth for part in parts])
    return _Starts(
        np.concatenate([part.rows for part in parts]), HandState.concatenate([p.state for p in parts]), depth, touch
    )


def _draw_starts(launch: _Launch, rows: Rows, attempt: Rows) -> _Starts:
    batches, coarse = launch.batches, launch.coarse
    fidelity, placed, generators = batches.fidelity, launch.placed(rows), batches.generators(rows, attempt)
    if placed is None:
        state, depth = starts.clear_starts(coarse, generators, each=fidelity.starts, wanted=batches.requirements)
        # Only grasps that opened further in their first attempt may do so later; the others have clear starts.
        may_open = np.repeat(batches.opened[rows] | (attempt == 0), fidelity.starts)
        opened = starts.open_further(coarse, generators, state, depth, may_open, batches.requirements)
        batches.opened[rows] |= opened.reshape(len(rows), -1).any(axis=1)
    else:
        starts_of = batches.warm or partial(scene_starts.clear_scene_starts, wanted=batches.requirements)
        state, depth = starts_of(coarse, generators, each=fidelity.starts, placed=placed, ways=batches.ways)
    touch = Probe(coarse, len(state.pivot)).nearest(state) / DILATION if fidelity.dilation == "touch" else None
    return _Starts(rows, state, depth, touch)


def _rows_with_starts(launch: _Launch, begun: _Starts) -> Rows:
    """Return the rows of the batches that found starts.
    Around a free object every hand must have a start. In scenes one per batch suffices, in this part or another."""
    batches = launch.batches
    deep = begun.depth.reshape(len(begun.rows), -1)
    owners = batches.owner[begun.rows]
    for owner in sorted(set(owners.tolist())):
        own = deep[owners == owner]
        if batches.placed is None and own.max() > NO_PLACE:
            batches.fail(owner, starts.no_start_error(launch.coarse, batches.requirements))
        elif batches.placed is not None and own.min() > NO_PLACE and not batches.asked[owner].wanted.others_have_place:
            batches.fail(owner, scene_starts.no_start_error(launch.coarse, batches.requirements))
    return batches.active_rows()


def _optimise_part(launch: _Launch, begun: _Starts, beat: Floats | None = None) -> LaunchPart:
    """Optimise hands and select one per grasp; with rollouts, `beat` (n,) are the scores to beat."""
    batches, pair, rows = launch.batches, launch.pair, begun.rows
    fidelity, placed, n = batches.fidelity, launch.placed(rows), len(rows)
    hand, obj, last = pair.hand.model, pair.fine.obj.model, finalist_count(fidelity)
    data = _set_scenes(Data(launch.coarse, n * fidelity.starts), placed, fidelity.starts)
    data.set_schedule(coarse_schedule(fidelity))
    data.set_state(begun.state, dilation=begun.touch)
    # During the coarse phase the dilation shrinks and changes the loss, so nothing converges before its end.
    launches = record_iteration(launch.coarse, data, fidelity.optimizer, patience=0)
    curve: list[Floats] = []
    state = _descend(launches, data, batches, rows, fidelity.coarse_iterations, "coarse optimization", curve)
    losses = _losses(data, len(state.pivot))
    order, unlike = np.arange(n * fidelity.starts).reshape(n, -1), np.zeros(len(state.pivot), bool)
    if last < fidelity.starts or (batches.has_rollout and fidelity.starts > 1):
        merit = launch.merits(state, losses)
        if placed is None:
            merit -= candidates.NEARNESS * data.near_share(candidates.NEAR_M, len(state.pivot))
        else:
            merit += scene_starts.obstruction(
                launch.coarse, state, placed.take(np.repeat(np.arange(n), fidelity.starts))
            )
        unlike = launch.unlike(data, len(state.pivot))
        order = candidates.rank_hands(merit + UNLIKE * unlike, n)[:, :last]
    fine_phase = _FinePhase(launch, rows, state, losses, curve)
    if batches.has_rollout:
        together = 1 if placed is None else candidates.TOGETHER
        device = pair.hand.device
        taken = candidates.select_by_rollout(
            *(hand, obj, order, fine_phase.refine, placed),
            lambda grasps, which, beat: batches.rollout(grasps, rows[which], beat),
            beat=beat,
            unlike=unlike,
            together=together,
            device=device,
        )
        found, score = taken.joined(), taken.score
        if placed is None:
            off = fingers_off_object(hand, obj, found.grasp, device=device)
            score = np.where(off & (score < STANDS), STANDS + 1e-3 * score, score)
        return LaunchPart(rows, taken.state, taken.losses, score, curve, found)
    refined = fine_phase.refine(np.sort(order, axis=1), np.arange(n))
    winners = candidates.rank_hands(refined.merit, n)[:, 0] if last > 1 else np.arange(n)
    return LaunchPart(rows, refined.state[winners], refined.losses[winners], refined.merit[winners], curve)


def _retry(launch: _Launch, part: LaunchPart, run: ExecutionContext) -> LaunchPart:
    """Retry grasps with a poor score or merit; select the first good attempt, else the best one.
    The last few grasps would leave cores idle, and a hand costs a third more in a small launch. Several of their
    attempts therefore run at once. Attempts after a good one are dropped, so the result equals sequential attempts."""
    limits: tuple[float, ...] = FREE if launch.batches.has_rollout else (SET_OUT_AGAIN,)
    if launch.batches.placed is not None:
        limits = IN_SCENES
    done = 0
    while done < len(limits) and len(poor := np.flatnonzero(part.merit > limits[done])):
        ahead = int(np.clip(PART * run.cores // len(poor), 1, min(AHEAD, limits[done:].count(limits[done]))))
        attempt = np.repeat(np.arange(done + 1, done + 1 + ahead), len(poor))
        again = _run_attempts(launch, np.tile(part.rows[poor], ahead), attempt, np.tile(part.merit[poor], ahead), run)
        merit, attempts, chosen = part.merit.copy(), part.attempts.copy(), np.arange(len(part.rows))
        for made, limit in zip(np.split(np.arange(len(attempt)), ahead), limits[done:], strict=False):
            wanting = merit[poor] > limit
            attempts[poor] += wanting
            better = wanting & (again.merit[made] < merit[poor])
            chosen[poor[better]] = len(part.rows) + made[better]
            merit[poor[better]] = again.merit[made[better]]
        part, done = replace(part.followed_by(again).take(chosen), attempts=attempts), done + ahead
    return part


def _run_attempts(launch: _Launch, rows: Rows, attempt: Rows, merit: Floats, run: ExecutionContext) -> LaunchPart:
    """Run later attempts (n,) of grasps with merits (n,) so far; a grasp without a start gets merit inf.
    The attraction term is off: with it, half as many grasps hold on a bowl's wall."""
    launch = replace(launch, pulled=False)

    def work(which: range) -> LaunchPart:
        some = slice(which.start, which.stop)
        begun = _draw_starts(launch, rows[some], attempt[some])
        # Attempts at failed grasps may run at once, so they do not depend on each other's scores.
        made = _optimise_part(launch, begun, np.where(merit[some] < STANDS, merit[some], np.inf))
        # Around a free object every hand needs a start; in scenes one hand of a grasp suffices.
        deep = begun.depth.reshape(len(made.rows), -1)
        lost = (deep.max(axis=1) if launch.batches.placed is None else deep.min(axis=1)) > NO_PLACE
        return replace(made, merit=np.where(lost, np.inf, made.merit))

    return reduce(LaunchPart.followed_by, run_parts(split_batch(len(rows), run), work))


def _add_postures(launch: _Launch, part: LaunchPart) -> LaunchPart:
    hand, obj, device = launch.pair_on_device()
    placed = launch.placed(part.rows)
    return replace(part, grasps=candidates.grasps_of_state(hand, obj, part.state, part.loss, placed, device=device))


@dataclass
class _FinePhase:
    """Fine phase and projection of hands that have passed the coarse phase."""

    launch: _Launch
    rows: Rows
    state: HandState
    losses: Floats
    curve: list[Floats]
    """Loss curve; only the first call of `refine` continues it."""

    def refine(self, rows: NDArray[np.intp], which: NDArray[np.intp]) -> candidates.Refinements:
        launch, flat = self.launch, rows.ravel()
        fidelity, mine = launch.batches.fidelity, self.rows[which]
        state, losses = self.state[flat], self.losses[flat]
        data = _set_scenes(Data(launch.fine, len(flat)), launch.placed(mine), rows.shape[1])
        data.set_schedule(fine_schedule(fidelity))
        data.set_state(state)
        launches = record_iteration(launch.fine, data, fidelity.optimizer, patience=fidelity.patience)
        curve, self.curve = self.curve, []
        state = _descend(launches, data, launch.batches, mine, fidelity.fine_iterations, "refinement", curve)
        if fidelity.fine_iterations:
            losses = _losses(data, len(flat))
        options = AROUND if launch.batches.placed is None else ProjectionOptions()
        if launch.batches.requirements.out_of_line:
            options = replace(options, hold_weight=HOLD_WEIGHT)
        state = launch.closed(state, np.repeat(mine, rows.shape[1]))
        # Without iterations the projection only measures the depth of each hand.
        state, depths = Projection(launch.fine, data, options).run(state, fidelity.polish_iterations)
        merit = launch.merits(state, losses, depths) if rows.shape[1] > 1 else np.zeros(len(flat))
        return candidates.Refinements(
            state,
            losses,
            merit,
            launch.infeasible(state, depths, np.repeat(mine, rows.shape[1])),
            launch.stand_off(state),
        )


def _set_scenes(data: Data, placed: PlacedGrasps | None, each: int) -> Data:
    if placed is not None:
        data.set_scenes(np.repeat(placed.index, each))
    return data


def _losses(data: Data, n: int) -> Floats:
    return data.loss.numpy()[:n].mean(axis=1).astype(float)


def _descend(
    launches: Launches, data: Data, batches: Batches, rows: Rows, iterations: int, name: str, curve: list[Floats]
) -> HandState:
    """Optimise the hands of grasps `rows`; exclude batches that stop meanwhile."""
    done, out = 0, len(batches.errors)
    each = data.capacity // len(rows)
    while done < iterations:
        chunk = min(CHUNK, iterations - done)
        launches.run(chunk)
        done += chunk
        batches.step(rows, each * chunk, name)
        if len(batches.errors) > out:
            out = len(batches.errors)
            data.deactivate(np.repeat(~batches.is_active(rows), each))
        if not wp.get_device(data.device).is_cuda:
            curve.append(_losses(data, data.capacity).reshape(len(rows), each).mean(axis=1))
    return data.state(data.capacity)


def grasps_of(
    hand: HandModel,
    obj: ObjectModel,
    parts: list[LaunchPart],
    seconds: float,
    placed: PlacedGrasps | None = None,
    *,
    device: str = "cpu",
) -> GraspSet:
    curve = [np.concatenate(chunk).mean() for chunk in zip(*(part.curve for part in parts), strict=True)]
    known = [part.grasps for part in parts if part.grasps is not None]
    if len(known) == len(parts):
        grasps = join_grasp_sets(known)
    else:
        loss = np.concatenate([part.loss for part in parts])
        state = HandState.concatenate([part.state for part in parts])
        grasps = candidates.grasps_of_state(hand, obj, state, loss, placed, device=device)
    attempts = int(sum(part.attempts.sum() for part in parts))
    info = {"loss_curve": np.round(curve, 5).tolist(), "chunk": CHUNK}
    return replace(grasps, seconds=seconds, info=info, attempts=attempts)


METHOD: Final = Method(
    summary="gradient descent through a differentiable contact simulation",
    source="D. Turpin et al., Fast-Grasp'D, ICRA 2023",
    planner=lambda options: plan,
    joined=lambda options: plan_batches,
    in_scenes=True,
    in_parts=True,
    uses=tuple(name for name in Fidelity.model_fields if name != "name"),
)
