"""Table lifts of objects with their published masses and with 0.1 kg, per hand and object.

usage: python -m benchmarks.masses DATA_DIR [--hands allegro ...] [--objects 025_mug ...] [--grasps 16] [--scenes 4]
           [--seed 1200] [--page OUT.md]
       DATA_DIR holds hands/ and objects/; objects need a mass in their meta.json

Shares are of candidates at fidelity standard, planned for the object's mass, on the resting faces of drops."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

from benchmarks.cells import HANDS
from graspd.service.model.domain import JobOptions
from graspd.service.model.matter import MASS_KG
from graspd.service.model.scene_spec import parse_scene
from graspd.worker.files.synthesis import SynthesisResult, synthesize_grasps

#: Seed that was not used to choose any setting.
SEED = 1200
HEAD = """# Table lifts of objects with their own masses

`python -m benchmarks.masses DATA`: shares of candidates that lift an object of its published mass off a table, at full
and at half friction, and the same shares for 0.1 kg. {grasps} candidates per pair of hand and object, {scenes} scenes,
seed {seed}.

"""


def main() -> None:
    given = arguments(__doc__, SEED).parse_args()
    rows = [
        "| hand | object | mass [kg] | lift | half friction | lift at 0.1 kg | half friction at 0.1 kg |",
        "|---|---|---|---|---|---|---|",
    ]
    for hand in given.hands:
        means: list[list[float]] = []
        for name, mass in masses(given.data).items():
            if given.objects and name not in given.objects:
                continue
            shares = [part for kg in (mass, MASS_KG) for part in lifts(given, hand, name, kg)]
            means.append(shares)
            rows.append(line(hand, name, f"{mass:g}", shares))
            print(rows[-1], flush=True)  # noqa: T201
        rows.append(line(hand, "mean", "", [sum(column) / len(column) for column in zip(*means, strict=True)]))
        print(rows[-1], flush=True)  # noqa: T201
    if given.page:
        given.page.write_text(HEAD.format(**vars(given)) + "\n".join(rows) + "\n")


def arguments(description: str | None, seed: int) -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--hands", nargs="+", default=list(HANDS), choices=list(HANDS))
    parser.add_argument("--objects", nargs="+")
    parser.add_argument("--grasps", type=int, default=16)
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--seed", type=int, default=seed)
    parser.add_argument("--page", type=Path, help="file for the table in Markdown")
    return parser


def masses(data: Path) -> dict[str, float]:
    told = {meta.parent.name: json.loads(meta.read_text()) for meta in sorted((data / "objects").glob("*/meta.json"))}
    known = {name: meta.get("real", {}).get("mass_kg") for name, meta in told.items()}
    return {name: float(mass) for name, mass in known.items() if mass}


def lifts(given: Any, hand: str, name: str, mass: float) -> tuple[float, float]:
    """Return the shares of candidates that lift the object, at full and at half friction."""
    told = on_table(given, hand, given.data / "objects" / name / "clean.stl", mass=mass).summary()
    return told["lift_share"], told["lift_hard_share"]


def on_table(given: Any, hand: str, mesh: Path, **matter: float) -> SynthesisResult:
    """Return candidates of a hand on an object with this mass or density on a table."""
    common: dict[str, Any] = {"grasps": given.grasps, "want": "candidates", "rechecks": 0, "seed": given.seed}
    request = JobOptions(**common, scene="table", scenes=given.scenes, **matter)
    urdf = str(given.data / "hands" / HANDS[hand])
    return synthesize_grasps(urdf, str(mesh), request, place=parse_scene("table"), scenes=given.scenes)


def line(hand: str, name: str, mass: str, shares: list[float]) -> str:
    return f"| {hand} | {name} | {mass} | " + " | ".join(f"{share:.2f}" for share in shares) + " |"


if __name__ == "__main__":
    main()
