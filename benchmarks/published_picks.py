"""Published picks of an Allegro hand, validated by six pushes and by lifts under several conditions.

Negative controls are postures that cannot hold; the pushes must reject them.

usage: python -m benchmarks.published_picks DATA_DIR [--work DIR] [--objects NAME ...] [--out STEM]
DATA_DIR/reference_grasps has the grasps published with FRoGGeR (IROS 2023), with the results of their picks. In the
published pick (facts from the authors' program, MIT) the hand starts at the grasp, around an object of 150 kg/m^3 on a
table. A QP over the measured pose of the object gives contact forces of at least 1 N per finger; friction is 0.5. The
hand lifts 10 cm in 1 s, shakes by 3 mm and holds for 1.5 s. A pick fails at 7.5 cm of height error or 30 degrees.
Prints Markdown; `--out` receives Markdown and JSON. `--work` caches verdicts."""

from __future__ import annotations

import argparse
import json
import sys
from collections import Counter
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import binomtest

from benchmarks.cells import write_json
from graspd.exchange.inputs import Case, load_case
from graspd.service.model.digests import digest_json
from graspd.service.model.transforms import quat_rotate
from graspd.worker.control.postures import TOTAL_NORMAL_FORCE, squeeze
from graspd.worker.engines.mujoco_warnings import is_invalid
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.quality.intervals import wilson_interval
from graspd.worker.quality.table import measure
from graspd.worker.scenes.trajectory import plan_trajectory
from graspd.worker.simulation.environment import RISE_M, Obstacle, PlacedGrasps
from graspd.worker.validation.decomposition import ConvexPieces, decompose
from graspd.worker.validation.lift import Lift, LiftOutcome
from graspd.worker.validation.lifting import validate_lifts
from graspd.worker.validation.model import MujocoOptions, build_scene
from graspd.worker.validation.protocol import STAGE_S, Outcome, Rollout
from graspd.worker.validation.validator import validate

Floats = NDArray[np.float64]

#: Thresholds of the published pick: height error [m] and rotation [rad].
FALLEN_M, TURNED = 0.075, np.radians(30)
DENSITY = 150.0
#: Number of negative controls of each kind per object.
CONTROLS = 5


@dataclass(frozen=True)
class Terms:
    """Conditions of a lift off a table; the defaults are those of DexGraspBench."""

    from_grasp: bool = False
    """Whether the hand starts at the grasp, not at graspd's pregrasp."""
    light: bool = False
    """Whether the mass follows from the published density; otherwise it is 0.1 kg."""
    friction: float = MujocoOptions().friction[0]
    force: float = TOTAL_NORMAL_FORCE
    """Total commanded normal force [N]."""
    published_limits: bool = False
    slowly: bool = False
    """Whether the lift takes 1 s, with a hold of 1.5 s; otherwise it takes 0.4 s, without a hold."""


PUBLISHED = Terms(from_grasp=True, light=True, friction=0.5, force=15.0, published_limits=True, slowly=True)
#: Changes of conditions. Lifts have none, one, all, or all but one of them.
CHANGES: dict[str, dict[str, Any]] = {
    "150 kg/m^3 instead of 0.1 kg": {"light": True},
    "failure at 7.5 cm of height or 30 degrees": {"published_limits": True},
    "start at the grasp, not at graspd's pregrasp": {"from_grasp": True},
    "15 N of normal forces instead of 50": {"force": 15.0},
    "friction 0.5 instead of 0.6": {"friction": 0.5},
    "lift of 1 s, hold of 1.5 s": {"slowly": True},
}
LIFTS = {"lift, dexgraspbench": Terms()}
LIFTS |= {f"dexgraspbench, but {words}": Terms(**change) for words, change in CHANGES.items()}
LIFTS["lift, published conditions where possible"] = PUBLISHED
LIFTS |= {
    f"published conditions without: {words}": replace(PUBLISHED, **{name: getattr(Terms(), name) for name in change})
    for words, change in CHANGES.items()
}


