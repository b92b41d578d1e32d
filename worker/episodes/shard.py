"""Episodes of a base shard's grasps, and the HDF5 shard of episodes."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from time import perf_counter
from typing import Annotated, Any, Final

import numpy as np
from numpy.typing import NDArray
from typer import Option

from graspd.service.model.errors import ConflictError, InputError
from graspd.service.model.transforms import IDENTITY_POSE, Floats
from graspd.service.store import validity
from graspd.service.store.columns import CAMERAS, SCHEMAS, VIDEOS, Attribute
from graspd.service.store.shards import Shard
from graspd.worker.episodes.episode import Episode, EpisodeOutcome, Robot
from graspd.worker.episodes.execution import Executions, ToolFrame, build_executions
from graspd.worker.episodes.motion import Motion, MotionPlanner
from graspd.worker.episodes.reach import BUILTIN_ARMS
from graspd.worker.episodes.robots import read_robot
from graspd.worker.episodes.simulation import Simulation
from graspd.worker.execution_context import DEFAULT_CONTEXT, Count, ExecutionContext, evaluate_rows
from graspd.worker.files.provenance import INHERITED, hand_of_shard, object_of_shard, scenes_of_shard, source_attributes
from graspd.worker.files.subsets import select_grasps
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.validation.decomposition import ConvexPieces, decompose

#: Frames per second of an episode.
FPS: Final = 15.0
#: Attributes of the base shard that an episodes shard inherits, with `INHERITED`.
_INHERITED: Final = (
    *("object_mass_kg", "object_friction", "requirements", "scene"),
    *("neighbours", "neighbour_digests", "neighbour_sources"),
)
_FRAMES: Final = ("state", "action", "phase", "object_pose", "neighbour_pose")

#: Adds videos and camera poses to an episode.
Film = Callable[[Episode], Episode]
#: Makes the film of one thread, for a robot and its grasps.
FilmMaker = Callable[[Robot, Executions], Film]


@dataclass(frozen=True)
class EpisodeOptions:
    """Options of `graspd episodes create`; see `read_robot` for the arm's."""

    arm: Annotated[str | None, Option(help="ur10e, franka or a URDF; default: the hand flies.")] = None
    mount: Annotated[str | None, Option(help="Link of the arm on which the hand is mounted.")] = None
    mount_pose: Annotated[str | None, Option(help="Pose of the hand in the mount: x y z qw qx qy qz.")] = None
    base: Annotated[str | None, Option(help="Pose of the arm's base in the scene: x y z qw qx qy qz.")] = None
    fps: Annotated[float, Option(min=5, max=60, help="Rate of frames [Hz].")] = FPS
    seed: Annotated[int, Option(min=0, help="Seed of start postures and motions.")] = 0
    limit: Annotated[int, Option(min=0, help="Number of valid grasps, from the first; 0: all.")] = 0


