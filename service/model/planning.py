"""Planning of jobs in pure functions: tasks and their states, fair scheduling, outcomes of candidates.

A job is split into batches of `BATCH_SIZE` grasps. Each range of `JobRecord.span` batches has one task per requested
stage: synthesize -> scene -> render, or for grasps planned in scenes: scene -> synthesize -> render -> episode.
"""

import math
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any, Final, TypeVar

from graspd.service.model.digests import digest_json, shard_id
from graspd.service.model.domain import BATCH_SIZE, JobOptions, JobRequest, count_batches
from graspd.service.model.messages import IngestMessage, TaskMessage
from graspd.service.model.options import option_rows
from graspd.service.model.records import JobRecord
from graspd.service.model.states import AssetKind, Priority, Stage, State
from graspd.service.model.version import OLDEST_TASK_SCHEMA, SCHEMA_OF_NETWORKS, SCHEMA_OF_RANGES, TASK_SCHEMA

#: Maximum number of grasps of an interactive job, for which a user waits. Larger jobs run in bulk.
INTERACTIVE_GRASPS: Final = 4 * BATCH_SIZE

MAX_BACKOFF_S: Final = 300.0


@dataclass(frozen=True)
class PlannedTask:
    """Task of a job: `count` grasps, starting at batch `batch`; `inputs` and `output` are shard ids."""

    id: str
    stage: Stage
    batch: int
    count: int
    inputs: tuple[str, ...]
    output: str


@dataclass
class TaskFacts:
    stage: Stage
    done: bool = False
    """Whether the manifest of the task's shard is in the store."""
    last_attempt: int = 0
    exhausted: bool = False
    retried_upto: int = 0
    """Number of the last attempt before the latest retry by a user; these attempts are ignored."""
    running: bool = False


def priority_of(request: JobRequest) -> Priority:
    """Return the priority of a single job; jobs of a dataset always run in bulk."""
    return Priority.INTERACTIVE if request.grasps <= INTERACTIVE_GRASPS else Priority.BULK


def stages_of(request: JobOptions) -> tuple[Stage, ...]:
    render = (Stage.RENDER,) if request.views else ()
    if request.in_scene:
        return (Stage.SCENE, Stage.SYNTHESIZE, *render, *((Stage.EPISODE,) if request.has_episodes else ()))
    return (Stage.SYNTHESIZE, *((Stage.SCENE,) if request.scenes else ()), *render)


def task_id(job: str, stage: Stage, batch: int) -> str:
    return digest_json({"job": job, "stage": stage, "batch": batch})


