"""Robustness: verdicts in other models of the same hand and object, and with the object displaced.

Each of k models differs from the nominal one along one axis (`variant`); axes alternate in random order. Models depend
only on the seed and the grasp's own numbers. A grasp therefore gets the same models in any set, and the first 8 of 16
models equal those of a test with 8."""

import hashlib
import math
import time
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.metrics import ROBUST_MODELS, PerturbedParameter
from graspd.service.model.transforms import Floats
from graspd.worker.execution_context import DEFAULT_CONTEXT, Count, ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.validation.decomposition import ConvexPieces, decompose
from graspd.worker.validation.lifting import LiftLevel, require_approaches
from graspd.worker.validation.model import MujocoOptions
from graspd.worker.validation.variant import Models, Variant, draw_variant, first_axes

NOT_VALIDATED: Final = -1
_EXACT: Final = 1e-9  # numerical tolerance of wanted shares: 0.9 of 10 models is exactly 9


@dataclass(frozen=True)
class Robustness:
    """Verdicts on N grasps in k models."""

    held: NDArray[np.int8]
    """(N, k) 1 held, 0 not, -1 not validated: the grasp was not tested, or earlier models decided its share."""
    axis: NDArray[np.uint8]
    wanted: float
    seconds: float

    @property
    def share(self) -> Floats:
        """(N,) share of the models in which a grasp holds; nan if it was not tested.
        After an early end the share is a lower bound if the wanted share was reached, else an upper bound."""
        models = self.held.shape[1]
        held, failed = (self.held == 1).sum(axis=1), (self.held == 0).sum(axis=1)
        reached = held >= required_model_count(self.wanted, models)
        share = np.where(reached, held, models - failed) / models
        return np.where((self.held == NOT_VALIDATED).all(axis=1), np.nan, share)

    @property
    def weakest(self) -> NDArray[np.uint8]:
        """(N,) `Axis` of the first model in which a grasp does not hold; 0 if it holds in all."""
        failed = self.held == 0
        first = failed.argmax(axis=1)
        return np.where(failed.any(axis=1), self.axis[np.arange(len(first)), first], np.uint8(PerturbedParameter.NONE))

    @property
    def columns(self) -> dict[str, NDArray[Any]]:
        return {"quality/robust_share": self.share, "quality/robust_weakest": self.weakest}

    def by_axis(self) -> dict[PerturbedParameter, tuple[int, int]]:
        """Return the number of models in which a grasp held, and of all models, for each validated axis."""
        validated = {axis: self.held[(self.axis == axis) & (self.held != NOT_VALIDATED)] for axis in PerturbedParameter}
        return {axis: (int(held.sum()), len(held)) for axis, held in validated.items() if len(held)}


def required_model_count(wanted: float, models: int) -> int:
    """Return the number of models in which a grasp must hold for a wanted share; all of them for share 0."""
    return math.ceil(wanted * models - _EXACT) if wanted > 0 else models


def reaches_share(share: Floats, wanted: float) -> NDArray[np.bool_]:
    """Return a mask (N,) of shares (N,) that reach the wanted one; nan does not."""
    return np.asarray(np.nan_to_num(share, nan=-1.0) >= wanted - _EXACT)


def validate_robustness(
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    *,
    held: NDArray[np.generic] | None = None,
    placed: PlacedGrasps | None = None,
    level: LiftLevel = "lift",
    models: int = ROBUST_MODELS,
    wanted: float = 0.0,
    seed: int = 0,
    hard: bool = False,
    pieces: ConvexPieces | None = None,
    run: ExecutionContext = DEFAULT_CONTEXT,
) -> Robustness:
    """Validate grasps in models around the nominal one, by six pushes at level standard or by lifts.
    Raises InputError: a grasp has no scene or approach. MeshError: the object has no usable convex pieces.

    Args:
        held: (N,) verdicts of the nominal model; only grasps with 1 are tested. By default all.
        placed: the grasps' scenes, for the lift test; None for six pushes.
        wanted: share of models in which a grasp must hold; a grasp's tests end once this is decided. 0 tests in all.
        seed: seed of the models, together with the grasp's own numbers.

    All other arguments are those of `validate`; `run` is polled for cancellation between models."""
    if placed is not None:
        require_approaches(grasps, placed, level)
    began = time.perf_counter()
    verdicts = np.full((len(grasps), models), NOT_VALIDATED, np.int8)
    axes = np.zeros((len(grasps), models), np.uint8)
    tried = np.arange(len(grasps)) if held is None else np.flatnonzero(np.asarray(held) == 1)
    if not len(tried):
        return Robustness(verdicts, axes, wanted, 0.0)
    physics = MujocoOptions().hardened() if hard else MujocoOptions()
    beside = (placed.supports, placed.neighbours) if placed is not None else ()
    around = Models(hand, obj, pieces or decompose(obj), physics, *beside)
    least, done = required_model_count(wanted, models), Count(len(tried), run, "robustness")

    def holds(row: int, variant: Variant) -> bool:
        if placed is None:
            return around.standard(grasps, row, variant).success
        return around.lift(grasps, row, placed, variant, dexgraspbench=level == "dexgraspbench").success

    def validate_row(row: int) -> None:
        for k, (axis, variant) in enumerate(draw_models(hand, grasps, row, models, seed)):
            run.check("robustness")
            axes[row, k] = axis
            verdicts[row, k] = holds(row, variant)
            ok, lost = (verdicts[row] == 1).sum(), (verdicts[row] == 0).sum()
            if wanted > 0 and (ok >= least or models - lost < least):
                break
        done.add(1)

    with ThreadPoolExecutor(run.cores, thread_name_prefix="robust") as pool:
        list(pool.map(validate_row, tried.tolist()))
    return Robustness(verdicts, axes, wanted, time.perf_counter() - began)


def draw_models(
    hand: HandModel, grasps: GraspSet, row: int, models: int, seed: int
) -> list[tuple[PerturbedParameter, Variant]]:
    """Return the axis and the variant of each model in which one grasp is validated."""
    whole = hashlib.sha256()
    for part in (grasps.pregrasp, grasps.grasp, grasps.squeeze):
        for array in (part.hand_pose, part.joint_positions):
            whole.update(np.ascontiguousarray(array[row], "<f8").tobytes())
    words = (seed, *np.frombuffer(whole.digest()[:16], "<u4").tolist())
    axes = first_axes(hand, models, words)
    return [(axis, draw_variant(axis, hand, np.random.default_rng((*words, k)))) for k, axis in enumerate(axes)]
