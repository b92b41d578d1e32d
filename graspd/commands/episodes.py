"""Command line: `graspd episodes create` and `graspd episodes replay`."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from graspd.service.cli import CommandGroup, JsonFlag, print_result, progress_bar, write_output
from graspd.service.command_options import with_fields
from graspd.service.store.shards import read_shard, write_shard
from graspd.worker.episodes.episode import EpisodeOutcome
from graspd.worker.episodes.film import cameras_attribute, film_maker, film_options
from graspd.worker.episodes.shard import EpisodeOptions, episodes_of_shard, record_episodes, replay_episodes
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.files.provenance import hand_of_shard, id_of_columns, object_of_shard, scenes_of_shard

app = CommandGroup(no_args_is_help=True, add_completion=False)
group = CommandGroup(no_args_is_help=True, help="Execute grasps by an arm or a flying hand in MuJoCo.")
app.add_typer(group, name="episodes")

HandOption = Annotated[str | None, typer.Option(help="Hand file; default: found by its digest.")]
ObjectOption = Annotated[str | None, typer.Option(help="Object file; default: found by its digest.")]
ThreadsOption = Annotated[int, typer.Option(min=0, help="CPU threads; 0: one per core.")]


@group.command(epilog="graspd episodes create grasps.h5 --arm ur10e -o episodes.h5")
@with_fields(EpisodeOptions)
def create(
    grasps: Annotated[Path, typer.Argument(help="Base shard with grasps in scenes, as of `synth --scene table`.")],
    hand: HandOption = None,
    object: ObjectOption = None,
    *,
    options: EpisodeOptions,
    film: Annotated[str, typer.Option(help="Cameras that film episodes: scene,wrist,moving; default: none.")] = "",
    size: Annotated[str, typer.Option(help="Width and height of films [px].")] = "320x240",
    channels: Annotated[str, typer.Option(help="Further videos of each camera: depth,segmentation.")] = "",
    threads: ThreadsOption = 0,
    output: Annotated[Path, typer.Option("--output", "-o", help="HDF5 file to write.")] = Path("episodes.h5"),
    json: JsonFlag = False,
) -> None:
    """Execute the valid grasps of a file, from the transit to the hold; failures remain, labelled."""
    shard = read_shard(grasps, kind="base")
    model, thing = hand_of_shard(shard, hand), object_of_shard(shard, object)
    with progress_bar(quiet=json) as report:
        run = ExecutionContext(threads=threads, progress=report)
        filmed = film_maker(shard, film_options(film, size, channels, options.fps), options.seed, run) if film else None
        placed = scenes_of_shard(shard)
        columns, attributes = record_episodes(shard, model, thing, placed, options, film=filmed, run=run)
    if film:
        attributes["cameras"] = cameras_attribute(film_options(film, size, channels, options.fps))
    attributes["shard_id"] = id_of_columns(columns)
    write_output(output, write_shard("episodes", columns, attributes))
    counts, frames = count_outcomes(columns["episode/outcome"]), columns["episode/frames"]
    executed, succeeded = int((frames > 0).sum()), counts.get("succeeded", 0)
    told = {"file": str(output), "grasps": len(frames), "executed": executed, "succeeded": succeeded}
    told |= {"outcomes": counts, "frames": int(frames.sum()), "seconds": attributes["seconds"]}
    failed = ", ".join(f"{count} {reason}" for reason, count in counts.items() if reason != "succeeded")
    line = f"{output}: {executed} of {len(frames)} grasps executed, {succeeded} with success"
    print_result(told, line + (f"; {failed}" if failed else ""), json=json)


@group.command(epilog="graspd episodes replay episodes.h5")
def replay(
    file: Annotated[Path, typer.Argument(help="File of episodes.")],
    hand: HandOption = None,
    object: ObjectOption = None,
    threads: ThreadsOption = 0,
    json: JsonFlag = False,
) -> None:
    """Execute the stored actions again and compare outcomes; exit code 1 if less than 99 % are equal."""
    shard = read_shard(file, kind="episodes")
    with progress_bar(quiet=json) as report:
        again = replay_episodes(shard, hand=hand, obj=object, run=ExecutionContext(threads=threads, progress=report))
    pairs = [(a, b) for a, b in zip(episodes_of_shard(shard), again, strict=True) if len(a.phase)]
    equal = sum(a.outcome is b.outcome for a, b in pairs)
    identical = sum(np.array_equal(a.state, b.state) and np.array_equal(a.object_pose, b.object_pose) for a, b in pairs)
    told = {"file": str(file), "episodes": len(pairs), "equal_outcomes": equal, "identical": identical}
    line = f"{file}: {equal} of {len(pairs)} episodes have the stored outcome, {identical} have identical frames"
    print_result(told, line, json=json)
    if equal < 0.99 * len(pairs):
        raise typer.Exit(1)


def count_outcomes(codes: Iterable[Any]) -> dict[str, int]:
    """Return the number of episodes by outcome in words, most frequent first."""
    words = (EpisodeOutcome(int(code)).name.lower().replace("_", " ") for code in codes)
    return dict(Counter(words).most_common())
