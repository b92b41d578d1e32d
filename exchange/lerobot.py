"""A LeRobot data set (v3.0): a grasp's trajectory as an episode, with a picture before the motion.

docs/how-to/exchange/lerobot.md describes the features. A frame is a waypoint of the trajectory, from the standoff to
the squeeze; `action` is the next frame's state, at the end the lift."""

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.exchange.huggingface import png
from graspd.exchange.plan import ExportPart, ExportSummary, PictureReference, group_by_scene
from graspd.service import parquet
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import POSE_PARTS, Floats, compose
from graspd.service.readers import Pictures
from graspd.service.readers.trajectories import trajectory_of

VERSION: Final = "v3.0"
FPS: Final = 10
STATE, ACTION = "observation.state", "action"
OBJECT, PICTURE = "observation.environment_state", "observation.images.scene"
EPISODE: Final = "episode_index"
VERDICT: Final = "graspd/verdict"  # column of verdicts in the list of episodes
#: Times and indices that LeRobot stores for each frame.
NUMBERS: Final = {
    "timestamp": "float32",
    "frame_index": "int64",
    EPISODE: "int64",
    "index": "int64",
    "task_index": "int64",
}
#: Number of episodes in a file, and of files in a folder.
_EPISODES: Final = 100
_FILES: Final = 1000
_QUANTILES: Final = {"q01": 0.01, "q10": 0.1, "q50": 0.5, "q90": 0.9, "q99": 0.99}
#: Metadata for pandas: the texts of the tasks are the index of their table.
_INDEXED: Final = {
    "index_columns": ["task"],
    "column_indexes": [],
    "pandas_version": "2.0.0",
    "columns": [
        {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy, "metadata": None}
        for name, kind, numpy in (("task_index", "int64", "int64"), ("task", "unicode", "object"))
    ],
}


