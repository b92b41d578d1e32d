"""Influence of the scene's model on the verdict of the lift test.

The reference is the lift test: a rigid table with friction, approach, closing, lift and hold. All variants use the same
grasps, planned on a table, with a clear approach."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from benchmarks.modelling.common import PLAIN, SEED, Bools, Row, Subject, cpu, share
from graspd.service.model.scene_spec import SceneSpec
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import GraspSet
from graspd.worker.planners import synthesize
from graspd.worker.planners.port import PlanRequest
from graspd.worker.scenes.clearance import MARGIN_M
from graspd.worker.scenes.kinds import rest_poses, supports_of
from graspd.worker.scenes.trajectory import Trajectory, plan_trajectory
from graspd.worker.simulation.environment import Obstacle, PlacedGrasps, Scenes
from graspd.worker.validation.lift import Lift
from graspd.worker.validation.model import MujocoOptions, Scene, build_scene
from graspd.worker.validation.protocol import Outcome, Rollout

#: A table of 1.2 x 0.9 m, 30 mm thick.
SLAB = Obstacle.box([0, 0, -0.015, 1, 0, 0, 0], [1.2, 0.9, 0.03])
SOFT_M = 5e-3


@dataclass
class OnTable:
    """Grasps of a subject, planned on a table."""

    subject: Subject

    @cached_property
    def scenes(self) -> Scenes:
        spec = SceneSpec(kind="table", faces="all")
        return Scenes(supports_of(spec), rest_poses(spec, self.subject.obj, count=1, seed=SEED)["scene/object_pose"])

    @cached_property
    def placed(self) -> PlacedGrasps:
        return self.scenes.placed(np.arange(self.subject.count) % len(self.scenes.object_pose))

    def planned(self, placed: PlacedGrasps) -> GraspSet:
        wanted = PlanRequest(self.subject.count, PLAIN, SEED, placed=placed)
        return synthesize(self.subject.hand, self.subject.obj, wanted, ExecutionContext(threads=1))

    @cached_property
    def grasps(self) -> GraspSet:
        return self.planned(self.placed)

    @cached_property
    def way(self) -> Trajectory:
        return plan_trajectory(self.subject.hand, self.subject.obj, self.grasps, self.placed)

    @cached_property
    def clear(self) -> tuple[GraspSet, PlacedGrasps]:
        """Grasps with clear trajectories, and their scenes."""
        way, rows = self.way, np.flatnonzero(self.way.clear)
        ready = replace(self.grasps, approach=way.approach, coming=way.open, lift=way.lift)
        return ready.take(rows), self.placed.take(rows)


def _supports(scene: Scene, friction: float | None = None, width_m: float | None = None) -> None:
    """Set friction or softness of contacts with supports, independent of the other geometry."""
    rows = scene.support_geoms
    scene.model.geom_priority[rows] = 1
    if friction is not None:
        scene.model.geom_friction[rows] = friction
    if width_m is not None:
        scene.model.geom_solimp[rows] = (0.05, 0.95, width_m, 0.5, 2.0)


def _no_hold(test: Lift, grasps: GraspSet, row: int) -> bool:
    test._set_up_scene(grasps, row)
    if not test._close(grasps, row, give_up=True):
        return False
    test._rise(grasps, row)
    return test._validate(Rollout()) is Outcome.HELD


def variants() -> dict[str, tuple[Callable[[Scene], None], Callable[[Lift, GraspSet, int], bool]]]:
    """Return variants: change of the compiled scene, and function that validates a grasp in it."""

    def lift(test: Lift, grasps: GraspSet, row: int) -> bool:
        return test.lift(grasps, row).success

    def dexgraspbench(test: Lift, grasps: GraspSet, row: int) -> bool:
        return test.dexgraspbench(grasps, row).success

    def same(scene: Scene) -> None:
        return None

    return {
        "lift": (same, lift),
        "a table without friction": (lambda scene: _supports(scene, friction=1e-6), lift),
        "a table that yields by 5 mm": (lambda scene: _supports(scene, width_m=SOFT_M), lift),
        "without the hold of 2 s": (same, _no_hold),
        "DexGraspBench protocol: no approach, no hold": (same, dexgraspbench),
    }


def validated(tables: list[OnTable]) -> list[Row]:
    """Return each variant's rate, and its agreement and cost relative to the lift test."""
    rows: list[Row] = []
    reference: Bools | None = None
    spent = 0.0
    for name, (change, ask) in variants().items():
        held: list[bool] = []
        with cpu() as clock:
            for one in tables:
                grasps, placed = one.clear
                scene = build_scene(
                    one.subject.hand, one.subject.obj, one.subject.pieces, MujocoOptions(), placed.supports
                )
                change(scene)
                test = Lift(scene, placed)
                held += [ask(test, grasps, row) for row in range(len(grasps))]
        now = np.array(held, bool)
        if reference is None:
            reference, spent = now, clock.seconds
        rows.append(
            {
                "model": name,
                "held": share(int(now.sum()), len(now)),
                "agreement": share(int((now == reference).sum()), len(now)),
                "only_here": int((now & ~reference).sum()),
                "only_lift": int((~now & reference).sum()),
                "cost_ratio": clock.seconds / spent,
            }
        )
    return rows


def straight(tables: list[OnTable]) -> Row:
    """Return the share of grasps that are obstructed only on the straight approach."""
    lost = [
        (np.minimum(np.minimum(one.way.contact, one.way.closing), one.way.lifting) >= MARGIN_M) & ~one.way.clear
        for one in tables
    ]
    every = np.concatenate(lost)
    return share(int(every.sum()), len(every))


def slabs(tables: list[OnTable]) -> Row:
    """Compare planning on a half-space with planning on a slab of six planes."""
    half, slab = 0.0, 0.0
    clear = []
    for one in tables:
        on_slab = PlacedGrasps((SLAB,), one.placed.object_pose, one.placed.index)
        with cpu() as clock:
            one.planned(one.placed)
        half += clock.seconds
        with cpu() as clock:
            found = one.planned(on_slab)
        slab += clock.seconds
        clear.append(plan_trajectory(one.subject.hand, one.subject.obj, found, one.placed).clear)
    now = np.concatenate(clear)
    return {
        "cost_ratio": slab / half,
        "clear": share(int(now.sum()), len(now)),
        "clear_half_space": share(int(sum(one.way.clear.sum() for one in tables)), len(now)),
    }


def study(subjects: list[Subject], count: int) -> dict[str, Any]:
    tables = [OnTable(replace(subject, count=count)) for subject in subjects]
    for one in tables:
        _ = (one.clear, one.subject.pieces)  # prepares grasps, trajectories and pieces before the timed runs
    rows = validated(tables)
    return {"variants": rows, "straight_only": straight(tables), "slab": slabs(tables)}
