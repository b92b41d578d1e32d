"""Our six-dimensional hull against qhull and closed forms."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from graspd.worker.quality import wrench_space
from graspd.worker.quality.wrench_space import (
    MAX_POINTS,
    measure_hulls,
    measure_space,
    radius,
    radius_and_volume,
    wrenches,
)

#: Both hulls joggle their points, ours by 1e-8; slivers between nearly coplanar points multiply that.
JOGGLED = 1e-6


def contacts(count: int, friction: float = 1.0, seed: int = 0) -> np.ndarray:
    """(8 count, 6) edge wrenches of contacts on an ellipsoid: eight at a time are coplanar."""
    normals = Rotation.random(count, rng=seed).apply([0, 0, 1.0])
    points = -normals * np.array([1.0, 0.7, 0.4])
    return wrenches(points, normals, friction=friction, centre=np.zeros(3), radius=1.0).reshape(-1, 6)


@pytest.mark.parametrize(("count", "friction"), [(4, 0.5), (8, 1.0), (20, 0.2), (20, 1.0)])
def test_radius_and_volume_are_qhull_s(count: int, friction: float) -> None:
    points = contacts(count, friction)
    theirs = ConvexHull(points, qhull_options="QJ")
    wanted = (-theirs.equations[:, -1].max(), theirs.volume)
    assert radius_and_volume(points) == pytest.approx(wanted, rel=JOGGLED, abs=JOGGLED)


@pytest.mark.parametrize("seed", range(5))
def test_gaussian_clouds_are_measured_like_qhull_does(seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(120, 6)) + 0.3
    theirs = ConvexHull(points)
    wanted = (-theirs.equations[:, -1].max(), theirs.volume)
    assert radius_and_volume(points) == pytest.approx(wanted, rel=JOGGLED, abs=JOGGLED)


def test_cube_has_half_its_edge_as_radius() -> None:
    corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * 6)).reshape(6, -1).T
    assert radius_and_volume(corners) == pytest.approx((1.0, 64.0), rel=JOGGLED)


def test_cross_polytope_with_points_inside() -> None:
    inner = 0.16 * np.random.default_rng(0).uniform(-1, 1, (40, 6))
    points = np.vstack([np.eye(6), -np.eye(6), inner])
    assert radius_and_volume(points) == pytest.approx((1 / math.sqrt(6), 64 / 720), rel=JOGGLED)


def test_origin_outside_gives_its_distance_as_negative() -> None:
    points = np.random.default_rng(1).normal(size=(60, 6)) + np.array([10.0, 0, 0, 0, 0, 0])
    theirs = ConvexHull(points)
    found = radius_and_volume(points)
    assert found is not None
    assert found[0] == pytest.approx(-theirs.equations[:, -1].max(), rel=JOGGLED)


def test_threads_do_not_disturb_one_another() -> None:
    sets = [contacts(12, seed=seed) for seed in range(8)]
    alone = [radius_and_volume(points) for points in sets]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(radius_and_volume, sets)) == alone


def test_stamps_begin_anew_before_they_run_out(monkeypatch: pytest.MonkeyPatch) -> None:
    points = contacts(6)
    before = radius_and_volume(points)
    monkeypatch.setattr(wrench_space._workspace, "next_stamp", wrench_space._LAST_STAMP - 1)
    assert radius_and_volume(points) == before
    assert wrench_space._workspace.next_stamp < 1000


def test_too_many_facets_are_no_hull(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wrench_space, "CAPACITY", 200)
    monkeypatch.setattr(wrench_space, "_workspace", wrench_space._Workspace())
    assert radius_and_volume(contacts(12)) is None


def test_wrench_space_takes_qhull_where_ours_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    edges = contacts(12).reshape(12, 8, 6)
    wanted = measure_space(edges)
    monkeypatch.setattr(
        "graspd.worker.quality.wrench_space.measure_hulls", lambda clouds, *_: np.full((2, len(clouds)), np.nan)
    )
    assert measure_space(edges) == pytest.approx(wanted, rel=JOGGLED)


def test_more_points_than_the_workspace_holds_go_to_qhull() -> None:
    points = np.random.default_rng(2).normal(size=(MAX_POINTS + 8, 6))
    points /= 1 + np.linalg.norm(points, axis=1, keepdims=True) ** 4
    theirs = ConvexHull(points)
    assert measure_space(points[:, None])[1] == pytest.approx(theirs.volume, rel=JOGGLED)


@pytest.mark.parametrize(("count", "friction"), [(4, 0.5), (8, 1.0), (20, 0.2), (20, 1.0)])
@pytest.mark.parametrize("seed", range(4))
def test_the_radius_alone_is_that_of_the_whole_hull(count: int, friction: float, seed: int) -> None:
    points = contacts(count, friction, seed)
    whole = radius_and_volume(points)
    assert whole is not None
    # Where the origin is outside only that is known: how far the nearest facet is from it then says nothing of ε.
    found = radius(points)
    assert found is not None
    assert max(0.0, found) == pytest.approx(max(0.0, whole[0]), abs=1e-12)  # the same planes, made in another order


def test_the_radius_alone_of_a_cube_with_points_inside() -> None:
    corners = np.array(np.meshgrid(*[[-1.0, 1.0]] * 6)).reshape(6, -1).T
    inner = np.random.default_rng(0).uniform(-0.9, 0.9, (60, 6))
    assert radius(np.vstack([inner, corners])) == pytest.approx(1.0, rel=JOGGLED)


@pytest.mark.parametrize("seed", range(3))
def test_the_radius_alone_of_a_cloud_beside_the_origin_is_not_positive(seed: int) -> None:
    points = np.random.default_rng(seed).normal(size=(120, 6)) + 5.0
    found = radius(points)
    assert found is not None
    assert found <= 0


def test_many_hulls_at_once_are_those_of_each_alone() -> None:
    """Clouds of different sizes, a flat one and one too small among them; a volume only where it is asked for."""
    sets = [contacts(count, seed=count) for count in (4, 20, 9)]
    sets += [np.hstack([np.random.default_rng(3).normal(size=(40, 5)), np.zeros((40, 1))]), sets[0][:6]]
    clouds = np.full((5, 160, 6), 7.0)  # what lies behind a cloud is none of its points
    for row, points in enumerate(sets):
        clouds[row, : len(points)] = points
    whole = np.array([True, False, True, True, True])
    radii, volumes = measure_hulls(clouds, np.array([len(points) for points in sets]), whole)
    for row in (0, 2):
        assert (radii[row], volumes[row]) == radius_and_volume(sets[row])
    assert radii[1] == radius(sets[1]) and np.isnan(volumes[1])
    assert np.isnan(radii[3:]).all() and np.isnan(volumes[3:]).all()
