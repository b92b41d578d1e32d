"""From a job to its tasks, from facts about tasks to their states, fair scheduling, outcomes of candidates. Pure
functions: no store, no clock.

A job is cut into batches of `BATCH_SIZE` grasps, the unit of seeds and launches, and its batches into ranges of
`JobRecord.span`. Each range is a chain of tasks, one a stage as far as asked: synthesize -> scene -> render, or where
grasps are planned in scenes, scene -> synthesize -> render.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Final, TypeVar

from graspd.service.model.digests import digest_json, shard_id
from graspd.service.model.domain import BATCH_SIZE, JobOptions, JobRequest, batches_of
from graspd.service.model.messages import IngestMessage, TaskMessage
from graspd.service.model.options import rows
from graspd.service.model.records import JobRecord
from graspd.service.model.states import AssetKind, Priority, Stage, State
from graspd.service.model.version import (
    OLDEST_TASK_SCHEMA,
    SCHEMA_OF_NETWORKS,
    SCHEMA_OF_RANGES,
    TASK_SCHEMA,
)

#: A job this small is somebody waiting at a screen; anything larger runs in bulk.
INTERACTIVE_GRASPS: Final = 4 * BATCH_SIZE

#: Longest wait between two attempts of a task [s].
MAX_BACKOFF_S: Final = 300.0


@dataclass(frozen=True)
class PlannedTask:
    """A task as it follows from its job: batches from `batch` on, as many as `count` grasps take. `inputs` and `output`
    are shard ids."""

    id: str
    stage: Stage
    batch: int
    count: int
    inputs: tuple[str, ...]
    output: str


@dataclass
class TaskFacts:
    """What decides a task's state."""

    stage: Stage
    done: bool = False
    """Its shard's manifest is in the store."""
    last_attempt: int = 0
    """Number of the last failed attempt."""
    exhausted: bool = False
    """That attempt was the last."""
    retried_upto: int = 0
    """Attempts up to this number no longer count: a user retried the job."""
    running: bool = False


def priority_of(request: JobRequest) -> Priority:
    """Lane of a job submitted by itself; the jobs of a dataset always go in bulk."""
    return Priority.INTERACTIVE if request.grasps <= INTERACTIVE_GRASPS else Priority.BULK


def stages_of(request: JobOptions) -> tuple[Stage, ...]:
    """The stages each batch of the job passes through, in their order."""
    render = (Stage.RENDER,) if request.views else ()
    if request.in_scene:
        return (Stage.SCENE, Stage.SYNTHESIZE, *render)
    return (Stage.SYNTHESIZE, *((Stage.SCENE,) if request.scenes else ()), *render)


def task_id(job: str, stage: Stage, batch: int) -> str:
    """Address of a task: the same job has the same tasks."""
    return digest_json({"job": job, "stage": stage, "batch": batch})


