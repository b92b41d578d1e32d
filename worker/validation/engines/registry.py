"""Engines by name, and verdicts on grasps in one of them or in several.

The module of an engine has its name; MuJoCo is part of the validator."""

import time
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.engines import ENGINES
from graspd.service.model.errors import InputError, choices_text
from graspd.service.model.transforms import Floats
from graspd.worker.execution_context import DEFAULT_CONTEXT, Count, ExecutionContext, evaluate_rows
from graspd.worker.grasps import GraspSet
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.validation.decomposition import ConvexPieces, decompose
from graspd.worker.validation.engines.port import Engine, Simulation
from graspd.worker.validation.engines.trial import engine_model, run_trial, trial_of
from graspd.worker.validation.lift import OUTCOMES, Lift, LiftOutcome
from graspd.worker.validation.lifting import require_approaches, validate_lifts
from graspd.worker.validation.model import MujocoOptions, scene_of
from graspd.worker.validation.protocol import Outcome, Rollout, Test, loss_text
from graspd.worker.validation.validator import validate


@dataclass(frozen=True)
class EngineVerdicts:
    """Verdicts of one engine on N grasps."""

    engine: str
    success: NDArray[np.int8]  # (N,) 1 held, 0 not
    reasons: tuple[str, ...]  # (N,) `held` or `lifted`, or the kind of the loss
    margin: Floats  # (N,) largest ratio of displacement or rotation to its limit
    core_s: float  # CPU time of this process


def check_engines(names: Sequence[str]) -> tuple[str, ...]:
    """Return the names in the order of `ENGINES`. Raises InputError: unknown, or not installed."""
    for name in names:
        if name not in ENGINES:
            raise InputError(f"unknown engine {name!r}; choose {choices_text(name, ENGINES)}")
        if name != "mujoco":
            load_engine(name)
    return tuple(name for name in ENGINES if name in names)


def load_engine(name: str) -> Engine:
    """Return the module of an engine other than MuJoCo. Raises InputError: it is not installed."""
    try:
        return cast(Engine, import_module(f"{__package__}.{name}"))
    except ModuleNotFoundError as error:
        raise InputError(f"engine {name} needs {error.name}; run pip install 'graspd[{name}]'") from None


def validate_with_engine(
    name: str,
    hand: HandModel,
    obj: ObjectModel,
    grasps: GraspSet,
    placed: PlacedGrasps | None = None,
    *,
    level: Any = "standard",
    hard: bool = False,
    pieces: ConvexPieces | None = None,
    run: ExecutionContext = DEFAULT_CONTEXT,
) -> EngineVerdicts:
    """Validate grasps in one engine: free ones by pushes, placed ones by lifts.
    MuJoCo's verdicts are those of `validate` or `validate_lifts` at `level`. The other engines have one protocol
    (`worker.validation.engines.trial`), whose tests end early unless level is dexgraspbench. Raises InputError: the
    engine is unknown, not installed, or cannot simulate the model; and the errors of `validate`."""
    (name,) = check_engines([name])
    pieces, began = pieces or decompose(obj), time.process_time()
    if name == "mujoco":
        given: dict[str, Any] = {"level": level, "hard": hard, "pieces": pieces, "run": run}
        found = validate(hand, obj, grasps, **given) if placed is None else None
        done: Any = found or validate_lifts(hand, obj, grasps, placed, **given)  # type: ignore[arg-type]
        return EngineVerdicts(name, done.success, tuple(done.reasons), done.margin, time.process_time() - began)
    if placed is not None:
        require_approaches(grasps, placed, "lift")
        if placed.neighbours:
            raise InputError(f"engine {name} simulates no neighbours: only mujoco does")
    physics = MujocoOptions().hardened() if hard else MujocoOptions()
    engine, scene = load_engine(name), scene_of(hand, obj, pieces, physics, placed.supports if placed else ())
    model = engine_model(scene, pieces, placed)
    if missing := engine.limitations(model):
        raise InputError(f"engine {name} cannot simulate {hand.name}: {', '.join(missing)}")
    done_rows = Count(len(grasps), run, f"validation in {name}")

    def tests() -> tuple[Simulation, Test]:
        return engine.simulation(model), Test(scene) if placed is None else Lift(scene, placed)

    def ask(pair: tuple[Simulation, Test], row: int) -> tuple[bool, str, float]:
        run.check("the validator")
        simulation, test = pair
        reason, rollout = _geometry(test, grasps, row), Rollout()
        if not reason:
            rollout = run_trial(
                simulation, trial_of(scene, grasps, row, placed), obj.centre_of_mass, early=level != "dexgraspbench"
            )
            lifted = OUTCOMES.get(rollout.outcomes[0], rollout.outcomes[0])
            reason = loss_text(rollout.outcomes) if placed is None else lifted.name.lower().replace("_", " ")
        done_rows.add(1)
        return rollout.success, reason, rollout.margin

    rows = evaluate_rows(range(len(grasps)), tests, ask, threads=run.cores, name=name)
    held, reasons, margin = zip(*rows, strict=True) if rows else ((), (), ())
    seconds = time.process_time() - began
    return EngineVerdicts(name, np.array(held, np.int8), tuple(reasons), np.array(margin, float), seconds)


def _geometry(test: Test, grasps: GraspSet, row: int) -> str:
    """Return why geometry rejects the start of a trial, the same for all engines; empty if it does not."""
    if isinstance(test, Lift):
        outcome = test.check_approach(grasps, row).outcome
        return "" if outcome is LiftOutcome.NOT_TRIED else outcome.name.lower().replace("_", " ")
    return "penetration" if test.set_up(grasps, row).outcomes[0] is Outcome.PENETRATION else ""


def engine_columns(verdicts: Sequence[EngineVerdicts]) -> dict[str, NDArray[Any]]:
    """Return `quality/held_in` (N,), bits in the order of `ENGINES`, and `quality/agreement` (N,).
    Agreement is the share of engines that give the verdict of the majority: 1 if all agree."""
    held = np.array([one.success for one in verdicts], bool)
    bits = np.array([1 << ENGINES.index(one.engine) for one in verdicts])
    share = held.mean(axis=0)
    return {
        "quality/held_in": (held * bits[:, None]).sum(axis=0).astype(np.uint8),
        "quality/agreement": np.maximum(share, 1 - share),
    }
