"""Several batches of a job: one after the other, or in waves that are planned in one launch each."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, field, replace
from itertools import accumulate, pairwise
from typing import Final

import numpy as np

from service.model.domain import BATCH_SIZE, JobOptions
from service.model.errors import InputError, TaskCancelled
from worker.certified import PARTS, Batch, Certified, Known, Scoring, certified_grasps, require_graspable
from worker.engines.devices import check_device, exclusive
from worker.grasps import GraspSet, joined
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.planners import Asked, NoPlace, synthesize_batches
from worker.quality.diversity import distinct, hand_points
from worker.quality.referee.decomposition import ConvexPieces, decompose
from worker.quality.referee.first.screening import Screened
from worker.rounds import taken
from worker.run import ALONE, Progress, Run
from worker.side_by_side import Shares
from worker.simulation.surroundings import Scenes, scenes_together

#: Times that batches are made for grasps that were too like those of another batch.
_REFILLS: Final = 3


def certified_batches(
    hand: HandModel,
    obj: ObjectModel,
    request: JobOptions,
    *,
    sizes: Sequence[int],
    first: int = 0,
    join: int = 1,
    scenes: Scenes | Sequence[Scenes] | None = None,
    pieces: Callable[[ObjectModel], ConvexPieces] = decompose,
    run: Run = ALONE,
    partial: bool = False,
    checked: Callable[[int, Certified], None] | None = None,
    empty_on: tuple[type[Exception], ...] = (),
) -> list[Certified]:
    """Batches of a job that follow each other; see `certified_grasps`, which makes the same of each.

    Args:
        hand: the hand.
        obj: the object.
        request: see `certified_grasps`.
        sizes: grasps wanted of each batch.
        first: number of the first batch within its job.
        join: batches whose grasps are planned in one launch; 1: one batch after the other.
        scenes: see `certified_grasps`; those of all batches, or of each.
        pieces: gives the object's convex pieces; asked once.
        run: told of the grasps that are done.
        partial: if it is stopped, the batches that were judged before are the result, the last one maybe in part.
        checked: called with the number of each batch as it is made, and with what came of it; may raise.
        empty_on: where one of these becomes of a batch, it has no grasps; not of a job's first batch, nor of all.

    Raises:
        Exception: what became of the first batch that failed; the others are stopped.
    """
    known: list[ConvexPieces] = []

    def pieces_once(prepared: ObjectModel) -> ConvexPieces:
        if not known:
            known.append(pieces(prepared))
        return known[0]

    given = [scenes] * len(sizes) if scenes is None or isinstance(scenes, Scenes) else list(scenes)
    job = _Job(hand, obj, request, sizes, first, given, pieces_once, run, partial)
    found: dict[int, Certified | None] = {}
    refused: list[Exception] = []
    waves = join > 1 and len(sizes) > 1
    try:
        with closing(job.in_waves(join) if waves else job.one_by_one()) as batches:
            for number, one in batches:
                if isinstance(one, Certified):
                    if checked is not None:
                        checked(first + number, one)
                    found[number] = one
                elif isinstance(one, empty_on) and first + number > 0:
                    refused.append(one)
                    found[number] = None
                else:
                    raise one
    except TaskCancelled:
        if not partial or not found:
            raise
    ordered = [found[number] for number in sorted(found)]
    if (like := next(filter(None, ordered), None)) is None:
        raise refused[0]
    return [one or _nothing(like) for one in ordered]


@dataclass(frozen=True)
class _Job:
    """Batches of a job, and both ways to make them."""

    hand: HandModel
    obj: ObjectModel
    request: JobOptions
    sizes: Sequence[int]
    first: int
    scenes: Sequence[Scenes | None]
    pieces: Callable[[ObjectModel], ConvexPieces]
    run: Run
    partial: bool

    def one_by_one(self) -> Generator[tuple[int, Certified | Exception]]:
        """Each batch by its number here, or what became of it."""
        shares = Shares(self.sizes, self.run.progress)
        for number, count in enumerate(self.sizes):
            own = replace(self.run, progress=shares.of(number))
            try:
                yield (
                    number,
                    certified_grasps(
                        self.hand,
                        self.obj,
                        self.request,
                        count=count,
                        batch=self.first + number,
                        scenes=self.scenes[number],
                        pieces=self.pieces,
                        run=own,
                        partial=self.partial,
                    ),
                )
                own.progress(1.0, 1.0, "done")
            except InputError as error:
                yield number, error

    def in_waves(self, join: int) -> Generator[tuple[int, Certified | Exception]]:
        """The same, with what `join` batches need next planned in one launch. While the device plans a wave, the one
        before it is judged and measured."""
        require_graspable(self.hand, self.obj)
        stop, shares = threading.Event(), Shares(self.sizes, self.run.progress)
        run = replace(self.run, cancelled=lambda: stop.is_set() or self.run.cancelled())
        apart = len({id(one) for one in self.scenes}) > 1
        scenes = scenes_together([one for one in self.scenes if one is not None]) if apart else self.scenes[0]
        ends = accumulate((0 if one is None else len(one.object_pose) for one in self.scenes), initial=0)
        own = [range(*both) for both in pairwise(ends)] if apart else [None] * len(self.sizes)
        with (
            Scoring.begun(self.hand, self.obj, self.request, scenes=scenes, pieces=self.pieces, run=run) as scoring,
            ThreadPoolExecutor(1, thread_name_prefix="device") as device,
        ):
            waves = _Waves(scoring, join * BATCH_SIZE)
            fresh = (
                _Open(number, Batch(scoring, self.first + number, count, own[number]), shares.of(number))
                for number, count in enumerate(self.sizes)
            )
            going: dict[int, _Open] = {}
            ahead: Future[_Wave] | None = None
            try:
                while (members := waves.next(fresh)) or ahead is not None:
                    planned, ahead = ahead, device.submit(waves.planned, members) if members else None
                    going |= {one.number: one for one in members}
                    for number, made in waves.scored(planned.result()) if planned is not None else ():
                        del going[number]
                        yield number, made
            except TaskCancelled:
                stop.set()
                if self.partial:
                    scoring.goes_on()
                    yield from ((one.number, one.batch.finish()) for one in going.values() if one.batch.rounds)
                raise
            finally:
                stop.set()


@dataclass
class _Open:
    """A batch that is being made."""

    number: int
    batch: Batch
    progress: Progress

    def __post_init__(self) -> None:
        self.requests = self.batch.requests()
        self.needed = next(self.requests, None)


@dataclass(frozen=True)
class _Wave:
    """Grasps of several batches that were planned in one launch."""

    members: list[_Open]
    planned: list[GraspSet]
    """Of each of them."""
    refused: list[tuple[int, Exception]]
    """Batches that could not be planned."""
    whole: GraspSet | None
    known: Known
    prefilter: Screened | None


@dataclass
class _Waves:
    """Waves of batches; what comes after the first round of a batch goes before batches that have not begun."""

    scoring: Scoring
    most: int
    """Grasps in a wave."""
    waiting: deque[_Open] = field(default_factory=deque)

    def next(self, fresh: Iterator[_Open]) -> list[_Open]:
        """The batches of the next wave."""
        found, size = list[_Open](), 0
        while (one := self.waiting.popleft() if self.waiting else next(fresh, None)) is not None:
            assert one.needed is not None
            size += len(one.needed.rows)
            if found and size > self.most:
                self.waiting.appendleft(one)
                break
            found.append(one)
        return found

    def planned(self, members: Sequence[_Open]) -> _Wave:
        """Plan what they need; by the one thread that has the device."""
        known: Known = {}
        trial, request, asked = self.scoring.trial(known), self.scoring.request, []
        for one in members:
            assert one.needed is not None
            wanted = one.batch.wanted(one.needed, trial, others_have_place=one.batch.tried > 0)
            run = replace(self.scoring.run, progress=one.progress).part(*one.needed.progress)
            asked.append(Asked(wanted, run.part(0.0, PARTS[0])))
        with exclusive:
            made = synthesize_batches(
                self.scoring.hand, self.scoring.obj, asked, method=request.method, options=request.options
            )
            check_device(self.scoring.run.device)
            wave = _Wave([], [], [], None, known, None)
            told: list[GraspSet] = []
            for one, each, grasps in zip(members, asked, made, strict=True):
                if isinstance(grasps, TaskCancelled):
                    raise grasps
                if isinstance(grasps, Exception):
                    refused = one.batch.refused(grasps) if isinstance(grasps, NoPlace) else grasps
                    wave.refused.append((one.number, refused))
                    continue
                told.append(one.batch.told(each.wanted, grasps))
                wave.members.append(one)
                wave.planned.append(told[-1])
            if not told:
                return wave
            whole = joined(told)
            return replace(wave, whole=whole, prefilter=self.scoring.prefiltered(whole))

    def scored(self, wave: _Wave) -> Iterator[tuple[int, Certified | Exception]]:
        """Judge and measure a wave; batches that need nothing more are made."""
        yield from wave.refused
        if wave.whole is None:
            return
        made = self.scoring.scored(wave.whole, self.scoring.run.quiet(), wave.known, wave.prefilter)
        parts = made.split([len(planned) for planned in wave.planned])
        done: list[_Open] = []
        for one, planned, part in zip(wave.members, wave.planned, parts, strict=True):
            assert one.needed is not None
            part.grasps = replace(part.grasps, info=planned.info, seconds=planned.seconds)
            one.batch.add(one.batch.noted(one.needed, part, planned))
            one.progress(one.needed.progress[1], 1.0, "judged")
            one.needed = next(one.requests, None)
            (done if one.needed is None else self.waiting).append(one)
        for one in done:
            yield one.number, one.batch.finish()
            one.progress(1.0, 1.0, "done")


def _nothing(like: Certified) -> Certified:
    """A batch without grasps, and nothing tried."""
    grasps, columns = taken(like.grasps, like.columns, np.zeros(0, int))
    seconds, shares = (dict.fromkeys(counts, 0.0) for counts in (like.seconds, like.shares))
    return Certified(grasps, columns, 0, dict.fromkeys(like.rejected, 0), {}, like.verdict_key, 0, seconds, shares)


def distinct_batches(
    hand: HandModel, request: JobOptions, batches: list[Certified], more: Callable[[int, int], Certified | None]
) -> list[Certified]:
    """The batches without grasps too like one of an earlier batch, and further batches in their place.

    A job's tasks know nothing of each other, so this is for whoever has all batches at hand.

    Args:
        hand: the hand.
        request: `min_distance` says what is too like; raw grasps are all kept.
        batches: the batches of a job, from the first.
        more: makes a batch of so many grasps, of that number within the job; None: there are to be no more.
    """
    if request.want == "raw" or request.min_distance <= 0:
        return batches
    points = hand_points(hand, batches[0].grasps.grasp)
    kept = [batches[0]]
    waiting, missing, refills = batches[1:], 0, 0
    while waiting:
        batch = waiting.pop(0)
        both = np.concatenate([points, hand_points(hand, batch.grasps.grasp)])
        mask = distinct(both, request.min_distance, given=len(points))
        points, mine = both[mask], mask[len(points) :]
        kept.append(batch if mine.all() else batch.keeping(mine))
        missing += int((~mine).sum())
        if not waiting and missing and refills < _REFILLS:
            if (another := more(missing, len(batches) + refills)) is None:
                break
            waiting.append(another)
            missing, refills = 0, refills + 1
    return kept
