"""Several batches of a job at once: each in a thread of its own, with their planning done in common launches."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from graspd.service.model.domain import BATCH_SIZE, JobOptions
from graspd.service.model.errors import TaskCancelled
from graspd.worker.engines.joins import PER_LAUNCH
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.generation import ValidatedBatch, validated_grasps
from graspd.worker.hands.model import HandModel
from graspd.worker.meeting import Meeting
from graspd.worker.objects.model import ObjectModel
from graspd.worker.rounds import taken
from graspd.worker.side_by_side import Shares, in_threads
from graspd.worker.simulation.environment import Scenes
from graspd.worker.validation.decomposition import ConvexPieces, decompose


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
        partial: if it is stopped, the batches that were validated before are the result, the last one maybe in part.
        checked: called with the number of each batch as it is made, and with what came of it; may raise.
        empty_on: where one of these becomes of a batch, it has no grasps; not of a job's first batch, nor of all.

    Raises:
        Exception: what became of the first batch that failed; the others are stopped.
    """
    shares = Shares(sizes, run.progress)
    known: list[ConvexPieces] = []

    def pieces_once(prepared: ObjectModel) -> ConvexPieces:
        if not known:
            known.append(pieces(prepared))
        return known[0]

    refused: list[Exception] = []

    def batch(number: int, own: ExecutionContext) -> ValidatedBatch | None:
        own = replace(own, progress=shares.of(number))
        where = scenes if scenes is None or isinstance(scenes, Scenes) else scenes[number]
        try:
            made = validated_grasps(
                hand,
                obj,
                request,
                count=sizes[number],
                batch=first + number,
                scenes=where,
                pieces=pieces_once,
                run=own,
                partial=partial,
            )
        except empty_on as error:
            if first + number == 0:
                raise
            refused.append(error)
            return None
        if checked is not None:
            checked(first + number, made)
        own.progress(1.0, 1.0, "done")
        return made

    found: dict[int, ValidatedBatch | None] = {}
    try:
        if join == 1 or len(sizes) == 1:
            for number in range(len(sizes)):
                found[number] = batch(number, run)
        else:
            if request.validation != "none":
                pieces_once(obj.centred)  # not by every batch at the same time
            _together(batch, len(sizes), join, run, found)
    except TaskCancelled:
        if not partial or not found:
            raise
    made = [one for number in sorted(found) if (one := found[number]) is not None]
    if not made:
        raise refused[0]
    return [one or _nothing(made[0]) for _, one in sorted(found.items())]


def _nothing(like: ValidatedBatch) -> ValidatedBatch:
    """A batch without grasps, and nothing tried."""
    grasps, columns = taken(like.grasps, like.columns, np.zeros(0, int))
    seconds, shares = (dict.fromkeys(counts, 0.0) for counts in (like.seconds, like.shares))
    return ValidatedBatch(grasps, columns, 0, dict.fromkeys(like.rejected, 0), {}, like.verdict_key, 0, seconds, shares)


def _together(
    work: Callable[[int, ExecutionContext], ValidatedBatch | None],
    count: int,
    join: int,
    run: ExecutionContext,
    found: dict[int, ValidatedBatch | None],
) -> None:
    """Puts each batch under its number as soon as it is made."""
    members = min(count, PER_LAUNCH * join)
    stop, left = threading.Event(), iter(range(count))
    with Meeting(members, join * BATCH_SIZE) as meeting:
        own = replace(run, meeting=meeting, cancelled=lambda: stop.is_set() or run.cancelled())

        def member() -> None:
            try:
                while not stop.is_set() and (number := next(left, None)) is not None:
                    found[number] = work(number, own)
            finally:
                meeting.leave()

        in_threads([member] * members, stop, "batch")
