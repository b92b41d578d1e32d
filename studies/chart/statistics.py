"""Figures of runs with error bars, their summary over pairs, and the Pareto front."""

from collections.abc import Mapping, Sequence
from typing import Any, Final

import numpy as np

from graspd.service.model.studies import pareto_front
from graspd.service.model.transforms import Floats
from graspd.studies.chart.trials import SettingRuns
from graspd.worker.quality.intervals import wilson_interval, wilson_interval_of_mean

#: Number of bootstrap draws; error bars are their 2.5 and 97.5 percentiles.
DRAWS: Final = 400
BAR: Final = (2.5, 97.5)
#: Accuracies, and whether more is better.
METRICS: Final = {"dexgraspbench": True, "hard": True, "robust": True, "gsr": True, "epsilon": True, "pd_mm": False}
SPEEDS: Final = ("valid_per_second", "end_to_end_per_second")  # speeds that are plotted against accuracies
#: Metrics summarised by a cell's median; `gsr` by the mean.
MEDIANS: Final = ("epsilon", "pd_mm", "spd_mm", "ca_cm2", "iv_cm3", "wrench_volume")


def run_figures(cell: SettingRuns) -> dict[str, Any]:
    """Return speed and accuracy of a run, each with error bar `KEY_low`, `KEY_high`."""
    held, kept = (np.concatenate(rows).astype(float) for rows in (cell.success, cell.kept))
    seconds = np.array(cell.seconds)
    row: dict[str, Any] = {
        "seconds": [round(s, 6) for s in cell.seconds],
        "grasps": len(held),
        "valid": int(held.sum()),
        "grasps_per_second": len(held) / seconds.sum(),
        "end_seconds": [round(s, 6) for s in cell.end_seconds],
        "kept": int(kept.sum()),
        "end_to_end_per_second": kept.sum() / sum(cell.end_seconds),
        "seconds_to_first_valid": seconds_to_valid(float(kept.mean()), cell.first_calls, cell.first_grasps),
        "valid_per_second": held.sum() / seconds.sum(),
        "gsr": held.mean(),
        "batch": cell.setting.batch,
        "repeats": len(seconds),
    }
    row |= {key: float(np.median(cell.values(key))) for key in MEDIANS}
    for key, values in _bootstrap_draws(cell).items():
        row[f"{key}_low"], row[f"{key}_high"] = np.percentile(values, BAR)
    widen_intervals(row, int(held.sum()), len(held), len(held) / float(seconds.sum()))
    widen_speed_interval(row, "end_to_end_per_second", int(kept.sum()), len(kept), len(kept) / sum(cell.end_seconds))
    row |= _strict_success(cell) if cell.dexgraspbench else {}
    return {key: rounded_json_value(value) for key, value in row.items()}


def widen_intervals(row: dict[str, Any], valid: int, grasps: int, per_second: float) -> None:
    """Set the bar of success to Wilson's interval; widen the bar of the speed to contain this interval."""
    row["gsr_low"], row["gsr_high"] = wilson_interval(valid, grasps)
    widen_speed_interval(row, "valid_per_second", valid, grasps, per_second)


def widen_speed_interval(row: dict[str, Any], key: str, valid: int, grasps: int, per_second: float) -> None:
    """Widen the bar of the speed `key` to contain Wilson's interval of the share of valid grasps."""
    low, high = wilson_interval(valid, grasps)
    row[f"{key}_low"] = min(row[f"{key}_low"], low * per_second)
    row[f"{key}_high"] = max(row[f"{key}_high"], high * per_second)


def _strict_success(cell: SettingRuns) -> dict[str, Any]:
    """Return success by DexGraspBench's protocol and at half friction, and robust share of held grasps."""
    row: dict[str, Any] = {}
    for key, verdicts in (("dexgraspbench", cell.dexgraspbench), ("hard", cell.hard)):
        held = np.concatenate(verdicts) == 1
        row[key] = float(held.mean())
        row[f"{key}_low"], row[f"{key}_high"] = wilson_interval(int(held.sum()), len(held))
    shares = np.concatenate(cell.shares)
    known = shares[np.isfinite(shares)]
    if not len(known):
        return row | dict.fromkeys(("robust", "robust_low", "robust_high"))
    low, high = wilson_interval_of_mean(float(known.sum()), len(known))
    return row | {"robust": float(known.mean()), "robust_low": low, "robust_high": high}


def seconds_to_valid(share: float, seconds: Sequence[float], grasps: int) -> float | None:
    """Return expected seconds until a call gives a valid grasp; None if no grasp was valid.
    A call has `grasps` grasps, of which the given share is valid, and takes the median of `seconds`."""
    if share <= 0 or not seconds:
        return None
    return float(np.median(seconds)) / (1.0 - (1.0 - share) ** grasps)


