"""Episodes of valid table grasps at the objects' own masses: a flying hand and two arms, replay, cost of films.

usage: python -m benchmarks.episodes DATA_DIR [--hands allegro ...] [--objects 025_mug ...] [--grasps 12] [--scenes 4]
           [--seed 1200] [--page OUT.md]
       DATA_DIR holds hands/ and objects/; objects need a mass in their meta.json"""

from __future__ import annotations

import time
from collections import Counter, defaultdict
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np

from benchmarks.cells import HANDS
from benchmarks.masses import arguments, masses
from graspd.service.model.domain import JobOptions
from graspd.service.model.scene_spec import parse_scene
from graspd.service.store.shards import Shard
from graspd.worker.episodes.episode import EpisodeOutcome
from graspd.worker.episodes.film import film_maker, film_options
from graspd.worker.episodes.shard import EpisodeOptions, episodes_of_shard, record_episodes, replay_episodes
from graspd.worker.execution_context import DEFAULT_CONTEXT
from graspd.worker.files.provenance import hand_of_shard, object_of_shard, scenes_of_shard
from graspd.worker.files.synthesis import synthesize_grasps

ROBOTS: Final = (None, "ur10e", "franka")
#: Filmed episodes of each hand; the first one compiles kernels and is not counted.
FILMED: Final = 4
HEAD: Final = """# Executed episodes of table grasps

`python -m benchmarks.episodes DATA{options}`: valid grasps at fidelity standard, planned for
the objects' own masses on a table, executed by a flying hand and by two arms. Executed: reached by inverse kinematics,
with a free transit. Equal: replays with the stored outcome. CPU s: time of planning and execution.

| robot | hand | grasps | executed | succeeded | succeeded of executed | equal | CPU s per episode | others |
| --- | --- | --: | --: | --: | --: | --: | --: | --- |
"""


@dataclass
class Tally:
    """Sums over the objects of a hand."""

    outcomes: Counter[EpisodeOutcome] = field(default_factory=Counter)
    executed: int = 0
    equal: int = 0
    seconds: float = 0.0

    def line(self, robot: str | None, hand: str) -> str:
        done, others = (
            self.outcomes[EpisodeOutcome.SUCCEEDED],
            self.outcomes - Counter([EpisodeOutcome.SUCCEEDED] * 10**6),
        )
        words = ", ".join(f"{count} {one.name.lower().replace('_', ' ')}" for one, count in others.most_common())
        share, each = done / max(1, self.executed), self.seconds / max(1, self.executed)
        return (
            f"| {robot or 'flying'} | {hand} | {self.outcomes.total()} | {self.executed} | {done} | {share:.3f} "
            f"| {self.equal} | {each:.2f} | {words} |"
        )


def main() -> None:
    given = arguments(__doc__, 1200).parse_args()
    tallies: defaultdict[tuple[str | None, str], Tally] = defaultdict(Tally)
    films = []
    for hand in given.hands:
        for name, mass in masses(given.data).items():
            if given.objects and name not in given.objects:
                continue
            base = valid_grasps(given, hand, name, mass)
            if not np.asarray(base["quality/valid"]).any():
                continue
            for robot in ROBOTS:
                execute(base, robot, tallies[robot, hand])
            if len(films) < 1 + given.hands.index(hand):
                films.append(film_line(base, hand))
    rows = [tallies[robot, hand].line(robot, hand) for robot in ROBOTS for hand in given.hands]
    said = f" --grasps {given.grasps} --scenes {given.scenes} --seed {given.seed}"
    said += f" --objects {' '.join(given.objects)}" if given.objects else ""
    text = HEAD.format(options=said) + "\n".join(rows)
    text += "\n\nFilms of a flying hand by two cameras of 320 x 240 pixels at 15 frames/s:\n\n"
    text += "| hand | frames | CPU s per episode | CPU s per 60 frames | kB per episode |\n"
    text += "| --- | --: | --: | --: | --: |\n"
    text += "\n".join(films) + "\n"
    if given.page:
        given.page.write_text(text)
    print(text)  # noqa: T201


def valid_grasps(given: Any, hand: str, name: str, mass: float) -> Shard:
    """Return the base shard of a hand and an object on a table."""
    request = JobOptions(
        grasps=given.grasps, rechecks=0, seed=given.seed, scene="table", scenes=given.scenes, mass=mass
    )
    urdf, mesh = given.data / "hands" / HANDS[hand], given.data / "objects" / name / "clean.stl"
    made = synthesize_grasps(str(urdf), str(mesh), request, place=parse_scene("table"), scenes=given.scenes)
    return Shard("base", made.attributes, made.arrays)


def recorded(base: Shard, options: EpisodeOptions, film: Any = None) -> tuple[Shard, float]:
    """Return the shard of episodes and their CPU time [s]."""
    hand, obj = hand_of_shard(base, None), object_of_shard(base, None)
    placed, began = scenes_of_shard(base), time.process_time()
    columns, attributes = record_episodes(base, hand, obj, placed, options, film=film)
    return Shard("episodes", attributes, columns), time.process_time() - began


def execute(base: Shard, robot: str | None, tally: Tally) -> None:
    """Execute the grasps and replay the episodes."""
    shard, seconds = recorded(base, EpisodeOptions(arm=robot))
    stored = episodes_of_shard(shard)
    tally.outcomes.update(one.outcome for one in stored)
    tally.executed += sum(len(one.state) > 0 for one in stored)
    tally.seconds += seconds
    pairs = zip(stored, replay_episodes(shard), strict=True)
    tally.equal += sum(a.outcome is b.outcome for a, b in pairs if len(a.state))


def film_line(base: Shard, hand: str) -> str:
    """Return the cost of films, without the first one's compilation."""
    options = film_options("scene,wrist")
    make = film_maker(base, options, 0, DEFAULT_CONTEXT)
    recorded(base, EpisodeOptions(limit=1), make)
    shard, seconds = recorded(base, EpisodeOptions(limit=FILMED), make)
    frames = int(np.asarray(shard["episode/frames"]).sum())
    size = sum(len(film) for one in episodes_of_shard(shard) for film in one.videos.values())
    count = len(shard["episode/frames"])
    cost = f"{seconds / count:.2f} | {60 * seconds / frames:.2f}"
    return f"| {hand} | {frames // count} | {cost} | {size / count / 1e3:.0f} |"


if __name__ == "__main__":
    main()
