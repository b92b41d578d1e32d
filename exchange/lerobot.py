"""A LeRobot data set (v3.0) of executed episodes: states, actions, filmed video, tasks in words.

The videos are those of the shards: packets are copied, not encoded again. docs/how-to/exchange/lerobot.md describes the
features."""

import io
import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic_core import from_json

from graspd.exchange.plan import ExportSummary, plain_name
from graspd.service import parquet
from graspd.service.model.contact_region import parse_region
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import POSE_PARTS
from graspd.service.readers import Shards
from graspd.service.store.columns import CAMERAS
from graspd.service.store.shards import Shard, read_shard
from graspd.worker.episodes.episode import Episode, EpisodeOutcome
from graspd.worker.episodes.film import import_av
from graspd.worker.episodes.shard import episodes_of_shard
from graspd.worker.files.provenance import object_of_shard
from graspd.worker.objects.model import ObjectModel

VERSION: Final = "v3.0"
STATE, ACTION = "observation.state", "action"
OBJECT, PICTURE = "observation.environment_state", "observation.images."
EPISODE, SUCCESS = "episode_index", "next.success"
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
_TYPES: Final = {1: "power", 2: "precision", 3: "lateral"}
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


@dataclass(frozen=True)
class EpisodesPart:
    """Exported episodes of one shard."""

    id: str
    name: str  # name of the object
    obj: ObjectModel
    shard: Shard
    numbers: tuple[int, ...]

    @property
    def robot(self) -> tuple[Any, ...]:
        said = self.shard.attributes
        return said["hand_digest"], said.get("arm_digest"), tuple(said["state_names"]), said["fps"], self.sizes  # type: ignore[arg-type]

    @property
    def sizes(self) -> tuple[tuple[str, int, int], ...]:
        """Name, height and width of each camera."""
        cameras = from_json(str(self.shard.attributes.get("cameras", "{}")))
        return tuple((name, cameras[name]["height"], cameras[name]["width"]) for name in CAMERAS if name in cameras)


def episode_parts(shards: Shards, obj: str | None, *, every: bool) -> list[EpisodesPart]:
    """Return the successful episodes of all shards, or `every` executed one.
    Raises InputError: there are none, or they are of several robots, rates or cameras."""
    parts = []
    for file in shards.of_kind("episodes"):
        shard = read_shard(shards.path(file), kind="episodes")
        chosen = np.asarray(shard["episode/frames"], int) > 0
        if not every:
            chosen &= shard["episode/outcome"] == EpisodeOutcome.SUCCEEDED
        if chosen.any():
            thing = object_of_shard(shard, obj)
            parts.append(EpisodesPart(file.id, plain_name(thing.name), thing, shard, tuple(np.flatnonzero(chosen))))
    if not parts:
        raise InputError("there is no successful episode; record some: graspd episodes create")
    if len({part.robot for part in parts}) > 1:
        raise InputError("a LeRobot data set has one robot, rate and set of cameras; export other episodes separately")
    return parts


def write(parts: Sequence[EpisodesPart], folder: Path, out: frozenset[str]) -> ExportSummary:
    """Write all episodes; those of held-out objects come last. InputError: the folder has a data set."""
    parquet.import_pyarrow()
    if (folder / "meta").exists():
        raise InputError(f"{folder} holds a data set already; give another folder as --output")
    ordered = sorted(parts, key=lambda part: part.name in out)
    writer = _Writer(folder, ordered[0])
    episodes = ((part, number, one) for part in ordered for number, one in _chosen(part))
    while writer.write_file(episodes):
        pass
    writer.write_meta(sum(len(part.numbers) for part in parts if part.name not in out))
    counts = {"episodes": len(writer.episodes), "frames": writer.frames, "files": writer.files}
    return ExportSummary({**counts, "tasks": len(writer.tasks)})


def _chosen(part: EpisodesPart) -> Iterator[tuple[int, Episode]]:
    episodes = episodes_of_shard(part.shard)
    return ((number, episodes[number]) for number in part.numbers)


