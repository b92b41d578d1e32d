"""Influence of mesh faces and hand points; penetration is measured on the unsimplified object."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.modelling.common import SEED, Row, cpu, hand_of, mean, object_of, share, verdicts
from graspd.service.model.fidelity import FIDELITIES
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.planners import synthesize
from graspd.worker.planners.port import PlanRequest
from graspd.worker.quality.probe import probe_of
from graspd.worker.quality.volume import penetration_depth
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.model import MujocoOptions, build_scene

STANDARD = FIDELITIES["standard"]
SETTINGS: dict[str, dict[str, Any]] = {
    "standard": {},
    "all faces": {"face_error_m": 0.0},
    "face error up to 1 mm": {"face_error_m": 1e-3},
    "face error up to 3 mm": {"face_error_m": 3e-3},
    "500 hand points": {"fine_points": 500},
    "4000 hand points": {"fine_points": 4000},
}


def study(data: Path | None, objects: list[str], count: int) -> dict[str, Any]:
    """Return success, penetration and CPU time of each setting; all settings have the same seeds."""
    hand = hand_of(data)
    true = {name: object_of(data, name, 0.0) for name in objects}
    scenes = {}
    for name in objects:
        # All settings are validated with the pieces of the standard object.
        standard = object_of(data, name)
        scenes[name] = build_scene(hand, standard, decompose(standard), MujocoOptions())
    rows: list[Row] = []
    for setting, change in SETTINGS.items():
        fidelity = STANDARD.model_copy(update=change)
        held, depth, seconds, faces = 0, [], 0.0, []
        for name in objects:
            obj = object_of(data, name, fidelity.face_error_m)
            synthesize(hand, obj, PlanRequest(count=1, fidelity=fidelity, seed=1), ExecutionContext(threads=1))
            with cpu() as clock:
                found = synthesize(
                    hand, obj, PlanRequest(count=count, fidelity=fidelity, seed=SEED), ExecutionContext(threads=1)
                )
            seconds += clock.seconds
            faces.append(len(obj.faces))
            held += int(verdicts(scenes[name], found).sum())
            probe = probe_of(hand, true[name], hand_points=2000, object_points=3000)
            depth.append(1e3 * penetration_depth(probe.measure(found.grasp)))
        rows.append(
            {
                "setting": setting,
                "faces": faces,
                "held": share(held, count * len(objects)),
                "penetration_mm": mean(np.concatenate(depth)),
                "seconds": seconds,
                "cost_ratio": seconds / rows[0]["seconds"] if rows else 1.0,
            }
        )
    return {"objects": objects, "settings": rows}
