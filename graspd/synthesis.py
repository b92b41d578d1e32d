"""Grasps made in this process."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

from pydantic import ValidationError

from graspd.grasps import Grasps
from service.model.base import refusal
from service.model.domain import JobOptions
from service.model.errors import InputError
from service.model.metrics import MIN_DISTANCE_M
from service.model.scene_spec import parse_scene


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
    want: Literal["valid", "raw"] = "valid",
    budget: float = 4.0,
    min_distance: float = MIN_DISTANCE_M,
    referee: Literal["letter", "certificate", "screen", "none"] = "certificate",
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
    """Grasps of a hand on an object, judged and measured as by `graspd synth`: the same seed gives the same ones.

    The first call of a process builds or loads kernels.

    Args:
        hand: a URDF, a ZIP with one, or the name of a built-in hand.
        object: a mesh (STL, OBJ, PLY, GLB, OFF) or the name of a built-in object.
        count: grasps wanted, 1 to 1,000,000; fewer come back where the budget of tries ends first.
        scene: where they are used: free, table, bin, shelf, or a JSON or YAML file (docs/scenes.md).
        scenes: scenes that they are shared out to, 1 to 4096.
        faces: drawn: as drops fall; all: a scene for each stable face.
        touch: distance that fingertips keep from supports [mm]: 2 as the rest of the hand; 0, the default: they may
            touch; down to -1: they may press into it.
        beside: up to eight other objects, files or names, that are dropped around it.
        want: valid: that many valid grasps; raw: of any kind.
        budget: grasps tried for each one wanted, at most.
        min_distance: no two grasps are nearer [m]: mean distance of the same points of the hand, in the object's frame.
        referee: level at which MuJoCo judges; none: nobody, and grasps are sound at best.
        robust: share of models around the nominal one that a grasp must hold in to count (docs/quality.md).
        robust_models: how many such models; 0: 8 where a share is wanted, else none.
        method: the planner.
        options: its own options, such as {"steps": 20000} or, of learned, {"network": "net.npz"}.
        fidelity: draft, standard or fine.
        seed: with hand, object and options all that decides the result.
        friction: Coulomb coefficient of the quality metrics.
        mass: of the object [kg]; by default its own, 0.1 kg where its file says none.
        density: of the object [kg/m^3], in place of the mass.
        object_friction: Coulomb coefficient of contacts in simulation; by default the object's own, else 0.6.
        payload: whether the heaviest mass that each valid grasp lifts is measured (`quality/payload_kg`).
        min_payload: mass that a grasp must lift to count [kg]; 0: none is wanted.
        shake: whether each valid grasp, lifted, is shaken (`quality/shake_margin`); goes with a scene.
        units: of the mesh: m, cm, mm or in; guessed if not given.
        scale_to: longest side of the object [m].
        device: cpu, cuda:0 or auto.
        threads: CPU threads; 0: one per core.
        join: batches of 32 grasps that are planned in one launch; auto: as many as a GPU needs to be busy, 1 on a CPU.
            The grasps are the same.
        progress: called with the share that is done, 0 to 1.

    Returns:
        at most `count` grasps: poses in the object frame [m], joints [rad or m]; `reason` says why there are fewer.

    Raises:
        InputError: something of it cannot be used (MeshError, HandError: a file); says what, and the mend.
        ImportError: this install has no engine: pip install 'graspd[worker]'.
    """
    try:
        from service.store.asset_options import object_options
        from worker.files.synthesis import chosen_fidelity, synthesized
        from worker.planners.registry import of_this_machine
    except ModuleNotFoundError as error:
        raise ImportError(f"synthesize needs {error.name}; run pip install 'graspd[worker]'") from error
    try:
        request = JobOptions(
            grasps=count,
            want=want,
            budget=budget,
            referee=referee,
            method=method,
            seed=seed,
            friction=friction,
            options=of_this_machine(method, options),
            min_distance=min_distance,
            audits=0,
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