def _bootstrap_draws(cell: SettingRuns) -> dict[str, Floats]:
    """Bootstrap: resample repeats, then grasps within each."""
    rng = np.random.default_rng(0)
    repeats = len(cell.seconds)
    out: dict[str, list[float]] = {key: [] for key in (*SPEEDS, "gsr", "epsilon", "pd_mm")}
    for _ in range(DRAWS):
        chosen = rng.integers(repeats, size=repeats)
        rows = [rng.integers(len(cell.success[r]), size=len(cell.success[r])) for r in chosen]
        held = np.concatenate([cell.success[r][i] for r, i in zip(chosen, rows, strict=True)])
        out["gsr"].append(float(held.mean()))
        out["valid_per_second"].append(float(held.sum() / sum(cell.seconds[r] for r in chosen)))
        kept = sum(float(cell.kept[r][i].sum()) for r, i in zip(chosen, rows, strict=True))
        out["end_to_end_per_second"].append(kept / sum(cell.end_seconds[r] for r in chosen))
        for key in ("epsilon", "pd_mm"):
            values = [cell.columns[r][key][i] for r, i in zip(chosen, rows, strict=True)]
            out[key].append(float(np.median(np.concatenate(values))))
    return {key: np.array(values) for key, values in out.items()}


def summarise_runs(runs: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return a row per method, fidelity and batch, over all hands and objects.
    Speed is the number of valid grasps over all seconds; accuracies are means over the pairs."""
    groups: dict[tuple[str, str, int], list[dict[str, Any]]] = {}
    for run in runs:
        groups.setdefault((run["method"], run["fidelity"], run["batch"]), []).append(run)
    rows = []
    for (method, fidelity, batch), own in groups.items():
        valid, seconds = sum(r["valid"] for r in own), sum(sum(r["seconds"]) for r in own)
        firsts = [r["seconds_to_first_valid"] for r in own]
        row: dict[str, Any] = {"method": method, "fidelity": fidelity, "batch": batch, "pairs": len(own)}
        row["grasps"] = sum(r["grasps"] for r in own)
        row["grasps_per_second"] = row["grasps"] / seconds
        # Pairs without a valid grasp have no time, and a mean without them would be too good.
        row["seconds_to_first_valid"] = None if None in firsts else float(np.mean(firsts))
        for key in METRICS:
            # Robustness is undefined for a pair without held grasps.
            known = [r for r in own if r[key] is not None]
            row[key] = float(np.mean([r[key] for r in known])) if known else None
            row[f"{key}_low"], row[f"{key}_high"] = _error_bar(known, key) if known else (None, None)
        row["valid_per_second"] = valid / seconds
        kept, end = sum(r["kept"] for r in own), sum(sum(r["end_seconds"]) for r in own)
        row["end_to_end_per_second"] = kept / end
        for key, times in zip(SPEEDS, ("seconds", "end_seconds"), strict=True):
            row[f"{key}_low"], row[f"{key}_high"] = (_ratio_bar(own, key, times, side) for side in ("low", "high"))
        widen_intervals(row, valid, row["grasps"], row["grasps_per_second"])
        widen_speed_interval(row, "end_to_end_per_second", kept, row["grasps"], row["grasps"] / end)
        row["candidates_end_to_end_per_second"] = row["grasps"] / end
        rows.append({key: rounded_json_value(value) for key, value in row.items()})
    mark_fronts(rows, METRICS)
    return rows


def mark_fronts(rows: Sequence[dict[str, Any]], metrics: Mapping[str, bool]) -> None:
    """Add `front`: accuracies in which no faster row is better; `metrics` has True where more is better."""
    for row in rows:
        row["front"] = []
    for key, more in metrics.items():
        # Methods without valid grasps are excluded, since hands without contact have no penetration.
        able = [row for row in rows if row["end_to_end_per_second"] and row[key] is not None]
        for index in pareto_front([(row["end_to_end_per_second"], row[key] if more else -row[key]) for row in able]):
            able[index]["front"].append(key)


def _error_bar(runs: Sequence[dict[str, Any]], key: str) -> tuple[float, float]:
    """Return the bar of the mean over independent pairs: half-widths added in quadrature."""
    mean = float(np.mean([r[key] for r in runs]))
    down = np.sqrt(np.sum([(r[key] - r[f"{key}_low"]) ** 2 for r in runs])) / len(runs)
    up = np.sqrt(np.sum([(r[f"{key}_high"] - r[key]) ** 2 for r in runs])) / len(runs)
    return mean - float(down), mean + float(up)


def _ratio_bar(runs: Sequence[dict[str, Any]], key: str, seconds: str, side: str) -> float:
    """Return one end of the bar of valid grasps per second, with pairs weighted by their seconds."""
    weight = np.array([sum(r[seconds]) for r in runs])
    value = np.array([r[key] for r in runs])
    off = np.array([r[f"{key}_{side}"] for r in runs]) - value
    spread = float(np.sqrt(np.sum((weight * off) ** 2)) / weight.sum())
    return float((weight * value).sum() / weight.sum()) + (spread if side == "high" else -spread)


def valid_rate_bound(row: Mapping[str, Any]) -> float:
    """Return the 95 % upper bound on valid grasps per second, end to end, if none of n is valid.
    The bound on the share is 3 / n. In scenes it applies to lifted grasps."""
    raw = row.get("candidates_end_to_end_per_second", row["grasps_per_second"])
    return float(raw) * min(1.0, 3.0 / row["grasps"])


def rounded_json_value(value: Any) -> Any:
    """Return a value for JSON: floats with six significant digits, None for nan or inf."""
    if isinstance(value, np.generic):
        value = value.item()
    if isinstance(value, float):
        return float(f"{value:.6g}") if np.isfinite(value) else None
    return value
