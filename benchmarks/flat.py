"""Table lifts of flat and thin objects, per hand: boxes 5 to 20 mm high and a screwdriver.

usage: python -m benchmarks.flat DATA_DIR [--hands allegro ...] [--things 60x60x10 ...] [--grasps 16] [--scenes 4]
           [--seed 1300] [--page OUT.md] [--keep FOLDER]
       DATA_DIR holds hands/; --keep writes grasps to FOLDER/HAND-THING.h5

Shares are of candidates at fidelity standard. This module builds the objects; their density is 700 kg/m3."""

from __future__ import annotations

import argparse
import tempfile
from pathlib import Path
from typing import Any, Final

import numpy as np
import trimesh

from benchmarks.cells import HANDS
from benchmarks.masses import on_table
from graspd.service.store.shards import write_shard

#: Seed that was not used to choose any setting.
SEED = 1300
DENSITY: Final = 700.0
#: Extents of flat boxes and of bars [mm].
BOXES: Final = (
    (60, 60, 5), (60, 60, 10), (60, 60, 15), (60, 60, 20), (100, 20, 5), (100, 20, 10), (100, 20, 20),
)  # fmt: skip
HEAD = """# Table lifts of flat and thin objects

`python -m benchmarks.flat DATA`: shares of candidates that are clear of the table, that lift, and that lift at half
the friction. {grasps} candidates per pair of hand and object, {scenes} scenes, seed {seed}, density 700 kg/m3. Boxes
are named by their extents in mm; the screwdriver has a handle of 28 x 100 mm and a shaft of 6 x 100 mm.

"""


def screwdriver() -> trimesh.Trimesh:
    """Return a handle with a shaft, along x [m]."""
    handle = trimesh.creation.cylinder(radius=0.014, height=0.1, sections=48)
    shaft = trimesh.creation.cylinder(radius=0.003, height=0.102, sections=24)
    shaft.apply_translation([0, 0, 0.1])
    whole = trimesh.boolean.union([handle, shaft], engine="manifold")
    whole.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, [0, 1, 0]))
    return whole


def things() -> dict[str, trimesh.Trimesh]:
    """Return meshes by name [m]."""
    boxes = {"x".join(map(str, size)): trimesh.creation.box(1e-3 * np.array(size)) for size in BOXES}
    return {**boxes, "screwdriver": screwdriver()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--hands", nargs="+", default=list(HANDS), choices=list(HANDS))
    parser.add_argument("--things", nargs="+", default=list(things()), choices=list(things()))
    parser.add_argument("--grasps", type=int, default=16)
    parser.add_argument("--scenes", type=int, default=4)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--page", type=Path, help="file for the table in Markdown")
    parser.add_argument("--keep", type=Path, help="folder for the grasps")
    given = parser.parse_args()
    rows = ["| hand | object | clear | lift | half friction |", "|---|---|---|---|---|"]
    with tempfile.TemporaryDirectory() as folder:
        for hand in given.hands:
            for name in given.things:
                mesh = Path(folder) / f"{name}.stl"
                things()[name].export(mesh)
                told = lifts(given, hand, name, mesh)
                shares = (told["clear_share"], told["lift_share"], told["lift_hard_share"])
                rows.append(f"| {hand} | {name} | {' | '.join(f'{s:.2f}' for s in shares)} |")
                print(rows[-1], flush=True)  # noqa: T201
    if given.page:
        given.page.write_text(HEAD.format(**vars(given)) + "\n".join(rows) + "\n")


def lifts(given: Any, hand: str, name: str, mesh: Path) -> dict[str, Any]:
    made = on_table(given, hand, mesh, density=DENSITY)
    if given.keep:
        given.keep.mkdir(parents=True, exist_ok=True)
        kept = given.keep / f"{hand}-{name}.h5"
        kept.write_bytes(write_shard("base", made.arrays, made.attributes))
    return made.summary()


if __name__ == "__main__":
    main()
