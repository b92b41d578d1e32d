"""Lift tests of many grasps in their scenes, on all cores."""

import time
from dataclasses import asdict, dataclass
from typing import Final, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.digests import digest_bytes, digest_json
from graspd.service.model.errors import InputError
from graspd.worker.control import postures
from graspd.worker.execution_context import DEFAULT_CONTEXT, Count, ExecutionContext, evaluate_rows
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation import environment as surroundings
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.validation import lift as protocol
from graspd.worker.validation.decomposition import ConvexPieces, decompose
from graspd.worker.validation.key import postures_key, verdict_key
from graspd.worker.validation.lift import Lift, LiftOutcome, LiftResult
from graspd.worker.validation.model import TOUCH_ROUNDING_M, MujocoOptions, scene_of

LiftLevel = Literal["dexgraspbench", "lift"]
KnownLifts = dict[str, LiftResult]  # finished lifts, by `lift_digest`
LEVELS: Final[tuple[LiftLevel, ...]] = get_args(LiftLevel)
REVISION: Final = 5  # revision of the lift test's code; increase it if code (not a constant) changes verdicts
_MOVES: Final = {surroundings: ("RISE_M",), protocol: ("LOOKS", "OVERHANG_M", "LOSSES"), postures: ("ROOM_M", "WIDE")}


@dataclass(frozen=True)
class LiftVerdicts:
    """Verdicts of the lift test on N grasps."""

    success: NDArray[np.int8]  # (N,) 1 lifted and held, 0 not
    outcome: NDArray[np.uint8]
    margin: NDArray[np.float64]
    level: LiftLevel
    hard: bool
    terms: str  # digest of everything that affects a verdict except the grasp and its scene
    seconds: float

    @property
    def reasons(self) -> list[str]:
        """Outcome of each grasp in words."""
        return [LiftOutcome(int(value)).name.lower().replace("_", " ") for value in self.outcome]


def validate_lifts(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    placed: PlacedGrasps,
    *,
    level: LiftLevel = "lift",
    hard: bool = False,
    pieces: ConvexPieces | None = None,
    known: KnownLifts | None = None,
    run: ExecutionContext = DEFAULT_CONTEXT,
) -> LiftVerdicts:
    """Validate grasps by lifts out of their scenes; see `worker.validation.lift`.
    Raises InputError: unknown level, or a grasp has no scene or approach; and the other errors of `validate`.

    Args:
        grasps: N grasps with pregrasp, squeeze and, for level lift, approach.
        placed: the grasps' scenes; `index` has the scene of each grasp.
        hard: sliding friction halved, torsional friction a tenth; also for supports.
        known: finished lifts of this hand, object and level; they are reused, and new lifts are added.

    All other arguments are those of `validate`."""
    require_approaches(grasps, placed, level)
    began = time.perf_counter()
    pieces = pieces or decompose(obj)
    physics = MujocoOptions().hardened() if hard else MujocoOptions()
    scene = scene_of(hand, obj, pieces, physics, placed.supports, placed.neighbours)
    done, finished = Count(len(grasps), run, "lifts"), {} if known is None else known

    def lift(test: Lift, row: int) -> LiftResult:
        run.check("the validator")
        key = lift_digest(grasps, row, placed, hard=hard)
        if (rollout := finished.get(key)) is None:
            rollout = test.dexgraspbench(grasps, row) if level == "dexgraspbench" else test.lift(grasps, row)
            finished[key] = rollout
        done.add(1)
        return rollout

    rollouts = evaluate_rows(range(len(grasps)), lambda: Lift(scene, placed), lift, threads=run.cores, name="lift")
    return LiftVerdicts(
        success=np.array([t.success for t in rollouts], np.int8),
        outcome=np.array([t.outcome for t in rollouts], np.uint8),
        margin=np.array([t.margin for t in rollouts], float),
        level=level,
        hard=hard,
        terms=lift_key(hand, obj, placed, level, hard, pieces=pieces),
        seconds=time.perf_counter() - began,
    )


def lift_digest(grasps: GraspSet, row: int, placed: PlacedGrasps, *, hard: bool) -> str:
    """Return the digest of all that determines a lift besides hand, object, level and fixed obstacles."""
    number = int(placed.index[row])
    around = [array[row] for array in (grasps.approach, grasps.coming) if array is not None]
    around += [placed.object_pose[number], placed.scenes[number].up, *placed.relative_neighbour_poses(number)]
    terms = digest_bytes(b"".join(np.asarray(array, float).tobytes() for array in around) + bytes([hard]))
    return postures_key(terms, grasps.take(slice(row, row + 1)))


def require_approaches(grasps: GraspSet, placed: PlacedGrasps, level: LiftLevel) -> None:
    """Raise InputError for an unknown level, or if a grasp has no scene or approach."""
    if level not in LEVELS:
        raise InputError(f"unknown level {level!r} of the lift test; choose one of {', '.join(LEVELS)}")
    if len(placed.index) != len(grasps) or (level == "lift" and grasps.approach is None):
        raise InputError("each grasp needs a scene for the lift test, and an approach unless level is dexgraspbench")


def lift_key(
    hand: HandModel, obj: ObjectModel, placed: PlacedGrasps, level: LiftLevel, hard: bool, *, pieces: ConvexPieces
) -> str:
    """Return the digest of a lift's terms: those of pushes, supports and neighbours, and its constants."""
    pushes = verdict_key(hand, obj, "dexgraspbench" if level == "dexgraspbench" else "standard", hard, pieces=pieces)
    supports = b"".join(np.round(s.planes, 9).tobytes() for s in placed.supports)
    constants = {name: getattr(module, name) for module, names in _MOVES.items() for name in names}
    physics = asdict(MujocoOptions().hardened() if hard else MujocoOptions())
    terms = [REVISION, pushes, level, physics, digest_bytes(supports), constants]
    if any(support.tips_m is not None for support in placed.supports):
        terms.append([TOUCH_ROUNDING_M, *(support.tips_m for support in placed.supports)])
    if placed.neighbours:
        corners = b"".join(np.round(piece, 9).tobytes() for one in placed.neighbours for piece in one.pieces)
        masses = [one.obj.mass for one in placed.neighbours]
        terms += [digest_bytes(corners), [*masses, protocol.NEIGHBOUR_MOVED_M, protocol.NEIGHBOUR_TILTED]]
    return digest_json(terms)
