"""Sums over the shards of a dataset, and approach directions in cells of equal area.

A cell (hand x object) stores its grasps as a few float32 columns, so that millions fit in memory."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.metrics import BANDS, DIRECTION_CELLS, GRASP_METRICS, SECTORS
from graspd.service.model.transforms import Floats, quat_rotate
from graspd.service.store import validity
from graspd.service.store.manifests import INDEX_THRESHOLD_M
from graspd.studies.cards.contents import AssetFacts, Contents, Pair, ShardContents
from graspd.worker.grasps import Posture
from graspd.worker.quality.diversity import direction_cells

BINS: Final = 200  # number of bins between a joint's limits

_AT: Final = 0.01  # distance from a limit, as a share of the range, below which a joint is at its limit


@dataclass
class JointUse:
    """Histograms of a hand's joints between their limits; joints without known limits are omitted."""

    names: tuple[str, ...]
    lower: Floats
    upper: Floats
    counts: NDArray[np.int64]  # (J, BINS) counts of grasps

    @classmethod
    def from_hand_facts(cls, names: tuple[str, ...], facts: Mapping[str, Any]) -> JointUse:
        """Return empty histograms for the joints with limits in the hand's facts."""
        lower, upper = dict(facts.get("lower", {})), dict(facts.get("upper", {}))
        known = tuple(name for name in names if name in lower and upper[name] > lower[name])
        low, high = (np.array([ends[name] for name in known]) for ends in (lower, upper))
        return cls(known, low, high, np.zeros((len(known), BINS), np.int64))

    def add(self, names: tuple[str, ...], positions: Floats) -> None:
        """Count positions (N, J) of the joints `names`; positions beyond a limit count as at the limit."""
        for row, name in enumerate(self.names):
            if name not in names:
                continue
            share = (positions[:, names.index(name)] - self.lower[row]) / (self.upper[row] - self.lower[row])
            places = np.clip((share * BINS).astype(np.int64), 0, BINS - 1)
            self.counts[row] += np.bincount(places, minlength=BINS)

    def shares(self) -> dict[str, dict[str, float]]:
        """Return percentiles of each joint, and shares of grasps at its limits.
        `used` is the range from the 1st to the 99th percentile."""
        found = {}
        near = max(1, round(_AT * BINS))
        for name, counts in zip(self.names, self.counts, strict=True):
            if not (total := int(counts.sum())):
                continue
            below = np.cumsum(counts) / total
            low, p5, middle, p95, high = (np.searchsorted(below, (0.01, 0.05, 0.5, 0.95, 0.99)) + 0.5) / BINS
            limits = {"at_lower": counts[:near].sum() / total, "at_upper": counts[-near:].sum() / total}
            shares = {"p5": p5, "median": middle, "p95": p95, "used": high - low} | limits
            found[name] = {key: float(value) for key, value in shares.items()}
        return found


Array = NDArray[Any]
Floats32 = NDArray[np.float32]
SAMPLED: Final = 512  # number of a cell's first grasps from which its diversity is computed
_UNPACKED: Final = 16  # number of arrays of a cell above which they are merged
_DIGITS: Final = 6  # grasps with all numbers equal to this many decimals (metres, radians) count as repeated


@dataclass
class CellTally:
    """Sums of one cell (hand x object), or of several. Qualities and directions cover valid grasps only."""

    n: Counter[str] = field(default_factory=Counter)
    """Numbers of grasps and pairs.
    `validated`: candidates in validated shards. `placed`: valid grasps placed into scenes; `clear`: clear in at least
    one scene. `lift_tested`: valid grasps with a lift test at half friction; `lift_hard`: lifted in this test."""
    seconds: float = 0.0  # worker seconds over all stages
    rejected: Counter[str] = field(default_factory=Counter)  # rejected candidates by reason
    refused: Counter[int] = field(default_factory=Counter)
    """Number of pairs of grasp and scene by code of `grasp/rejection`."""
    columns: dict[str, list[Floats32]] = field(default_factory=dict)
    towards: list[Floats32] = field(default_factory=list)
    """Unit vectors from the object to the palm before the approach, object frame."""
    prints: list[NDArray[np.int64]] = field(default_factory=list)
    sample: list[Posture] = field(default_factory=list)

    @classmethod
    def merge(cls, cells: Iterable[CellTally]) -> CellTally:
        """Return the sums of several cells, without `prints` and `sample`."""
        out = cls()
        for cell in cells:
            out.n.update(cell.n)
            out.seconds += cell.seconds
            out.rejected.update(cell.rejected)
            out.refused.update(cell.refused)
            out.towards += cell.towards
            for name, parts in cell.columns.items():
                out.columns.setdefault(name, []).extend(parts)
        return out

    def merge_arrays(self) -> None:
        """Merge the arrays of many shards, because thousands of small arrays need ten times the memory."""
        every: list[list[Any]] = [*self.columns.values(), self.towards, self.prints]
        for parts in every:
            if len(parts) > _UNPACKED:
                parts[:] = [np.concatenate(parts)]

    def column(self, name: str) -> Floats32:
        """Return all values of a quality; empty if no shard has it."""
        return np.concatenate(self.columns[name]) if self.columns.get(name) else np.empty(0, np.float32)

    def directions(self) -> Floats32:
        """Return unit vectors (N, 3) to the palms; empty if they are unknown."""
        return np.concatenate(self.towards) if self.towards else np.empty((0, 3), np.float32)


