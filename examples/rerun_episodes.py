"""Show an episode in Rerun: moving hand, arm and object, states, actions and films.

pip install 'rerun-sdk>=0.24,<1'
python -m examples.rerun_episodes episodes.h5 --number 0 -o episode.rrd && rerun episode.rrd"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import rerun as rr
import typer

from graspd.service.model.errors import InputError
from graspd.service.store.shards import read_shard
from graspd.worker.episodes.episode import PHASES
from graspd.worker.episodes.shard import episodes_of_shard, robot_of_shard
from graspd.worker.files.provenance import hand_of_shard, object_of_shard
from graspd.worker.rendering.hands import hand_parts


def main(
    file: Annotated[Path, typer.Argument(help="Episodes of `graspd episodes create`.")],
    number: Annotated[int, typer.Option(min=0, help="Number of the episode in the file.")] = 0,
    output: Annotated[Path, typer.Option("--output", "-o", help="Recording to write.")] = Path("episode.rrd"),
) -> None:
    """Write a recording."""
    shard = read_shard(file, kind="episodes")
    episodes = episodes_of_shard(shard)
    if number >= len(episodes) or not len(episodes[number].phase):
        raise InputError(f"{file} has {len(episodes)} episodes; number {number} is not one of those executed")
    episode, obj = episodes[number], object_of_shard(shard, None)
    robot, fps = robot_of_shard(shard, hand_of_shard(shard, None)), float(shard.attributes["fps"])  # type: ignore[arg-type]
    times = rr.TimeColumn("time", duration=np.arange(len(episode.phase)) / fps)
    recording = rr.RecordingStream("graspd episodes")
    recording.save(output)
    recording.log("scene", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    recording.log("scene/object", rr.Mesh3D(vertex_positions=obj.vertices, triangle_indices=obj.faces), static=True)
    moving = {"scene/object": np.asarray(episode.object_pose)}
    for model, poses in robot.poses(episode.state):
        for k, part in enumerate(hand_parts(model)):
            name, solid = f"scene/{model.name}/{k}", part.solid
            recording.log(name, rr.Mesh3D(vertex_positions=solid.vertices, triangle_indices=solid.faces), static=True)
            moving[name] = poses[:, part.body]
    for name, pose in moving.items():
        turns = np.roll(pose[:, 3:], -1, axis=1)  # w last
        recording.send_columns(name, [times], rr.Transform3D.columns(translation=pose[:, :3], quaternion=turns))
    for what, values in (("state", episode.state), ("action", episode.action)):
        for name, column in zip(robot.names, values.T, strict=True):
            recording.send_columns(f"{what}/{name}", [times], rr.Scalars.columns(scalars=column))
    recording.send_columns("phase", [times], rr.TextLog.columns(text=[PHASES[phase] for phase in episode.phase]))
    for camera, film in episode.videos.items():
        video = rr.AssetVideo(contents=film, media_type="video/mp4")
        recording.log(f"cameras/{camera}", video, static=True)
        stamps = np.arange(len(episode.phase)) * 10**9 // round(fps)
        frames = rr.VideoFrameReference.columns_nanos(stamps)
        recording.send_columns(f"cameras/{camera}", [times], frames)
    recording.flush()


if __name__ == "__main__":
    typer.run(main)
