"""Episodes of a dataset through a real service, all of whose processes are killed in the middle.

    python -m benchmarks.episodes_run --work DIR --grasps 170

Makes the dataset of examples/episodes/table.toml. At a third of the work every process gets SIGKILL, and the same
commands continue. Prints the outcomes, the cost of an episode, and the number of shards that the kill changed."""

from __future__ import annotations

import json
import math
import os
from collections import Counter
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from benchmarks.matrix import ExecutionContext
from benchmarks.object_run import Kept, follow
from graspd.service.model.digests import file_sha256
from graspd.service.store.columns import EXECUTED

SPEC: Final = Path(__file__).parents[1] / "examples" / "episodes" / "table.toml"
NAME: Final = "episodes"
#: Interval of kills of single workers [s], beyond the run: only all processes are killed, once.
_NO_WORKER_S: Final = 1e9


def main(
    work: Annotated[Path, typer.Option(help="Folder of the service.")],
    grasps: Annotated[int, typer.Option(help="Valid grasps of each hand and object.")] = 170,
    robot: Annotated[str, typer.Option(help="flying, ur10e or franka.")] = "flying",
    spec: Annotated[Path, typer.Option(help="Spec of the dataset.")] = SPEC,
    hands: Annotated[str, typer.Option(help="Names of hands, comma-separated.")] = "allegro,barrett",
    objects: Annotated[str, typer.Option(help="Names of objects, comma-separated.")] = "mug,block,bottle",
    fidelity: Annotated[str, typer.Option(help="draft, standard or fine.")] = "standard",
    workers: Annotated[int, typer.Option(help="Workers of the service.")] = 2,
) -> None:
    """Run the dataset and print its figures."""
    work.mkdir(parents=True, exist_ok=True)
    run = ExecutionContext(work, {k: v for k, v in os.environ.items() if not k.startswith("GRASPD_")}, workers=workers)
    options = {"--hands": hands, "--objects": objects, "--grasps": str(grasps), "--fidelity": fidelity}
    options |= {"--episodes": robot}
    command = (
        "datasets",
        "create",
        NAME,
        "--spec",
        str(spec),
        "--yes",
        *(one for pair in options.items() for one in pair),
    )
    kept = Kept()
    run.up()
    try:
        follow(run, {NAME: command}, kept, end=math.inf, kill_s=_NO_WORKER_S)
        cells = list(run.client().cells(NAME))
    finally:
        run.stop()
    typer.echo(
        json.dumps(
            figures(work / "data" / "store" / "shards" / "episodes")
            | {
                "cells": dict(Counter(cell.state.value for cell in cells)),
                "service_killed": kept.service_killed,
                "failed_attempts": sum(cell.attempts_failed for cell in cells),
                "wall_s": round(kept.seconds, 1),
            },
            indent=1,
        )
    )


def figures(folder: Path) -> dict[str, Any]:
    """Return the sums over the episode shards of a store's folder."""
    made = [json.loads(file.read_bytes()) for file in sorted(folder.glob("*.json"))]
    outcomes = Counter(outcome for one in made for outcome in one.get("episodes", {}).values())
    executed = sum(outcomes[one] for one in EXECUTED)
    files = {one["shard_id"]: folder / f"{one['shard_id']}.h5" for one in made}
    return {
        "episodes": sum(outcomes.values()),
        "executed": executed,
        "outcomes": dict(outcomes),
        "seconds_per_episode": round(sum(one["seconds"] for one in made) / max(1, executed), 2),
        "bytes_per_episode": round(sum(file.stat().st_size for file in files.values()) / max(1, executed)),
        "shards": len(made),
        "shards_unlike_their_manifest": sum(file_sha256(files[one["shard_id"]]) != one["sha256"] for one in made),
        "shards_without_manifest": len(list(folder.glob("*.h5"))) - len(made),
    }


if __name__ == "__main__":
    typer.run(main)
