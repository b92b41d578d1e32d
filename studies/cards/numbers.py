"""Content of `card.json`, computed from the shards; None stands for unknown values."""

from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from pydantic_core import from_json

from graspd.service.model.clock import timestamp
from graspd.service.model.grasp_types import TAXONOMY
from graspd.service.model.metrics import DIRECTION_CELLS, GRASP_METRICS, GraspType, entropy_bits, evenness
from graspd.service.model.names import SHARD_KINDS
from graspd.service.model.states import AssetKind
from graspd.service.model.version import PACKAGE_VERSION
from graspd.studies.cards.contents import AssetFacts, Contents
from graspd.studies.cards.tally import ELEVATION_BINS, ENOUGH, CellTally, Tally, cell_counts
from graspd.worker.grasps import Posture
from graspd.worker.quality.diversity import explained_variance
from graspd.worker.quality.intervals import wilson_interval

Row = dict[str, Any]
#: Codes of `grasp/rejection`: the obstacle, and the phase of the motion.
REJECTIONS: Final = {
    1: "the table at contact",
    2: "the table on the approach",
    3: "a neighbour at contact",
    4: "a neighbour on the approach",
}
_PERCENTILES: Final = {"p5": 5, "p25": 25, "median": 50, "p75": 75, "p95": 95}
_KINDS: Final = tuple(SHARD_KINDS.values())


def card_content(contents: Contents, tally: Tally, *, licence: str = "", source: str = "") -> Row:
    """Return the whole content of a card as JSON values."""
    whole = CellTally.merge(tally.cells.values())
    taken = contents.snapshot
    return {
        "schema": "graspd/card@1",
        "name": contents.name,
        "licence": licence or None,
        "source": source or None,
        "card_made": timestamp(),
        "graspd": PACKAGE_VERSION,
        "snapshot": taken and {"digest": taken.digest, "created": taken.created, "complete": taken.complete},
        "composition": _composition(contents, tally, whole),
        "making": _provenance(contents, tally, whole),
        "validity": {**_validity(whole), "by_hand": {hand: _validity(tally.of_hand(hand)) for hand in contents.hands}},
        "quality": {hand: _quality(tally.of_hand(hand)) for hand in contents.hands},
        "contact_threshold_m": next((value for value, _ in tally.threshold_m.most_common(1)), None),
        "table": {**_table(whole), "by_object": {obj: _table(tally.of_object(obj)) for obj in contents.objects}},
        "elevation": {
            hand: {name: counts.tolist() for name, counts in sums.items()} for hand, sums in tally.elevation.items()
        },
        "elevation_bins": ELEVATION_BINS,
        "directions": {
            "cells": DIRECTION_CELLS,
            "enough": ENOUGH,
            "by_object": {obj: _directions(tally.of_object(obj)) for obj in contents.objects},
            "by_hand": {hand: _directions(tally.of_hand(hand)) for hand in contents.hands},
        },
        "joints": {hand: use.shares() for hand, use in tally.joints.items()},
        "repeated": sum(_duplicate_count(cell) for cell in tally.cells.values()),
        "taxonomy": _taxonomy(whole),
        "cells": _cells(contents, tally),
    }


def share(part: int, whole: int) -> Row | None:
    """Return a share with its 95 % interval (Wilson 1927); None if `whole` is 0."""
    if not whole:
        return None
    low, high = wilson_interval(part, whole)
    return {"share": part / whole, "low": low, "high": high}


def _composition(contents: Contents, tally: Tally, whole: CellTally) -> Row:
    return {
        "hands": [_asset(asset, tally.of_hand(name), AssetKind.HAND) for name, asset in contents.hands.items()],
        "objects": [_asset(asset, tally.of_object(name), AssetKind.OBJECT) for name, asset in contents.objects.items()],
        "cells": len(contents.hands) * len(contents.objects) if contents.record else len(tally.cells),
        **{key: whole.n[key] for key in ("grasps", "valid", "scenes", "pairs", "pictures")},
        "shards": {kind: tally.shards[kind] for kind in _KINDS},
        "bytes": {kind: tally.bytes[kind] for kind in _KINDS},
    }


