"""Command line: `graspd transfer`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from graspd.service.cli import CommandGroup, JsonFlag, print_result, write_output
from graspd.service.store.shards import read_shard, write_shard
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.files.transfer import transfer_grasps

app = CommandGroup(add_completion=False)


@app.command(epilog="graspd transfer grasps.h5 --hand shadow -o transferred.h5")
def transfer(
    file: Annotated[Path, typer.Argument(help="Base shard with grasps of a free object.")],
    hand: Annotated[str, typer.Option(help="Hand to transfer to: file or built-in name.")],
    out: Annotated[Path, typer.Option("-o", "--out", help="HDF5 file to write.")],
    source_hand: Annotated[str | None, typer.Option(help="Hand file of the grasps; default: by its digest.")] = None,
    object: Annotated[str | None, typer.Option(help="Object file; default: found by its digest.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first grasp.")] = 0,
    threads: Annotated[int, typer.Option(min=0, help="CPU threads; 0: one per core.")] = 0,
    json: JsonFlag = False,
) -> None:
    """Plan a grasp of another hand for each valid grasp: same type, contact region and approach."""
    shard = read_shard(file, kind="base")
    run = ExecutionContext(threads=threads)
    arrays, attributes = transfer_grasps(shard, hand, source_hand=source_hand, obj=object, seed=seed, run=run)
    write_output(out, write_shard("base", arrays, attributes))
    count, valid = len(arrays["quality/valid"]), int((shard["quality/valid"] == 1).sum())
    line = f"{out}: {count} of {valid} valid grasps of {file} transferred to {attributes['hand']}"
    print_result({"file": str(out), "grasps": count, "source_grasps": valid}, line, json=json)