def write(lots: Sequence[ExportPart], pictures: Pictures, folder: Path, out: frozenset[str]) -> ExportSummary:
    """Write an episode per grasp, with a picture of its scene (round-robin); held-out objects come last.
    Raises InputError: no picture shows a grasp planned in a scene, or hands or picture sizes differ."""
    parquet.import_pyarrow()
    if (folder / "meta").exists():
        raise InputError(f"{folder} holds a data set already; give another folder as --output")
    if len({lot.hand.digest for lot in lots}) > 1:
        raise InputError("a LeRobot data set has one robot, but there are several hands; export each separately")
    ways = [lot for lot in sorted(lots, key=lambda lot: lot.name in out) if lot.placed is not None]
    if not ways:
        raise InputError("free grasps have no approach; plan grasps in a scene: --scene table")
    seen = {(some[0].base, some[0].scene): some for some in group_by_scene(pictures)}
    episodes = [(lot, row, look) for lot in ways for row, look in _pictured_rows(lot, seen)]
    if not episodes:
        raise InputError("no picture shows the scene of a grasp; render views into the grasps' folder: graspd render")
    tasks = {name: k for k, name in enumerate(dict.fromkeys(lot.name for lot, _, _ in episodes))}
    writer = _Writer(folder, ways[0], pictures, tasks)
    for first in range(0, len(episodes), _EPISODES):
        writer.write_file(episodes[first : first + _EPISODES])
    writer.write_meta(sum(lot.name not in out for lot, _, _ in episodes))
    done = ExportSummary({"grasps": len(episodes), "frames": writer.frames, "files": -(-len(episodes) // _EPISODES)})
    if left := sum(len(lot.rows) for lot in lots) - len(episodes):
        done.notes.append(f"{left} grasps are left out: they are free, or no picture shows their scene")
    return done


def _pictured_rows(
    lot: ExportPart, seen: Mapping[tuple[str, int], list[PictureReference]]
) -> Iterator[tuple[int, PictureReference]]:
    assert lot.placed is not None
    for k, row in enumerate(lot.rows.tolist()):
        if found := seen.get((lot.id, int(lot.placed.index[row]))):
            yield row, found[k % len(found)]


def postures_of(lot: ExportPart, row: int) -> Floats:
    """Return a grasp's trajectory (W, 7 + J) of root poses and joints, in the table's frame."""
    assert lot.placed is not None
    rest = np.asarray(lot.placed.object_pose[lot.placed.index[row]], float)
    way = trajectory_of(lot.shard, row)
    return np.array([np.concatenate([compose(rest, at.hand_pose), at.joint_positions]) for at in way])


class _Writer:
    """Writer of episodes in sequence, and then of the files in `meta`."""

    def __init__(self, folder: Path, lot: ExportPart, pictures: Pictures, tasks: dict[str, int]) -> None:
        self.folder, self.hand, self.pictures, self.tasks = folder, lot.hand, pictures, tasks
        self.frames, self.episodes = 0, list[dict[str, Any]]()
        self._size: tuple[int, ...] = ()
        self._values: dict[str, list[NDArray[Any]]] = {}

    def write_file(self, episodes: Sequence[tuple[ExportPart, int, PictureReference]]) -> None:
        """Write a file with one row group per episode."""
        number = len(self.episodes) // _EPISODES
        width = 7 + len(self.hand.joint_names)
        moving = {STATE: f"float32[{width}]", ACTION: f"float32[{width}]"}
        columns = {**moving, OBJECT: "float32[7]", PICTURE: parquet.IMAGE, **NUMBERS}
        chunk, file = divmod(number, _FILES)
        place = {"data/chunk_index": chunk, "data/file_index": file}
        path = self.folder / "data" / f"chunk-{chunk:03}" / f"file-{file:03}.parquet"
        parquet.write(path, parquet.arrow_schema(columns), (self._episode(*one, place) for one in episodes))

    def _episode(
        self, lot: ExportPart, row: int, look: PictureReference, place: Mapping[str, int]
    ) -> list[dict[str, Any]]:
        way = postures_of(lot, row).astype(np.float32)
        colour = np.asarray(self.pictures[look.index]["image/rgb"])
        if self._size not in ((), colour.shape):
            raise InputError(f"pictures of {colour.shape[:2]} and {self._size[:2]} pixels do not fit into one data set")
        self._size = colour.shape
        picture, number, count = png(colour), len(self.episodes), len(way) - 1
        rest = look.object_pose.astype(np.float32)
        numbers: dict[str, NDArray[Any]] = {
            "timestamp": (np.arange(count) / FPS).astype(np.float32),
            "frame_index": np.arange(count),
            EPISODE: np.full(count, number),
            "index": self.frames + np.arange(count),
            "task_index": np.full(count, self.tasks[lot.name]),
        }
        values = {STATE: way[:-1], ACTION: way[1:], OBJECT: np.tile(rest, (count, 1)), **numbers}
        for name, some in values.items():
            self._values.setdefault(name, []).append(some.reshape(len(some), -1))
        # A tenth of the pixels is enough for statistics of colours.
        self._values.setdefault(PICTURE, []).append(colour.reshape(-1, colour.shape[-1])[::10] / 255)
        self.episodes.append(
            {
                EPISODE: number,
                "tasks": [task_text(lot.name)],
                "length": count,
                **place,
                "dataset_from_index": self.frames,
                "dataset_to_index": self.frames + count,
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
                "graspd/shard": lot.id,
                "graspd/row": row,
                VERDICT: int(lot.verdict[row]),
            }
        )
        self.frames += count
        still = {OBJECT: rest.tolist(), PICTURE: picture}
        rows = []
        for k in range(count):
            moving = {STATE: way[k].tolist(), ACTION: way[k + 1].tolist()}
            rows.append(moving | still | {name: values[k].item() for name, values in numbers.items()})
        return rows

    def write_meta(self, train: int) -> None:
        meta, total = self.folder / "meta", len(self.episodes)
        meta.mkdir(parents=True)
        splits = {"train": f"0:{train}"} | ({"test": f"{train}:{total}"} if train < total else {})
        info = {
            "codebase_version": VERSION,
            "robot_type": self.hand.name,
            "total_episodes": total,
            "total_frames": self.frames,
            "total_tasks": len(self.tasks),
            "chunks_size": _FILES,
            "fps": FPS,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 500,
            "splits": splits,
            "video_path": None,
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "features": self._features(),
        }
        (meta / "info.json").write_text(json.dumps(info, indent=4) + "\n")
        stats = {key: _statistics(np.concatenate(some), picture=key == PICTURE) for key, some in self._values.items()}
        (meta / "stats.json").write_text(json.dumps(stats, indent=4) + "\n")
        schema = parquet.arrow_schema({"task_index": "int64", "task": "text"}, {"pandas": json.dumps(_INDEXED)})
        rows = [{"task_index": number, "task": task_text(name)} for name, number in self.tasks.items()]
        parquet.write(meta / "tasks.parquet", schema, [rows])
        words = {"tasks": "text[]", "graspd/shard": "text"}
        columns = {name: words.get(name, "int64") for name in self.episodes[0]}
        path = meta / "episodes" / "chunk-000" / "file-000.parquet"
        parquet.write(path, parquet.arrow_schema(columns), [self.episodes])

    def _features(self) -> dict[str, Any]:
        names = [*POSE_PARTS, *self.hand.joint_names]
        moving = {"dtype": "float32", "shape": [len(names)], "names": names}
        return {
            STATE: moving,
            ACTION: moving,
            OBJECT: {"dtype": "float32", "shape": [7], "names": list(POSE_PARTS)},
            PICTURE: {"dtype": "image", "shape": list(self._size), "names": ["height", "width", "channels"]},
            **{name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in NUMBERS.items()},
        }


def task_text(name: str) -> str:
    return f"lift the {name}"


def _statistics(values: NDArray[Any], *, picture: bool) -> dict[str, Any]:
    """Return statistics: of shape (n,) for frames (F, n), of shape (3, 1, 1) for pixels (P, 3)."""
    values = np.asarray(values, float)
    found = {name: getattr(values, name)(axis=0) for name in ("min", "max", "mean", "std")}
    found |= {name: np.quantile(values, share, axis=0) for name, share in _QUANTILES.items()}
    shaped = {name: (one[:, None, None] if picture else one).tolist() for name, one in found.items()}
    return shaped | {"count": [len(values)]}