def _asset(asset: AssetFacts, cell: CellTally, kind: AssetKind) -> Row:
    facts = asset.facts
    known = {"name": asset.name, "digest": asset.digest or None, "licence": asset.licence or None}
    known |= {"source": asset.source or None, "description": asset.description or None}
    counts = {key: cell.n[key] for key in ("grasps", "valid")}
    if kind is AssetKind.HAND:
        sizes = {key: len(facts[key]) if key in facts else None for key in ("dofs", "joints", "fingertips")}
        return {**known, **sizes, **counts}
    return {**known, **{key: facts.get(key) for key in ("extents_m", "volume_m3", "mass_kg", "faces")}, **counts}


def _provenance(contents: Contents, tally: Tally, whole: CellTally) -> Row:
    valid = whole.n["valid"]
    total = sum(tally.seconds.values())
    scenes = [_parse_json(text) for text in _distinct_values(tally, "scene")]
    return {
        "methods": _distinct_values(tally, "method"),
        "fidelities": [_parse_json(text) for text in _distinct_values(tally, "fidelity")],
        "levels": _distinct_values(tally, "verdict_level"),
        "verdict_keys": len(tally.values.get("verdict_key", {})),
        "scenes": sorted({str(spec.get("kind", "")) for spec in scenes} - {"", "free"}),
        "neighbours": sorted({str(one.get("object", "")) for spec in scenes for one in spec.get("neighbours") or ()}),
        "wants": _distinct_values(tally, "want"),
        "requirements": _distinct_values(tally, "requirements"),
        "seeds": _distinct_values(tally, "seed"),
        "friction": _distinct_values(tally, "mu"),
        "devices": _distinct_values(tally, "device"),
        "workers": len(tally.values.get("worker", {})) or None,
        "code_versions": _distinct_values(tally, "code_version"),
        "revisions": {kind: sorted(counts) for kind, counts in tally.revisions.items()},
        "imported_from": _distinct_values(tally, "source"),
        "options": contents.record.options.model_dump(mode="json") if contents.record else None,
        "first_shard": tally.created[0] if tally.created else None,
        "last_shard": tally.created[-1] if tally.created else None,
        "seconds": {kind: round(tally.seconds[kind], 3) for kind in _KINDS if kind in tally.seconds},
        "synthesis_parts": {name: round(value, 3) for name, value in tally.parts.items()},
        "seconds_per_1000_valid": 1000 * total / valid if valid and total else None,
    }


def _distinct_values(tally: Tally, name: str) -> list[Any]:
    return sorted(tally.values.get(name, {}))


def _parse_json(text: str) -> Any:
    try:
        return from_json(text)
    except ValueError:
        return {"name": text}


def _validity(cell: CellTally) -> Row:
    n = cell.n
    dropped = n["rechecked"] - n["recheck_held"]
    return {
        **{key: n[key] for key in ("candidates", "valid", "validated")},
        "of_validated": share(min(n["valid"], n["validated"]), n["validated"]),
        "rejected": dict(cell.rejected) or None,
        "rechecked": n["rechecked"],
        "recheck_dropped": dropped,
        "false_valid": share(dropped, n["rechecked"]),
        "second_tested": n["second_tested"],
        "second_held": share(n["second_held"], n["second_tested"]),
        "lift_hard": share(n["lift_hard"], n["lift_tested"]),
        "episodes": share(n["episodes_succeeded"], n["episodes"]),
        "seconds": round(cell.seconds, 3),
    }


def _quality(cell: CellTally) -> dict[str, Row]:
    """Return the distribution of each quality over the valid grasps; omit missing qualities."""
    found = {}
    for metric in GRASP_METRICS:
        values = cell.column(metric.name)
        values = values[np.isfinite(values)].astype(float)
        if len(values) and not metric.code:
            found[metric.name] = {
                "n": len(values),
                "mean": _six_digits(values.mean()),
                **{key: _six_digits(np.percentile(values, at)) for key, at in _PERCENTILES.items()},
                "max": _six_digits(values.max()),
                "zero": _six_digits(np.mean(values == 0)),
            }
    return found


