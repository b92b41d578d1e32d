"""Verdicts in a model of the hand other than the one used to plan the grasps.

    python -m benchmarks.second_hand grasps.h5 --hand other/hand.xml [--joint-map OURS=THEIRS,...]

The other model provides the mechanism: shapes, masses, joint frames, limits, couplings, armature and dry friction. The
grasp's own model provides the controller: commanded postures, gains, damping and torque limits."""

import argparse
import json
import sys
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

import numpy as np

from benchmarks.hand_matching import TOLERANCE_M, HandMatch, match_hands
from graspd.exchange.inputs import Case, load_case
from graspd.service.model.transforms import compose
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.validation.decomposition import ConvexPieces, decompose
from graspd.worker.validation.key import Level
from graspd.worker.validation.validator import Verdicts, validate
from graspd.worker.validation.variant import nearest_feasible_joints


@dataclass(frozen=True)
class ForeignVerdicts:
    """Verdicts on the same N grasps in the model they were planned with and in another model."""

    nominal: Verdicts
    foreign: Verdicts
    same: HandMatch

    def facts(self) -> dict[str, Any]:
        """Return a JSON record of both validations: the keys of `share_counts`, and three more.
        validation_hand: name of the other model. fingertips_mm: largest distance between fingertips of both models.
        foreign_key: terms of the verdicts in the other model."""
        a, b = self.nominal.success == 1, self.foreign.success == 1
        held = {"both": a & b, "nominal": a & ~b, "foreign": ~a & b, "neither": ~a & ~b}
        return {
            "validation_hand": self.same.theirs.name,
            "fingertips_mm": round(1e3 * self.same.fingertips_m, 6),
            "foreign_key": self.foreign.terms,
            **share_counts({models: int(mask.sum()) for models, mask in held.items()}),
        }


def share_counts(held: Mapping[str, int]) -> dict[str, Any]:
    """Return shares from numbers of grasps held in both models, one, or neither; None without grasps.
    foreign_held: the counts. agreement: share with equal verdicts. foreign_share: share of nominally held grasps that
    hold in the other model. foreign_gsr: share of all grasps that hold in it."""
    n, nominal = sum(held.values()), held["both"] + held["nominal"]

    def share(part: int, whole: int) -> float | None:
        return round(part / whole, 6) if whole else None

    return {
        "foreign_held": dict(held),
        "agreement": share(held["both"] + held["neither"], n),
        "foreign_share": share(held["both"], nominal),
        "foreign_gsr": share(held["both"] + held["foreign"], n),
    }


def foreign_verdicts(
    same: HandMatch,
    obj: ObjectModel,
    grasps: GraspSet,
    nominal: Verdicts,
    *,
    pieces: ConvexPieces,
    run: ExecutionContext = DEFAULT_CONTEXT,
) -> ForeignVerdicts:
    """Validate grasps of `same.ours` in the other model, with the settings of their nominal verdicts."""
    level = cast(Level, nominal.level)
    moved = transfer_grasps(same, grasps)
    found = validate(transfer_drives(same), obj, moved, level=level, hard=nominal.hard, pieces=pieces, run=run)
    return ForeignVerdicts(nominal, found, same)


def transfer_drives(same: HandMatch) -> HandModel:
    """Return the other model with the gains and limits of `same.ours`.
    Joint i of the n joints of a dof with gain k and limit e, moved by m_i, gets the gain k / (n m_i^2) and the limit e
    / (n |m_i|). Conversely, a dof has gain sum(m_i^2 k_i) and limit sum(|m_i| e_i). Coupled joints and tendons thus
    have the same drive along their common motion."""
    ours, theirs = same.ours, same.theirs
    dof, rate = ours.dof[ours.joint_body], ours.multiplier[ours.joint_body]
    joints = np.bincount(dof, minlength=ours.dofs)[dof]
    gain = (ours.stiffness[dof] / (joints * rate**2))[same.joints]
    limit = (ours.effort[dof] / (joints * np.abs(rate)))[same.joints]
    dof, rate = theirs.dof[theirs.joint_body], theirs.multiplier[theirs.joint_body]
    stiffness, effort = np.zeros(theirs.dofs), np.zeros(theirs.dofs)
    np.add.at(stiffness, dof, rate**2 * gain)
    np.add.at(effort, dof, np.abs(rate) * limit)
    return replace(theirs, stiffness=stiffness, effort=effort)


def transfer_grasps(same: HandMatch, grasps: GraspSet) -> GraspSet:
    """Return the grasps as postures of the other model: base transformed, joints matched by name.
    Joints that only the other model couples take the nearest feasible values."""

    def transfer_posture(part: Posture) -> Posture:
        pose, joints = compose(part.hand_pose, same.base), part.joint_positions[:, same.joints]
        free = same.theirs.dofs == len(same.theirs.joint_names)
        return Posture(pose, joints if free else nearest_feasible_joints(same.theirs, joints))

    loss = np.asarray(grasps.stability_loss, float)
    return GraspSet(
        transfer_posture(grasps.grasp), transfer_posture(grasps.pregrasp), transfer_posture(grasps.squeeze), loss
    )


def validate_twice(case: Case, same: HandMatch, *, cache: Path | None = None) -> ForeignVerdicts:
    """Validate the grasps of a file in both models, at level standard."""
    case, pieces = case.centred, decompose(case.centred.obj, cache=cache)
    nominal = validate(case.hand, case.obj, case.grasps, pieces=pieces)
    return foreign_verdicts(same, case.obj, case.grasps, nominal, pieces=pieces)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("grasps", type=Path, help="base shard")
    parser.add_argument("--hand", required=True, help="second model of the hand")
    parser.add_argument("--joint-map", default="", help="joints with different names")
    parser.add_argument("--tolerance", type=float, default=1e3 * TOLERANCE_M, help="distance between fingertips [mm]")
    given = parser.parse_args()
    names = dict(pair.split("=") for pair in given.joint_map.split(",") if pair)
    case = load_case(given.grasps)
    same = match_hands(case.hand, hand_from_path(given.hand, drag=True), names, tolerance_m=given.tolerance / 1e3)
    sys.stdout.write(json.dumps(validate_twice(case, same).facts()) + "\n")


if __name__ == "__main__":
    main()
