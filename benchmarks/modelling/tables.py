"""Results of the studies as Markdown."""

from __future__ import annotations

from typing import Any, Final

Row = dict[str, Any]
TITLES: Final = {
    "engines": "Validation with changed models, compared with level standard",
    "predictors": "Predictors of the verdict",
    "pads": "Contact area and ε by contact threshold",
    "shape": "Resolution of object and hand",
    "drops": "Drops with convex pieces, compared with drops of the convex hull",
    "scenes": "Lift test with changed models",
    "pictures": "Pictures with changed settings",
}


def tables(found: dict[str, Any]) -> dict[str, str]:
    out = {}
    if "motion" in found:
        study = found["motion"]
        out["engines"] = _table(
            "model|held|same verdict (95 %)|held only here / only at level standard|cost",
            map(_engine, study["engines"]),
        )
        out["predictors"] = _table("model|AUC (95 %)|cost", map(_predictor, study["predictors"]))
        out["pads"] = _table(
            "hand surface in contact|contact area cm²|ε",
            (
                (f"within {r['give_mm']:g} mm", f"{r['contact_area_cm2']:.1f}", f"{r['epsilon']:.2f}")
                for r in study["pads"]
            ),
        )
    if "shape" in found:
        out["shape"] = _table(
            "setting|faces|success (95 %)|penetration mm|cost", map(_shape, found["shape"]["settings"])
        )
    if "drops" in found:
        out["drops"] = _table(
            "object|pieces|same face from the same release|variation distance of faces|the same for two seeds|cost",
            map(_drop, found["drops"]["drops"]),
        )
    if "scenes" in found:
        out["scenes"] = _table(
            "model|lifted|same verdict (95 %)|only here / only by the lift test|cost",
            map(_lift, found["scenes"]["variants"]),
        )
    if "pictures" in found:
        out["pictures"] = _table(
            "picture|cost|RMS colour error, of 255|changed labels|mean depth error, mm",
            map(_rays, found["pictures"]["rays"]),
        )
    return out


def _table(head: str, rows: Any) -> str:
    names = head.split("|")
    lines = [names, ["---", *["--:"] * (len(names) - 1)], *rows]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in lines)


def percent(rate: Row) -> str:
    return f"{100 * rate['value']:.0f} % ({100 * rate['low']:.0f} to {100 * rate['high']:.0f})"


def _engine(row: Row) -> list[str]:
    return [
        row["model"],
        f"{100 * row['held']['value']:.0f} %",
        percent(row["agreement"]),
        f"{row['only_here']} / {row['only_standard']}",
        f"{row['cost_ratio']:.2f}",
    ]


def _lift(row: Row) -> list[str]:
    return _engine({**row, "only_standard": row["only_lift"]})


def _predictor(row: Row) -> list[str]:
    auc = row["auc"]
    steps = row.get("steps_ratio")
    cost = f"{row['cost_ratio']:.3f} of a verdict" if steps is None else f"{steps:g} × the planner's step"
    return [row["model"], f"{auc['value']:.2f} ({auc['low']:.2f} to {auc['high']:.2f})", cost]


def _shape(row: Row) -> list[str]:
    depth = row["penetration_mm"]
    return [
        row["setting"],
        ", ".join(map(str, row["faces"])),
        percent(row["held"]),
        f"{depth['value']:.2f} ({depth['low']:.2f} to {depth['high']:.2f})",
        f"{row['cost_ratio']:.2f}",
    ]


def _drop(row: Row) -> list[str]:
    return [
        row["object"],
        str(row["pieces"]),
        percent(row["same_face"]),
        f"{row['distance']:.2f}",
        f"{row['distance_of_two_seeds']:.2f}",
        f"{row['cost_ratio']:.1f}",
    ]


def _rays(row: Row) -> list[str]:
    return [
        row["picture"],
        f"{row['cost_ratio']:.2f}",
        f"{row['rms_of_255']:.1f}",
        f"{100 * row['labels_changed']:.1f} %",
        f"{row['depth_changed_mm']:.2f}",
    ]