@dataclass
class Tally:
    """Sums of a whole dataset."""

    cells: dict[Pair, CellTally] = field(default_factory=dict)
    joints: dict[str, JointUse] = field(default_factory=dict)
    elevation: dict[str, dict[str, NDArray[np.int64]]] = field(default_factory=dict)
    """Numbers of pairs of grasp and scene of each hand, all and clear ones, by the palm's elevation."""
    seconds: dict[str, float] = field(default_factory=dict)  # worker seconds of each kind of shard
    parts: Counter[str] = field(default_factory=Counter)
    bytes: Counter[str] = field(default_factory=Counter)
    shards: Counter[str] = field(default_factory=Counter)
    values: dict[str, Counter[Any]] = field(default_factory=dict)
    """Number of shards by values of attributes such as method, device, seed."""
    revisions: dict[str, Counter[int]] = field(default_factory=dict)
    created: list[str] = field(default_factory=list)  # first and last time of a shard, RFC 3339
    threshold_m: Counter[float] = field(default_factory=Counter)

    def of_hand(self, hand: str) -> CellTally:
        return CellTally.merge(cell for (name, _), cell in self.cells.items() if name == hand)

    def of_object(self, obj: str) -> CellTally:
        return CellTally.merge(cell for (_, name), cell in self.cells.items() if name == obj)


_ATTRIBUTES: Final = (
    *("method", "fidelity", "seed", "want", "device", "worker", "code_version"),
    *("verdict_level", "verdict_key", "mu", "source", "scene", "requirements"),
)


def tally_of(contents: Contents, pieces: Iterable[ShardContents]) -> Tally:
    """Return the sums over all shards; those of a batch are in the order of `SHARD_KINDS`."""
    tally = Tally()
    valid: dict[str, Array] = {}
    batch_now: tuple[Pair, int] | None = None
    for piece in pieces:
        pair = (piece.file.hand, piece.file.object)
        if (pair, piece.file.batch) != batch_now:
            batch_now, valid = (pair, piece.file.batch), {}
        cell = tally.cells.setdefault(pair, CellTally())
        kind = piece.file.kind
        tally.shards[kind] += 1
        tally.bytes[kind] += piece.size_bytes
        if "seconds" in piece.said:
            tally.seconds[kind] = tally.seconds.get(kind, 0.0) + float(piece.said["seconds"])
            cell.seconds += float(piece.said["seconds"])
        for name in _ATTRIBUTES:
            if (value := piece.said.get(name)) not in (None, ""):
                tally.values.setdefault(name, Counter())[value] += 1
        if piece.revision is not None:
            tally.revisions.setdefault(kind, Counter())[piece.revision] += 1
        if created := piece.said.get("created"):
            tally.created = [min([*tally.created[:1], created]), max([*tally.created[1:], created])]
        for name, value in piece.info.items():
            if name.endswith("_seconds"):
                tally.parts[name.removesuffix("_seconds")] += value
        hand = contents.hands.get(piece.file.hand, AssetFacts(piece.file.hand))
        if piece.file.kind == "base":
            valid[piece.file.id] = _add_base(tally, cell, piece, hand)
        elif piece.file.kind == "scene":
            _add_scene(tally, cell, piece, hand, valid)
        elif piece.file.kind == "episodes":
            lifted = int(np.count_nonzero(piece.columns["episode/outcome"] == 0))
            cell.n.update(episodes=piece.rows, episodes_succeeded=lifted)
        else:
            cell.n["pictures"] += piece.rows
    return tally


