"""The wrench space and its hull against closed forms, qhull and published values."""

import json
import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
import pytest
from scipy.spatial import ConvexHull
from scipy.spatial.transform import Rotation

from graspd.worker.quality import wrench_space
from graspd.worker.quality.wrench_space import MAX_POINTS, cone_edges, contact_wrenches, measure_hulls, measure_spaces

#: The table of reference values is printed with six digits.
PRINTED = 1e-5
#: qhull joggles its input by about 1e-9 of the coordinates' range; six dimensions multiply that.
JOGGLE = 1e-6
ORIGIN = np.zeros(3)
OCTAHEDRON = np.vstack([np.eye(3), -np.eye(3)])
TETRAHEDRON = np.array([[1.0, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / math.sqrt(3)
TRIPOD = np.array([[math.cos(a), math.sin(a), 0.0] for a in 2 * np.pi * np.arange(3) / 3])
#: Both hulls joggle their points, ours by 1e-8; slivers between nearly coplanar points multiply that.
JOGGLED = 1e-6


def measure_space(edge_wrenches: np.ndarray) -> tuple[float, float]:
    """Epsilon and volume of one space."""
    one = measure_spaces(edge_wrenches[None], np.array([len(edge_wrenches)]), np.ones(1, bool))
    return float(one[0][0]), float(one[1][0])


def hull_of(points: np.ndarray, whole: bool = True) -> tuple[float, float]:
    """Radius and volume of one hull; nan where it has none."""
    one = measure_hulls(points[None], np.array([len(points)]), np.array([whole]))
    return float(one[0][0]), float(one[1][0])


def sphere_space(points: np.ndarray, friction: float, *, radius: float = 1.0, edges: int = 8) -> tuple[float, float]:
    return measure_space(
        contact_wrenches(points, -points, friction=friction, centre=ORIGIN, radius=radius, edges=edges)
    )


def test_spaces_of_closed_form() -> None:
    for dimension, volume in ((6, 64 / 720), (3, 4 / 3)):
        points = np.vstack([np.eye(dimension), -np.eye(dimension)])[:, None, :]
        assert measure_space(points) == pytest.approx((1 / math.sqrt(dimension), volume), abs=PRINTED)
    # The apothem of the friction pyramid of antipodal forces, which resist no torsion.
    opposed = np.array([[1.0, 0, 0], [-1.0, 0, 0]])
    pyramid = 0.5 * math.cos(math.pi / 8), 8 * 0.25 * math.sin(math.pi / 4)
    assert measure_space(cone_edges(opposed, 0.5)) == pytest.approx(pyramid, abs=PRINTED)
    assert sphere_space(opposed, 0.5) == (0.0, 0.0)
    # Face centres of a cube.
    edges = contact_wrenches(0.05 * OCTAHEDRON, -OCTAHEDRON, friction=0.5, centre=ORIGIN, radius=0.05 * math.sqrt(3))
    assert measure_space(edges) == pytest.approx((0.235702, 0.115207), abs=PRINTED)


@pytest.mark.parametrize(
    ("points", "options", "friction", "epsilon", "volume"),
    [(OCTAHEDRON, {}, 0.2, 0.2 * math.sqrt(2 / 3), 0.024992), (OCTAHEDRON, {}, 0.5, 0.5 * math.sqrt(2 / 3), 0.598634),
     (OCTAHEDRON, {}, 1.0, math.sqrt(2 / 3), 10.615952), (OCTAHEDRON, {"edges": 4}, 0.2, 0.2 / math.sqrt(3), 0.014643),
     (OCTAHEDRON, {"edges": 4}, 0.5, 0.5 / math.sqrt(3), 0.3125), (OCTAHEDRON, {"radius": 2}, 0.5, 0.204124, 0.074829),
     (OCTAHEDRON, {"edges": 4}, 1.0, 1 / math.sqrt(3), 4.088889),
     (TETRAHEDRON, {}, 0.2, 0.137258, 0.009218), (TETRAHEDRON, {}, 0.5, 0.343027, 0.269793),
     (TETRAHEDRON, {}, 1.0, 0.689186, 5.588981), (TRIPOD, {}, 0.2, 0.103717, 0.001378),
     (TRIPOD, {}, 0.5, 0.275925, 0.078880), (TRIPOD, {}, 1.0, 0.554694, 2.211303)],
)  # fmt: skip
def test_contacts_on_the_unit_sphere(points, options, friction: float, epsilon: float, volume: float) -> None:
    assert sphere_space(points, friction, **options) == pytest.approx((epsilon, volume), abs=PRINTED)


def test_size_order_and_rotation_of_contacts_do_not_matter() -> None:
    rng = np.random.default_rng(3)
    points = Rotation.random(7, rng=rng).apply([0, 0, 1.0])
    force = cone_edges(-points, 0.7)
    edges = np.concatenate([force, np.cross(points[:, None], force)], axis=-1)
    turn = Rotation.random(rng=rng).as_matrix()
    turned = np.einsum("ab,neb->nea", np.kron(np.eye(2), turn), edges)[rng.permutation(7)]
    assert measure_space(turned) == pytest.approx(measure_space(edges), abs=JOGGLE)
    points = Rotation.random(6, rng=4).apply([0, 0, 1.0])
    small = contact_wrenches(0.03 * points, -points, friction=0.5, centre=ORIGIN, radius=0.04)
    large = contact_wrenches(3.0 * points, -points, friction=0.5, centre=ORIGIN, radius=4.0)
    assert np.allclose(small, large, atol=1e-12)


def test_origin_outside_the_space_has_no_ball() -> None:
    epsilon, volume = measure_space(np.random.default_rng(0).normal(size=(20, 8, 6)) + 10)
    assert epsilon == 0.0 and volume > 0.0


def frogger_edges(grasp: dict[str, list[list[float]]]) -> np.ndarray:
    """Edge wrenches by the contact model that the reference files state."""
    normal = np.array(grasp["contact_normals_into_object_derived"])
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    seed = np.array([1.2, 2.3, 3.4])
    t1 = seed - (normal @ seed)[:, None] * normal
    t1 /= np.linalg.norm(t1, axis=1, keepdims=True)
    t2 = np.cross(normal, t1)
    angle = np.pi / 2 * np.arange(4)
    around = np.cos(angle)[:, None] * t1[:, None] + np.sin(angle)[:, None] * t2[:, None]
    force = (normal[:, None] + 0.5 * around) / math.sqrt(1.25)
    return np.concatenate([force, np.cross(np.array(grasp["contact_points_object"])[:, None], force)], axis=-1)


def test_published_frogger_grasps_have_their_ferrari_canny(shared_data) -> None:
    files = sorted((shared_data / "reference_grasps" / "frogger_allegro").glob("*.json"))
    grasps = [grasp for file in files for grasp in json.loads(file.read_text())["grasps"]]
    assert len(grasps) == 378
    found = [measure_space(frogger_edges(grasp))[0] for grasp in grasps]
    # Stored points and normals are rounded to 1e-7 m and 1e-6, the stored metric to 1e-8.
    stored = [max(0.0, grasp["ferrari_canny_L1_recomputed_here"]) for grasp in grasps]
    np.testing.assert_allclose(found, stored, rtol=0, atol=1e-6)


def contacts(count: int, friction: float = 1.0, seed: int = 0) -> np.ndarray:
    """(8 count, 6) edge wrenches of contacts on an ellipsoid: eight at a time are coplanar."""
    normals = Rotation.random(count, rng=seed).apply([0, 0, 1.0])
    points = -normals * np.array([1.0, 0.7, 0.4])
    return contact_wrenches(points, normals, friction=friction, centre=np.zeros(3), radius=1.0).reshape(-1, 6)


def test_radius_and_volume_are_qhull_s() -> None:
    clouds = [contacts(count, friction) for count, friction in ((4, 0.5), (8, 1.0), (20, 0.2), (20, 1.0))]
    clouds += [np.random.default_rng(seed).normal(size=(120, 6)) + 0.3 for seed in range(5)]
    clouds += [np.random.default_rng(1).normal(size=(60, 6)) + np.array([10.0, 0, 0, 0, 0, 0])]  # the origin is outside
    for points in clouds:
        theirs = ConvexHull(points, qhull_options="QJ")
        wanted = (-theirs.equations[:, -1].max(), theirs.volume)
        assert hull_of(points) == pytest.approx(wanted, rel=JOGGLED, abs=JOGGLED)


def test_threads_do_not_disturb_one_another() -> None:
    sets = [contacts(12, seed=seed) for seed in range(8)]
    alone = [hull_of(points) for points in sets]
    with ThreadPoolExecutor(4) as pool:
        assert list(pool.map(hull_of, sets)) == alone


def test_stamps_begin_anew_before_they_run_out(monkeypatch: pytest.MonkeyPatch) -> None:
    points = contacts(6)
    before = hull_of(points)
    monkeypatch.setattr(wrench_space._workspace, "next_stamp", wrench_space._LAST_STAMP - 1)
    assert hull_of(points) == before and wrench_space._workspace.next_stamp < 1000


def test_too_many_facets_are_no_hull(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wrench_space, "CAPACITY", 200)
    monkeypatch.setattr(wrench_space, "_workspace", wrench_space._Workspace())
    assert np.isnan(hull_of(contacts(12))[0])


def test_wrench_space_takes_qhull_where_ours_fails(monkeypatch: pytest.MonkeyPatch) -> None:
    edges = contacts(12).reshape(12, 8, 6)
    wanted = measure_space(edges)
    monkeypatch.setattr(wrench_space, "measure_hulls", lambda clouds, *_: np.full((2, len(clouds)), np.nan))
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
    # Where the origin is outside only that is known: how far the nearest facet is from it then says nothing of ε.
    found, whole = (max(0.0, hull_of(points, one)[0]) for one in (False, True))
    assert found == pytest.approx(whole, abs=1e-12)  # the same planes, made in another order


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
        assert (radii[row], volumes[row]) == hull_of(sets[row])
    assert radii[1] == hull_of(sets[1], False)[0] and np.isnan(volumes[1])
    assert np.isnan(radii[3:]).all() and np.isnan(volumes[3:]).all()
