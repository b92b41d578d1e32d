"""Grasps of one hand as arrays, with postures, metrics and verdicts."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, overload

import numpy as np
from numpy.typing import NDArray

from graspd.service.cli import write_output
from graspd.service.model.errors import InputError
from graspd.service.model.metrics import GRASP_METRICS, GraspMetric
from graspd.service.model.transforms import Floats, compose
from graspd.service.readers.files import Shards, open_shards
from graspd.service.store import validity
from graspd.service.store.columns import SCHEMAS, Attribute
from graspd.service.store.manifests import INDEX_THRESHOLD_M
from graspd.service.store.shards import Shard, read_shard, write_shard

if TYPE_CHECKING:
    from PIL.Image import Image

    from graspd.worker.viewing import Viewer

Array = NDArray[Any]
#: Rows to select: a mask (N,) or row numbers.
Rows = NDArray[Any] | Sequence[int] | Sequence[bool]

_METRICS: Final = {metric.name: metric for metric in GRASP_METRICS}
_PER_GRASP: Final = {"object", *(path for path, it in SCHEMAS["base"].items() if it.shape.split()[0] == "N")}
_THRESHOLDS: Final = "quality/thresholds_m"
_SCENES: Final = ("scene/object_pose", "scene/rest_probability")
_INDEX: Final = "grasp/scene_index"


@dataclass(frozen=True)
class Postures:
    """Hand postures in the object frame."""

    hand_pose: Floats
    """(N, 7) pose of the hand's root link: x y z [m], then unit quaternion w x y z."""
    joint_positions: Floats
    """(N, J) [rad or m], order in `Grasps.joint_names`."""

    def __repr__(self) -> str:
        return f"<{len(self.hand_pose)} postures of {self.joint_positions.shape[-1]} joints>"


@dataclass(frozen=True)
class Grasp:
    """One grasp."""

    hand_pose: Floats
    """(7,) pose of the hand's root link in the object frame: x y z [m], then unit quaternion w x y z."""
    joints: dict[str, float]
    """Position of each joint at contact [rad or m]."""
    valid: bool
    """Whether it is valid, see `Grasps.is_valid`."""
    metrics: dict[str, float]
    """Value of each metric; per-threshold metrics at 5 mm."""

    def __repr__(self) -> str:
        x, y, z = self.hand_pose[:3]
        said = f"epsilon {self.metrics['epsilon']:.3g}, " if "epsilon" in self.metrics else ""
        valid = "valid" if self.valid else "not valid"
        return f"<grasp at ({x:.3f}, {y:.3f}, {z:.3f}) m, {len(self.joints)} joints, {said}{valid}>"


