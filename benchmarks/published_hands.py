"""Self-tests of published hands, compared with lifts of objects that the self-test does not use.

    pip install --no-deps --target DIR airo-models example-robot-data robosuite robosuite-models robopianist
    pip install --no-deps --target DIR mani-skill dexmate-urdf gymnasium-robotics
    python -m benchmarks.published_hands DIR --data DATA

DATA holds objects/ (YCB and others). Hands that are not in DIR are skipped. Results are cached in
`docs/results/published_hands.json` by the hand's digest and the planner's revision, so an interrupted run resumes.
`--out FOLDER` replaces docs/results/."""

from __future__ import annotations

import argparse
import json
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.gallery import HANDS, Entry
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import GraspdError
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.version import STAGE_REVISIONS
from graspd.worker.generation import validated_grasps
from graspd.worker.hands.jaws import jaws_of
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.pinch_postures import pinch_postures_of
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners.fast_graspd.antipodal_starts import crossings_of
from graspd.worker.scenes.placement import scenes_of
from graspd.worker.stages.hand_self_test import TABLE_READY, self_test_facts

#: Hands besides those of the gallery. LEAP is from MuJoCo Menagerie, in the folder leap of DIR.
_SKILL, _MATE = "mani_skill/assets/robots", "dexmate_urdf/robots/hands/f5d6_hand"
MORE = (
    Entry("leap", "LEAP", "MuJoCo Menagerie, MIT", "leap/right_hand.xml"),
    Entry("allegro-left", "Allegro, left", "mani-skill, Apache-2.0", f"{_SKILL}/allegro/allegro_hand_left.urdf"),
    Entry("dclaw", "D'Claw", "mani-skill, Apache-2.0", f"{_SKILL}/dclaw/dclaw_gripper_glb.urdf"),
    Entry("f5d6", "Dexmate F5D6", "dexmate-urdf, Apache-2.0", f"{_MATE}/f5d6_right.urdf"),
    Entry(
        "adroit", "Adroit", "gymnasium-robotics, MIT", "gymnasium_robotics/envs/assets/adroit_hand/adroit_relocate.xml"
    ),
    Entry(
        "inspire-urdf",
        "Inspire RH56, URDF",
        "mani-skill, Apache-2.0",
        f"{_SKILL}/inspire_hand/RH56DFX-2LR/urdf/inspire_hand_right.urdf",
    ),
    Entry(
        "ability-urdf",
        "PSYONIC Ability, URDF",
        "mani-skill, Apache-2.0",
        f"{_SKILL}/ability_hand/ability_hand_right.urdf",
    ),
)
OBJECTS = ("025_mug", "005_tomato_soup_can", "011_banana")
#: Least share of an object's antipodal pairs that the open hand must fit. Grasps of a rim or handle alone say little
#: about the hand.
FITTING = 0.1
#: Seed that was not used to choose any setting.
SEED, SCENES = 404, 4
#: Revisions at the end of the key of a row.
REVISIONS = f"{STAGE_REVISIONS['synthesize']}-{STAGE_REVISIONS['scene']}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("sources", type=Path)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--grasps", type=int, default=16, help="candidates per object")
    parser.add_argument("--only", help="names of hands, comma-separated")
    parser.add_argument("--out", type=Path, default=Path("docs/results"))
    asked = parser.parse_args()
    results = asked.out / "published_hands.json"
    done: dict[str, Any] = json.loads(results.read_text()) if results.is_file() else {}
    wanted = asked.only.split(",") if asked.only else None
    for entry in (*HANDS, *MORE):
        if not entry.path or not (asked.sources / entry.path).exists() or (wanted and entry.name not in wanted):
            continue
        hand = hand_from_path(asked.sources / entry.path, entry.options)
        key = f"{hand.content[:16]}-{asked.grasps}-{SEED}-{REVISIONS}"
        if done.get(entry.name, {}).get("key") == key:
            continue
        began = time.perf_counter()
        candidates = self_test_facts(lambda hand=hand: hand)  # type: ignore[misc]
        seconds = time.perf_counter() - began
        lifts = {name: lift_share(hand, asked.data / "objects" / name, asked.grasps) for name in OBJECTS}
        done[entry.name] = {
            "key": key,
            "title": entry.title,
            "source": entry.source,
            "dofs": hand.dofs,
            "grasps": asked.grasps,
            "self_test": candidates,
            "seconds": round(seconds, 1),
            "lifts": lifts,
        }
        results.write_text(json.dumps(done, indent=1) + "\n")
        (asked.out / "published_hands.md").write_text(page(done))
        sys.stderr.write(f"{entry.title}: {candidates['says']}; {lifts}\n")


def lift_share(hand: HandModel, folder: Path, grasps: int) -> float | None:
    """Return the share of candidates that lift an object off a table; None if it is refused or too wide."""
    obj, jaws = object_from_path(folder / "clean.stl"), jaws_of(hand)
    widest = pinch_postures_of(hand).widest if jaws is None else jaws.opening
    if np.mean(crossings_of(obj).width <= widest) < FITTING:
        return None
    scenes, _ = scenes_of(SceneSpec(kind="table"), obj, count=SCENES, seed=SEED)
    request = JobOptions(want="candidates", grasps=grasps, seed=SEED)
    try:
        found = validated_grasps(hand, obj, request, count=grasps, scenes=scenes)
    except GraspdError:
        return None
    return round(found.shares["lift_share"], 4)


def page(done: dict[str, Any]) -> str:
    rows, agreeing = [], 0
    for row in done.values():
        known = [share for share in row["lifts"].values() if share is not None]
        mean, candidates = float(np.mean(known)) if known else 0.0, row["self_test"]
        ready = candidates["says"].startswith("ready")
        agrees = ready == (mean >= TABLE_READY)
        agreeing += agrees
        cells = ["too wide" if share is None else f"{share:.2f}" for share in row["lifts"].values()]
        rows.append(
            f"| {row['title']} | {row['source']} | {row['dofs']} | {'ready' if ready else 'suspicious'} "
            f"| {candidates['gsr']:.2f} | {candidates['table']:.2f} | {' | '.join(cells)} | **{mean:.2f}** "
            f"| {'yes' if agrees else 'no'} | {row['seconds']:.0f} |"
        )
    grasps = next(iter(done.values()))["grasps"]
    earlier = sum(not row["key"].endswith(f"-{REVISIONS}") for row in done.values())
    return (
        "# Published hands: self-test and lifts\n\n"
        "`python -m benchmarks.published_hands DIR --data DATA`: self-test of each hand as published, and lifts of "
        "objects "
        "that the self-test does not use.\n\n"
        "- *Free*: share of the self-test's candidates that hold; *table*: share that lift.\n"
        f"- Columns with an object: share of {grasps} candidates that lift it off a table, fidelity *standard*, seed "
        f"{SEED}; *mean*: over the objects.\n"
        f"- *Too wide*: the hand opens wide enough for less than {FITTING:.0%} of the antipodal pairs.\n"
        f"- *Agrees*: the verdict is *ready* and the mean at least {TABLE_READY:.0%}, or neither; {agreeing} of "
        f"{len(done)} agree.\n\n"
        f"{earlier} of the rows are from earlier revisions, as their keys in the JSON show.\n\n"
        f"| hand | from | dofs | verdict | free | table | {' | '.join(OBJECTS)} | mean | agrees | self-test [s] |\n"
        f"| --- | --- | --: | --- | --: | --: | {'--: | ' * len(OBJECTS)}--: | --- | --: |\n" + "\n".join(rows) + "\n"
    )


if __name__ == "__main__":
    main()
