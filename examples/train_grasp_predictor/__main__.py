"""Train on each source of data, lift objects that none has shown: `python -m examples.train_grasp_predictor --help`."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import torch
import typer

from examples.train_grasp_predictor import sources
from examples.train_grasp_predictor.evaluation import FACE, OBJECT, Exam, Proposer, Row, examined
from examples.train_grasp_predictor.samples import Sight, Taught, sights
from examples.train_grasp_predictor.sheet import page
from examples.train_grasp_predictor.table import markdown
from examples.train_grasp_predictor.training import SHOWN, Lessons, Trained, train
from examples.train_grasp_predictor.without_network import SQUEEZE, Nearest, across
from service.readers import Shards, open_shards
from worker.engines import backend
from worker.hands.load import hand_from_path
from worker.hands.model import HandModel
from worker.objects.prepare import object_from_path
from worker.planners.learned.network import ProposalNetwork, propose, save

FREE, PEER = "free, filtered", "graspit, filtered"
ACROSS, NEAREST = "no network: across", "no network: nearest"
#: Pictures of each unseen object, and of each unseen face.
PICTURES: Final = (16, 4)
#: Of the noise from which grasps are proposed: of 1, 0.3 and 0.1 what lifted most of the unseen faces.
SPREAD: Final = 0.3
#: Noise of the depth camera that all are shown.
NOISE: Final = "stereo"

Option = typer.Option


@dataclass
class Study:
    """Everything that is the same for all sources."""

    hand: HandModel
    shards: Shards
    others: Mapping[str, Shards]
    meshes: Path
    back: Sequence[str]
    count: int

    def __post_init__(self) -> None:
        self.seen = sights(self.shards, noise=NOISE)
        names = sorted({file.object for file in self.shards.of("base")})
        self.objects = [name for name in names if name not in self.back]
        self.held = sources.Held(self.shards, self.objects)
        self.models = {name: object_from_path(self.meshes / name / "clean.stl") for name in names}

    def exams(self) -> list[Exam]:
        """Unseen objects on all their faces, and unseen faces of the others."""
        found = []
        for name in self.back:
            mine = [sight for sight in self.seen if sight.scene.object == name]
            found.append(Exam.of(name, OBJECT, self.models[name], mine, PICTURES[0]))
        for name in self.held.face:
            mine = [sight for sight in self.seen if sight.scene.object == name and self.held.back(sight.scene)]
            found.append(Exam.of(name, FACE, self.models[name], mine, PICTURES[1]))
        return [exam for exam in found if exam.seen]

    def all_of(self, obj: str) -> Taught:
        return sources.in_scenes(self.shards, obj, self.held, 10**6)

    def usual(self, obj: str) -> Taught:
        return sources.in_scenes(self.shards, obj, self.held, self.count)

    def put_into(self, free: str, obj: str) -> Taught:
        like, model = self.usual(obj), self.models[obj]
        return sources.put_into(self.others[free], self.hand, model, obj, like, self.held, seed=0)

    def failed(self, obj: str) -> Taught:
        own = sources.Held(self.others[sources.FAILED], [obj])
        return sources.with_failures(self.others[sources.FAILED], obj, own, self.count)

    def makers(self) -> dict[str, Callable[[str], Taught]]:
        """From a source to what it teaches of an object; the first is what the others are compared with."""
        made: dict[str, Callable[[str], Taught]] = {sources.SCENES: self.usual}
        made |= {name: partial(self.put_into, name) for name in (FREE, PEER) if name in self.others}
        return made

    def ablations(self) -> dict[str, Callable[[str], Taught]]:
        def spread(obj: str, *, alike: bool) -> Taught:
            return sources.spread(self.all_of(obj), self.held, self.count, alike=alike)

        made: dict[str, Callable[[str], Taught]] = {
            sources.QUARTER: lambda obj: sources.first(self.usual(obj), self.count // 4),
            sources.FOURFOLD: self.all_of,
            sources.ALIKE: lambda obj: spread(obj, alike=True),
            sources.UNLIKE: lambda obj: spread(obj, alike=False),
            sources.HARD: lambda obj: sources.by_friction(self.usual(obj)),
        }
        return made | ({sources.FAILED: self.failed} if sources.FAILED in self.others else {})

    def pictures_for(self, source: str) -> Sequence[Sight]:
        return sights(self.others[source], noise=NOISE) if source == sources.FAILED else self.seen


def main(
    shards: Annotated[str, Option(help="Shards of grasps planned on tables, with views: a folder, a store.")],
    meshes: Annotated[Path, Option(help="Folder with the objects' meshes, OBJECT/clean.stl.")],
    held_out: Annotated[str, Option(help="Objects to evaluate on, with commas; none of them is trained on.")],
    hand: Annotated[str, Option(help="URDF or built-in hand of the data.")] = "barrett",
    free: Annotated[str, Option(help="Shards of valid grasps of free objects, to be put on tables and filtered.")] = "",
    peer: Annotated[str, Option(help="The same of the graspit baseline.")] = "",
    raw: Annotated[str, Option(help="Shards planned on tables with `want raw`, with views: failures told.")] = "",
    grasps: Annotated[int, Option(help="Grasps of each object.")] = 64,
    steps: Annotated[int, Option(help="Training steps of each network.")] = 1500,
    seeds: Annotated[int, Option(help="Networks trained on each source.")] = 3,
    ablations: Annotated[bool, Option(help="Other sizes and choices of the data besides.")] = False,
    threads: Annotated[int, Option(help="Threads of torch.")] = 1,
    output: Annotated[Path, Option("--output", "-o", help="JSON of all scores; what it has is kept.")] = Path(
        "predictor.json"
    ),
    network: Annotated[Path | None, Option(help="Where the first network on scenes is saved, for planning.")] = None,
    sheet: Annotated[Path | None, Option(help="PNG of what the first seed proposes.")] = None,
) -> None:
    """Train a grasp predictor on each source of data and lift what it proposes for unseen objects and faces."""
    torch.set_num_threads(threads)
    backend.start()
    model = hand_from_path(hand)

    def opened(where: str) -> Shards:
        return open_shards(where).only(hands=[model.name])

    others = {name: opened(where) for name, where in ((FREE, free), (PEER, peer), (sources.FAILED, raw)) if where}
    study = Study(model, opened(shards), others, meshes, held_out.split(","), grasps)
    rows: list[Row] = json.loads(output.read_text()) if output.exists() else []
    drawn: dict[str, dict[str, Any]] = {}
    exams = study.exams()
    wanted = study.makers() | (study.ablations() if ablations else {})
    for source, seed, facts, proposer in _proposers(study, wanted, rows, seeds=seeds, steps=steps, network=network):
        for exam, row, ready, lifted in examined(
            model, exams, proposer, seed=seed, epsilon=source not in study.ablations()
        ):
            rows.append({"hand": model.name, "source": source, "seed": seed, **facts, **row})
            if seed == 0 and exam.kind == OBJECT:
                drawn.setdefault(exam.object, {})[source] = (exam, ready, lifted)
        output.write_text(json.dumps(rows, indent=1) + "\n")
        typer.echo(_line(source, seed, facts, rows))
    if sheet is not None and drawn:
        sheet.write_bytes(page(model, drawn))
    typer.echo(markdown(rows))


def _proposers(
    study: Study, wanted: Mapping[str, Callable[[str], Taught]], rows: Sequence[Row], *, seeds: int, steps: int,
    network: Path | None,
) -> Iterator[tuple[str, int, Row, Proposer]]:  # fmt: skip
    """Each source and seed that `rows` do not have: what is known of it, and what proposes."""
    done = {(row["hand"], row["source"], row["seed"]) for row in rows}
    for source, make in wanted.items():
        if all((study.hand.name, source, seed) in done for seed in range(seeds)):
            continue
        given = [make(obj) for obj in study.objects]
        lessons = Lessons.of(study.pictures_for(source), given)
        facts: Row = {"grasps": sum(map(len, given)), "views": len(lessons)}
        for seed in range(seeds):
            if (study.hand.name, source, seed) in done:
                continue
            trained = train(lessons, steps=steps, seed=seed)
            made = _as_file(study.hand, trained, source)
            if network is not None and source == sources.SCENES and seed == 0:
                save(made, network)
            yield source, seed, facts | {"loss": trained.loss}, _by(made)
        if source == sources.SCENES:
            yield from _without(study, given, done, seeds)


def _without(study: Study, given: Sequence[Taught], done: set[tuple[str, str, int]], seeds: int) -> Iterator[Any]:
    nearest, rows = Nearest(study.seen, given), sum(map(len, given))
    for seed in range(seeds):
        if (study.hand.name, NEAREST, seed) not in done:
            yield NEAREST, seed, {"grasps": rows}, lambda sight, n, rng: nearest.propose(sight, n, rng)
        if (study.hand.name, ACROSS, seed) not in done:
            yield (
                ACROSS, seed, {"grasps": 0},
                lambda sight, n, rng: across(study.hand, sight, n, squeeze=SQUEEZE, rng=rng),
            )  # fmt: skip


def _by(made: ProposalNetwork) -> Proposer:
    def proposer(sight: Sight, count: int, rng: np.random.Generator) -> Any:
        shown = slice(0, SHOWN)
        points, normals = sight.points[shown], sight.normals[shown]
        return propose(made, points, normals, table_height=0.0, count=count, rng=rng, spread=SPREAD)

    return proposer


def _as_file(hand: HandModel, trained: Trained, about: str) -> ProposalNetwork:
    weights = {name: value.numpy() for name, value in trained.network.state_dict().items()}
    return ProposalNetwork(
        hand=hand.name, hand_digest=hand.digest, joint_names=hand.joint_names, points=SHOWN, steps=16, about=about,
        mean=trained.mean, std=trained.std, weights=weights,
    )  # fmt: skip


def _line(source: str, seed: int, facts: Row, rows: Sequence[Row]) -> str:
    mine = [row for row in rows if (row["source"], row["seed"]) == (source, seed)]
    means = {kind: np.mean([row["lift"] for row in mine if row["kind"] == kind]) for kind in (OBJECT, FACE)}
    return f"{source} {seed}: {facts}; lift " + ", ".join(f"{kind} {value:.2f}" for kind, value in means.items())


if __name__ == "__main__":
    typer.run(main)
