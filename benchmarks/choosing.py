"""Success of required grasp types, contact regions and approach cones, and number of distinct grasps.

usage: python -m benchmarks.choosing DATA_DIR [--parts precision taxonomy ...] [--grasps 16] [--seed 1300]
           [--objects 025_mug ...] [--page OUT.md]
       DATA_DIR holds hands/ and objects/

A candidate counts if it is valid (level standard, 0.1 kg) and fulfils the requirement by its measured contacts."""

from __future__ import annotations

import argparse
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.cells import HANDS
from graspd.service.model.domain import JobOptions
from graspd.service.model.grasp_types import TAXONOMY
from graspd.service.model.matter import MASS_KG
from graspd.service.model.scene_spec import parse_scene
from graspd.service.store.shards import read_shard, write_shard
from graspd.worker.files.provenance import id_of_columns
from graspd.worker.files.synthesis import synthesize_grasps
from graspd.worker.files.transfer import transfer_grasps
from graspd.worker.grasps import Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.planners.requirements import Requirements
from graspd.worker.quality.diversity import distinct_mask, hand_points
from graspd.worker.quality.grasp_type import RULES

#: Seed that was not used to choose any setting.
SEED = 1300
#: Objects of the taxonomy: balls, boxes, cylinders, handles.
TAXONOMY_OBJECTS = (
    "003_cracker_box",
    "005_tomato_soup_can",
    "006_mustard_bottle",
    "025_mug",
    "035_power_drill",
    "048_hammer",
    "056_tennis_ball",
    "061_foam_brick",
)
#: Contact regions: the handle of a mug and of a drill, and the neck of a bottle.
REGIONS = {"025_mug": "x > 0.027", "006_mustard_bottle": "z > 0.15", "035_power_drill": "y > -0.042, y < 0.03"}
AVOIDED = {"025_mug": "z > 0.05", "006_mustard_bottle": "z > 0.1", "035_power_drill": "y > 0.04"}
CONES = ("0, 0, -1, 30", "1, 0, 0, 30")
#: Least mean distance of corresponding hand points of two distinct grasps [m].
DISTINCT_M = 0.02


class Cell:
    """Candidates of a hand on an object with required properties."""

    def __init__(self, given: argparse.Namespace, hand: str, name: str, count: int = 0, **required: Any) -> None:
        mesh, urdf = given.data / "objects" / name / "clean.stl", given.data / "hands" / HANDS[hand]
        common: dict[str, Any] = {"grasps": count or given.grasps, "want": "candidates", "rechecks": 0}
        request = JobOptions(**common, seed=given.seed, mass=MASS_KG, **required)
        scene, began = required.get("scene", "free"), time.process_time()
        scenes = 0 if scene == "free" else 4
        found = synthesize_grasps(str(urdf), str(mesh), request, place=parse_scene(scene), scenes=scenes)
        self.seconds, self.arrays = time.process_time() - began, found.arrays
        self.attributes = {**found.attributes, "shard_id": id_of_columns(found.arrays)}
        self.hand, self.mesh = hand_from_path(urdf), mesh
        self.posture = Posture(
            np.asarray(self.arrays["grasp/hand_pose"]), np.asarray(self.arrays["grasp/joint_positions"])
        )
        needed = Requirements.of(request, self.hand)
        self.valid = np.asarray(self.arrays["quality/valid"]) == 1
        self.fulfilled = needed.failed(self.hand, self.posture, None, self.arrays) == ""

    @property
    def good(self) -> NDArray[np.bool_]:
        return self.valid & self.fulfilled


def objects(given: argparse.Namespace) -> list[str]:
    return sorted(path.parent.name for path in (given.data / "objects").glob("*/clean.stl"))


def head(title: str, text: str, *columns: str) -> str:
    return f"## {title}\n\n{text}\n\n| {' | '.join(columns)} |\n|{'---|' * len(columns)}"


def precision(given: argparse.Namespace) -> Iterator[str]:
    yield head(
        "Precision grasps",
        "Shares of candidates that count.",
        *("hand", "free", "of type precision", "on a table", "without requirement, free"),
    )
    for hand in HANDS:
        free = [Cell(given, hand, name, type="precision") for name in objects(given)]
        table = [Cell(given, hand, name, type="precision", scene="table") for name in objects(given)]
        plain = [Cell(given, hand, name) for name in objects(given)]
        for cell in plain:
            cell.fulfilled = np.asarray(cell.arrays["quality/grasp_type"]) == 2
        shares = [mean(cell.good for cell in cells) for cells in (free, table, plain)]
        yield f"| {hand} | {shares[0]} | {mean(cell.fulfilled for cell in free)} | {shares[1]} | {shares[2]} |"


