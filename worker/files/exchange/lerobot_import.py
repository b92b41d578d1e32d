"""Grasps back from a LeRobot data set of ours, see `lerobot`: the way of each episode, in its object's frame."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from service import parquet
from service.model.base import why
from service.model.errors import InputError
from service.model.transforms import POSE_PARTS, Floats, compose, invert
from worker.files.exchange.bench_scene import placed_of
from worker.files.exchange.imported import Imported, joints_by_name, verdicts
from worker.files.exchange.lerobot import ACTION, EPISODE, OBJECT, STATE, VERDICT, task_of
from worker.files.exchange.objects import scaled_object
from worker.grasps import GraspSet, Posture
from worker.hands.load import hand_from_path

#: Postures that end a way: pregrasp, grasp, squeeze, lift.
_STOPS = 4
#: What `info.json` may take [bytes].
_LARGEST = 2**22


def read(path: Path, *, hand: str, obj: str, object_name: str = "") -> list[Imported]:
    """The grasps on one object, on tables, with their ways as far as all episodes have as many waypoints.

    Args:
        path: the data set.
        hand: URDF or built-in hand; joints are found by name.
        obj: mesh of the object.
        object_name: as the tasks name it; may be left out where there is one task.

    Raises:
        InputError: pyarrow is absent, no such data set or object, or one that graspd did not write.
    """
    names = _names(path)
    task = _task(path, object_name)
    ways, rest, numbers = _ways(path, task)
    if not len(ways) or min(map(len, ways)) < _STOPS:
        raise InputError(f"{path} has no episodes of the task {task_of(object_name)!r} with a whole way")
    model, thing = hand_from_path(hand), scaled_object(obj)

    def posture(qpos: Floats) -> Posture:
        pose = qpos[:, :7].copy()
        # float32 leaves quaternions a little off the unit sphere.
        pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
        return Posture(compose(invert(rest), pose), joints_by_name(model, names, qpos[:, 7:], what=str(path)))

    pregrasp, grasp, squeeze, lift = (posture(np.array([way[k] for way in ways])) for k in range(-_STOPS, 0))
    grasps = GraspSet(grasp, pregrasp, squeeze, np.full(len(ways), np.nan))
    placed = placed_of(rest)
    grasps.scene, grasps.lift = placed.index, lift
    if len({len(way) for way in ways}) == 1 and len(ways[0]) > _STOPS:
        coming = [posture(np.array([way[k] for way in ways])) for k in range(len(ways[0]) - _STOPS)]
        grasps.approach = np.stack([at.hand_pose for at in coming], axis=1)
        grasps.coming = coming[-1].joint_positions
    return [Imported(model, thing, grasps, object_name or thing.name, 1.0, _verdicts(path, numbers), placed)]


def _names(path: Path) -> list[str]:
    """The joints that states have, in their order."""
    file = path / "meta" / "info.json"
    try:
        with file.open("rb") as stream:
            names = [str(name) for name in json.loads(stream.read(_LARGEST))["features"][STATE]["names"]]
    except (OSError, ValueError, KeyError, TypeError, RecursionError) as error:
        raise InputError(f"{file} is no description of a LeRobot data set: {why(error)}") from None
    if tuple(names[:7]) != POSE_PARTS:
        raise InputError(f"{path} is no data set of ours: its states do not begin with {', '.join(POSE_PARTS)}")
    return names[7:]


def _task(path: Path, object_name: str) -> int:
    found = parquet.read(path / "meta" / "tasks.parquet", ("task", "task_index"))
    words, numbers = found.get("task", []), found.get("task_index", [])
    if not object_name and len(numbers) == 1:
        return int(numbers[0])
    if task_of(object_name) not in words:
        raise InputError(f"{path} has the tasks {', '.join(map(str, words[:8]))}; name an object of them: --name")
    return int(numbers[words.index(task_of(object_name))])


def _ways(path: Path, task: int) -> tuple[list[Floats], Floats, list[int]]:
    """Of each episode of a task all postures (W, 7 + J), the object's pose, and its number."""
    ways: list[Floats] = []
    rest: list[Floats] = []
    numbers: list[int] = []
    wanted = (STATE, ACTION, OBJECT, EPISODE, "frame_index", "task_index")
    for file in sorted((path / "data").glob("*/*.parquet")):
        found: dict[str, Any] = parquet.read(file, wanted)
        try:
            episode, frame, kind = (np.asarray(found[name], np.int64) for name in wanted[3:])
            for number in np.unique(episode[kind == task]):
                rows = np.flatnonzero(episode == number)
                rows = rows[np.argsort(frame[rows], kind="stable")]
                way = [found[STATE][k] for k in rows] + [found[ACTION][rows[-1]]]
                ways.append(np.array(way, float))
                rest.append(np.array(found[OBJECT][rows[0]], float).reshape(7))
                numbers.append(int(number))
        except (KeyError, ValueError, TypeError) as error:
            raise InputError(f"{file} is no file of frames of ours: {error}") from None
    place = np.array(rest).reshape(len(rest), 7)
    place[:, 3:] /= np.maximum(np.linalg.norm(place[:, 3:], axis=1, keepdims=True), 1e-12)
    return ways, place, numbers


def _verdicts(path: Path, episodes: list[int]) -> NDArray[np.int8] | None:
    """(N,) as the list of episodes tells them."""
    found: dict[Any, Any] = {}
    for file in sorted((path / "meta" / "episodes").glob("*/*.parquet")):
        columns = parquet.read(file, (EPISODE, VERDICT))
        if VERDICT in columns and EPISODE in columns:
            found |= dict(zip(columns[EPISODE], columns[VERDICT], strict=True))
    return verdicts([found.get(number) for number in episodes]) if found else None
