"""Cost of a dataset from measurements: workers, Redis operations, objects, bytes, index rows, money.

usage: python -m benchmarks.cost_model [--grasps 1000000] [--grasps 100000000] [--days 7] [--scenes 2] [--views 3]
                                       [--core-hour 0.04] [--from-data DIR] [--json]

`docs/explanation/scaling.md` has the origin of each input, and the limits of the model. Prices are
examples; replace them by your own. `--from-data` measures the sizes in your data folder."""

from __future__ import annotations

import argparse
import dataclasses
import json
import math
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

_DAY_S: Final = 86_400.0
_GB: Final = 1e9
#: Field of `Measured`, kind of the measured shards, and axis of their counts (grasps, scenes, pictures).
_SIZES: Final = {"base_bytes_per_grasp": ("base", "N"), "scene_bytes": ("scene", "S"), "picture_bytes": ("views", "V")}


@dataclass(frozen=True)
class Work:
    grasps: int
    """Number of valid grasps in the dataset."""
    days: float = 7.0
    """Time limit [days]."""
    batch: int = 32
    """Grasps per batch."""
    scenes: int = 2
    """Scenes per batch."""
    views: int = 3
    """Camera placements per scene."""
    eyes: int = 2
    """Pictures per placement; 2: stereo."""
    job: int = 3200
    """Grasps per job."""
    span: int = 1
    """Batches per task; 1 with pictures."""

    @property
    def batches(self) -> int:
        return math.ceil(self.grasps / self.batch)

    @property
    def stages(self) -> int:
        """Tasks per batch: synthesis, then scenes, then pictures."""
        return 1 + (self.scenes > 0) + (self.scenes > 0 and self.views > 0)

    @property
    def pictures(self) -> int:
        return self.batches * self.scenes * self.views * self.eyes


@dataclass(frozen=True)
class Measured:
    """Measured inputs; `docs/explanation/scaling.md` has the commands."""

    core_s_per_grasp: float = 0.194
    """Time per valid grasp at fidelity standard: planning, validation, postures, metrics [core s]."""
    core_s_per_scene: float = 0.073
    """Time per scene with the grasps of its batch [core s]."""
    core_s_per_picture: float = 0.186
    """Time per picture of 320 x 240 with all channels [core s]."""
    busy: float = 0.9
    """Share of a worker's time spent in computation; the rest is starts, ends of jobs and waiting."""
    base_bytes_per_grasp: float = 1496.0
    scene_bytes: float = 7837.0
    """Size of one scene with the grasps of its batch."""
    picture_bytes: float = 106_246.0
    manifest_bytes: float = 6000.0
    """Mean over the manifests of the stages."""
    index_bytes_per_grasp: float = 869.0
    """Size of all tables and their indexes on SQLite, including jobs, tasks and shards."""
    redis_ops_per_task: float = 109.0
    redis_bytes_per_task: float = 19_500.0
    """Network traffic in both directions."""
    redis_ops_controller: float = 34.0
    """Operations of the idle controller [1/s]."""
    redis_ops_worker: float = 9.0
    """Heartbeats of one busy worker [1/s]."""
    controller_core_s_per_task: float = 0.0013
    """CPU time of the controller from queueing a task to its rows in the index [core s]."""
    store_reads_per_task: float = 4.0
    """Store requests of a task: for its inputs, and for the existence of its output."""


@dataclass(frozen=True)
class Prices:
    """Example prices in any currency; replace them by your own."""

    core_hour: float = 0.04
    gpu_hour: float = 2.0
    gb_month: float = 0.023
    """Price of object storage."""
    months: float = 1.0
    """Storage time of the dataset."""
    thousand_writes: float = 0.005
    thousand_reads: float = 0.0004
    service_hour: float = 0.25
    """Price of Redis, database, two APIs and controller during the work."""


@dataclass(frozen=True)
class Estimate:
    grasps: int
    batches: int
    tasks: int
    jobs: int
    pictures: int
    core_hours: float
    cores: int
    """Number of cores for the time limit."""
    tasks_per_second: float
    redis_ops_per_second: float
    redis_megabits_per_second: float
    controller_cores: float
    """Share of a core that the controller needs; near 1 it is the bottleneck."""
    objects: int
    writes: int
    reads: int
    gigabytes: float
    index_rows: int
    index_gigabytes: float
    index_rows_per_second: float
    money_compute: float
    money_store: float
    money_service: float
    money: float
    money_per_million: float