def taxonomy(given: argparse.Namespace) -> Iterator[str]:
    yield head(
        "Types of the GRASP taxonomy, Shadow",
        f"An object admits a type if one of the candidates counts. {len(TAXONOMY_OBJECTS)} objects.",
        *("number", "type", "objects that admit it", "share on these", "best object"),
    )
    for name, number in sorted(TAXONOMY.items(), key=lambda item: item[1]):
        if name not in (given.types or TAXONOMY):
            continue
        found = {obj: Cell(given, "shadow", obj, given.grasps // 2, type=name).good.mean() for obj in TAXONOMY_OBJECTS}
        admitted = [share for share in found.values() if share > 0]
        best = max(found, key=lambda obj: found[obj])
        share = f"{np.mean(admitted):.2f}" if admitted else "-"
        yield f"| {number} | {name} | {len(admitted)} | {share} | {best}: {found[best]:.2f} |"


def regions(given: argparse.Namespace) -> Iterator[str]:
    yield head(
        "Contact regions",
        "The region is obeyed if 95 % of the contact is inside.",
        *("hand", "object", "region", "candidates that count", "valid ones that obey"),
    )
    for hand in given.hands or HANDS:
        for key, table in (("touch_region", REGIONS), ("avoid_region", AVOIDED)):
            for name, text in table.items():
                cell = Cell(given, hand, name, **{key: text})
                inside = cell.fulfilled[cell.valid].mean() if cell.valid.any() else np.nan
                words = text if key == "touch_region" else f"not {text}"
                yield f"| {hand} | {name} | {words} | {cell.good.mean():.2f} | {inside:.2f} |"


def cones(given: argparse.Namespace) -> Iterator[str]:
    yield head(
        "Approach cones of 30 degrees",
        "CPU time per valid grasp is relative to that without a cone.",
        *("hand", "axis", "valid ones inside", "candidates that count", "without a cone", "CPU time"),
    )
    for hand in HANDS:
        plain = [Cell(given, hand, name) for name in REGIONS]
        for axis in CONES:
            cells = [Cell(given, hand, name, approach_cone=axis) for name in REGIONS]
            inside = np.concatenate([cell.fulfilled[cell.valid] for cell in cells]).mean()
            ratio = cost(cells) / cost(plain)
            yield (
                f"| {hand} | {axis} | {inside:.2f} | {mean(cell.good for cell in cells)} | "
                f"{mean(cell.good for cell in plain)} | {ratio:.2f} |"
            )


def distinct(given: argparse.Namespace) -> Iterator[str]:
    numbers = [given.candidates // 4, given.candidates // 2, given.candidates]
    yield head(
        "Distinct valid grasps",
        "Two grasps are distinct if corresponding points of the hand are 2 cm apart on average, or if other digits "
        "touch.",
        *("object", "hand", *(f"{number} candidates" for number in numbers)),
    )
    for name in given.objects or objects(given):
        for hand in ("allegro", "shadow"):
            cell = Cell(given, hand, name, given.candidates)
            yield f"| {name} | {hand} | " + " | ".join(str(count_distinct(cell, first)) for first in numbers) + " |"


def count_distinct(cell: Cell, first: int) -> int:
    """Return the number of distinct valid grasps among the first candidates."""
    valid = np.flatnonzero(cell.valid[:first])
    points, digits = hand_points(cell.hand, cell.posture.take(valid)), np.asarray(cell.arrays["quality/digits"])[valid]
    return sum(int(distinct_mask(points[digits == one], DISTINCT_M).sum()) for one in np.unique(digits))


def type_cost(given: argparse.Namespace) -> Iterator[str]:
    yield head(
        "Cost of a valid grasp of a type",
        "CPU time per valid grasp of the type, over that of any valid grasp (mug, bottle, drill).",
        *("hand", *(kinds := given.types or ("precision", "pinch", "tripod", "power"))),
    )
    for hand in given.hands or ("allegro", "shadow"):
        Cell(given, hand, "025_mug", 1)  # the start of the process does not count
        plain = cost([Cell(given, hand, name) for name in REGIONS])
        ratios = [cost([Cell(given, hand, name, type=kind) for name in REGIONS]) / plain for kind in kinds]
        yield f"| {hand} | " + " | ".join(f"{ratio:.2f}" for ratio in ratios) + " |"


def transfer(given: argparse.Namespace) -> Iterator[str]:
    yield head(
        "Transfer from Allegro to Shadow",
        "Valid Allegro grasps, and those for which a Shadow grasp of the same type is valid, with 95 % of the contact "
        "in the box of the Allegro contacts enlarged by 15 mm.",
        *("object", "Allegro", "Shadow"),
    )
    shares, shadow = [], str(given.data / "hands" / HANDS["shadow"])
    for name in given.objects or objects(given):
        cell = Cell(given, "allegro", name, given.grasps // 2)
        shard = read_shard(write_shard("base", cell.arrays, cell.attributes), kind="base")
        arrays, _ = transfer_grasps(shard, shadow)
        shares.append(len(arrays["quality/valid"]) / cell.valid.sum())
        yield f"| {name} | {cell.valid.sum()} | {len(arrays['quality/valid'])} |"
    yield f"\nMean share: {np.mean(shares):.2f}"


def mean(masks: Iterator[NDArray[np.bool_]] | Any) -> str:
    return f"{np.mean([mask.mean() for mask in masks]):.2f}"


def cost(cells: Sequence[Cell]) -> float:
    return sum(cell.seconds for cell in cells) / max(1, sum(int(cell.good.sum()) for cell in cells))


PARTS = {
    "precision": precision,
    "taxonomy": taxonomy,
    "regions": regions,
    "cones": cones,
    "distinct": distinct,
    "cost": type_cost,
    "transfer": transfer,
}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--parts", nargs="+", default=list(PARTS), choices=list(PARTS))
    parser.add_argument("--objects", nargs="+")
    parser.add_argument("--hands", nargs="+", choices=list(HANDS), help="hands of parts regions and cost; default: all")
    parser.add_argument("--types", nargs="+", choices=list(RULES), help="types of parts taxonomy and cost")
    parser.add_argument("--grasps", type=int, default=16)
    parser.add_argument("--seed", type=int, default=SEED)
    parser.add_argument("--candidates", type=int, default=1024, help="candidates of the part distinct")
    parser.add_argument("--page", type=Path, help="file for the tables in Markdown")
    given = parser.parse_args()
    lines = [
        f"# Choosing grasps\n\n`python -m benchmarks.choosing DATA`: {given.grasps} candidates, seed {given.seed}.\n"
    ]
    for part in given.parts:
        for line in PARTS[part](given):
            lines.append(line)
            print(line, flush=True)  # noqa: T201
        lines.append("")
    if given.page:
        given.page.write_text("\n".join(lines))


if __name__ == "__main__":
    main()