class Pick(Lift):
    """A lift under given conditions."""

    def __init__(self, scene: Any, placed: PlacedGrasps, terms: Terms) -> None:
        super().__init__(scene, placed)
        self.terms = terms

    def pick(self, grasps: GraspSet, row: int) -> tuple[str, float]:
        """Return the outcome, and the worst motion over its limit."""
        if self._set_up_scene(grasps, row).outcome is LiftOutcome.PENETRATION:
            return "penetration", 2.0
        self._close(grasps, row)
        if self._steps and self._lost():
            return "lost while closing", self._motion_excess()
        self._up_slowly(grasps, row) if self.terms.slowly else self._rise(grasps, row)
        self._goal = RISE_M * self._up
        outcome = self._validate(Rollout())
        return ("lifted" if outcome is Outcome.HELD else outcome.name.lower()), self._motion_excess()

    def _up_slowly(self, grasps: GraspSet, row: int) -> None:
        squeezed = grasps.squeeze
        stages = round(1.0 / STAGE_S)
        for stage in range(1, stages + 1):
            pose = squeezed.hand_pose[row].copy()
            pose[:3] += RISE_M * stage / stages * self._up
            self.scene.command(self.data, pose, squeezed.joint_positions[row])
            self._run(STAGE_S)
        self._run(1.5)

    def _lost(self) -> bool:
        moved, turned = self._object_motion()
        return bool(is_invalid(self.data) or moved > 2 * FALLEN_M or turned > 2 * TURNED)

    def _validate(self, rollout: Rollout) -> Outcome:
        if not self.terms.published_limits:
            return super()._validate(rollout)
        if is_invalid(self.data):
            return Outcome.DIVERGED
        if abs(float(self._object_displacement() @ self._up)) >= FALLEN_M:
            return Outcome.DISPLACED
        return Outcome.ROTATED if self._object_motion()[1] >= TURNED else Outcome.HELD


def on_table(case: Case) -> PlacedGrasps:
    """Place the object in the orientation of its scan, z up, on a table under its lowest point."""
    low = float(case.obj.vertices[:, 2].min())
    table = Obstacle.half_space((0, 0, 1), 0.0)
    pose = np.array([[0, 0, -low, 1, 0, 0, 0]], float)
    return PlacedGrasps((table,), pose, np.zeros(len(case.grasps), np.intp))


def picked(case: Case, pieces: ConvexPieces, terms: Terms) -> dict[str, Any]:
    """Return verdicts on the grasps of a case under the conditions."""
    hand, obj, grasps = case.hand, case.obj, case.grasps
    if terms.force != TOTAL_NORMAL_FORCE:
        grasps = replace(grasps, squeeze=squeeze(hand, obj, grasps.grasp, total_normal_force=terms.force))
    if terms.from_grasp:
        grasps = replace(grasps, pregrasp=grasps.grasp)
    placed = on_table(case)
    obj = obj.with_mass(density=DENSITY) if terms.light else obj
    scene = build_scene(hand, obj, pieces, MujocoOptions(friction=(terms.friction, 0.02)), placed.supports)

    def part(rows: range) -> list[tuple[str, float]]:
        test = Pick(scene, placed, terms)
        return [test.pick(grasps, row) for row in rows]

    with ThreadPoolExecutor(2) as pool:
        halves = list(pool.map(part, [range(0, len(grasps), 2), range(1, len(grasps), 2)]))
    found: list[tuple[str, float]] = [("", 0.0)] * len(grasps)
    found[0::2], found[1::2] = halves
    return {
        "held": [what == "lifted" for what, _ in found],
        "reasons": [what for what, _ in found],
        "margin": [finite(margin) for _, margin in found],
    }


def finite(value: float) -> float:
    return round(float(value), 5) if np.isfinite(value) else 1e3


def pushed(case: Case, pieces: ConvexPieces, **terms: Any) -> dict[str, Any]:
    found = validate(case.hand, case.obj, case.grasps, pieces=pieces, **terms)
    return {
        "held": (found.success == 1).tolist(),
        "reasons": found.reasons,
        "margin": [finite(one) for one in found.margin],
    }


def lifted(case: Case, pieces: ConvexPieces) -> dict[str, Any]:
    placed = on_table(case)
    way = plan_trajectory(case.hand, case.obj, case.grasps, placed)
    grasps = replace(case.grasps, approach=way.approach, coming=way.open, lift=way.lift)
    found = validate_lifts(case.hand, case.obj, grasps, placed, pieces=pieces)
    return {
        "held": (found.success == 1).tolist(),
        "reasons": found.reasons,
        "margin": [finite(one) for one in found.margin],
        "clear": way.clear.tolist(),
    }


