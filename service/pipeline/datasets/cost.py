"""Cost estimate of a dataset before it starts: time for 1, 8 and 64 workers, storage, network.

    candidates of a cell = grasps / yield, at most grasps x budget   (want candidates: grasps)
    seconds of a cell  = candidates x seconds per candidate + batches x scenes x seconds per scene
                         + pictures x seconds per picture + valid grasps x seconds per episode
    time of W workers  = the larger of seconds / W and rounds of batches x seconds of a batch

`service.index.queries.rates` provides rates and intervals. Intervals add, as if all errors were correlated. Workers are
assumed to run on devices like the measured ones.
"""

import math
from collections import defaultdict
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Final

from graspd.service.index.index import Index
from graspd.service.index.queries.overview import BatchCost
from graspd.service.index.queries.rates import (
    Machine,
    Rate,
    Rates,
    StageRate,
    episode_rate,
    expected_candidates,
    picture_rate,
    scene_rate,
)
from graspd.service.model.domain import BATCH_SIZE, JobOptions, JobRequest
from graspd.service.model.errors import LimitError
from graspd.service.model.names import SHARD_KINDS
from graspd.service.model.planning import stages_of
from graspd.service.model.projects import EVERYTHING, ProjectScope
from graspd.service.model.records import create_job_request
from graspd.service.model.states import AssetKind, Stage
from graspd.service.pipeline.datasets.spec import MAX_CELLS, Estimate, Matrix, RateUsed, WorkersPlan

WORKERS: Final = (1, 8, 64)
#: Traffic [bytes] of a task between worker and Redis (docs/explanation/scaling.md).
_MESSAGE_BYTES: Final = 19_500
#: Assumed size [bytes] of an unknown asset: an STL file with 5000 faces.
_ASSET_BYTES: Final = 250_000
_SHOWN_RATES: Final = 20
Batches = Callable[[Stage], list[BatchCost]]
_RATES: Final = {Stage.SCENE: scene_rate, Stage.RENDER: picture_rate, Stage.EPISODE: episode_rate}


@dataclass
class _Sums:
    candidates: float = 0.0
    kept: float = 0.0
    valid: float = 0.0
    seconds: float = 0.0
    low: float = 0.0
    high: float = 0.0
    machine: Machine = field(default_factory=Machine)
    base_bytes: float = 0.0
    cells: dict[tuple[str, Rate], int] = field(default_factory=lambda: defaultdict(int))


def estimate(
    index: Index,
    matrix: Matrix,
    resolve: Callable[[JobRequest], JobRequest] = lambda request: request,
    *,
    costs: Batches | None = None,
    scope: ProjectScope = EVERYTHING,
) -> Estimate:
    """Estimate the cost of a matrix, whose hands and objects need not exist yet.

    `resolve` replaces the fidelity `auto`, or raises InputError. `costs` returns the finished batches of a stage (None:
    read from the index). `scope` limits sets of objects and measurements.
    """
    objects = expand_objects(index, matrix, scope)
    options = matrix.cell_options
    devices = {worker.device for worker in index.overview.workers() if worker.state != "lost"}
    costs = costs or partial(index.costs.batch_costs, scope=scope)
    batches = costs(Stage.SYNTHESIZE)
    rates: dict[str, Rates] = {}
    sums = _Sums()
    for hand in matrix.hands:
        for obj in objects:
            chosen = resolve(create_job_request(options, hand, obj))
            if chosen.resolved_fidelity.name not in rates:
                rates[chosen.resolved_fidelity.name] = Rates(batches, chosen, devices)
            sums.machine = rates[chosen.resolved_fidelity.name].machine
            _add_cell(sums, hand, rates[chosen.resolved_fidelity.name].rate_for(hand, obj), options)
    stages = stages_of(options)
    later = {stage: rate(costs(stage), options, sums.machine) for stage, rate in _RATES.items() if stage in stages}
    with_neighbours = list(dict.fromkeys([*objects, *(one.object for one in options.all_neighbours)]))
    known = _asset_bytes(index, matrix.hands, with_neighbours, scope)
    return _estimate_from_sums(options, len(matrix.hands) * len(objects), sums, later, known)


def expand_objects(index: Index, matrix: Matrix, scope: ProjectScope) -> list[str]:
    """Return the objects of a matrix with sets expanded; LimitError for more than `MAX_CELLS` cells."""
    objects = dict.fromkeys(matrix.objects)
    for name in matrix.sets:
        objects |= dict.fromkeys(index.object_sets.get(name, scope=scope).objects)
    if len(matrix.hands) * len(objects) > MAX_CELLS:
        raise LimitError(f"{len(matrix.hands)} hands x {len(objects)} objects is over {MAX_CELLS} cells; split it")
    return list(objects)


