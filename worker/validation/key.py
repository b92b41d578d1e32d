"""Key of a verdict: digest of all that affects it. Only success rates with equal keys are comparable."""

from collections.abc import Sequence
from dataclasses import asdict
from types import ModuleType
from typing import Any, Final, Literal

import mujoco
import numpy as np

from graspd.service.model import matter
from graspd.service.model.digests import digest_bytes, digest_json
from graspd.worker.control import jaw_squeeze, opening, postures, squeeze
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.validation import model, protocol
from graspd.worker.validation.decomposition import ConvexPieces

Level = Literal["dexgraspbench", "standard", "fast"]

REVISION: Final = 6  # revision of the code of protocol and scene; increase it if code (not a constant) changes verdicts

_EARLY: Final = ("FIRST_LOOK_S", "INTERVAL_S", "SURE", "AHEAD", "LOST_ROTATION")
#: All constants of these modules that affect verdicts; `LEVEL_MOVES` has those that not all levels use.
MOVES: Final[dict[ModuleType, tuple[str, ...]]] = {
    protocol: ("DIRECTIONS", "MAX_DISPLACEMENT_M", "MAX_ROTATION", "MAX_PENETRATION_M", "STAGES", "STAGE_S", "HOLD_S"),
    matter: ("ACCELERATION",),
    model: (
        "FRICTION",
        "HARD",
        "DAMPING_TIME",
        "HAND_SOLIMP",
        "HAND_SOLREF",
        "COUPLING_SOLREF",
        "COUPLING_SOLIMP",
        "NOT_IN_3_3_2",
        "SPARSE",
        "_BARE_RADIUS",
        "_MIN_MASS",
    ),
    opening: (
        *("CLEARANCE_M", "STUCK_M", "PALM_CLEARANCE_M", "PLAIN_OPENING", "OPENING_STEP", "SLIDING_STEP_M"),
        *("OPENING_STEPS", "JAM_M", "WAY", "JAM_LOOKS", "RETREATS_M"),
    ),
    postures: (
        *("PRESSING_M", "CLOSING_M", "FRICTION", "MAX_PRESSING", "_POINTS"),
        *("TOTAL_NORMAL_FORCE", "OF_WEIGHT", "LEAST_NORMAL_FORCE"),
    ),
    squeeze: ("SPREAD", "TORQUE", "SUM"),
    jaw_squeeze: ("GAP_M", "STALL", "LEAST_WAY"),
}
LEVEL_MOVES: Final[dict[Level, dict[ModuleType, tuple[str, ...]]]] = {
    "dexgraspbench": {protocol: ("DEXGRASPBENCH_INTERVAL_S",)},
    "standard": {protocol: _EARLY},
    "fast": {protocol: (*_EARLY, "FAST_BAND"), model: ("COARSE",)},
}


def verdict_key(
    hand: HandModel, obj: ObjectModel, level: Level, hard: bool, *, pieces: ConvexPieces, prefilter: Sequence[Any] = ()
) -> str:
    """Return the digest of a verdict's terms: everything that determines it except the grasp's postures.
    `prefilter` has the prefilter's terms if it is used."""
    shapes = b"".join(np.round(p.vertices, 9).tobytes() + np.round(p.pose, 9).tobytes() for p in hand.pieces)
    return digest_json(
        {
            "revision": REVISION,
            "level": level,
            "hard": hard,
            "engine": mujoco.__version__,
            "hand": [hand.digest, digest_bytes(shapes)],
            "gains": [array.tolist() for array in (hand.stiffness, hand.effort, hand.masses)],
            "matter": [obj.mass, obj.friction],
            "object": [obj.digest, np.round(obj.inertia, 12).tolist(), np.round(obj.centre_of_mass, 9).tolist()],
            "pieces": pieces.digest,
            "physics": asdict(model.MujocoOptions().hardened() if hard else model.MujocoOptions()),
            "constants": [_named_constants(MOVES), _named_constants(LEVEL_MOVES[level])],
            # Only for grippers, so that the keys of other hands stay unchanged.
            **({"several_contacts": flag} if (flag := model.multi_contact_flags(hand)) else {}),
            # Only for hands with tendons, for the same reason.
            **({"tendons": [[*t.dofs, *t.coefficients] for t in hand.tendons]} if hand.tendons else {}),
            **({"drag": [hand.drag.armature.tolist(), hand.drag.dry_friction.tolist()]} if hand.drag else {}),
            **({"prefilter": list(prefilter)} if prefilter else {}),
        }
    )


def postures_key(terms: str, grasps: GraspSet) -> str:
    """Return the digest of the terms (`verdict_key`) together with the validated postures."""
    parts = (grasps.pregrasp, grasps.grasp, grasps.squeeze)
    arrays = (array for part in parts for array in (part.hand_pose, part.joint_positions))
    return digest_json([terms, digest_bytes(b"".join(np.ascontiguousarray(a, float).tobytes() for a in arrays))])


def _named_constants(names: dict[ModuleType, tuple[str, ...]]) -> dict[str, Any]:
    """Return named constants by the last part of their module's name; those of `opening` under `postures`."""
    out: dict[str, Any] = {}
    for part, there in names.items():
        group = out.setdefault((postures if part is opening else part).__name__.rpartition(".")[2], {})
        for name in there:
            value = getattr(part, name)
            group[name] = asdict(value) if isinstance(value, model.MujocoOptions) else value
    return out