class Grasps:
    """N grasps of one hand, in the order of the file or of `top`.

    Columns have the names, shapes, units and frames of docs/reference/dataset.md.
    """

    def __init__(
        self, columns: Mapping[str, Array], attributes: Mapping[str, Attribute], path: Path | None = None
    ) -> None:
        self._columns = dict(columns)
        #: Path of the file; meshes are searched for in its folder.
        self._path = path
        self._attributes = dict(attributes)
        if "object" not in self._columns:
            self._columns["object"] = np.full(len(columns["grasp/hand_pose"]), str(attributes.get("object", "")))

    def __len__(self) -> int:
        return len(self._columns["grasp/hand_pose"])

    def __repr__(self) -> str:
        names = ", ".join(self.objects)
        return f"<{len(self)} grasps of {self.hand} on {names or 'nothing'}, {int(self.is_valid.sum())} valid>"

    def _repr_html_(self) -> str:
        from graspd.display import grasps_html

        return grasps_html(self)

    def __iter__(self) -> Iterator[Grasp]:
        return (self[i] for i in range(len(self)))

    @overload
    def __getitem__(self, rows: int) -> Grasp: ...
    @overload
    def __getitem__(self, rows: slice | Rows) -> Grasps: ...
    def __getitem__(self, rows: Any) -> Any:
        """Return one grasp by number, or several by a slice, a mask (N,) or numbers."""
        if isinstance(rows, int | np.integer):
            if not -len(self) <= rows < len(self):
                raise IndexError(f"there is no grasp {rows}; of {len(self)} the last is {len(self) - 1}")
            return self._grasp_at(int(rows) % len(self))
        chosen = rows if isinstance(rows, slice) else np.asarray(rows)
        if isinstance(chosen, np.ndarray) and not len(chosen):
            chosen = chosen.astype(int)
        kept = {path: data[chosen] if path in _PER_GRASP else data for path, data in self._columns.items()}
        return Grasps(kept, self._attributes, self._path)

    @property
    def hand(self) -> str:
        """Name of the hand."""
        return str(self._attributes.get("hand", ""))

    @property
    def objects(self) -> list[str]:
        """Names of the objects, each once, in order of appearance."""
        return list(dict.fromkeys(str(name) for name in self._columns["object"]))

    @property
    def joint_names(self) -> list[str]:
        """(J) names of the hand's moving joints, in the order of all joint positions."""
        names = self._attributes.get("joint_names", [])
        return [str(name) for name in names] if isinstance(names, list) else []

    @property
    def attributes(self) -> dict[str, Attribute]:
        """Attributes of the file: method, fidelity, seed, digests (docs/reference/dataset.md)."""
        return dict(self._attributes)

    @property
    def reason(self) -> str | None:
        """Reason why there are fewer grasps than requested, as a sentence; None otherwise."""
        said = self._attributes.get("reason")
        return None if said is None else str(said)

    @property
    def outcomes(self) -> dict[str, int]:
        """Numbers of rejected candidates by outcome (docs/explanation/quality.md)."""
        return {name: int(count) for name, count in json.loads(str(self._attributes.get("outcomes", "{}"))).items()}

    @property
    def hand_pose(self) -> Floats:
        """(N, 7) root link at contact, in the object frame: x y z [m], unit quaternion w x y z."""
        return self.column("grasp/hand_pose")

    @property
    def joint_positions(self) -> Floats:
        """(N, J) joint positions at contact [rad or m], order in `joint_names`."""
        return self.column("grasp/joint_positions")

    @property
    def pregrasp(self) -> Postures:
        """Postures before contact, fingers clear of the object."""
        return Postures(self.column("pregrasp/hand_pose"), self.column("pregrasp/joint_positions"))

    @property
    def squeeze(self) -> Postures:
        """Commanded postures that press on the object."""
        return Postures(self.column("squeeze/hand_pose"), self.column("squeeze/joint_positions"))

    @property
    def approach(self) -> Floats:
        """(N, W, 7) root poses from the standoff to the pregrasp; only for grasps planned in a scene."""
        return self.column("grasp/approach")

    @property
    def lift(self) -> Postures:
        """Squeeze postures raised by 10 cm; only for grasps planned in a scene."""
        return Postures(self.column("grasp/lift"), self.column("squeeze/joint_positions"))

    @property
    def object_pose(self) -> Floats:
        """(N, 7) object in each grasp's scene, z up; only for grasps planned in a scene."""
        return self.column("scene/object_pose")[self.column(_INDEX)]

    @property
    def hand_pose_in_scene(self) -> Floats:
        """(N, 7) `hand_pose` in each grasp's scene, z up; only for grasps planned in a scene."""
        return compose(self.object_pose, self.hand_pose)

    @property
    def is_valid(self) -> NDArray[np.bool_]:
        """(N,) whether each grasp is feasible and held in validation; in a scene, lifted."""
        return validity.valid_mask(self._columns)

    @property
    def is_feasible(self) -> NDArray[np.bool_]:
        """(N,) whether each grasp is within the limits of penetration and contact."""
        return validity.feasible_mask(self._columns)

    @property
    def metrics(self) -> list[str]:
        """Names accepted by `metric` and `top`."""
        return [metric.name for metric in GRASP_METRICS if metric.path in self._columns]

    def metric(self, name: str, *, threshold_m: float = INDEX_THRESHOLD_M) -> Array:
        """Return a metric (N,); nan where it was not measured.

        Args:
            name: one of `metrics`, such as epsilon or contact_area_cm2.
            threshold_m: contact threshold [m]; the nearest threshold in the file is used.
        Raises:
            InputError: the file has no such metric.
        """
        known = self._find_metric(name)
        values = self._columns[known.path]
        if not known.swept:
            return values
        return values[:, int(np.argmin(np.abs(self._columns[_THRESHOLDS] - threshold_m)))]

    @property
    def columns(self) -> dict[str, Array]:
        """All columns by name (docs/reference/dataset.md), and `object` (N,): the object's name."""
        return dict(self._columns)

    def column(self, path: str) -> Array:
        """Return a column of docs/reference/dataset.md, such as quality/verdict_margin.

        Raises:
            InputError: the file has no such column.
        """
        if path not in self._columns:
            raise InputError(f"these grasps have no column {path!r}; they have {', '.join(sorted(self._columns))}")
        return self._columns[path]

    def valid(self) -> Grasps:
        """Select the valid grasps."""
        return self[self.is_valid]

    def where(self, rows: Rows | Callable[[Grasps], Rows]) -> Grasps:
        """Select by a mask (N,), by row numbers, or by a function that returns one of these.

        Example: `grasps.where(lambda g: g.metric("epsilon") > 0.3)`.
        """
        return self[np.asarray(rows(self) if callable(rows) else rows)]

    def top(self, metric: str, count: int) -> Grasps:
        """Select the best grasps by a metric, best first; grasps without a value are omitted.

        Raises:
            InputError: the file has no such metric, or `count` is negative.
        """
        if count < 0:
            raise InputError(f"top {metric} of {count}: the number of grasps must be at least 0")
        values = np.asarray(self.metric(metric), float)
        order = np.argsort(values if self._find_metric(metric).less_is_better else -values, kind="stable")
        return self[order[np.isfinite(values[order])][:count]]

    def to_pandas(self) -> Any:
        """Return a `pandas.DataFrame` with one row per grasp.

        Columns: `object`, `valid`; `x y z` [m] and the unit quaternion `qw qx qy qz` of `hand_pose` in the object
        frame; each joint by its name [rad or m]; each metric by its name, per-threshold metrics at 5 mm; other numbers
        by the last part of their column's name. The same names with the prefix `pregrasp.`, `squeeze.` or `lift.`
        describe these postures. A joint whose name is already taken gets the prefix `joint.`.

        Raises:
            InputError: pandas is not installed.
        """
        from graspd.display import data_frame_of

        return data_frame_of(self)

    def plot(self, count: int = 4, *, edge: int = 320) -> Image:
        """Draw the best grasps by epsilon on one sheet, valid ones first, each in a square of `edge` pixels.

        Raises:
            InputError: there are no grasps, or they are on several objects.
            NotFoundError: the file of the hand or the object is not found.
        """
        import PIL.Image

        from graspd.display import sheet_png

        return PIL.Image.open(io.BytesIO(sheet_png(self, count, edge)))

    def view(self, *, host: str = "127.0.0.1", port: int = 8080) -> Viewer:
        """Serve the grasps in 3D to a browser until `close()` of the result; `url` is its address.

        Args:
            host: address to serve on; anyone who can reach it can view the grasps.
            port: the first port to try; 0: any free port.

        Raises:
            InputError: viser is not installed (`graspd[view]`), there are no grasps, they are on several objects, or
                the address cannot be used.
            NotFoundError: the file of the hand or the object is not found.
        """
        from graspd.display import start_viewer

        return start_viewer(self, host=host, port=port)

    def shard(self) -> Shard:
        """Return the grasps as a base shard, with the content that `save` writes.

        Raises:
            InputError: they are on several objects.
        """
        if len(self.objects) > 1:
            raise InputError(f"a file holds grasps on one object; these are on {', '.join(self.objects)}")
        # With several files, the attributes are those of the first file, and do not describe another object.
        if self.objects and self.objects != [str(self._attributes.get("object", ""))]:
            fix = f"open the file of {self.objects[0]} alone"
            raise InputError(f"these grasps were selected from several objects; {fix}")
        said = {name: value for name, value in self._attributes.items() if name not in ("shard_id", "schema")}
        columns = {name: data for name, data in self._columns.items() if name != "object"}
        return Shard("base", said, columns, self._path)

    def save(self, path: str | Path) -> Path:
        """Write one file that every command and `graspd.open` reads.

        Raises:
            InputError: they are on several objects, or the file cannot be written.
        """
        shard = self.shard()
        try:
            write_output(Path(path), write_shard("base", shard.arrays, shard.attributes))
        except OSError as error:
            raise InputError(f"{path} cannot be written: {error.strerror}") from None
        return Path(path)

    def _find_metric(self, name: str) -> GraspMetric:
        metric = _METRICS.get(name)
        if metric is None or metric.path not in self._columns:
            raise InputError(f"these grasps have no metric {name!r}; they have {', '.join(self.metrics)}")
        return metric

    def _grasp_at(self, row: int) -> Grasp:
        joints = dict(zip(self.joint_names, map(float, self.joint_positions[row]), strict=True))
        metrics = {name: float(self.metric(name)[row]) for name in self.metrics}
        return Grasp(self.hand_pose[row], joints, bool(self.is_valid[row]), metrics)