def count_ranges(grasps: int, span: int) -> int:
    return -(-count_batches(grasps) // span)


def plan_tasks(job: JobRecord, ranges: range | None = None) -> Iterator[PlannedTask]:
    """Yield the tasks of a job for all or some `ranges`, range by range in the order of stages."""
    request = job.request
    digests: dict[str, Any] = {"hand_digest": job.hand_digest, "object_digest": job.object_digest}
    for number in ranges if ranges is not None else range(count_ranges(request.grasps, job.span)):
        batch = number * job.span
        count = min(job.span * BATCH_SIZE, request.grasps - batch * BATCH_SIZE)
        inputs: tuple[str, ...] = ()
        for stage in stages_of(request):
            facts = digests | {"batch": batch, "count": count, "revision": job.revisions[stage], "inputs": inputs}
            output = shard_id(stage, request=request, **facts)
            yield PlannedTask(task_id(job.id, stage, batch), stage, batch, count, inputs, output)
            # Stages after the grasps read these.
            inputs = inputs if stage is Stage.RENDER else (output,)


def create_task_message(job: JobRecord, task: PlannedTask, *, attempt: int, max_attempt: int) -> TaskMessage:
    return TaskMessage(
        schema_=max(required_schema(job.request), SCHEMA_OF_RANGES if count_batches(task.count) > 1 else 0),
        newest_schema=TASK_SCHEMA,
        task_id=task.id,
        job_id=job.id,
        revision=job.revisions[task.stage],
        attempt=attempt,
        max_attempt=max(attempt, max_attempt),
        **{name: getattr(task, name) for name in ("stage", "batch", "count", "inputs", "output")},
        **{name: getattr(job, name) for name in ("request", "hand_digest", "object_digest", "origin")},
    )


#: First schema of each newer option: only jobs with such an option need newer workers.
_SCHEMAS: Final = {row.name: row.option.schema for row in option_rows(JobOptions, "job") if row.option.schema}


def required_schema(request: JobRequest, since: Mapping[str, int] = _SCHEMAS) -> int:
    """Return the oldest schema that can express a request: the schema of its newest option with a value."""
    fields = JobRequest.model_fields
    used = [schema for name, schema in since.items() if getattr(request, name) != fields[name].get_default()]
    used += [SCHEMA_OF_NETWORKS] if request.network else []
    return max(used, default=OLDEST_TASK_SCHEMA)


def backoff(first_s: float, failures: int) -> float:
    """Return the delay before the next attempt [s]: doubled with each failure, up to `MAX_BACKOFF_S`."""
    return min(MAX_BACKOFF_S, first_s * 2.0 ** max(0, failures - 1))


def ingest_id(kind: AssetKind, digest: str) -> str:
    return digest_json({"ingest": kind, "digest": digest})


def ingest_message(kind: AssetKind, name: str, digest: str, *, attempt: int, max_attempt: int) -> IngestMessage:
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


def range_states(chain: Sequence[TaskFacts], *, job_cancelled: bool) -> list[State]:
    """Return the states of one range's tasks; tasks after a failed or cancelled task are cancelled."""
    states: list[State] = []
    for facts in chain:
        state = _task_state(facts, job_cancelled=job_cancelled)
        is_blocked = State.FAILED in states or State.CANCELLED in states
        states.append(State.CANCELLED if is_blocked and not state.is_final else state)
    return states


def range_ready_mask(states: Sequence[State]) -> list[bool]:
    """Return a mask of the tasks of a range that can start: unfinished, and all earlier tasks succeeded."""
    return [not state.is_final and set(states[:i]) <= {State.SUCCEEDED} for i, state in enumerate(states)]


def job_state(tasks: Iterable[State]) -> State:
    states = set(tasks)
    if states & {State.QUEUED, State.RUNNING}:
        return State.QUEUED if states == {State.QUEUED} else State.RUNNING
    if State.FAILED in states:
        return State.FAILED
    return State.CANCELLED if State.CANCELLED in states else State.SUCCEEDED


def _task_state(facts: TaskFacts, *, job_cancelled: bool) -> State:
    if facts.done:
        return State.SUCCEEDED
    if facts.exhausted and facts.last_attempt > facts.retried_upto:
        return State.FAILED
    if job_cancelled:
        return State.CANCELLED
    return State.RUNNING if facts.running else State.QUEUED


T = TypeVar("T")
#: Maximum number of jobs in one scheduling round; other jobs follow in later rounds.
JOBS_A_ROUND: Final = 64
#: Number of remembered turns, greater than the number of waiting jobs; a forgotten job comes first again.
_REMEMBERED: Final = 100_000


@dataclass(frozen=True)
class WaitingJob:
    """Job with tasks ready for the queue."""

    id: str
    key: str
    """Owner of the job's share of the queue (`queue_owner`)."""


def queue_owner(project: str, key: str) -> str:
    """Return the owner of a job's share of the queue: the project, else the key ("" without keys)."""
    return f"project {project}" if project else key


class RoundRobin:
    """Round-robin scheduling over owners, then over their jobs; the end of the process loses the turns."""

    def __init__(self) -> None:
        self._served: dict[str, int] = {}
        self._count = 0

    def next_jobs(self, jobs: Iterable[WaitingJob], limit: int) -> list[tuple[WaitingJob, int]]:
        """Return the next jobs, each with its number of tasks to queue; about `limit` tasks in total."""
        of_key: dict[str, list[WaitingJob]] = defaultdict(list)
        for job in sorted(jobs, key=lambda job: self._served.get(f"job {job.id}", 0)):
            of_key[job.key].append(job)
        keys = sorted(of_key, key=lambda key: self._served.get(f"key {key}", 0))
        chosen = interleave([of_key[key] for key in keys])[: min(JOBS_A_ROUND, limit)]
        number: dict[str, int] = defaultdict(int)
        for job in chosen:
            number[job.key] += 1
        return [(job, -(-limit // (len(number) * number[job.key]))) for job in chosen]

    def record_served(self, jobs: Sequence[WaitingJob]) -> None:
        for job in jobs:
            self._count += 1
            self._served[f"job {job.id}"] = self._served[f"key {job.key}"] = self._count
        if len(self._served) > _REMEMBERED:
            self._served.clear()


def interleave(lists: Sequence[Sequence[T]]) -> list[T]:
    """Interleave lists: the first items of all lists, then the second items, and so on."""
    return [item for turn in zip_longest(*lists) for item in turn if item is not None]


#: Outcomes of rejected candidates, in the order of the tests, with descriptions.
OUTCOMES: Final = {
    "diverged": "without a finite posture",
    "no_place": "without a collision-free place or approach in the scene",
    "touched_on_the_way": "with contact on the approach",
    "penetration": "with penetration in simulation",
    "lost_while_closing": "lost while closing",
    "not_lifted": "not lifted",
    "turned": "rotated in the hand",
    "slipped": "slipped",
    "neighbour_moved": "moved a neighbour",
    "unstable": "unstable in simulation",
    "gate_penetration": "above the limit of object penetration",
    "gate_self_penetration": "above the limit of self-penetration",
    "gate_contacts": "without opposing contacts (fewer than two links touch)",
    "other_type": "of another type",
    "other_digits": "with other digits in contact",
    "other_approach": "outside the approach cone",
    "outside_region": "with contact outside the region",
    "other_wrist_pose": "far from the demonstrated wrist pose",
    "not_robust": "held in too few perturbed models",
    "weak": "below the required payload",
    "alike": "near-duplicates",
    "repeated": "repeated attempts",
}


def sum_outcomes(parts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    found = Counter(dict.fromkeys(OUTCOMES, 0))
    for part in parts:
        found.update(part)
    return {name: int(count) for name, count in found.items() if count}


def phase_seconds(*infos: Mapping[str, Any]) -> dict[str, float]:
    """Return the time of each phase [s] in the `info` of manifests: planner, validation, quality."""
    times = [(name[:-8], value) for info in infos for name, value in info.items() if name.endswith("_seconds")]
    times = [(name, value) for name, value in times if isinstance(value, int | float)]
    return {name: sum(value for one, value in times if one == name) for name in dict(times)}


def format_outcomes(outcomes: Mapping[str, int]) -> str:
    order = sorted(outcomes.items(), key=lambda pair: -pair[1])
    return ", ".join(f"{count:,} {OUTCOMES.get(name, name.replace('_', ' '))}" for name, count in order if count)


def explain_shortfall(
    options: JobOptions, found: int, candidates: int, outcomes: Mapping[str, int], *, wanted: int = 0, limit: str = ""
) -> str | None:
    """Explain why fewer grasps than `wanted` (0: `options.grasps`) were found, else return None.

    `limit` replaces the exhausted budget.
    """
    wanted = wanted or options.grasps
    if found >= wanted:
        return None
    lost, tries = format_outcomes(outcomes), candidates + outcomes.get("repeated", 0)
    why = limit or f"the budget of {options.budget:g} candidates per grasp is exhausted"
    counts = f"found {found:,} of {wanted:,} {options.counted_status} grasps in {tries:,} candidates"
    return f"{counts}{f': {lost}' if lost else ''}; {why}"


def payload_limit_text(
    hand: str, friction: float, grasps: int, lifts: float, bound: float, wanted: float | None = None
) -> str:
    """Describe the payload limit of a hand [kg]; `bound` follows from actuators and friction (inf: none)."""
    most = f", and at most {bound:.2g} kg by actuator effort" if math.isfinite(bound) else ""
    less = "" if wanted is None else f"; {wanted:.3g} kg are wanted"
    return f"{hand} lifts {lifts:.2g} kg at friction {friction:g} in the best of {grasps} grasps{most}{less}"