def record_episodes(
    base: Shard,
    hand: HandModel,
    obj: ObjectModel,
    placed: PlacedGrasps | None,
    options: EpisodeOptions,
    *,
    pieces: ConvexPieces | None = None,
    film: FilmMaker | None = None,
    empty: bool = False,
    run: ExecutionContext = DEFAULT_CONTEXT,
) -> tuple[dict[str, NDArray[Any]], dict[str, Attribute]]:
    """Execute the valid grasps of a base shard; return columns and attributes of the shard of episodes.
    `placed` are the scenes of all its grasps. Raises InputError: the grasps have no scenes, none is valid (without
    `empty`), or the robot is not as `read_robot` asks."""
    began = perf_counter()
    if placed is None:
        raise InputError(
            f"{base.path or 'the shard'} has free grasps; episodes need a scene: graspd synth --scene table"
        )
    valid = validity.valid_mask(base.arrays) if empty else select_grasps(base)[0]
    rows = np.flatnonzero(valid)[: options.limit or None]
    robot = read_robot(hand, options.arm, mount=options.mount, mount_pose=options.mount_pose, base=options.base)
    grasps, tool = GraspSet.from_columns(base.arrays).take(rows), ToolFrame(hand.root_link, IDENTITY_POSE)
    found = build_executions(hand, obj, grasps, rows=rows, placed=placed.take(rows), tool=tool, quality={})
    convex, done = pieces or decompose(obj), Count(len(found), run, "episodes")
    state, beside = np.zeros((0, len(robot.names))), np.zeros((0, len(placed.neighbours), 7))
    none = Episode(0, 0, EpisodeOutcome.NO_TRANSIT, np.zeros(0, np.uint8), state, state, neighbour_pose=beside)

    def make() -> tuple[MotionPlanner, Simulation, Film | None]:
        planner = MotionPlanner(robot, found, convex, seed=options.seed)
        return planner, Simulation(robot, obj, convex, placed, fps=options.fps), film and film(robot, found)

    def execute(tools: tuple[MotionPlanner, Simulation, Film | None], row: int) -> Episode:
        run.check("the execution of grasps")
        planner, simulation, camera = tools
        motion, shard_row = planner.plan(row), int(rows[row])
        if isinstance(motion, Motion):
            episode = simulation.execute(motion, shard_row)
            episode = episode if camera is None else camera(episode)
        else:
            episode = replace(none, row=shard_row, scene=int(placed.index[shard_row]), outcome=motion)
        done.add(1)
        return episode

    episodes = evaluate_rows(range(len(found)), make, execute, threads=run.cores, name="episode")
    inherited = {name: base.attributes[name] for name in (*INHERITED, *_INHERITED) if name in base.attributes}
    attributes: dict[str, Attribute] = inherited | source_attributes(base) | _robot_attributes(robot, options)
    attributes |= {"seed": options.seed, "fps": options.fps, "device": "cpu"}
    quality = [path for path in SCHEMAS["episodes"] if path.startswith("quality/") and path in base.arrays]
    columns = episode_columns(episodes, none, placed) | {path: np.asarray(base.arrays[path])[rows] for path in quality}
    return columns, attributes | {"seconds": round(perf_counter() - began, 4)}


def replay_episodes(
    shard: Shard, *, hand: str | None = None, obj: str | None = None, run: ExecutionContext = DEFAULT_CONTEXT
) -> list[Episode]:
    """Execute the stored actions of a shard's episodes again; return these with new frames and outcomes.
    Raises NotFoundError: hand, object or arm is not found, see `find_files`. ConflictError: it is another one."""
    model, thing, placed = hand_of_shard(shard, hand), object_of_shard(shard, obj), scenes_of_shard(shard)
    assert placed is not None, "the schema requires scenes"
    robot, pieces = robot_of_shard(shard, model), decompose(thing)
    episodes, fps = episodes_of_shard(shard), float(shard.attributes["fps"])  # type: ignore[arg-type]
    done = Count(len(episodes), run, "replays")

    def replay(simulation: Simulation, number: int) -> Episode:
        run.check("the replay")
        done.add(1)
        return simulation.replay(episodes[number]) if len(episodes[number].state) else episodes[number]

    def make() -> Simulation:
        return Simulation(robot, thing, pieces, placed, fps=fps)

    return evaluate_rows(range(len(episodes)), make, replay, threads=run.cores, name="replay")


def robot_of_shard(shard: Shard, hand: HandModel) -> Robot:
    """Return the robot of a shard. Raises ConflictError: the arm's files changed; NotFoundError."""
    said = {name: str(value) for name, value in shard.attributes.items() if name.startswith("arm")}
    if "arm" not in said:
        return Robot(hand)
    given = {name: said[f"arm_{name}"] for name in ("mount", "mount_pose", "base")}
    robot = read_robot(hand, said.get("arm_source", said["arm"]), **given)
    assert robot.arm is not None
    if robot.arm.model.digest != said["arm_digest"]:
        raise ConflictError(f"the files of the arm {said['arm']} changed since the episodes were recorded")
    return robot