def estimate(work: Work, measured: Measured, prices: Prices, *, cores_per_worker: int = 4) -> Estimate:
    """Return the cost of a dataset by CPU workers with `cores_per_worker` threads and own heartbeats each."""
    scenes = work.batches * work.scenes
    core_s = (
        work.grasps * measured.core_s_per_grasp
        + scenes * measured.core_s_per_scene
        + work.pictures * measured.core_s_per_picture
    ) / measured.busy
    seconds = work.days * _DAY_S
    cores = math.ceil(core_s / seconds)
    workers = math.ceil(cores / cores_per_worker)
    tasks = math.ceil(work.batches / work.span) * work.stages
    jobs = math.ceil(work.grasps / work.job)
    rate = tasks / seconds
    # A shard and its manifest for each task; a record for each job.
    objects = 2 * tasks + jobs
    size = (
        work.grasps * measured.base_bytes_per_grasp
        + scenes * measured.scene_bytes
        + work.pictures * measured.picture_bytes
        + tasks * measured.manifest_bytes
    )
    reads = round(tasks * measured.store_reads_per_task)
    rows = work.grasps + 2 * tasks + jobs
    compute = core_s / 3600 * prices.core_hour
    store = (
        size / _GB * prices.gb_month * prices.months
        + objects / 1000 * prices.thousand_writes
        + reads / 1000 * prices.thousand_reads
    )
    service = work.days * 24 * prices.service_hour
    return Estimate(
        grasps=work.grasps,
        batches=work.batches,
        tasks=tasks,
        jobs=jobs,
        pictures=work.pictures,
        core_hours=core_s / 3600,
        cores=cores,
        tasks_per_second=rate,
        redis_ops_per_second=rate * measured.redis_ops_per_task
        + workers * measured.redis_ops_worker
        + measured.redis_ops_controller,
        redis_megabits_per_second=rate * measured.redis_bytes_per_task * 8 / 1e6,
        controller_cores=rate * measured.controller_core_s_per_task,
        objects=objects,
        writes=objects,
        reads=reads,
        gigabytes=size / _GB,
        index_rows=rows,
        index_gigabytes=work.grasps * measured.index_bytes_per_grasp / _GB,
        index_rows_per_second=rows / seconds,
        money_compute=compute,
        money_store=store,
        money_service=service,
        money=compute + store + service,
        money_per_million=(compute + store + service) / work.grasps * 1e6,
    )


def gpu_hours(work: Work, grasps_per_second: float) -> float:
    return work.grasps / grasps_per_second / 3600


def sizes(data: Path) -> dict[str, float]:
    """Return sizes in a data folder with a file store, as fields of `Measured`.
    Raises SystemExit: the folder has no shard."""
    files = sorted((data / "store" / "shards").glob("*/*.json"))
    if not files:
        raise SystemExit(f"there is no shard below {data / 'store'}; give the data folder of a run")
    manifests = [json.loads(file.read_text()) for file in files]
    found = {"manifest_bytes": sum(file.stat().st_size for file in files) / len(files)}
    for field, (kind, axis) in _SIZES.items():
        shards = [manifest for manifest in manifests if manifest["kind"] == kind]
        if count := sum(shard["counts"][axis] for shard in shards):
            found[field] = sum(shard["size_bytes"] for shard in shards) / count
    return found


def table(estimates: Sequence[Estimate]) -> str:
    head = ["what", *(f"{item.grasps:,} grasps" for item in estimates)]
    lines = [f"| {' | '.join(head)} |", f"| --- |{' --: |' * len(estimates)}"]
    for field in dataclasses.fields(Estimate)[1:]:
        values = (getattr(item, field.name) for item in estimates)
        lines.append(f"| {field.name.replace('_', ' ')} | {' | '.join(map(_shown, values))} |")
    return "\n".join(lines)


def _shown(value: float) -> str:
    if isinstance(value, int) or value >= 100:
        return f"{value:,.0f}"
    return f"{value:.3g}"


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--grasps", type=int, action="append")
    parser.add_argument("--cores-per-worker", type=int, default=4)
    parser.add_argument("--gpu-grasps-per-second", type=float, help="rate of your GPU; adds its hours and price")
    parser.add_argument("--from-data", type=Path, help="data folder with shards to measure")
    parser.add_argument("--json", action="store_true")
    for group in (Work, Measured, Prices):
        for field in dataclasses.fields(group):
            if field.name != "grasps":
                kind = type(field.default)
                parser.add_argument(f"--{field.name.replace('_', '-')}", type=kind, default=field.default)
    given = vars(parser.parse_args(arguments))
    if given["from_data"] is not None:
        given |= sizes(given["from_data"])

    def of(group: type[Any]) -> dict[str, Any]:
        return {field.name: given[field.name] for field in dataclasses.fields(group) if field.name != "grasps"}

    measured, prices = Measured(**of(Measured)), Prices(**of(Prices))
    works = [Work(grasps=count, **of(Work)) for count in given["grasps"] or [1_000_000, 100_000_000]]
    results = [estimate(work, measured, prices, cores_per_worker=given["cores_per_worker"]) for work in works]
    if given["json"]:
        sys.stdout.write(json.dumps({"estimates": [dataclasses.asdict(item) for item in results]}) + "\n")
        return
    sys.stdout.write(table(results) + "\n")
    if rate := given["gpu_grasps_per_second"]:
        for work in works:
            hours = gpu_hours(work, rate)
            money = hours * prices.gpu_hour
            sys.stdout.write(
                f"\n{work.grasps:,} grasps: {hours:,.0f} GPU hours of synthesis, {money:,.0f} at your price\n"
            )


if __name__ == "__main__":
    main()
