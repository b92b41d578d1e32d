"""Train on each source and lift unseen objects: `python -m examples.train_grasp_predictor --help`."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

import numpy as np
import torch
import typer

from examples.train_grasp_predictor import sources
from examples.train_grasp_predictor.evaluation import FACE, OBJECT, Exam, Proposer, Row, examined
from examples.train_grasp_predictor.evaluator import Ensemble, learned
from examples.train_grasp_predictor.practice import TrainingRun
from examples.train_grasp_predictor.refinement import RefinedHands, joined
from examples.train_grasp_predictor.samples import Sight, TrainedModel, sights
from examples.train_grasp_predictor.sheet import page
from examples.train_grasp_predictor.table import markdown
from examples.train_grasp_predictor.training import SHOWN, Trained, TrainingData, train
from examples.train_grasp_predictor.without_network import SQUEEZE, Nearest, across
from graspd.baselines.learned.network import Proposals, propose, save
from graspd.service.readers import Shards, open_shards
from graspd.service.store.network_file import ProposalNetwork
from graspd.worker.engines import backend
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.prepare import object_from_path

FREE, BASELINE = "free, filtered", "graspit, filtered"
ACROSS, NEAREST = "no network: across", "no network: nearest"
#: Rows of the ablations: the first source without parts of its method, and the controls with its evaluator.
DEFAULT_CONTEXT, UNMOVED = "proposals alone", "chosen, not moved"
VALIDATED: Final = {ACROSS: "across, chosen and moved", NEAREST: "nearest, chosen and moved"}
EXTRAS: Final = (DEFAULT_CONTEXT, UNMOVED, *VALIDATED.values())
#: Pictures per unseen object, and per unseen face.
PICTURES: Final = (16, 4)
#: Standard deviation of the noise from which grasps are proposed, without an evaluator: the best of 1, 0.3 and 0.1 on
#: unseen faces. With an evaluator, each value gives half of the proposals.
SPREAD: Final = 0.3
SPREADS: Final = (0.3, 1.0)
#: Number of evaluators in the ensemble.
MEMBERS: Final = 3
#: Noise of the depth camera in all pictures.
NOISE: Final = "stereo"

Option = typer.Option


@dataclass
class Study:
    """Data and settings shared by all sources."""

    hand: HandModel
    shards: Shards
    others: Mapping[str, Shards]
    meshes: Path
    back: Sequence[str]
    count: int

    def __post_init__(self) -> None:
        self.seen = sights(self.shards, noise=NOISE)
        names = sorted({file.object for file in self.shards.of_kind("base")})
        self.objects = [name for name in names if name not in self.back]
        self.held = sources.Held(self.shards, self.objects)
        self.models = {name: object_from_path(self.meshes / name / "clean.stl") for name in names}

    def exams(self) -> list[Exam]:
        """Return the exams: unseen objects on all faces, and unseen faces of the other objects."""
        found = []
        for name in self.back:
            mine = [sight for sight in self.seen if sight.scene.object == name]
            found.append(Exam.of(name, OBJECT, self.models[name], mine, PICTURES[0]))
        for name in self.held.face:
            mine = [sight for sight in self.seen if sight.scene.object == name and self.held.back(sight.scene)]
            found.append(Exam.of(name, FACE, self.models[name], mine, PICTURES[1]))
        return [exam for exam in found if exam.seen]

    def usual(self, obj: str) -> TrainedModel:
        return sources.in_scenes(self.shards, obj, self.held, self.count)

    def put_into(self, free: str, obj: str) -> TrainedModel:
        like, model = self.usual(obj), self.models[obj]
        return sources.put_into(self.others[free], self.hand, model, obj, like, self.held, seed=0)

    def failed(self, obj: str) -> TrainedModel:
        own = sources.Held(self.others[sources.FAILED], [obj])
        return sources.with_failures(self.others[sources.FAILED], obj, own, self.count)

    def makers(self) -> dict[str, Callable[[str], TrainedModel]]:
        """Return source -> function from an object to its training data. The first source is the reference."""
        made: dict[str, Callable[[str], TrainedModel]] = {sources.SCENES: self.usual}
        made |= {name: partial(self.put_into, name) for name in (FREE, BASELINE) if name in self.others}
        return made

    def ablations(self) -> dict[str, Callable[[str], TrainedModel]]:
        def spread(obj: str, *, alike: bool) -> TrainedModel:
            return sources.spread(self.usual(obj), self.held, self.count // 4, alike=alike)

        made: dict[str, Callable[[str], TrainedModel]] = {
            sources.QUARTER: lambda obj: sources.first(self.usual(obj), self.count // 4),
            sources.SIXTEENTH: lambda obj: sources.first(self.usual(obj), self.count // 16),
            sources.ALIKE: lambda obj: spread(obj, alike=True),
            sources.UNLIKE: lambda obj: spread(obj, alike=False),
            sources.HARD: lambda obj: sources.by_friction(self.usual(obj)),
        }
        return made | ({sources.FAILED: self.failed} if sources.FAILED in self.others else {})

    def pictures_for(self, source: str) -> Sequence[Sight]:
        return sights(self.others[source], noise=NOISE) if source == sources.FAILED else self.seen


def main(
    shards: Annotated[str, Option(help="Shards of grasps planned on tables, with views: a folder or a store.")],
    meshes: Annotated[Path, Option(help="Folder with the objects' meshes, OBJECT/clean.stl.")],
    held_out: Annotated[str, Option(help="Objects for evaluation only, separated by commas.")] = "",
    hand: Annotated[str, Option(help="URDF or built-in hand of the data.")] = "barrett",
    free: Annotated[str, Option(help="Shards of valid free grasps, to be transferred to tables and filtered.")] = "",
    baseline: Annotated[str, Option(help="Shards of free grasps of the baseline graspit.")] = "",
    raw: Annotated[
        str, Option(help="Shards planned on tables with `want candidates`, with views; they include failures.")
    ] = "",
    grasps: Annotated[int, Option(help="Maximum number of grasps per object.")] = 256,
    steps: Annotated[int, Option(help="Training steps of each network.")] = 3000,
    seeds: Annotated[int, Option(help="Number of networks per source.")] = 3,
    ablations: Annotated[bool, Option(help="Also use other sizes and selections of the data.")] = False,
    plain: Annotated[bool, Option("--plain", help="No evaluators: minutes instead of hours.")] = False,
    threads: Annotated[int, Option(help="Threads of torch.")] = 1,
    output: Annotated[Path, Option("--output", "-o", help="JSON file of all scores; existing ones are kept.")] = Path(
        "predictor.json"
    ),
    network: Annotated[Path | None, Option(help="File for the first network on scenes, for planning.")] = None,
    sheet: Annotated[Path | None, Option(help="PNG file with proposals of the first seed.")] = None,
) -> None:
    """Train a grasp predictor on each source of data; lift unseen objects and faces with its proposals."""
    torch.set_num_threads(threads)
    backend.start_warp()
    model = hand_from_path(hand)

    def opened(where: str) -> Shards:
        return open_shards(where).select(hands=[model.name])

    others = {
        name: opened(where) for name, where in ((FREE, free), (BASELINE, baseline), (sources.FAILED, raw)) if where
    }
    study = Study(model, opened(shards), others, meshes, [name for name in held_out.split(",") if name], grasps)
    rows: list[Row] = json.loads(output.read_text()) if output.exists() else []
    drawn: dict[str, dict[str, Any]] = {}
    exams = study.exams()
    wanted = study.makers() | (study.ablations() if ablations else {})
    shown = {*study.makers(), ACROSS, NEAREST}
    for source, seed, facts, proposer in _proposers(
        study, wanted, rows, seeds=seeds, steps=steps, network=network, ablations=ablations, plain=plain
    ):
        for exam, row, ready, lifted in examined(model, exams, proposer, seed=seed, epsilon=source in shown):
            rows.append({"hand": model.name, "source": source, "seed": seed, **facts, **row})
            if seed == 0 and exam.kind == OBJECT and source in shown:
                drawn.setdefault(exam.object, {})[source] = (exam, ready, lifted)
        output.write_text(json.dumps(rows, indent=1) + "\n")
        typer.echo(_line(source, seed, facts, rows))
        if sheet is not None and seed == 0 and source in shown:
            sheet.write_bytes(page(model, drawn))
    typer.echo(markdown(rows))


def _proposers(
    study: Study,
    wanted: Mapping[str, Callable[[str], TrainedModel]],
    rows: Sequence[Row],
    *,
    seeds: int,
    steps: int,
    network: Path | None,
    ablations: bool,
    plain: bool,
) -> Iterator[tuple[str, int, Row, Proposer]]:
    """Yield source, seed, facts and proposer for each source and seed that `rows` lack."""
    done = {(row["hand"], row["source"], row["seed"]) for row in rows}
    main = study.makers()
    for source, make in wanted.items():
        parts = [source, *(EXTRAS if ablations and source == sources.SCENES else ())]
        missing = [s for s in range(seeds) if any((study.hand.name, part, s) not in done for part in parts)]
        if not missing:
            continue
        given = [make(obj) for obj in study.objects]
        lessons, validated = TrainingData.of(study.pictures_for(source), given), None
        controls = _without(study, given) if source == sources.SCENES and not plain else {}
        facts: Row = {"grasps": sum(map(len, given)), "views": len(lessons)}
        for seed in missing:
            trained = train(lessons, steps=steps, seed=seed)
            made = _as_file(study.hand, trained, source)
            if network is not None and source == sources.SCENES and seed == 0:
                save(made, network)
            told = facts | {"loss": trained.loss}
            if plain or source not in main:
                yield source, seed, told, _by(made, (SPREAD,))
                continue
            by = _by(made, SPREADS)
            validated = validated or _validates(TrainingRun(study.hand, study.models, given, study.seen, by))
            refined = RefinedHands(study.hand, validated[0], by)
            told |= {"tries": validated[1]}
            whole: dict[str, Proposer] = {source: refined}
            if source == sources.SCENES:
                whole |= {DEFAULT_CONTEXT: _by(made, (SPREAD,)), UNMOVED: replace(refined, rounds=())}
                whole |= {VALIDATED[name]: replace(refined, source=other) for name, other in controls.items()}
            for name in parts:
                if (study.hand.name, name, seed) not in done:
                    yield name, seed, told, whole[name]
        for name, proposer in controls.items():
            for seed in range(seeds):
                if (study.hand.name, name, seed) not in done:
                    yield name, seed, {"grasps": facts["grasps"] if name == NEAREST else 0}, proposer


def _validates(practice: TrainingRun) -> tuple[Ensemble, int]:
    """Train an ensemble on attempts of a source's first network; return ensemble and number of attempts."""
    tries = practice.tries(seed=0)
    return Ensemble(learned(practice.hand, tries, seed=seed) for seed in range(MEMBERS)), len(tries)