def episode_columns(episodes: list[Episode], none: Episode, placed: PlacedGrasps) -> dict[str, NDArray[Any]]:
    """Return the columns of episodes, except those of the grasps' quality; `none` has no frames."""
    columns: dict[str, NDArray[Any]] = {
        "episode/row": np.array([one.row for one in episodes], np.int32),
        "episode/scene_index": np.array([one.scene for one in episodes], np.int32),
        "episode/outcome": np.array([one.outcome for one in episodes], np.uint8),
        "episode/frames": np.array([len(one.phase) for one in episodes], np.int32),
        "scene/object_pose": np.asarray(placed.object_pose),
    }
    for name in _FRAMES if placed.neighbours else _FRAMES[:-1]:
        parts, dtype = [getattr(one, name) for one in (none, *episodes)], SCHEMAS["episodes"][f"frame/{name}"].dtype
        columns[f"frame/{name}"] = np.concatenate(parts, dtype=dtype, casting="same_kind")
    if placed.neighbours:
        columns["scene/neighbour_pose"] = np.asarray(placed.neighbour_pose)
    for camera in CAMERAS:
        if poses := [one.camera_pose[camera] for one in episodes if camera in one.camera_pose]:
            columns[f"camera/{camera}_pose"] = np.concatenate(poses)
        for name in VIDEOS[camera]:
            files = [one.videos.get(name, b"") for one in episodes]
            if any(files):
                columns[f"video/{name}"] = np.frombuffer(b"".join(files), np.uint8)
                columns[f"video/{name}_bytes"] = np.array([len(file) for file in files], np.int64)
    return columns


def episodes_of_shard(shard: Shard) -> list[Episode]:
    """Return the episodes of a shard, without the poses of neighbours if there are none."""
    counts = np.asarray(shard["episode/frames"])
    ends, parts = np.cumsum(counts)[:-1], dict[str, Any]()
    for name in _FRAMES:
        if (column := shard.arrays.get(f"frame/{name}")) is not None:
            parts[name] = np.split(column if name == "phase" else np.asarray(column, float), ends)
    videos = {
        name: _files(shard, name) for names in VIDEOS.values() for name in names if f"video/{name}" in shard.arrays
    }
    paths = {camera: f"camera/{camera}_pose" for camera in CAMERAS}
    cameras = {
        camera: np.split(np.asarray(shard[path], float), ends) for camera, path in paths.items() if path in shard.arrays
    }
    return [
        Episode(
            row=int(shard["episode/row"][number]),
            scene=int(shard["episode/scene_index"][number]),
            outcome=EpisodeOutcome(int(shard["episode/outcome"][number])),
            videos={name: files[number] for name, files in videos.items()},
            camera_pose={camera: poses[number] for camera, poses in cameras.items()},
            **{name: part[number] for name, part in parts.items()},
        )
        for number in range(len(counts))
    ]


def _files(shard: Shard, video: str) -> list[bytes]:
    ends = np.cumsum(shard[f"video/{video}_bytes"])
    return [part.tobytes() for part in np.split(shard[f"video/{video}"], ends[:-1])]


def _robot_attributes(robot: Robot, options: EpisodeOptions) -> dict[str, Attribute]:
    said: dict[str, Attribute] = {"state_names": list(robot.names)}
    if robot.arm is None or options.arm is None:
        return said
    arm = robot.arm
    said |= {"arm": arm.model.name, "arm_digest": arm.model.digest, "arm_mount": arm.mount}
    said |= {"arm_mount_pose": _pose_text(arm.hand_pose), "arm_base": _pose_text(robot.base)}
    return said if options.arm in BUILTIN_ARMS else said | {"arm_source": str(Path(options.arm).resolve())}


def _pose_text(pose: Floats) -> str:
    return " ".join(map(repr, pose.tolist()))
