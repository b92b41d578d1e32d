"""Table lifts of a box beside a wall, in a corner, in a slot and among neighbours, by hand and gap.

usage: python -m benchmarks.corners DATA_DIR [--hands allegro ...] [--places wall ...] [--gaps 5 10 20 30 40]
           [--grasps 16] [--seed 1400] [--page OUT.md]
       DATA_DIR holds hands/

Shares are of candidates at fidelity standard on an upright box of 50 x 60 x 80 mm with a density of 700 kg/m3. Walls
are 150 mm high, walls of a slot 80 mm. Neighbours are four boxes of the same size."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any, Final

import trimesh

from benchmarks.cells import HANDS
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import Box, HalfSpace, NeighbourSpec, SceneSpec
from graspd.worker.files.synthesis import synthesize_grasps

#: Seed that was not used to choose any setting.
SEED = 1400
SIZE: Final = (0.05, 0.06, 0.08)
#: Directions of obstacles, as signs of x and y.
PLACES: Final = {
    "wall": ((1, 0),),
    "corner": ((1, 0), (0, 1)),
    "slot": ((1, 0), (-1, 0)),
    "neighbours": ((1, 0), (-1, 0), (0, 1), (0, -1)),
}
#: Thickness and height of walls [m].
WALL: Final = (0.02, 0.15)
HEAD = """# Lifts beside walls and among neighbours

`python -m benchmarks.corners DATA`: {grasps} candidates on a box of 50 x 60 x 80 mm for each hand, place and gap.
Columns are shares that are clear of obstacles, that lift, and that lift at half friction. Seed {seed}, density 700
kg/m3. *Slot*: walls on both sides along x, as high as the box. *Neighbours*: boxes of the same size on all four sides.
No grasp lifts if the gaps on every axis are narrower than a fingertip (Allegro 24 mm, Barrett 19 mm, Shadow 15 mm).

"""


def place_of(name: str, gap: float, mesh: str) -> SceneSpec:
    upright, supports, others = (1.0, 0.0, 0.0, 0.0), [HalfSpace()], []
    for x, y in PLACES[name]:
        if name == "neighbours":
            pose = (x * (SIZE[0] + gap), y * (SIZE[1] + gap), SIZE[2] / 2, *upright)
            others.append(NeighbourSpec(object=mesh, pose=pose))
            continue
        thick, high = WALL[0], SIZE[2] if name == "slot" else WALL[1]
        off = 0.5 * (SIZE[0] if x else SIZE[1]) + gap + 0.5 * thick
        size = (thick, 0.4, high) if x else (0.4, thick, high)
        supports.append(Box(size=size, pose=(x * off, y * off, 0.5 * high, *upright)))  # type: ignore[arg-type]
    return SceneSpec(
        kind="file", supports=tuple(supports), target=(0.0, 0.0, SIZE[2] / 2, *upright), neighbours=tuple(others)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--hands", nargs="+", default=list(HANDS), choices=list(HANDS))
    parser.add_argument("--places", nargs="+", default=list(PLACES), choices=list(PLACES))
    parser.add_argument("--gaps", nargs="+", type=float, default=[5, 10, 20, 30, 40], help="millimetres")
    parser.add_argument("--grasps", type=int, default=16)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--page", type=Path, help="file for the table in Markdown")
    given = parser.parse_args()
    rows = ["| hand | place | gap [mm] | clear | lift | half friction |", "|---|---|---|---|---|---|"]
    with tempfile.TemporaryDirectory() as folder:
        mesh = Path(folder) / "box.stl"
        trimesh.creation.box(SIZE).export(mesh)
        for hand in given.hands:
            for name in given.places:
                for gap in given.gaps:
                    rows.append(f"| {hand} | {name} | {gap:g} | {lifts(given, hand, name, 1e-3 * gap, str(mesh))} |")
                    print(rows[-1], flush=True)  # noqa: T201
    if given.page:
        given.page.write_text(HEAD.format(**vars(given)) + "\n".join(rows) + "\n")


def lifts(given: Any, hand: str, name: str, gap: float, mesh: str) -> str:
    """Return shares of candidates, or the reason why there are no candidates."""
    request = JobOptions(
        grasps=given.grasps, want="candidates", rechecks=0, seed=given.seed, scene="table", density=700.0
    )
    try:
        made = synthesize_grasps(
            str(given.data / "hands" / HANDS[hand]), mesh, request, place=place_of(name, gap, mesh), scenes=1
        )
    except InputError as error:
        return f"{error} | | "
    told = made.summary()
    return " | ".join(f"{told[key]:.2f}" for key in ("clear_share", "lift_share", "lift_hard_share"))


if __name__ == "__main__":
    main()