def _without(study: Study, given: Sequence[TrainedModel]) -> dict[str, Proposer]:
    nearest = Nearest(study.seen, given)
    return {
        NEAREST: nearest.propose,
        ACROSS: lambda sight, n, rng: across(study.hand, sight, n, squeeze=SQUEEZE, rng=rng),
    }


def _by(made: ProposalNetwork, spreads: Sequence[float]) -> Proposer:
    """Return a proposer with equal numbers of proposals from noise of each spread."""

    def proposer(sight: Sight, count: int, rng: np.random.Generator) -> Proposals:
        shown = slice(0, SHOWN)
        points, normals = sight.points[shown], sight.normals[shown]
        each = count // len(spreads)
        return joined(
            *(
                propose(made, points, normals, table_height=0.0, count=each, rng=rng, spread=spread)
                for spread in spreads
            )
        )

    return proposer


def _as_file(hand: HandModel, trained: Trained, about: str) -> ProposalNetwork:
    weights = {name: value.numpy() for name, value in trained.network.state_dict().items()}
    return ProposalNetwork(
        hand=hand.name,
        hand_digest=hand.digest,
        joint_names=hand.joint_names,
        points=SHOWN,
        steps=16,
        about=about,
        mean=trained.mean,
        std=trained.std,
        weights=weights,
    )


def _line(source: str, seed: int, facts: Row, rows: Sequence[Row]) -> str:
    mine = [row for row in rows if (row["source"], row["seed"]) == (source, seed)]
    lifts = {kind: [row["lift"] for row in mine if row["kind"] == kind] for kind in (OBJECT, FACE)}
    means = ", ".join(f"{kind} {np.mean(shares):.2f}" for kind, shares in lifts.items() if shares)
    return f"{source} {seed}: {facts}; lift {means}"


if __name__ == "__main__":
    typer.run(main)
