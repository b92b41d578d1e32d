"""Measure effects that graspd does not model: their cost and influence. Prints Markdown.

usage: python -m benchmarks.modelling [--data DATA_DIR] [--out DIR] [--only STUDY ...] [--grasps N]
DATA_DIR holds hands/ and objects/ (YCB); by default the built-in hand and objects are used. `--out` saves the numbers
to DIR/modelling.json after each study; `--only` resumes an interrupted run. Costs are ratios of CPU time within a run.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from benchmarks.modelling import drops, motion, pictures, scenes, shape
from benchmarks.modelling.common import Subject, hand_of, object_of
from benchmarks.modelling.tables import TITLES, tables

OBJECTS = ("006_mustard_bottle", "011_banana", "025_mug", "035_power_drill")
DROPPED = ("025_mug", "024_bowl", "011_banana")
SHAPED = ("025_mug", "011_banana")
PICTURED = "025_mug"
BUILT_IN = ("mug", "bottle", "block")
#: Studies, with numbers of grasps or drops per object, chosen for a few minutes of one core.
STUDIES = {"motion": 32, "shape": 24, "drops": 32, "pictures": 0, "scenes": 24}


def studies(data: Path | None, count: dict[str, int]) -> dict[str, Callable[[], dict[str, Any]]]:
    """Return the studies by name, as functions that run them; `motion` and `drops` share grasps."""
    hand = hand_of(data)
    names = OBJECTS if data else BUILT_IN
    subjects = [Subject(hand, object_of(data, name), count["motion"]) for name in names]
    dropped = DROPPED if data else BUILT_IN
    shaped = list(SHAPED if data else BUILT_IN[:2])
    return {
        "motion": lambda: motion.study(subjects),
        "shape": lambda: shape.study(data, shaped, count["shape"]),
        "drops": lambda: drops.study(subjects, lambda: [object_of(data, name) for name in dropped], count["drops"]),
        "pictures": lambda: pictures.study(data, PICTURED if data else BUILT_IN[0]),
        "scenes": lambda: scenes.study(subjects, count["scenes"]),
    }


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, help="folder with hands/ and objects/; default: built-in ones")
    parser.add_argument("--out", type=Path, help="folder for modelling.json")
    parser.add_argument("--only", nargs="+", choices=STUDIES, default=list(STUDIES))
    parser.add_argument("--grasps", type=int, help="number of grasps or drops per object in all studies")
    args = parser.parse_args(arguments)
    file = args.out / "modelling.json" if args.out else None
    found = json.loads(file.read_text()) if file and file.is_file() else {}
    count = {name: args.grasps or own for name, own in STUDIES.items()}
    for name, study in studies(args.data, count).items():
        if name not in args.only:
            continue
        found[name] = study()
        if file:
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(json.dumps(found, indent=1, allow_nan=False) + "\n")
    for title, text in tables(found).items():
        sys.stdout.write(f"**{TITLES[title]}**\n\n{text}\n\n")


if __name__ == "__main__":
    main()
