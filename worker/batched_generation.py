"""Several batches of a job: one after the other, or in waves that share one launch of the planner."""

import threading
from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass, replace
from itertools import accumulate, pairwise
from typing import Any

import numpy as np

from graspd.service.model.domain import BATCH_SIZE, JobOptions
from graspd.service.model.errors import InputError, TaskCancelled
from graspd.worker.engines.devices import check_device, exclusive
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext, ProgressShares
from graspd.worker.generation import PARTS, Batch, Known, Scoring, ValidatedBatch, require_graspable, validated_grasps
from graspd.worker.grasps import GraspSet, join_grasp_sets
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.planners import BatchRequest, NoStartFound, synthesize_batches
from graspd.worker.rounds import Round, select_rows
from graspd.worker.simulation.environment import Scenes, join_scenes
from graspd.worker.validation.decomposition import ConvexPieces, decompose
from graspd.worker.validation.prefilter.prefilter import PrefilterVerdicts


def validated_batches(
    hand: HandModel,
    obj: ObjectModel,
    request: JobOptions,
    *,
    sizes: Sequence[int],
    first: int = 0,
    join: int = 1,
    scenes: Scenes | Sequence[Scenes] | None = None,
    pieces: Callable[[ObjectModel], ConvexPieces] = decompose,
    run: ExecutionContext = DEFAULT_CONTEXT,
    partial: bool = False,
    checked: Callable[[int, ValidatedBatch], None] | None = None,
    empty_on: tuple[type[Exception], ...] = (),
) -> list[ValidatedBatch]:
    """Plan consecutive batches of a job from number `first`, each with the result of `validated_grasps`.
    `join` batches are planned in one launch. `scenes` are common to all batches, or one per batch. With `partial`, a
    cancellation returns the batches validated so far. `checked` receives each finished batch and may raise. An error
    whose type is in `empty_on` gives an empty batch, but not for the job's first. Other errors cancel all batches."""
    known: list[ConvexPieces] = []

    def pieces_once(prepared: ObjectModel) -> ConvexPieces:
        if not known:
            known.append(pieces(prepared))
        return known[0]

    given = [scenes] * len(sizes) if scenes is None or isinstance(scenes, Scenes) else list(scenes)
    job = _Job(hand, obj, request, sizes, first, given, pieces_once, run, partial)
    found: dict[int, ValidatedBatch | None] = {}
    refused: list[Exception] = []
    try:
        with closing(job.make_one_by_one() if join == 1 or len(sizes) == 1 else job.make_in_waves(join)) as batches:
            for number, one in batches:
                if isinstance(one, ValidatedBatch):
                    if checked is not None:
                        checked(number, one)
                    found[number] = one
                elif isinstance(one, empty_on) and number > 0:
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
    return [one or _empty_batch(like) for one in ordered]


#: Number of a batch within its job, and its result.
Made = tuple[int, ValidatedBatch | Exception]


@dataclass(frozen=True)
class _Job:
    """Batches of a job, made one by one or in waves."""

    hand: HandModel
    obj: ObjectModel
    request: JobOptions
    sizes: Sequence[int]
    first: int
    scenes: Sequence[Scenes | None]
    pieces: Callable[[ObjectModel], ConvexPieces]
    run: ExecutionContext
    partial: bool

    def make_one_by_one(self) -> Generator[Made]:
        """Make one batch after the other."""
        shares = ProgressShares(self.sizes, self.run.progress)
        for k, (count, scenes) in enumerate(zip(self.sizes, self.scenes, strict=True)):
            own, number = replace(self.run, progress=shares.progress_of_part(k)), self.first + k
            how: dict[str, Any] = {"scenes": scenes, "pieces": self.pieces, "run": own, "partial": self.partial}
            try:
                made = validated_grasps(self.hand, self.obj, self.request, count=count, batch=number, **how)
            except InputError as error:
                yield number, error
            else:
                yield number, made
                own.progress(1.0, 1.0, "done")

    def make_in_waves(self, join: int) -> Generator[Made]:
        """Plan candidates of `join` batches in one launch, while the previous wave is validated and measured."""
        require_graspable(self.hand, self.obj)
        stop, shares = threading.Event(), ProgressShares(self.sizes, self.run.progress)
        run = replace(self.run, cancelled=lambda: stop.is_set() or self.run.cancelled())
        several = [one for one in self.scenes if one is not None] if len({*map(id, self.scenes)}) > 1 else []
        ends = accumulate((len(one.object_pose) for one in several), initial=0)
        own = [range(*both) for both in pairwise(ends)] if several else [None] * len(self.sizes)
        scenes = join_scenes(several) if several else self.scenes[0]
        going, waiting = dict[int, Batch](), deque[Batch]()
        with (
            Scoring(self.hand, self.obj, self.request, scenes=scenes, pieces=self.pieces, run=run) as scoring,
            ThreadPoolExecutor(1, thread_name_prefix="device") as device,
        ):
            fresh = (
                Batch(scoring, self.first + k, count, replace(run, progress=shares.progress_of_part(k)), own[k])
                for k, count in enumerate(self.sizes)
            )
            ahead: Future[_Wave] | None = None
            try:
                # Batches of one launch have the same requirements.
                most = 0 if self.request.type == "balanced" else join * BATCH_SIZE
                while (wave := _next_wave(waiting, fresh, most)) or ahead is not None:
                    planned, ahead = ahead, device.submit(_plan_wave, scoring, wave) if wave else None
                    going |= {batch.number: batch for batch in wave}
                    for batch, error in _score_wave(scoring, planned.result()) if planned is not None else ():
                        if error is None and batch.needed is not None:
                            waiting.append(batch)
                            continue
                        del going[batch.number]
                        yield batch.number, error or batch.finish()
                        batch.run.progress(1.0, 1.0, "done")
            except TaskCancelled:
                stop.set()
                if self.partial:
                    scoring.ignore_cancellation()
                    yield from ((number, batch.finish()) for number, batch in going.items() if batch.rounds)
                raise
            finally:
                stop.set()


