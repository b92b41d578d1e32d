"""Grasps made in this process."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError

from graspd.grasps import Grasps
from graspd.service.model.base import refusal
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError
from graspd.service.model.metrics import MIN_DISTANCE_M
from graspd.service.model.scene_spec import parse_scene


def synthesize(
    hand: str | Path,
    object: str | Path,
    *,
    count: int = 32,
    scene: str | Path = "free",
    scenes: int = 4,
    faces: Literal["drawn", "all"] = "drawn",
    touch: float | None = None,
    beside: Sequence[str | Path] = (),
    want: Literal["valid", "candidates"] = "valid",
    budget: float = 4.0,
    min_distance: float = MIN_DISTANCE_M,
    validation: Literal["dexgraspbench", "standard", "fast", "none"] = "standard",
    robust: float = 0.0,
    robust_models: int = 0,
    method: str = "fast_graspd",
    options: dict[str, Any] | None = None,
    fidelity: str = "standard",
    seed: int = 0,
    friction: float = 1.0,
    mass: float | None = None,
    density: float | None = None,
    object_friction: float | None = None,
    payload: bool = False,
    min_payload: float = 0.0,
    shake: bool = False,
    units: str | None = None,
    scale_to: float | None = None,
    device: str = "auto",
    threads: int = 0,
    join: int | Literal["auto"] = "auto",
    progress: Callable[[float], None] | None = None,
) -> Grasps:
    """Plan, validate and measure grasps of a hand on an object, as `graspd synth` does.

    The same seed gives the same grasps. The first call of a process compiles or loads kernels.

    Args:
        hand: a URDF, a ZIP with one, or the name of a built-in hand.
        object: a mesh (STL, OBJ, PLY, GLB, OFF) or the name of a built-in object.
        count: grasps wanted, 1 to 1,000,000; fewer if the budget ends first.
        scene: free, table, bin, shelf, or a JSON or YAML file (docs/how-to/scenes.md).
        scenes: number of scenes over which the grasps are distributed, 1 to 4096.
        faces: drawn: rest poses as drops end; all: a scene for each stable face.
        touch: distance that fingertips keep from supports [mm]: 2 as the rest of the hand; 0, the default: they may
            touch; down to -1: they may press into it.
        beside: up to eight other objects, files or names, dropped around it.
        want: valid: `count` valid grasps; candidates: `count` candidates.
        budget: candidates for each grasp wanted, at most.
        min_distance: no two grasps are nearer [m]: mean distance of the same points of the hand, in the object's frame.
        validator: level of the validation in MuJoCo; none: no validation, no valid grasps.
        robust: share of perturbed models in which a grasp must hold to count (docs/explanation/quality.md).
        robust_models: number of such models; 0: 8 if a share is wanted, else none.
        method: the planner.
        options: its own options, such as {"steps": 20000} or, of learned, {"network": "net.npz"}.
        fidelity: draft, standard or fine.
        seed: decides the result, together with hand, object and options.
        friction: Coulomb coefficient of the quality metrics.
        mass: of the object [kg]; by default its own, 0.1 kg where its file says none.
        density: of the object [kg/m^3], in place of the mass.
        object_friction: Coulomb coefficient of contacts in simulation; by default the object's own, else 0.6.
        payload: measure the heaviest mass that each valid grasp lifts (`quality/payload_kg`).
        min_payload: mass that a grasp must lift to count [kg]; 0: any.
        shake: shake each lifted valid grasp (`quality/shake_margin`); needs a scene.
        units: of the mesh: m, cm, mm or in; default: metres.
        scale_to: longest side of the object [m].
        device: cpu, cuda:0 or auto.
        threads: CPU threads; 0: one per core.
        join: batches of 32 candidates planned in one launch; auto: as many as fill a GPU, 1 on a CPU. Grasps do not
            depend on it.
        progress: called with the finished share, 0 to 1.

    Returns:
        Grasps: at most `count`; poses in the object frame [m], joints [rad or m]. `reason` says why there are fewer.

    Raises:
        InputError: an argument cannot be used (MeshError, HandError: a file), with the fix.
        ImportError: the engine is not installed (`graspd[worker]`).
    """
    try:
        from graspd.service.store.asset_options import object_options
        from graspd.worker.files.synthesis import chosen_fidelity, synthesized
        from graspd.worker.planners.registry import of_this_machine
    except ModuleNotFoundError as error:
        raise ImportError(f"synthesize needs {error.name}; run pip install 'graspd[worker]'") from error
    try:
        request = JobOptions(
            grasps=count,
            want=want,
            budget=budget,
            validation=validation,
            method=method,
            seed=seed,
            friction=friction,
            options=of_this_machine(method, options),
            min_distance=min_distance,
            rechecks=0,
            robust=robust,
            robust_models=robust_models,
            mass=mass,
            density=density,
            object_friction=object_friction,
            payload=payload,
            min_payload=min_payload,
            shake=shake,
        )
    except ValidationError as error:
        # The field is called `grasps`, the argument `count`.
        raise InputError(re.sub("^grasps:", "count:", refusal(error, JobOptions))) from None
    request = request.model_copy(update={"fidelity": chosen_fidelity(fidelity)})
    place = parse_scene(str(scene), faces=faces, touch=touch, beside=[str(one) for one in beside])
    made = synthesized(
        str(hand),
        str(object),
        request,
        place=place,
        scenes=scenes,
        mesh=object_options(units=units, scale_to=scale_to),
        device=device,
        threads=threads,
        join=join,
        progress=(lambda done, total, _message: progress(done / total)) if progress else None,
    )
    return Grasps(made.arrays, made.attributes)