def ranges_of(grasps: int, span: int) -> int:
    """How many ranges of `span` batches they take."""
    return -(-batches_of(grasps) // span)


def plan(job: JobRecord, ranges: range | None = None) -> Iterator[PlannedTask]:
    """The tasks of a job, of all ranges or some, each range in the order of its stages."""
    request = job.request
    for number in ranges if ranges is not None else range(ranges_of(request.grasps, job.span)):
        batch = number * job.span
        count = min(job.span * BATCH_SIZE, request.grasps - batch * BATCH_SIZE)
        inputs: tuple[str, ...] = ()
        for stage in stages_of(request):
            output = shard_id(
                stage,
                request=request,
                hand_digest=job.hand_digest,
                object_digest=job.object_digest,
                batch=batch,
                count=count,
                revision=job.revisions[stage],
                inputs=inputs,
            )
            yield PlannedTask(task_id(job.id, stage, batch), stage, batch, count, inputs, output)
            inputs = (output,)


def message_of(job: JobRecord, task: PlannedTask, *, attempt: int, max_attempt: int) -> TaskMessage:
    """What a worker is told."""
    return TaskMessage(
        schema_=max(needed_schema(job.request), SCHEMA_OF_RANGES if batches_of(task.count) > 1 else 0),
        newest_schema=TASK_SCHEMA,
        task_id=task.id,
        job_id=job.id,
        stage=task.stage,
        batch=task.batch,
        count=task.count,
        revision=job.revisions[task.stage],
        attempt=attempt,
        max_attempt=max(attempt, max_attempt),
        request=job.request,
        hand_digest=job.hand_digest,
        object_digest=job.object_digest,
        inputs=task.inputs,
        output=task.output,
        origin=job.origin,
    )


#: Options by the schema that first had them. A job that uses one needs a worker that knows it; all other jobs go to
#: older workers too.
_SCHEMAS: Final = {row.name: row.option.schema for row in rows(JobOptions, "job") if row.option.schema}


def needed_schema(request: JobRequest, since: Mapping[str, int] = _SCHEMAS) -> int:
    """The oldest schema in which a request can be said: that of the newest option that it uses.

    Args:
        since: options by the schema that first had them.
    """
    fields = JobRequest.model_fields
    used = [schema for name, schema in since.items() if getattr(request, name) != fields[name].get_default()]
    used += [SCHEMA_OF_NETWORKS] if request.network else []
    return max(used, default=OLDEST_TASK_SCHEMA)


def backoff(first_s: float, failures: int) -> float:
    """Wait before the next attempt [s]: doubles with each failure, up to `MAX_BACKOFF_S`."""
    return min(MAX_BACKOFF_S, first_s * 2.0 ** max(0, failures - 1))


def ingest_id(kind: AssetKind, digest: str) -> str:
    """Address of the task that checks what was uploaded."""
    return digest_json({"ingest": kind, "digest": digest})


def ingest_message(kind: AssetKind, name: str, digest: str, *, attempt: int, max_attempt: int) -> IngestMessage:
    """What a worker is told to check."""
    return IngestMessage(
        schema_=OLDEST_TASK_SCHEMA,
        newest_schema=TASK_SCHEMA,
        task_id=ingest_id(kind, digest),
        kind=kind,
        name=name,
        digest=digest,
        attempt=attempt,
        max_attempt=max(attempt, max_attempt),
    )


def batch_states(chain: Sequence[TaskFacts], *, job_cancelled: bool) -> list[State]:
    """States of the tasks of one range, given in the order of their stages.

    A task behind one that failed or was cancelled can never start, so it is cancelled.
    """
    states: list[State] = []
    blocked = False
    for facts in chain:
        state = _own_state(facts, job_cancelled=job_cancelled)
        if blocked and not state.is_final:
            state = State.CANCELLED
        states.append(state)
        blocked = blocked or state in (State.FAILED, State.CANCELLED)
    return states


def batch_ready(states: Sequence[State]) -> list[bool]:
    """Which tasks of a range may start now: unfinished, and everything before them succeeded."""
    return [
        not state.is_final and all(before is State.SUCCEEDED for before in states[:i]) for i, state in enumerate(states)
    ]


def job_state(tasks: Iterable[State]) -> State:
    """State of a job from the set of its tasks' states."""
    states = set(tasks)
    if states & {State.QUEUED, State.RUNNING}:
        return State.QUEUED if states == {State.QUEUED} else State.RUNNING
    if State.FAILED in states:
        return State.FAILED
    return State.CANCELLED if State.CANCELLED in states else State.SUCCEEDED


def _own_state(facts: TaskFacts, *, job_cancelled: bool) -> State:
    if facts.done:
        return State.SUCCEEDED
    if facts.exhausted and facts.last_attempt > facts.retried_upto:
        return State.FAILED
    if job_cancelled:
        return State.CANCELLED
    return State.RUNNING if facts.running else State.QUEUED


T = TypeVar("T")
#: Jobs fed in one round; the others have their turn in the next ones.
JOBS_A_ROUND: Final = 64
#: Turns remembered: more than there are jobs with waiting tasks, or a forgotten one would come first again.
_REMEMBERED: Final = 100_000


@dataclass(frozen=True)
class WaitingJob:
    """A job with tasks that may be queued, and whose share of the queue it takes (see `share_of`)."""

    id: str
    key: str


def share_of(project: str, key: str) -> str:
    """Whose share of the queue a job takes: its project's, or without one its key's ("" where there are no keys)."""
    # No name of a key holds a space.
    return f"project {project}" if project else key


class RoundRobin:
    """Remembers who was served last. Lost with its process, which costs nobody more than one turn."""

    def __init__(self) -> None:
        self._served: dict[str, int] = {}
        self._count = 0

    def order(self, jobs: Iterable[WaitingJob], limit: int) -> list[tuple[WaitingJob, int]]:
        """The jobs whose turn it is, and how many of their tasks may be queued, `limit` or somewhat more in all."""
        of_key: dict[str, list[WaitingJob]] = defaultdict(list)
        for job in sorted(jobs, key=lambda job: self._served.get(f"job {job.id}", 0)):
            of_key[job.key].append(job)
        keys = sorted(of_key, key=lambda key: self._served.get(f"key {key}", 0))
        chosen = interleave([of_key[key] for key in keys])[: min(JOBS_A_ROUND, limit)]
        number: dict[str, int] = defaultdict(int)
        for job in chosen:
            number[job.key] += 1
        return [(job, -(-limit // (len(number) * number[job.key]))) for job in chosen]

    def served(self, jobs: Sequence[WaitingJob]) -> None:
        """These jobs had their turn, in this order."""
        for job in jobs:
            self._count += 1
            self._served[f"job {job.id}"] = self._served[f"key {job.key}"] = self._count
        if len(self._served) > _REMEMBERED:
            self._served.clear()


def interleave(lists: Sequence[Sequence[T]]) -> list[T]:
    """One of each list, then the second of each, and so on."""
    longest = max(map(len, lists), default=0)
    return [some[place] for place in range(longest) for some in lists if place < len(some)]


#: Outcomes of candidates that are not kept, in the order in which they are tested, with their words.
OUTCOMES: Final = {
    "diverged": "without a finite posture",
    "no_place": "without a clear place or way in the scene",
    "touched_on_the_way": "touched on the way",
    "penetration": "inside the object when simulated",
    "lost_while_closing": "lost while closing",
    "not_lifted": "not lifted",
    "turned": "turned in the hand",
    "slipped": "slipped",
    "neighbour_moved": "moved a neighbour",
    "unstable": "unstable in simulation",
    "gate_penetration": "too deep in the object (gate)",
    "gate_self_penetration": "hand too deep in itself (gate)",
    "gate_contacts": "did not oppose: fewer than two links in contact (gate)",
    "not_robust": "held in too few models",
    "weak": "lifted less than the wanted payload",
    "alike": "too similar to another",
    "repeated": "repeated attempts",
}


def totals(parts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Sums by outcome over several counts, those above zero, in the order of `OUTCOMES`."""
    found: dict[str, int] = dict.fromkeys(OUTCOMES, 0)
    for part in parts:
        for name, count in part.items():
            found[name] = found.get(name, 0) + int(count)
    return {name: count for name, count in found.items() if count}


def told(outcomes: Mapping[str, int]) -> str:
    """The counts in words, the most frequent first."""
    order = sorted(outcomes.items(), key=lambda pair: -pair[1])
    return ", ".join(f"{count:,} {OUTCOMES.get(name, name.replace('_', ' '))}" for name, count in order if count)


def shortfall(
    found: int, wanted: int, counted: str, candidates: int, budget: float, outcomes: Mapping[str, int], limit: str = ""
) -> str | None:
    """Why fewer grasps were found than wanted, in a sentence; None where all were.

    Args:
        found: grasps that count.
        wanted: grasps asked for.
        counted: which grasps count: valid or feasible.
        tried: candidates planned.
        budget: candidates for each grasp wanted, at most: candidates and repeated attempts.
        outcomes: candidates that were not kept, by `OUTCOMES`, and the repeated attempts.
        limit: what the hand lifts at best, in place of the budget that ended.
    """
    if found >= wanted:
        return None
    lost, tries = told(outcomes), candidates + outcomes.get("repeated", 0)
    ended = limit or f"the budget of {budget:g} candidates for each ended first"
    return (
        f"found {found:,} of {wanted:,} {counted} grasps in {tries:,} candidates{': ' if lost else ''}{lost}; {ended}"
    )


def limit_told(hand: str, friction: float, grasps: int, lifts: float, bound: float, wanted: float | None = None) -> str:
    """What a hand lifts at best, in a sentence.

    Args:
        hand: its name.
        friction: Coulomb coefficient.
        grasps: that were measured.
        lifts: payload of the best of them [kg].
        bound: that none exceeds by actuator effort and friction [kg]; inf: there is none.
        wanted: mass that it should lift [kg]; None: nobody asked for one.
    """
    most = f", and at most {bound:.2g} kg by actuator effort" if math.isfinite(bound) else ""
    less = "" if wanted is None else f"; {wanted:.3g} kg are wanted"
    return f"{hand} lifts {lifts:.2g} kg at friction {friction:g} in the best of {grasps} grasps{most}{less}"