def open(
    source: str | Path | Sequence[str | Path],
    *,
    hand: str | None = None,
    job: str | None = None,
    dataset: str | None = None,
) -> Grasps:
    """Read the grasps of files, of a folder with its subfolders, or of a job or dataset in a store.

    Args:
        source: one or several paths, or the URL of a store (`file://`, `s3://`, `gs://`, `az://`).
        hand: name of the hand, needed if there are several; one `Grasps` holds one hand.
        job: id of a job in the store.
        dataset: name of a dataset in the store; its newest snapshot is read.

    Raises:
        InputError: no file of grasps, or files of several hands.
        NotFoundError: no such file, job or dataset.
        DamagedError: a file does not match its checksum.
    """
    shards = open_shards(source, job=job, dataset=dataset)
    found = _select_hand(shards, hand).of_kind("base")
    return concatenate([read_shard(shards.path(file), kind="base") for file in found])


def concatenate(shards: Sequence[Shard]) -> Grasps:
    """Concatenate the grasps of base shards of one hand; columns missing from some shards are omitted."""
    if not shards:
        raise InputError("no file of grasps was found")
    first = shards[0]
    for shard in shards[1:]:
        if shard.attributes.get("joint_names") != first.attributes.get("joint_names"):
            raise InputError(f"the hands of these files have different joints: {first.path} and {shard.path}")
        if not np.array_equal(shard[_THRESHOLDS], first[_THRESHOLDS]):
            raise InputError(f"these files have different contact thresholds: {first.path} and {shard.path}")
    common = set.intersection(*(set(shard.arrays) for shard in shards))
    columns: dict[str, Array] = {
        path: np.concatenate([shard[path] for shard in shards])
        for path in sorted(common)
        if path in _PER_GRASP or path in _SCENES
    }
    columns[_THRESHOLDS] = first[_THRESHOLDS]
    if _INDEX in columns:
        before = np.cumsum([0, *(len(shard["scene/object_pose"]) for shard in shards[:-1])])
        columns[_INDEX] = np.concatenate([shard[_INDEX] + at for shard, at in zip(shards, before, strict=True)])
    counts = [len(shard["grasp/hand_pose"]) for shard in shards]
    names = [str(shard.attributes.get("object", "")) for shard in shards]
    columns["object"] = np.repeat(np.array(names), counts)
    return Grasps(columns, first.attributes, first.path)


def _select_hand(shards: Shards, hand: str | None) -> Shards:
    hands = sorted({file.hand for file in shards.of_kind("base")})
    if hand is not None and hand not in hands:
        raise InputError(f"there are no grasps of the hand {hand!r}; hands with grasps: {', '.join(hands) or 'none'}")
    if hand is None and len(hands) > 1:
        raise InputError(f"these are grasps of {', '.join(hands)}; name one of them: hand={hands[0]!r}")
    return shards.select(hands=[hand]) if hand else shards
