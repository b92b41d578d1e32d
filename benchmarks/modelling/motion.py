"""Influence of simulated motion and stiffness of hand and object on the verdict.

The reference is level standard: fingers driven by actuators, hand root on a weld, rigid bodies. All variants use the
same unselected grasps."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.stats import rankdata

from benchmarks.integrators.reference import World
from benchmarks.modelling.common import Bools, Floats, Row, Subject, cpu, ranking, share, verdicts
from benchmarks.modelling.steps import forward_simulation
from graspd.worker.control.postures import hold_forces
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.objects.convex import union_volume
from graspd.worker.planners.fast_graspd.candidates import FRICTION
from graspd.worker.quality.probe import probe_of
from graspd.worker.quality.table import measure
from graspd.worker.validation.decomposition import ConvexPieces
from graspd.worker.validation.displacement import simulated_displacement_cm
from graspd.worker.validation.model import MujocoOptions, Scene, build_scene

STEPS = (1, 3, 10)
#: Number of hand points of the rollouts, between those of the planner's coarse and fine phases.
POINTS = 800
#: Contact thresholds that represent pads which yield by this distance [m].
PADS_M = (0.0005, 0.001, 0.002, 0.005)
#: Torsional friction of point contacts without a patch [m].
NO_PATCH = 1e-4


def predictors(subjects: list[Subject], held: list[Bools], spent: float) -> list[Row]:
    """Return the AUC of cheap predictors with a fixed hand, and their costs relative to level standard."""
    rows = []
    rolled, seconds = _rollouts(subjects)
    for k, count in enumerate(STEPS):
        scores = [-r[:, k] for r in rolled]
        rows.append(_row(f"static hand, {count} step{'s' * (count > 1)} (L_stable)", scores, held, None, spent))
        # The first step is part of the planner; the cost of more steps is their number.
        rows[-1]["steps_ratio"] = float(count)
    with cpu() as clock:
        balance = [-hold_forces(s.hand, s.obj, s.grasps.grasp, friction=FRICTION).residual for s in subjects]
    rows.append(_row("static hand, balance of contact forces (selects the start)", balance, held, clock.seconds, spent))
    both = [rankdata(b) + rankdata(-r[:, -1]) for b, r in zip(balance, rolled, strict=True)]
    rows.append(_row(f"balance and {STEPS[-1]} steps, sum of ranks", both, held, None, spent))
    rows[-1]["steps_ratio"] = float(STEPS[-1])
    with cpu() as clock:
        slips = [
            -simulated_displacement_cm(s.hand, s.obj, s.grasps.grasp, pieces=s.pieces, run=ExecutionContext(threads=1))
            for s in subjects
        ]
    rows.append(_row("static hand, 35 steps of MuJoCo (simulated displacement)", slips, held, clock.seconds, spent))
    rows[0]["numpy_seconds"] = seconds
    return rows


def _row(name: str, scores: list[Floats], held: list[Bools], seconds: float | None, spent: float) -> Row:
    ratio = None if seconds is None else seconds / spent
    return {"model": name, "auc": ranking(scores, held), "cost_ratio": ratio}


def _rollouts(subjects: list[Subject]) -> tuple[list[Floats], float]:
    found = []
    with cpu() as clock:
        for s in subjects:
            probe = probe_of(s.hand, s.obj, hand_points=POINTS, object_points=64)
            world = World(inertia=s.obj.inertia, gyration=s.obj.gyration_radius)
            found.append(forward_simulation(probe, s.grasps.grasp, world, STEPS))
    return found, clock.seconds


def _soft(width_m: float) -> Callable[[Scene], None]:
    def soften(scene: Scene) -> None:
        # Use the hand's parameters alone; MuJoCo would average the parameters of both geometries.
        scene.model.geom_priority[scene.hand_geoms] = 1
        scene.model.geom_solimp[scene.hand_geoms] = (0.05, 0.95, width_m, 0.5, 2.0)

    return soften


def _hull(subject: Subject) -> ConvexPieces:
    corners = subject.obj.hull_vertices
    volume = union_volume((corners,))
    return ConvexPieces((corners,), volume / subject.obj.volume, 0.0, "hull")


def engines() -> dict[str, tuple[MujocoOptions, Callable[[Scene], None] | None, bool]]:
    """Return validator variants: physics, change of the compiled scene, whether the object is one hull."""
    base = MujocoOptions()
    slide, _ = base.friction
    return {
        "standard": (base, None, False),
        "hand root fixed": (replace(base, root="fixed"), None, False),
        "pads that yield by 2 mm": (base, _soft(2e-3), False),
        "no contact patch": (replace(base, friction=(slide, NO_PATCH)), None, False),
        "object as one hull": (base, None, True),
    }


def validated(subjects: list[Subject]) -> tuple[list[Row], list[Bools], float]:
    """Return each variant's rate, agreement and cost ratio; then verdicts and CPU time of level standard."""
    rows: list[Row] = []
    reference: list[Bools] = []
    spent = 0.0
    for name, (physics, change, hull) in engines().items():
        held = []
        with cpu() as clock:
            for s in subjects:
                scene = build_scene(s.hand, s.obj, _hull(s) if hull else s.pieces, physics)
                if change is not None:
                    change(scene)
                held.append(verdicts(scene, s.grasps))
        if not reference:
            reference, spent = held, clock.seconds
        now, then = np.concatenate(held), np.concatenate(reference)
        rows.append(
            {
                "model": name,
                "held": share(int(now.sum()), len(now)),
                "agreement": share(int((now == then).sum()), len(now)),
                "only_here": int((now & ~then).sum()),
                "only_standard": int((~now & then).sum()),
                "cost_ratio": clock.seconds / spent,
                "ms_per_grasp": 1e3 * clock.seconds / len(now),
            }
        )
    return rows, reference, spent


def pads(subjects: list[Subject]) -> list[Row]:
    """Return contact area and epsilon if all hand surface within a distance of the object were in contact."""
    tables = [
        measure(
            s.hand,
            s.obj,
            s.grasps.take(slice(0, 16)),
            friction=1.0,
            thresholds_m=PADS_M,
            run=ExecutionContext(threads=1),
        )
        for s in subjects
    ]
    area = np.concatenate([t["quality/contact_area_cm2"] for t in tables]).mean(axis=0)
    epsilon = np.concatenate([t["quality/epsilon"] for t in tables]).mean(axis=0)
    n = sum(len(t["quality/epsilon"]) for t in tables)
    return [
        {"give_mm": 1e3 * m, "contact_area_cm2": float(a), "epsilon": float(e), "n": n}
        for m, a, e in zip(PADS_M, area, epsilon, strict=True)
    ]


def study(subjects: list[Subject]) -> dict[str, Any]:
    for subject in subjects:
        # Prepare grasps, pieces and kernels before the timed runs.
        assert len(subject.grasps) and len(subject.pieces)
        simulated_displacement_cm(
            subject.hand,
            subject.obj,
            subject.grasps.grasp.take(slice(0, 1)),
            pieces=subject.pieces,
            run=ExecutionContext(threads=1),
        )
    rows, held, spent = validated(subjects)
    return {
        "objects": [s.obj.name for s in subjects],
        "engines": rows,
        "predictors": predictors(subjects, held, spent),
        "pads": pads(subjects),
    }
