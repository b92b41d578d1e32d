"""Findings in a dataset's figures: biases, gaps and failures that matter for training."""

from collections.abc import Iterator, Mapping, Sequence
from statistics import median_high
from typing import Any, Final

import numpy as np

Row = Mapping[str, Any]

_LITTLE: Final = 0.5  # share of the median yield of a hand's cells, below which a cell's yield is low
_STILL: Final = 0.05  # a joint hardly moves if 98 of 100 grasps use less than this share of its range
_AT_LIMIT: Final = 0.5  # share of grasps with a joint at its limit, above which the joint is reported
_EMPTY: Final = 0.25  # share of an object's directions without grasps, above which they are reported
_UNEVEN: Final = 1.2  # ratio of valid grasps between hands or objects, above which it is reported
#: A direction is preferred above this multiple of its share under uniform directions.
_PEAKED: Final = 1.25
_SHOWN: Final = 8
#: Keys of a card's `making`, and names of the settings whose mixture is reported.
_UNMIXED: Final = {
    "methods": "methods",
    "levels": "levels of the validator",
    "friction": "friction coefficients",
    "code_versions": "versions of graspd",
    "wants": "wanted grasps (candidates and valid)",
    "devices": "devices",
}


def findings(card: Row) -> list[str]:
    """Return the findings of a card's content as sentences in Markdown, with figures."""
    parts = (
        _missing_cell_findings,
        _yield_findings,
        _balance_findings,
        _recheck_findings,
        _second_engine_findings,
        _table_findings,
        _direction_findings,
        _joint_findings,
        _quality_findings,
        _mixed_setting_findings,
        _licence_findings,
    )
    return [line for part in parts for line in part(card)]


def _missing_cell_findings(card: Row) -> Iterator[str]:
    if card["snapshot"] and not card["snapshot"]["complete"]:
        yield "**Not complete**: the snapshot was taken before every cell had succeeded."
    missing = [cell for cell in card["cells"] if cell["missing_tasks"]]
    for cell in missing[:_SHOWN]:
        yield f"**{_pair_name(cell)} lacks {cell['missing_tasks']} of its shards**: {cell['missing_because']}."
    if len(missing) > _SHOWN:
        yield f"{len(missing) - _SHOWN} more cells lack shards; `card.json` lists them."
    wanted = (card["making"]["options"] or {}).get("want") == "valid"
    short = [c for c in card["cells"] if wanted and not c["missing_tasks"] and c["valid"] < c["asked"]]
    if short:
        short.sort(key=lambda cell: cell["valid"] / cell["asked"])
        each = _join_words(
            [f"{_pair_name(c)} ({c['valid']} of {c['asked']} after {c['candidates']} candidates)" for c in short]
        )
        yield (
            f"**{len(short)} of {len(card['cells'])} cells ran out of budget** before enough valid grasps were found: "
            f"{each}."
        )


def _yield_findings(card: Row) -> Iterator[str]:
    yields: dict[str, list[float]] = {}
    rows = [cell for cell in card["cells"] if cell["of_validated"] is not None]
    for cell in rows:
        yields.setdefault(cell["hand"], []).append(cell["of_validated"])
    low = [cell for cell in rows if cell["of_validated"] < _LITTLE * median_high(yields[cell["hand"]])]
    if low:
        low.sort(key=lambda cell: cell["of_validated"])
        each = _join_words([f"{_pair_name(cell)} ({percent(cell['of_validated'])})" for cell in low])
        yield (
            f"**Difficult pairs**, with less than half of the hand's median yield: {each}. Their valid grasps are "
            "biased towards easy ones."
        )


def _balance_findings(card: Row) -> Iterator[str]:
    said = []
    for what in ("hands", "objects"):
        counts = {asset["name"]: asset["valid"] for asset in card["composition"][what]}
        least, most = min(counts, key=counts.__getitem__), max(counts, key=counts.__getitem__)
        if len(counts) > 1 and counts[most] >= _UNEVEN * max(1, counts[least]):
            said.append(f"{what[:-1]} {most} has {counts[most]:,} valid grasps and {least} {counts[least]:,}")
    if said:
        yield f"**Uneven**: {'; '.join(said)}."


def _recheck_findings(card: Row) -> Iterator[str]:
    found, rate = card["validity"], card["validity"]["false_valid"]
    if not rate:
        yield (
            "**No rechecks**: no verdict was checked under the unmodified DexGraspBench protocol, so the share of "
            "false verdicts is unknown."
        )
    elif found["recheck_dropped"]:
        wrong = [
            f"{_pair_name(cell)} ({cell['recheck_dropped']} of {cell['rechecked']})"
            for cell in card["cells"]
            if cell["recheck_dropped"]
        ]
        yield (
            f"**Rechecks overturned {found['recheck_dropped']} of {found['rechecked']:,} verdicts** "
            f"({percent(rate['share'])}, 95 % {percent(rate['low'])} to {percent(rate['high'])}): "
            f"{_join_words(wrong)}."
        )


def _second_engine_findings(card: Row) -> Iterator[str]:
    found = card["validity"]
    if rate := found["second_held"]:
        yield (
            f"**Second engine**: of {found['second_tested']:,} valid grasps, {percent(rate['share'])} hold in all "
            f"engines (95 % {percent(rate['low'])} to {percent(rate['high'])})."
        )


