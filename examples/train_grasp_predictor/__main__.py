"""Train on each source of data, evaluate on held-back objects: `python -m examples.train_grasp_predictor --help`."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import torch
import typer

from examples.train_grasp_predictor import evaluation, execution
from examples.train_grasp_predictor.evaluation import Held
from examples.train_grasp_predictor.samples import Example, examples, first_grasps
from examples.train_grasp_predictor.sheet import page
from examples.train_grasp_predictor.table import CARRIED_OUT, DATA, PROPOSED, Row, markdown
from examples.train_grasp_predictor.training import train
from service.readers import Shards, open_shards
from worker.engines import backend
from worker.grasps import GraspSet
from worker.hands.load import hand_from_path
from worker.hands.model import HandModel
from worker.objects.prepare import object_from_path


def main(
    source: Annotated[list[str], typer.Option(help="NAME=FOLDER of base, scene and views shards; several times.")],
    held_out: Annotated[str, typer.Option(help="Objects to evaluate on, with commas; none of them is trained on.")],
    meshes: Annotated[Path, typer.Option(help="Folder with the held-back objects' meshes, OBJECT/clean.stl.")],
    hand: Annotated[str, typer.Option(help="URDF or built-in hand of the data.")] = "barrett",
    views_of: Annotated[str, typer.Option(help="Source whose pictures of the held-back objects are shown.")] = "",
    grasps: Annotated[
        int, typer.Option(help="Grasps of each object taken from each source, whole shards; 0: all.")
    ] = 0,
    steps: Annotated[int, typer.Option(help="Training steps of each network.")] = 3000,
    seeds: Annotated[int, typer.Option(help="Networks trained on each source.")] = 3,
    pictures: Annotated[int, typer.Option(help="Pictures of each held-back object.")] = 16,
    threads: Annotated[int, typer.Option(help="Threads of torch.")] = 2,
    output: Annotated[Path, typer.Option("--output", "-o", help="JSON of all scores.")] = Path("predictor.json"),
    sheet: Annotated[Path | None, typer.Option(help="PNG of what the first seed's networks propose.")] = None,
) -> None:
    """Train a grasp predictor on each source of data and compare what they propose for unseen objects."""
    torch.set_num_threads(threads)
    backend.start()
    back = held_out.split(",")
    folders = dict(entry.split("=", 1) for entry in source)
    sources = {name: first_grasps(open_shards(folder), grasps) for name, folder in folders.items()}
    model = hand_from_path(hand)
    shown = list(
        examples(open_shards(folders[views_of or next(iter(folders))]).only(objects=back), model.palm.approach)
    )
    tests = [Held.of(name, object_from_path(meshes / name / "clean.stl"), _of(shown, name)[:pictures]) for name in back]
    rows = [row for name, shards in sources.items() for row in _grasps_in(name, shards, back)]
    seen = {name: list(examples(_without(shards, back), model.palm.approach)) for name, shards in sources.items()}
    made: dict[str, dict[str, GraspSet]] = {name: {} for name in sources}
    for seed in range(seeds):
        for row, grasps_out in _grasps_out(model, seen, tests, steps=steps, seed=seed):
            typer.echo(json.dumps(row))
            rows.append(row)
            output.write_text(json.dumps(rows, indent=1) + "\n")
            if seed == 0 and row["source"] in made and row["side"] == CARRIED_OUT:
                made[row["source"]][row["object"]] = grasps_out
    if sheet is not None:
        sheet.write_bytes(page(model, tests, made))
    typer.echo(markdown(rows))


def _grasps_in(name: str, shards: Shards, back: list[str]) -> Iterator[Row]:
    """What a source teaches: figures of its grasps on the objects trained on."""
    for obj in _objects(_without(shards, back)):
        yield {"source": name, "side": DATA, "object": obj, **asdict(evaluation.in_data(shards, obj))}


def _grasps_out(
    hand: HandModel, seen: dict[str, list[Example]], tests: list[Held], *, steps: int, seed: int
) -> Iterator[tuple[Row, GraspSet]]:
    """What the networks propose for the held-back objects, and a control without a network."""
    for name, shown in seen.items():
        network, final = train(shown, steps=steps, seed=seed)
        facts: dict[str, Any] = {"source": name, "seed": seed, "loss": final, "pictures": len(shown)}
        for held in tests:
            proposals = execution.proposals(network, held.pictures)
            for side, done in ((PROPOSED, execution.as_proposed), (CARRIED_OUT, execution.carried_out)):
                grasps = done(hand, held.model, *proposals)
                yield facts | {"side": side, "object": held.name, **_scored(hand, held, grasps)}, grasps
    for held in tests:
        grasps = execution.anywhere(hand, held.model, execution.TAKEN * len(held.pictures), seed)
        facts = {"source": "no network", "seed": seed, "side": CARRIED_OUT, "object": held.name}
        yield facts | _scored(hand, held, grasps), grasps


def _scored(hand: HandModel, held: Held, grasps: GraspSet) -> Row:
    return asdict(evaluation.score(hand, held, grasps))


def _objects(shards: Shards) -> list[str]:
    return sorted({file.object for file in shards.of("base")})


def _without(shards: Shards, names: list[str]) -> Shards:
    return shards.only(objects=set(_objects(shards)) - set(names))


def _of(some: list[Example], name: str) -> list[Example]:
    found = [example for example in some if example.object == name]
    # Pictures of one scene look alike: take them spread over all scenes.
    order = np.random.default_rng(0).permutation(len(found))
    return [found[i] for i in order]


if __name__ == "__main__":
    typer.run(main)