def task_text(part: EpisodesPart, number: int) -> str:
    """Return the task in words: object, required part of the object, type of the grasp."""
    required = from_json(str(part.shard.attributes.get("requirements", "{}")))
    region = parse_region(required["touch_region"]).part if required.get("touch_region") else ""
    kind = _TYPES.get(int(part.shard.arrays.get("quality/grasp_type", np.zeros(number + 1))[number]))
    where, how = f" by its {region}" if region else "", f" with a {kind} grasp" if kind else ""
    return f"pick the {part.name.replace('_', ' ')}{where}{how}"


class _Writer:
    """Writer of episodes in sequence, and then of the files in `meta`."""

    def __init__(self, folder: Path, first: EpisodesPart) -> None:
        self.folder, self.sizes, said = folder, first.sizes, first.shard.attributes
        self.fps, self.names = int(str(said["fps"]).removesuffix(".0")), list(said["state_names"])  # type: ignore[arg-type]
        self.robot = "-".join(str(said[name]) for name in ("arm", "hand") if name in said)
        self.frames, self.files, self.episodes, self.tasks = 0, 0, list[dict[str, Any]](), dict[str, int]()
        self._values: dict[str, list[NDArray[Any]]] = {}

    def write_file(self, episodes: Iterator[tuple[EpisodesPart, int, Episode]]) -> bool:
        """Write up to `_EPISODES` episodes as a table, with a row group each, and a video per camera."""
        some = [one for _, one in zip(range(_EPISODES), episodes, strict=False)]
        if not some:
            return False
        chunk, file = divmod(self.files, _FILES)
        self.files += 1
        first, place = len(self.episodes), f"chunk-{chunk:03}/file-{file:03}"
        floats = {STATE: f"float32[{len(self.names)}]", ACTION: f"float32[{len(self.names)}]", OBJECT: "float32[7]"}
        schema = parquet.arrow_schema({**floats, SUCCESS: "bool_", **NUMBERS})
        groups = (self._episode(*one, {"chunk_index": chunk, "file_index": file}) for one in some)
        parquet.write(self.folder / f"data/{place}.parquet", schema, groups)
        for camera, *_ in self.sizes:
            path = self.folder / f"videos/{PICTURE}{camera}/{place}.mp4"
            frames = _join_videos([one.videos[camera] for _, _, one in some], path)
            self._values.setdefault(PICTURE + camera, []).append(frames)
            begun = 0
            for row, (_, _, one) in zip(self.episodes[first:], some, strict=True):
                ended = begun + len(one.state)
                times = {"from_timestamp": begun / self.fps, "to_timestamp": ended / self.fps}
                row |= {f"videos/{PICTURE}{camera}/{name}": value for name, value in times.items()}
                begun = ended
        return True

    def _episode(self, part: EpisodesPart, number: int, one: Episode, place: Mapping[str, int]) -> list[dict[str, Any]]:
        index, count, text = len(self.episodes), len(one.state), task_text(part, number)
        success = one.outcome is EpisodeOutcome.SUCCEEDED
        values: dict[str, NDArray[Any]] = {
            STATE: one.state.astype(np.float32),
            ACTION: one.action.astype(np.float32),
            OBJECT: one.object_pose.astype(np.float32),
            SUCCESS: (np.arange(count) == count - 1) & success,
            "timestamp": (np.arange(count) / self.fps).astype(np.float32),
            "frame_index": np.arange(count),
            EPISODE: np.full(count, index),
            "index": self.frames + np.arange(count),
            "task_index": np.full(count, self.tasks.setdefault(text, len(self.tasks))),
        }
        for name, some in values.items():
            self._values.setdefault(name, []).append(some.reshape(count, -1))
        kind, payload = (part.shard.arrays.get(f"quality/{name}") for name in ("grasp_type", "payload_kg"))
        self.episodes.append(
            {
                EPISODE: index,
                "tasks": [text],
                "length": count,
                "dataset_from_index": self.frames,
                "dataset_to_index": self.frames + count,
                **{f"data/{name}": value for name, value in place.items()},
                **{f"videos/{PICTURE}{camera}/{name}": place[name] for camera, *_ in self.sizes for name in place},
                "meta/episodes/chunk_index": 0,
                "meta/episodes/file_index": 0,
                "graspd/shard": part.id,
                "graspd/base_shard": str(part.shard.attributes.get("base_shard", "")),
                "graspd/row": one.row,
                "graspd/outcome": one.outcome.name.lower(),
                "graspd/grasp_type": 0 if kind is None else int(kind[number]),
                "graspd/payload_kg": np.nan if payload is None else float(payload[number]),
            }
        )
        self.frames += count
        columns = {name: some.tolist() for name, some in values.items()}
        return [{name: column[k] for name, column in columns.items()} for k in range(count)]

    def write_meta(self, train: int) -> None:
        meta, total = self.folder / "meta", len(self.episodes)
        meta.mkdir(parents=True)
        video = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
        splits = {"train": f"0:{train}"} | ({"test": f"{train}:{total}"} if train < total else {})
        info = {
            "codebase_version": VERSION,
            "robot_type": self.robot,
            "total_episodes": total,
            "total_frames": self.frames,
            "total_tasks": len(self.tasks),
            "chunks_size": _FILES,
            "fps": self.fps,
            "data_files_size_in_mb": 100,
            "video_files_size_in_mb": 200,
            "splits": splits,
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": video if self.sizes else None,
            "features": self._features(),
        }
        (meta / "info.json").write_text(json.dumps(info, indent=4) + "\n")
        stats = {name: _statistics(np.concatenate(some)) for name, some in self._values.items()}
        (meta / "stats.json").write_text(json.dumps(stats, indent=4) + "\n")
        schema = parquet.arrow_schema({"task_index": "int64", "task": "text"}, {"pandas": json.dumps(_INDEXED)})
        rows = [{"task_index": number, "task": text} for text, number in self.tasks.items()]
        parquet.write(meta / "tasks.parquet", schema, [rows])
        kinds = {list: "text[]", str: "text", float: "float64"}
        columns = {name: kinds.get(type(value), "int64") for name, value in self.episodes[0].items()}
        path = meta / "episodes" / "chunk-000" / "file-000.parquet"
        parquet.write(path, parquet.arrow_schema(columns), [self.episodes])

    def _features(self) -> dict[str, Any]:
        moving = {"dtype": "float32", "shape": [len(self.names)], "names": self.names}
        stored = {"fps": self.fps, "codec": "av1", "pix_fmt": "yuv420p", "is_depth_map": False, "has_audio": False}
        videos = {
            PICTURE + camera: {
                "dtype": "video",
                "shape": [height, width, 3],
                "names": ["height", "width", "channels"],
                "info": {"video.height": height, "video.width": width, "video.channels": 3}
                | {name if name == "has_audio" else f"video.{name}": value for name, value in stored.items()},
            }
            for camera, height, width in self.sizes
        }
        return {
            STATE: moving,
            ACTION: moving,
            OBJECT: {"dtype": "float32", "shape": [7], "names": list(POSE_PARTS)},
            **videos,
            SUCCESS: {"dtype": "bool", "shape": [1], "names": None},
            **{name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in NUMBERS.items()},
        }