def no_holds(case: Case, pieces: ConvexPieces) -> dict[str, Any]:
    """Validate negative controls: published grasps with an open thumb, and the object on the open palm."""
    hand, obj, grasps = case.hand, case.obj, case.grasps
    rows = np.arange(min(CONTROLS, len(grasps)))
    some = grasps.take(rows)
    thumb = np.array([name in ("joint_12.0", "joint_13.0", "joint_14.0", "joint_15.0") for name in hand.joint_names])
    open_thumb = [
        Posture(part.hand_pose, np.where(thumb, some.pregrasp.joint_positions - 0.3 * thumb, part.joint_positions))
        for part in (some.grasp, some.pregrasp, some.squeeze)
    ]
    sets = {"thumb open": replace(some, grasp=open_thumb[0], pregrasp=open_thumb[1], squeeze=open_thumb[2])}
    sets["in the palm"] = in_palm(case)
    out: dict[str, Any] = {}
    for name, one in sets.items():
        epsilon = measure(hand, obj, one, friction=0.6, thresholds_m=[0.005])["quality/epsilon"][:, 0]
        found = validate(hand, obj, one, pieces=pieces)
        out[name] = {"held": (found.success == 1).tolist(), "reasons": found.reasons, "epsilon": epsilon.tolist()}
    return out


def in_palm(case: Case) -> GraspSet:
    """Return postures with the object on the upward palm, straight fingers and no squeeze."""
    hand, obj = case.hand, case.obj
    low = obj.vertices[:, 2].min()
    poses = []
    for turn in 2 * np.pi * np.arange(CONTROLS) / CONTROLS:
        # Rotate the palm's approach to the world's up axis, then about this axis.
        a, up = hand.palm.approach, np.array([0.0, 0, 1])
        half = a + up if np.linalg.norm(a + up) > 1e-6 else np.array([1.0, 0, 0])
        half /= np.linalg.norm(half)
        q = np.array([0.0, *half])  # half a turn about the bisector of both
        spin = np.array([np.cos(turn / 2), 0, 0, np.sin(turn / 2)])
        w0, v0, w1, v1 = spin[0], spin[1:], q[0], q[1:]
        whole = np.array([w0 * w1 - v0 @ v1, *(w0 * v1 + w1 * v0 + np.cross(v0, v1))])
        place = np.array([*obj.centre_of_mass[:2], low - 0.001]) - quat_rotate(whole[None], hand.palm.centre[None])[0]
        poses.append([*place, *whole])
    pose = np.array(poses)
    flat = hand.expand(np.clip(np.zeros(hand.dofs), hand.lower, hand.upper)[None])
    posture = Posture(pose, np.repeat(flat, len(pose), axis=0))
    return GraspSet(posture, posture, posture, np.full(len(pose), np.nan))


def area_under_curve(score: Floats, good: NDArray[np.bool_]) -> float:
    """Return the probability that a picked grasp has a lower score than one that was not picked."""
    a, b = score[good], score[~good]
    return float(((a[:, None] < b) + 0.5 * (a[:, None] == b)).mean())


def answers(case: Case, work: Path) -> dict[str, dict[str, Any]]:
    """Return the verdicts of all tests on the published grasps of one object, cached in `work`."""
    known = np.flatnonzero(np.asarray(case.published) >= 0)
    every, case = case, replace(case, grasps=case.grasps.take(known))
    pieces = decompose(case.obj)
    tests: dict[str, Callable[[], dict[str, Any]]] = {
        "six pushes, level standard": lambda: pushed(case, pieces),
        "lift, graspd's own": lambda: lifted(case, pieces),
        "no holds": lambda: no_holds(every, pieces),
    }
    tests |= {words: partial(picked, case, pieces, terms) for words, terms in LIFTS.items()}
    found = {}
    for words, test in tests.items():
        file = work / f"{digest_json([case.name, words])}.json"
        if not file.is_file():
            write_json(file, test())
        found[words] = json.loads(file.read_text())
        sys.stderr.write(f"{case.name}: {words}\n")
    return found


