"""Train on each source of data, evaluate on held-back objects: `python -m examples.train_grasp_predictor --help`."""

from __future__ import annotations

import json
from dataclasses import asdict, fields
from pathlib import Path
from statistics import fmean, stdev
from typing import Annotated, Any

import numpy as np
import torch
import typer

from examples.train_grasp_predictor import evaluation
from examples.train_grasp_predictor.evaluation import Score
from examples.train_grasp_predictor.samples import Example, examples
from examples.train_grasp_predictor.training import train
from service.readers import open_shards
from worker import backend
from worker.hands.load import hand_from_path
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.objects.prepare import object_from_path

_HEADINGS = {
    "contact_area_cm2": "CA cm²", "intersection_volume_cm3": "IV cm³", "epsilon": "ε", "wrench_volume": "Vol",
    "simulated_displacement_cm": "SD cm", "gsr": "GSR",
}  # fmt: skip


def main(
    source: Annotated[list[str], typer.Option(help="NAME=FOLDER of base, scene and views shards; several times.")],
    held_out: Annotated[str, typer.Option(help="Objects to evaluate on, with commas; none of them is trained on.")],
    meshes: Annotated[Path, typer.Option(help="Folder with the held-back objects' meshes, OBJECT/clean.stl.")],
    hand: Annotated[str, typer.Option(help="URDF or built-in hand of the data.")] = "barrett",
    views_of: Annotated[str, typer.Option(help="Source whose pictures of the held-back objects are shown.")] = "",
    steps: Annotated[int, typer.Option(help="Training steps of each network.")] = 3000,
    seeds: Annotated[int, typer.Option(help="Networks trained on each source.")] = 3,
    pictures: Annotated[int, typer.Option(help="Pictures of each held-back object.")] = 16,
    threads: Annotated[int, typer.Option(help="Threads of torch.")] = 2,
    output: Annotated[Path, typer.Option("--output", "-o", help="JSON of all scores.")] = Path("predictor.json"),
) -> None:
    """Train a grasp predictor on each source of data and compare what they propose for unseen objects."""
    torch.set_num_threads(threads)
    backend.start()
    folders = dict(entry.split("=", 1) for entry in source)
    back = held_out.split(",")
    data = {name: list(examples(open_shards(folder))) for name, folder in folders.items()}
    shown = data[views_of or next(iter(data))]
    model = hand_from_path(hand)
    tests = {name: (object_from_path(meshes / name / "clean.stl"), _of(shown, name)[:pictures]) for name in back}
    rows: list[dict[str, Any]] = []
    for seed in range(seeds):
        for name, everything in data.items():
            seen = [example for example in everything if example.object not in back]
            network, final = train(seen, steps=steps, seed=seed)
            for obj_name, (obj, views) in tests.items():
                grasps = evaluation.carried_out(model, obj, *evaluation.proposals(network, views))
                made = evaluation.score(model, obj, grasps)
                rows.append({"source": name, "seed": seed, "object": obj_name, "loss": final, **asdict(made)})
                typer.echo(json.dumps(rows[-1]))
            output.write_text(json.dumps(rows, indent=1) + "\n")
        rows += _control(model, tests, seed)
    output.write_text(json.dumps(rows, indent=1) + "\n")
    typer.echo(table(rows, {name: _sizes(some, back) for name, some in data.items()}))


def table(rows: list[dict[str, Any]], sizes: dict[str, str]) -> str:
    """Markdown in the layout of the paper's Table 3: a line for each source, mean and spread over the seeds."""
    lines = ["| trained on | pictures, grasps | " + " | ".join(_HEADINGS.values()) + " |", "| --- " * 8 + "|"]
    for name in dict.fromkeys(row["source"] for row in rows):
        seeds = sorted({row["seed"] for row in rows if row["source"] == name})
        cells = []
        for metric in _HEADINGS:
            means = [fmean(r[metric] for r in rows if r["source"] == name and r["seed"] == seed) for seed in seeds]
            cells.append(f"{fmean(means):.3g} ± {stdev(means):.2g}" if len(means) > 1 else f"{means[0]:.3g}")
        lines.append(f"| {name} | {sizes.get(name, '')} | " + " | ".join(cells) + " |")
    return "\n".join(lines)


def _control(hand: HandModel, tests: dict[str, tuple[ObjectModel, list[Example]]], seed: int) -> list[dict[str, Any]]:
    rows = []
    for name, (obj, views) in tests.items():
        count = evaluation.TAKEN * len(views)
        made = evaluation.score(hand, obj, evaluation.anywhere(hand, obj, count, seed))
        rows.append({"source": "no network", "seed": seed, "object": name, **asdict(made)})
    return rows


def _of(some: list[Example], name: str) -> list[Example]:
    found = [example for example in some if example.object == name]
    # Pictures of one scene look alike: take them spread over all scenes.
    order = np.random.default_rng(0).permutation(len(found))
    return [found[i] for i in order]


def _sizes(some: list[Example], back: list[str]) -> str:
    seen = [example for example in some if example.object not in back]
    grasps = {
        (example.object, tuple(example.grasps[k, -3:].tolist())) for example in seen for k in range(len(example.grasps))
    }
    return f"{len(seen)}, {len(grasps)}"


assert {field.name for field in fields(Score)} >= set(_HEADINGS)

if __name__ == "__main__":
    typer.run(main)