def _join_videos(videos: Sequence[bytes], path: Path) -> NDArray[np.float64]:
    """Write videos in sequence; return a tenth of the pixels of their key frames (P, 3, 1, 1) in 0..1."""
    av = import_av()
    path.parent.mkdir(parents=True, exist_ok=True)
    begun, pixels = 0, list[NDArray[np.uint8]]()
    with av.open(str(path), "w") as out:
        stream = None
        for video in videos:
            with av.open(io.BytesIO(video)) as source:
                given = source.streams.video[0]
                stream = stream or out.add_stream_from_template(given, opaque=True)
                step = round(1 / (given.average_rate * given.time_base))
                for packet in source.demux(given):
                    if packet.size:
                        packet.stream, packet.pts, packet.dts = stream, packet.pts + begun, packet.dts + begun
                        out.mux(packet)
                begun += given.frames * step
            with av.open(io.BytesIO(video)) as source:
                source.streams.video[0].codec_context.skip_frame = "NONKEY"
                pixels += [one.to_ndarray(format="rgb24").reshape(-1, 3)[::10] for one in source.decode(video=0)]
    return np.concatenate(pixels)[..., None, None] / 255


def _statistics(values: NDArray[Any]) -> dict[str, Any]:
    """Return statistics over the first axis."""
    values = np.asarray(values, float)
    found = {name: getattr(values, name)(axis=0) for name in ("min", "max", "mean", "std")}
    found |= {name: np.quantile(values, share, axis=0) for name, share in _QUANTILES.items()}
    return {name: one.tolist() for name, one in found.items()} | {"count": [len(values)]}