def row(words: str, held: NDArray[np.bool_], margin: Floats | None, truth: NDArray[np.bool_]) -> dict[str, Any]:
    agree = int((held == truth).sum())
    right, wrong = int((~held & ~truth).sum()), int((~held & truth).sum())
    # A test differs from the constant answer only if it rejects a grasp (McNemar, exact).
    chance = float(binomtest(right, right + wrong).pvalue) if right + wrong else 1.0
    return {
        "test": words,
        "n": len(truth),
        "holds": float(held.mean()),
        "agreement": agree / len(truth),
        "interval": [round(bound, 4) for bound in wilson_interval(agree, len(truth))],
        "fails_both": right,
        "fails_here_alone": wrong,
        "p_against_constant": chance,
        "auc": None if margin is None else area_under_curve(margin, truth),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--work", type=Path, default=Path("quality-work") / "picks")
    parser.add_argument("--objects", nargs="+")
    parser.add_argument("--out", type=Path)
    args = parser.parse_args()
    files = sorted((args.data / "reference_grasps" / "frogger_allegro").glob("*.json"))
    files = [file for file in files if not args.objects or file.stem in args.objects]
    cases = [load_case(file) for file in files]
    truth = np.concatenate([case.published[case.published >= 0] for case in cases]) == 1  # type: ignore[index]
    found = [answers(case, args.work) for case in cases]
    rows = [row('always "holds"', np.ones(len(truth), bool), None, truth)]
    for words in [name for name in found[0] if name != "no holds"]:
        held, margin = (np.concatenate([one[words][key] for one in found]) for key in ("held", "margin"))
        rows.append(row(words, held, margin, truth))
    scores = {"l*": "min_weight_l_star_published", "ε": "ferrari_canny_L1_published"}
    picks = [one for file in files for one in json.loads(file.read_text())["grasps"]]
    picks = [one for one in picks if one["pick_success_published"] is not None]
    auc = {name: area_under_curve(-np.array([one[key] for one in picks]), truth) for name, key in scores.items()}
    objects = [
        {
            "object": file.stem,
            "n": int((case.published >= 0).sum()),
            "picked": float((case.published == 1).sum() / (case.published >= 0).sum()),
            **{
                words: float(np.mean(np.array(one[words]["held"]) == (case.published[case.published >= 0] == 1)))
                for words in SHOWN
            },
        }  # type: ignore[operator, index]
        for file, case, one in zip(files, cases, found, strict=True)
    ]
    nothing = {
        name: {
            "n": sum(len(one["no holds"][name]["held"]) for one in found),
            "held": sum(sum(one["no holds"][name]["held"]) for one in found),
            "reasons": dict(Counter(why for one in found for why in one["no holds"][name]["reasons"]).most_common()),
        }
        for name in found[0]["no holds"]
    }
    text = markdown(rows, auc, objects, nothing)
    sys.stdout.write(text)
    if args.out:
        args.out.with_suffix(".md").write_text(f"# Published picks\n\n{ABOUT}\n\n{text}")
        write_json(args.out.with_suffix(".json"), {"tests": rows, "auc": auc, "objects": objects, "no_holds": nothing})


ABOUT = (
    "Grasps of an Allegro hand were published with FRoGGeR, each with the result of a pick. The tests below "
    "repeat "
    "them in graspd's validator: six pushes, or lifts off a table under several conditions. Test columns of the last "
    "table "
    "have the share of grasps whose verdict agrees with the published pick."
)
SHOWN = (
    "six pushes, level standard",
    "lift, graspd's own",
    "lift, dexgraspbench",
    "lift, published conditions where possible",
)


def markdown(
    rows: list[dict[str, Any]], auc: dict[str, float], objects: list[dict[str, Any]], nothing: dict[str, dict[str, Any]]
) -> str:
    lines = [
        "| test | held | agreement with published picks (95 %) | fails in both, fails only here | p | AUC |",
        "| --- | --: | --- | --: | --: | --: |",
    ]
    for one in rows:
        low, high = (f"{100 * bound:.1f}" for bound in one["interval"])
        area = "" if one["auc"] is None else f"{one['auc']:.2f}"
        lines.append(
            f"| {one['test']} | {one['holds']:.2f} | {100 * one['agreement']:.1f} % ({low} to {high}) | "
            f"{one['fails_both']}, {one['fails_here_alone']} | {one['p_against_constant']:.2g} | {area} |"
        )
    lines.append(
        f"\n{rows[0]['n']} published grasps. *p*: probability that an uninformative test differs at least this much "
        "from "
        "the constant answer (McNemar, exact, two-sided). *AUC*: probability that a picked grasp moves less in the "
        "test "
        "than one that was not picked. The published scores have an AUC of "
        + " and ".join(f"{value:.2f} ({name})" for name, value in auc.items())
        + ".\n"
    )
    lines += [f"| object | published grasps | picked | {' | '.join(SHOWN)} |", "| --- |" + " --: |" * (2 + len(SHOWN))]
    lines += [
        f"| {one['object']} | {one['n']} | {one['picked']:.2f} | {' | '.join(f'{one[words]:.2f}' for words in SHOWN)} |"
        for one in objects
    ]
    lines.append("\nNegative controls (postures that cannot hold), validated by six pushes:\n")
    for name, one in nothing.items():
        why = ", ".join(f"{count} {reason}" for reason, count in one["reasons"].items())
        lines.append(f"- {name}: {one['held']} of {one['n']} hold; {why}.")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