@dataclass(frozen=True)
class _Wave:
    """Grasps of several batches that were planned in one launch."""

    batches: Sequence[Batch]
    made: Sequence[GraspSet | Exception]
    whole: GraspSet | None
    known: Known
    prefilter: PrefilterVerdicts | None


def _next_wave(waiting: deque[Batch], fresh: Iterator[Batch], most: int) -> list[Batch]:
    """Return batches that together fill one launch; batches in progress go first."""
    found, size = list[Batch](), 0
    while (batch := waiting.popleft() if waiting else next(fresh, None)) is not None:
        assert batch.needed is not None
        size += len(batch.needed.rows)
        if found and size > most:
            waiting.appendleft(batch)
            break
        found.append(batch)
    return found


def _plan_wave(scoring: Scoring, batches: Sequence[Batch]) -> _Wave:
    """Plan the next candidates of the batches, in the single thread that owns the device."""
    known: Known = {}
    rollout, request, asked = scoring.rollout(known), scoring.request, list[BatchRequest]()
    for batch in batches:
        assert batch.needed is not None
        wanted = batch.plan_request(batch.needed, rollout, others_have_place=batch.candidates > 0)
        asked.append(
            BatchRequest(
                wanted, batch.run.with_progress_range(*batch.needed.progress).with_progress_range(0.0, PARTS[0])
            )
        )
    with exclusive:
        made = synthesize_batches(scoring.hand, scoring.obj, asked, method=request.method, options=request.options)
        check_device(scoring.run.device)
        told: list[GraspSet | Exception] = []
        for batch, one, grasps in zip(batches, asked, made, strict=True):
            if isinstance(grasps, TaskCancelled):
                raise grasps
            told.append(batch.grasps_to_store(one.wanted, grasps) if isinstance(grasps, GraspSet) else grasps)
        good = [grasps for grasps in told if isinstance(grasps, GraspSet)]
        whole = join_grasp_sets(good) if good else None
        return _Wave(batches, told, whole, known, scoring.run_prefilter(whole) if whole is not None else None)


def _score_wave(scoring: Scoring, wave: _Wave) -> Iterator[tuple[Batch, Exception | None]]:
    """Validate and measure a wave at once; yield each batch with its planning error or None."""
    parts: Iterator[Round] = iter(())
    if wave.whole is not None:
        run, required = scoring.run.without_progress(), wave.batches[0].requirements
        scored = scoring.evaluate(wave.whole, run, wave.known, wave.prefilter, required)
        parts = iter(scored.split([len(made) for made in wave.made if isinstance(made, GraspSet)]))
    for batch, made in zip(wave.batches, wave.made, strict=True):
        if isinstance(made, Exception):
            yield batch, batch.explain_refusal(made) if isinstance(made, NoStartFound) else made
            continue
        assert batch.needed is not None
        batch.add(batch.complete_round(batch.needed, next(parts), made))
        yield batch, None


def _empty_batch(like: ValidatedBatch) -> ValidatedBatch:
    """Return a batch without grasps and without candidates."""
    grasps, columns = select_rows(like.grasps, like.columns, np.zeros(0, int))
    seconds, shares = (dict.fromkeys(counts, 0.0) for counts in (like.seconds, like.shares))
    return ValidatedBatch(grasps, columns, 0, dict.fromkeys(like.rejected, 0), {}, like.verdict_key, 0, seconds, shares)
