"""Train a policy on episodes of one hand; compare it with replay of the nearest episode at unseen object poses.

python -m examples.behaviour_cloning EPISODES.h5 ... --trials 40 -o cloning.json"""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer

from examples.behaviour_cloning.policy import Demonstration, angle, most_common, train
from graspd.service.model.transforms import Floats, compose, quat_from_axis_angle
from graspd.service.store.shards import read_shard
from graspd.worker.episodes.episode import EpisodeOutcome
from graspd.worker.episodes.shard import episodes_of_shard, robot_of_shard
from graspd.worker.episodes.simulation import Simulation
from graspd.worker.files.provenance import hand_of_shard, object_of_shard, scenes_of_shard
from graspd.worker.validation.decomposition import decompose

#: Largest motion of a test pose from a resting pose of the data along x and y [m]; its rotation about z is any.
MOVED_M = 0.05
#: Distance between poses of an object that counts as much as a radian [m].
M_PER_RAD = 0.1


def main(
    files: Annotated[list[Path], typer.Argument(help="Files of episodes of one flying hand, one per object.")],
    trials: Annotated[int, typer.Option(help="Test poses of each object.")] = 40,
    seed: Annotated[int, typer.Option(help="Seed of training and test poses.")] = 0,
    output: Annotated[Path, typer.Option("--output", "-o")] = Path("cloning.json"),
) -> None:
    """Train and compare; write the scores."""
    shards = [read_shard(file, kind="episodes") for file in files]
    shown = [
        Demonstration(number, episode)
        for number, shard in enumerate(shards)
        for episode in episodes_of_shard(shard)
        if episode.outcome is EpisodeOutcome.SUCCEEDED
    ]
    policy, rng = train(shown, seed=seed), np.random.default_rng(seed + 1)
    rows: list[dict[str, Any]] = []
    for number, shard in enumerate(shards):
        hand, obj, placed = hand_of_shard(shard, None), object_of_shard(shard, None), scenes_of_shard(shard)
        assert placed is not None, "episodes are in scenes"
        robot, pieces, fps = robot_of_shard(shard, hand), decompose(obj), float(shard.attributes["fps"])  # type: ignore[arg-type]
        here = [one for one in shown if one.thing == number]
        own = [one.episode for one in here]
        lifted = {"policy": 0, "replay": 0}
        for _ in range(trials):
            rest = np.asarray(placed.object_pose[rng.integers(len(placed.object_pose))], float)
            turn = quat_from_axis_angle(np.array([0.0, 0.0, 1.0]), np.array(rng.uniform(-np.pi, np.pi)))
            pose = compose(np.concatenate([rng.uniform(-MOVED_M, MOVED_M, 2), [0.0], turn]), rest)
            simulation = Simulation(robot, obj, pieces, replace(placed, object_pose=pose[None]), fps=fps)
            home = own[int(rng.integers(len(own)))]
            if (told := most_common(here, pose)) is not None:
                start = np.concatenate([home.state[:1, :7], told.episode.state[:1, 7:]], axis=1)
                begun = replace(told.episode, scene=0, state=start)
                done = simulation.follow(partial(policy.act, told), begun)
                lifted["policy"] += done.outcome is EpisodeOutcome.SUCCEEDED
            near = min(own, key=lambda one: _distance(np.asarray(one.object_pose[0], float), pose))
            lifted["replay"] += simulation.replay(replace(near, scene=0)).outcome is EpisodeOutcome.SUCCEEDED
        rows.append({"object": str(shard.attributes["object"]), "episodes": len(own), "trials": trials, **lifted})
        typer.echo(rows[-1])
    shares = {who: sum(row[who] for row in rows) / (trials * len(rows)) for who in ("policy", "replay")}
    said: dict[str, Any] = {"shares": shares, "seed": seed, "objects": rows}
    output.write_text(json.dumps(said, indent=1))
    typer.echo(f"{trials * len(rows)} poses: the policy lifts {shares['policy']:.0%}, replay {shares['replay']:.0%}")


def _distance(a: Floats, b: Floats) -> float:
    return float(np.linalg.norm(a[:3] - b[:3]) + M_PER_RAD * angle(a[3:], b[3:]))


if __name__ == "__main__":
    typer.run(main)
