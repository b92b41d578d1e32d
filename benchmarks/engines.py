"""Verdicts of several engines on the same candidates, free and on a table.

usage: python -m benchmarks.engines DATA_DIR [--hands allegro ...] [--objects 025_mug ...] [--grasps 16]
           [--engines mujoco,physx] [--seed 1500] [--page OUT.md]

Candidates are not selected by validation. Each is validated with the object's own mass and friction, and with half the
friction; cells of one hand are summed."""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Final

from benchmarks.cells import HANDS
from graspd.exchange.inputs import load_case
from graspd.service.model.errors import InputError
from graspd.studies.engines import compare_engines, summarise
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.validation.engines.registry import EngineVerdicts, check_engines

HEAD: Final = """# Engines

`python -m benchmarks.engines DATA --grasps {grasps} --engines {engines}`: verdicts of several
engines on the same candidates, which no validation selected.
{grasps} candidates per hand, object and kind of scene; objects: {listed}; seed {seed}. *Half*: half the friction.
*Both*, *only first*, *only second*: numbers of grasps that hold. κ: agreement beyond chance (Cohen). *First held:
second holds*: share of the first engine's grasps that the second engine holds. Core-ms are CPU time per verdict on a
busy machine.

Most grasps that differ turn by about 15°, the limit, while fingers close around the object or soon after. Of 192 grasps
that are valid in MuJoCo (16 per hand on mug, bottle, cube and drill), PhysX holds 188: Allegro 64, Barrett 62,
Shadow 62 of 64. Three of the four others also fail in PhysX at steps of 1 ms with 64 iterations: contact models differ,
not accuracy. Drake turns objects about the line through two contact points, where it has no torsional friction.

"""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--hands", nargs="+", default=["allegro", "barrett", "shadow"])
    parser.add_argument("--objects", nargs="+", help="default: all")
    parser.add_argument("--grasps", type=int, default=16)
    parser.add_argument("--engines", default="mujoco,physx")
    parser.add_argument("--seed", type=int, default=1500)
    parser.add_argument("--page", type=Path)
    given = parser.parse_args()
    given.objects = given.objects or sorted(path.parent.name for path in given.data.glob("objects/*/clean.stl"))
    engines = check_engines(given.engines.split(","))
    found: dict[tuple[str, str, str], list[list[EngineVerdicts]]] = {}
    with TemporaryDirectory() as work:
        for obj in given.objects:
            for hand in given.hands:
                for scene in ("free", "table"):
                    for friction, verdicts in cell(given, hand, obj, scene, engines, Path(work)).items():
                        found.setdefault((hand, scene, friction), []).append(verdicts)
                    write(given, engines, found)


def cell(
    given: Any, hand: str, obj: str, scene: str, engines: Sequence[str], work: Path
) -> dict[str, list[EngineVerdicts]]:
    """Return verdicts at full and at half friction on candidates of one hand, object and kind of scene."""
    file = work / "grasps.h5"
    mesh = given.data / "objects" / obj / "clean.stl"
    subprocess.run(
        [
            *(sys.executable, "-m", "graspd", "synth", "--hand", str(given.data / "hands" / HANDS[hand])),
            *("--object", str(mesh), "--scene", scene, "--want", "candidates", "--validation", "none"),
            *("-n", str(given.grasps), "--seed", str(given.seed), "-o", str(file)),
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        check=False,  # exit code 3: fewer candidates than requested
    )
    if not file.exists():
        return {}
    case, run = load_case(file, hand=str(given.data / "hands" / HANDS[hand]), obj=str(mesh)), ExecutionContext()
    lift: dict[str, Any] = {"lift": True, "level": "lift"} if scene == "table" else {}
    try:
        return {
            friction: compare_engines(case, engines, hard=hard, run=run, **lift)
            for friction, hard in (("full", False), ("half", True))
        }
    except InputError as error:
        print(f"{hand}, {obj}, {scene}: {error}", flush=True)  # noqa: T201
        return {}
    finally:
        file.unlink()


def write(given: Any, engines: Sequence[str], found: dict[tuple[str, str, str], list[list[EngineVerdicts]]]) -> None:
    """Print the tables of all cells so far, and write the page."""
    groups = {("all", scene, friction): [] for _, scene, friction in found} | found  # type: ignore[var-annotated]
    for (_, scene, friction), files in found.items():
        groups["all", scene, friction] = groups["all", scene, friction] + files
    rows = {key: summarise(files) for key, files in sorted(groups.items())}
    lines = table(
        ("hand", "scene", "friction", "n", *(f"{e} holds" for e in engines), *(f"{e} core-ms" for e in engines))
    )
    for key, row in rows.items():
        numbers = [f"{row['success'][e]:.3f}" for e in engines] + [f"{row['core_ms'][e]:.0f}" for e in engines]
        lines.append(f"| {' | '.join((*key, str(row['n']), *numbers))} |")
    heads = ("hand", "scene", "friction", "first", "second", "both", "only first", "only second", "agreement", "κ")
    lines += ["", *table((*heads, "first held: second holds", "losses of grasps that differ"))]
    for key, row in rows.items():
        for pair in row["pairs"]:
            both, (first, second) = pair["both"], pair["only"]
            kappa = "–" if pair["kappa"] is None else f"{pair['kappa']:.2f}"
            share = f"{both / (both + first):.3f}" if both + first else "–"
            lost = ", ".join(f"{count} {reason}" for reason, count in pair["differences"].items())
            cells = (
                *key,
                *pair["engines"],
                str(both),
                str(first),
                str(second),
                f"{pair['agreement']:.3f}",
                kappa,
                share,
            )
            lines.append(f"| {' | '.join((*cells, lost))} |")
    print("\n".join(lines), flush=True)  # noqa: T201
    if given.page:
        listed = ", ".join(given.objects)
        given.page.write_text(HEAD.format(**vars(given), listed=listed) + "\n".join(lines) + "\n")


def table(heads: Sequence[str]) -> list[str]:
    return [f"| {' | '.join(heads)} |", "|---" * len(heads) + "|"]


if __name__ == "__main__":
    main()