def _table(cell: CellTally) -> Row:
    n = cell.n
    return {
        "grasps": n["placed"],
        "clear": n["clear"],
        "of_grasps": share(n["clear"], n["placed"]),
        "pairs": n["pairs"],
        "clear_pairs": n["clear_pairs"],
        "of_pairs": share(n["clear_pairs"], n["pairs"]),
        "too_near": {REJECTIONS[code]: count for code, count in sorted(cell.refused.items()) if code in REJECTIONS},
    }


def _directions(cell: CellTally) -> Row | None:
    """Return the spread of approach directions in the object frame; None if the hands' files are missing."""
    vectors = cell.directions()
    if not len(vectors):
        return None
    counts = cell_counts(vectors)
    return {
        "grasps": len(vectors),
        "empty": int((counts == 0).sum()),
        "evenness": _six_digits(evenness(counts.ravel().tolist(), DIRECTION_CELLS)),
        "entropy_bits": _six_digits(entropy_bits(counts.ravel().tolist())),
    }


def _types(cell: CellTally) -> Row | None:
    """Return the number of grasps of each type, and the types' entropy; None if no shard has types."""
    told = cell.column("grasp_type")
    if not len(told):
        return None
    counts = {kind.name.lower(): int((told == kind).sum()) for kind in GraspType}
    return {**{name: n for name, n in counts.items() if n}, "entropy_bits": _six_digits(entropy_bits(counts.values()))}


def _taxonomy(cell: CellTally) -> Row | None:
    """Return the share of each taxonomy type, most frequent first; None if no shard has types."""
    told = cell.column("taxonomy_type")
    if not len(told):
        return None
    shares = {name: float((told == number).mean()) for name, number in TAXONOMY.items()}
    return {name: _six_digits(value) for name, value in sorted(shares.items(), key=lambda one: -one[1]) if value}


def _cells(contents: Contents, tally: Tally) -> list[Row]:
    """Return a row per cell (hand x object) of the dataset; for a folder, per cell with shards."""
    asked = contents.record.options.grasps if contents.record else None
    pairs = [(hand, obj) for hand in contents.hands for obj in contents.objects] if contents.record else [*tally.cells]
    rows = []
    for pair in pairs:
        cell, gap = tally.cells.get(pair, CellTally()), contents.gaps.get(pair, (0, None))
        valid = _validity(cell)
        row: Row = {"hand": pair[0], "object": pair[1], "asked": asked, "grasps": cell.n["grasps"]}
        copied = ("candidates", "validated", "valid", "rejected", "rechecked", "recheck_dropped", "seconds")
        row |= {key: valid[key] for key in copied}
        row["of_validated"] = valid["of_validated"] and valid["of_validated"]["share"]
        row |= {"missing_tasks": gap[0], "missing_because": gap[1]}
        row["median"] = {name: found["median"] for name, found in _quality(cell).items()}
        row["clear_of_table"] = (_table(cell)["of_grasps"] or {}).get("share")
        row["directions"] = _directions(cell)
        row["types"] = _types(cell)
        row["diversity"] = _diversity(cell)
        rows.append(row)
    return rows


def _diversity(cell: CellTally) -> float | None:
    """Return the variance explained by the first principal component; lower is more diverse."""
    if not cell.sample:
        return None
    parts = [np.concatenate([getattr(part, name) for part in cell.sample]) for name in ("hand_pose", "joint_positions")]
    explained = explained_variance(Posture(*parts))
    return _six_digits(explained[0]) if len(explained) else None


def _duplicate_count(cell: CellTally) -> int:
    prints = np.concatenate([np.empty(0, np.int64), *cell.prints])
    return len(prints) - len(np.unique(prints))


def _six_digits(value: float | np.floating[Any] | NDArray[Any]) -> float:
    """Round to six significant digits for JSON."""
    return float(f"{float(value):.6g}")