def _table_findings(card: Row) -> Iterator[str]:
    found = card["table"]
    if not found["grasps"]:
        return
    told = (
        f"**{percent(1 - found['of_grasps']['share'])} of the valid grasps are not clear of the table in any scene**: "
        "grasps are planned around a free object, from all directions. "
        f"{found['clear']:,} of {found['grasps']:,} are clear, in {percent(found['of_pairs']['share'])} of all pairs."
    )
    rows = {name: row["of_grasps"]["share"] for name, row in found["by_object"].items() if row["of_grasps"]}
    worst = sorted(rows, key=rows.__getitem__)[:3]
    if found["too_near"]:
        why = [f"{percent(count / found['pairs'])} to {what}" for what, count in found["too_near"].items()]
        told += f" Pairs that are too close: {', '.join(why)}."
    if len(rows) > 3:
        told += f" Fewest clear grasps: {_join_words([f'{name} ({percent(rows[name])})' for name in worst])}."
    yield told
    yield from _elevation_findings(card)


def _elevation_findings(card: Row) -> Iterator[str]:
    """Compare elevations of palms over the table with directions drawn uniformly on the sphere."""
    every, clear = (
        np.sum([sums[name] for sums in card["elevation"].values()] or [[0]], axis=0) for name in ("all", "clear")
    )
    if not every.sum():
        return
    edges = np.linspace(-90, 90, len(every) + 1)
    middles = (edges[1:] + edges[:-1]) / 2
    even = np.diff(np.sin(np.radians(edges))) / 2
    said = []
    for what, chosen in (("10° of the horizontal", abs(middles) < 10), ("20° of the vertical", abs(middles) > 70)):
        found, expected = every[chosen].sum() / every.sum(), even[chosen].sum()
        if found > _PEAKED * expected:
            said.append(f"{percent(found)} approach within {what} ({percent(expected)} under uniform directions)")
    if said:
        yield f"**Preferred directions**: of all palms over the table, {' and '.join(said)}."
    if clear.sum():
        yield (
            f"In {percent(clear[middles > 45].sum() / clear.sum())} of the pairs that are clear of the table, the "
            "palm approaches from 45° or more above the horizontal."
        )


def _direction_findings(card: Row) -> Iterator[str]:
    rows = card["directions"]
    some = {name: row for name, row in rows["by_object"].items() if row and row["grasps"] >= rows["enough"]}
    empty = {name: row["empty"] for name, row in some.items() if row["empty"] > _EMPTY * rows["cells"]}
    if empty:
        each = _join_words([f"{name} ({empty[name]})" for name in sorted(empty, key=lambda name: -empty[name])])
        yield f"**Unused directions**, of {rows['cells']} of equal area in the object's frame: {each}."
    elif some:
        most = max(some, key=lambda name: some[name]["empty"])
        low, high = (end(row["evenness"] for row in some.values()) for end in (min, max))
        yield (
            f"Hands approach from nearly all directions, but not uniformly. Of {rows['cells']} directions of equal "
            f"area, at most {some[most]['empty']} are empty per object ({most}). By object, grasps are spread as if "
            f"{percent(low)} to {percent(high)} of the directions were used uniformly."
        )


def _joint_findings(card: Row) -> Iterator[str]:
    for hand, joints in card["joints"].items():
        still = [f"`{name}` ({percent(use['used'])})" for name, use in joints.items() if use["used"] < _STILL]
        if still:
            yield f"**{hand} hardly moves** {_join_words(still)} (share of the range that 98 % of the grasps use)."
        ends = [
            f"`{name}` {end} ({percent(use[f'at_{end}'])})"
            for name, use in joints.items()
            for end in ("lower", "upper")
            if use[f"at_{end}"] > _AT_LIMIT and use["used"] >= _STILL
        ]
        if ends:
            yield f"**{hand} has joints at a limit** in more than half of its grasps: {_join_words(ends)}."


def _quality_findings(card: Row) -> Iterator[str]:
    said = []
    for hand, found in card["quality"].items():
        parts = []
        if (epsilon := found.get("epsilon")) and epsilon["zero"] > 0.01:
            parts.append(f"{percent(epsilon['zero'])} have ε = 0 (no force closure at this contact threshold)")
        if (depth := found.get("penetration_depth_mm")) and depth["p95"] > 1:
            parts.append(f"5 % penetrate deeper than {depth['p95']:.1f} mm")
        if (models := found.get("robust_share")) and models["median"] < 1:
            share = percent(models["median"])
            parts.append(f"half of them hold in at most {share} of the models around the nominal one")
        if parts:
            said.append(f"{hand}: {'; '.join(parts)}")
    if said:
        yield f"**Valid is not ideal.** {'. '.join(said)}."


def _mixed_setting_findings(card: Row) -> Iterator[str]:
    if count := card["repeated"]:
        yield f"**{count:,} valid grasps equal another** of their cell to six decimals."
    making = card["making"]
    for key, what in _UNMIXED.items():
        if len(making[key]) > 1:
            yield f"**Mixed {what}**: {', '.join(map(str, making[key]))}. Attributes of each shard distinguish them."
    if len({str(knobs) for knobs in making["fidelities"]}) > 1:
        yield f"**Mixed fidelities**: {', '.join(str(knobs.get('name')) for knobs in making['fidelities'])}."


def _licence_findings(card: Row) -> Iterator[str]:
    for what in ("hands", "objects"):
        nameless = [asset["name"] for asset in card["composition"][what] if not asset["licence"]]
        if nameless:
            yield (
                f"**Licence not recorded** for {len(nameless)} {what}: {_join_words(nameless)}. Ask their authors "
                "before you share the dataset."
            )


def _pair_name(cell: Row) -> str:
    return f"{cell['hand']} on {cell['object']}"


def _join_words(words: Sequence[str]) -> str:
    rest = f" and {len(words) - _SHOWN} more" if len(words) > _SHOWN else ""
    return ", ".join(words[:_SHOWN]) + rest


def percent(value: float | None) -> str:
    if value is None:
        return "-"
    digits = 0 if (value >= 0.1 and round(value, 3) < 0.995) or value in (0, 1) else 1
    return f"{100 * value:.{digits}f} %"