def _add_base(tally: Tally, cell: CellTally, piece: ShardContents, hand: AssetFacts) -> Array:
    """Add a base shard; return its mask (N,) of valid grasps."""
    columns = piece.columns
    valid = validity.valid_mask(columns)
    cell.n.update(grasps=piece.rows, valid=int(valid.sum()))
    candidates = int(piece.said.get("candidates", piece.rows))
    cell.n["candidates"] += candidates
    if validity.validated_mask(columns).any() or (not piece.rows and piece.said.get("verdict_level", "none") != "none"):
        cell.n["validated"] += candidates
    cell.n.update(validity.second_engine_counts(columns))
    cell.rejected.update({str(why): int(count) for why, count in dict(piece.info.get("rejected", {})).items()})
    for name, tested, held in (
        ("quality/recheck", "rechecked", "recheck_held"),
        ("quality/lift_hard", "lift_tested", "lift_hard"),
    ):
        if (verdicts := columns.get(name)) is not None:
            cell.n[tested] += int(np.count_nonzero(verdicts[valid] >= 0))
            cell.n[held] += int(np.count_nonzero(verdicts[valid] == 1))
    thresholds = np.asarray(columns["quality/thresholds_m"], float)
    at = int(np.argmin(np.abs(thresholds - INDEX_THRESHOLD_M)))
    tally.threshold_m[float(thresholds[at])] += 1
    for metric in GRASP_METRICS:
        if (values := columns.get(metric.path)) is not None:
            kept = (values[:, at] if metric.swept else values)[valid].astype(np.float32)
            cell.columns.setdefault(metric.name, []).append(kept)
    _add_postures(tally, cell, piece, hand, valid)
    cell.merge_arrays()
    return valid


def _add_postures(tally: Tally, cell: CellTally, piece: ShardContents, hand: AssetFacts, valid: Array) -> None:
    pose = np.asarray(piece.columns["grasp/hand_pose"], float)[valid]
    joints = np.asarray(piece.columns["grasp/joint_positions"], float)[valid]
    if (approach := hand.facts.get("palm_approach")) is not None:
        cell.towards.append(-quat_rotate(pose[:, 3:], np.asarray(approach, float)).astype(np.float32))
    rounded = np.round(np.hstack([pose, joints]), _DIGITS) + 0.0  # no negative zero
    cell.prints.append(np.fromiter((hash(row.tobytes()) for row in rounded), np.int64, len(rounded)))
    held = sum(len(part) for part in cell.sample)
    if held < SAMPLED and len(pose):
        cell.sample.append(Posture(pose[: SAMPLED - held], joints[: SAMPLED - held]))
    if names := piece.said.get("joint_names"):
        use = tally.joints.setdefault(piece.file.hand, JointUse.from_hand_facts(tuple(names), hand.facts))
        use.add(tuple(names), joints)


def _add_scene(
    tally: Tally, cell: CellTally, piece: ShardContents, hand: AssetFacts, valid: Mapping[str, Array]
) -> None:
    columns = piece.columns
    index = np.asarray(columns["grasp/base_index"])
    mask = valid.get(str(piece.said.get("base_shard", "")))
    good = np.ones(len(index), bool) if mask is None else mask[index]
    clear = (columns["grasp/valid"] == 1) & good
    cell.n.update(scenes=len(columns["scene/object_pose"]), pairs=int(good.sum()), clear_pairs=int(clear.sum()))
    cell.n.update(placed=len(np.unique(index[good])), clear=len(np.unique(index[clear])))
    if (why := columns.get("grasp/rejection")) is not None:
        codes, counts = np.unique(why[good], return_counts=True)
        cell.refused.update({int(code): int(count) for code, count in zip(codes, counts, strict=True)})
    if (approach := hand.facts.get("palm_approach")) is None:
        return
    quaternions = np.asarray(columns["grasp/hand_pose"], float)[:, 3:]
    towards = -quat_rotate(quaternions, np.asarray(approach, float))
    sums = tally.elevation.setdefault(
        piece.file.hand, {name: np.zeros(ELEVATION_BINS, np.int64) for name in ("all", "clear")}
    )
    sums["all"] += elevations(towards[good])
    sums["clear"] += elevations(towards[clear])


#: Fewest grasps for statements on empty cells: with uniform directions, 0.3 of 48 cells would be empty (e^-5 each).
ENOUGH: Final = 5 * DIRECTION_CELLS
ELEVATION_BINS: Final = 36  # number of bins of elevations from -90 to 90 degrees


def cell_counts(directions: NDArray[Any], bands: int = BANDS, sectors: int = SECTORS) -> NDArray[np.int64]:
    """Return (bands, sectors) counts of unit vectors (N, 3).
    They start at the lowest band and at azimuth -180 degrees."""
    cells = direction_cells(np.asarray(directions).reshape(-1, 3), bands, sectors)
    return np.bincount(cells, minlength=bands * sectors).reshape(bands, sectors)


def elevations(directions: NDArray[Any]) -> NDArray[np.int64]:
    """Return (ELEVATION_BINS,) counts of unit vectors (N, 3) by their angle above the horizontal."""
    degrees = np.degrees(np.arcsin(np.clip(directions[:, 2], -1.0, 1.0)))
    return np.histogram(degrees, bins=ELEVATION_BINS, range=(-90, 90))[0].astype(np.int64)