def _add_cell(sums: _Sums, hand: str, rate: Rate, options: JobOptions) -> None:
    number = expected_candidates(rate, options)
    valid = number * rate.valid_yield
    kept = min(valid, options.grasps) if options.want == "valid" else options.grasps
    sums.candidates += number
    sums.valid += min(valid, options.grasps)
    sums.kept += kept
    seconds = number * rate.seconds_per_try
    sums.seconds += seconds
    sums.low += seconds * rate.spread[0]
    sums.high += seconds * rate.spread[1]
    sums.base_bytes += kept * rate.bytes_per_grasp
    sums.cells[hand, rate] += 1


def _estimate_from_sums(
    options: JobOptions, cells: int, sums: _Sums, later: Mapping[Stage, StageRate], known: tuple[float, list[str]]
) -> Estimate:
    batches, stages = cells * -(-options.grasps // BATCH_SIZE), stages_of(options)
    assets, unknown = known
    pictures = options.scenes * options.views * (2 if options.stereo else 1)
    pixels = batches * pictures * options.width * options.height / 1e6
    seconds = {Stage.SYNTHESIZE: sums.seconds}
    ends = {Stage.SYNTHESIZE: (sums.low, sums.high)}
    storage = {"base": sums.base_bytes}
    scenes, placed = batches * options.scenes, (batches if options.in_scene else sums.kept) * options.scenes
    works = {Stage.SCENE: (scenes, placed), Stage.RENDER: (pixels, pixels), Stage.EPISODE: (sums.valid, sums.valid)}
    for stage, (units, rows) in works.items():
        if stage in stages:
            rate = later[stage]
            seconds[stage] = units * rate.seconds
            ends[stage] = (seconds[stage] * rate.spread[0], seconds[stage] * rate.spread[1])
            storage[SHARD_KINDS[stage]] = rows * rate.size_bytes
    total = sum(seconds.values())
    low, high = (sum(found) for found in zip(*ends.values(), strict=True))
    read = sum(storage[kind] for kind in list(storage)[:-1])
    network = sum(storage.values()) + read + batches * len(stages) * _MESSAGE_BYTES
    return Estimate(
        cells=cells,
        asked=cells * options.grasps,
        candidates=round(sums.candidates),
        valid=round(sums.valid),
        counted=options.counted_status,
        tasks=batches * len(stages),
        seconds=total,
        seconds_low=low,
        seconds_high=high,
        machine_factor=sums.machine.factor if sums.machine.batches else None,
        seconds_by_stage=seconds,
        seconds_per_valid=total / sums.valid if sums.valid else None,
        storage_bytes=round(sum(storage.values())),
        storage_by_kind={kind: round(size) for kind, size in storage.items()},
        plans=[_plan(workers, (total, low, high), batches, cells, network, assets) for workers in WORKERS],
        rates=_rates_used(sums),
        measured_share=sum(n for (_, rate), n in sums.cells.items() if rate.batches) / cells,
        unknown=unknown,
    )


def _plan(
    workers: int, totals: tuple[float, float, float], batches: int, cells: int, network: float, assets: float
) -> WorkersPlan:
    """Return the plan; one worker is assumed to run all stages of a batch."""
    share = max(1 / workers, math.ceil(batches / workers) / batches)
    seconds, low, high = (total * share for total in totals)
    # Each worker reads hand and object of a cell once.
    moved = network + assets * min(workers, max(1, batches // cells))
    return WorkersPlan(
        workers=workers,
        seconds=seconds,
        seconds_low=low,
        seconds_high=high,
        network_bytes=round(moved),
        network_bytes_per_s=moved / seconds if seconds else 0.0,
    )


def _asset_bytes(
    index: Index, hands: Sequence[str], objects: Sequence[str], scope: ProjectScope
) -> tuple[float, list[str]]:
    """Return the total size [bytes] of hands and objects over all cells, and the unknown names."""
    of_hands = index.assets.sizes(AssetKind.HAND, hands, scope=scope)
    of_objects = index.assets.sizes(AssetKind.OBJECT, objects, scope=scope)
    unknown = [name for name in hands if name not in of_hands] + [name for name in objects if name not in of_objects]
    hand_bytes = sum(of_hands.get(name, _ASSET_BYTES) for name in hands) * len(objects)
    object_bytes = sum(of_objects.get(name, _ASSET_BYTES) for name in objects) * len(hands)
    return float(hand_bytes + object_bytes), unknown


def _rates_used(sums: _Sums) -> list[RateUsed]:
    ordered = sorted(sums.cells.items(), key=lambda entry: -entry[1])
    return [
        RateUsed(
            hand=hand,
            cells=cells,
            seconds_per_valid=rate.seconds_per_try / rate.valid_yield if rate.valid_yield else None,
            **{name: getattr(rate, name) for name in ("seconds_per_try", "valid_yield", "origin", "batches")},
        )
        for (hand, rate), cells in ordered[:_SHOWN_RATES]
    ]
