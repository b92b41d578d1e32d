"""The prices of what is left out: the studies' own arithmetic, and the recipe of the page."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import trimesh

from benchmarks.modelling.common import auc, ranking
from benchmarks.modelling.drops import drops, forearm
from benchmarks.modelling.steps import forward_simulation, step
from graspd.service.store.shards import write_shard
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.quality.probe import probe_of
from graspd.worker.rendering import render
from graspd.worker.scenes import drop
from graspd.worker.simulation.reference import Contacts, World, direct
from tests.conftest import REPOSITORY

PAGE = (REPOSITORY / "docs" / "explanation" / "modelling.md").read_text()


def test_a_step_is_that_of_the_reference() -> None:
    rng = np.random.default_rng(3)
    points = rng.normal(scale=0.03, size=(12, 3))
    normals = points / np.linalg.norm(points, axis=1, keepdims=True)
    distance, weight = rng.normal(scale=4e-4, size=12), rng.uniform(0.5, 2.0, size=12)
    world = World(inertia=np.diag([4e-4, 5e-4, 6e-4]), gyration=0.022)
    motion = np.array([1e-3, 0, 0, 0, 0, 0])
    expected = direct(Contacts(points, normals, distance, weight), motion, world, passes=4)
    # Both are float64 and differ in the order of sums only.
    found = step(points, normals, distance, weight, motion, world, world.inertia, passes=4)
    np.testing.assert_allclose(found, expected, rtol=1e-9, atol=1e-15)


def test_an_object_that_nothing_touches_moves_on_freely() -> None:
    hand, obj = hand_from_path("allegro"), object_from_path("block")
    probe = probe_of(hand, obj, hand_points=100, object_points=64)
    far = Posture(np.array([[5.0, 0, 0, 1, 0, 0, 0]]), hand.expand(np.zeros((1, hand.dofs))))
    world = World(inertia=obj.inertia, gyration=obj.gyration_radius)
    # Six of seven velocities move by one step each; norms are smoothed by 1 % of a step, twice.
    np.testing.assert_allclose(forward_simulation(probe, far, world, (1, 4)), [[6 / 7, 24 / 7]], atol=0.03)


def test_rankings_count_what_is_told_apart() -> None:
    for score, expected in (([1, 2, 3, 4], 1.0), ([4, 3, 2, 1], 0.0), ([1, 1, 1, 1], 0.5)):
        assert auc(np.array(score, float), np.array([False, False, True, True])) == expected
    found = ranking([np.arange(6.0), np.zeros(4)], [np.arange(6) > 2, np.ones(4, bool)])
    assert (found["value"], found["n"]) == (1.0, 6)


def test_convex_objects_fall_as_their_hull_forearms_end_below() -> None:
    (found,) = drops([object_from_path("block")], 4)
    assert (found["pieces"], found["same_face"]["value"], found["distance"]) == (1, 1.0, 0.0)
    half = np.sqrt(0.5)
    # Fingers up, fingers down, lying on its side; the root half a metre above the table.
    turns = [[1, 0, 0, 0], [0, 1, 0, 0], [half, half, 0, 0]]
    lowest, slope = forearm(np.array([[0, 0, 0.5, *turn] for turn in turns]), np.zeros(3))
    np.testing.assert_allclose(lowest, [0.2, 0.8, 0.46], atol=1e-12)
    np.testing.assert_allclose(slope, [-1, 1, 0], atol=1e-12)


def test_pages_recipe_finds_point_of_the_mesh_behind_each_pixel(tmp_path: Path) -> None:
    obj = object_from_path("block")
    poses = drop(obj, count=1, seed=2)["scene/object_pose"]
    arrays = render(
        obj, poses, views=1, stereo=False, width=40, height=30, seed=3, samples=2, run=ExecutionContext(threads=1)
    )
    (tmp_path / "views.h5").write_bytes(write_shard("views", arrays, {}))
    with h5py.File(tmp_path / "scenes.h5", "w") as file:
        file["scene/object_pose"] = poses
    (recipe,) = re.findall(r"```python\n(.*?)```", PAGE, re.S)
    names: dict[str, Any] = {}
    exec(recipe, names)
    points = names["object_points"](tmp_path / "views.h5", tmp_path / "scenes.h5", 0)
    seen = points[arrays["image/segmentation"][0] == 2]
    mesh = trimesh.Trimesh(obj.vertices, obj.faces, process=False)
    # Depth is float32 at half a metre: 0.1 mm is a thousand times its rounding, and far below a pixel's width.
    assert len(seen) > 50
    assert np.abs(trimesh.proximity.closest_point(mesh, seen)[1]).max() < 1e-4
