"""Drops: rest poses are statically stable, repeatable, and move with the true inertia."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull
from scipy.stats import chisquare

from graspd.service.model.errors import InputError, MeshError
from graspd.service.model.transforms import apply, quat_rotate
from graspd.worker.objects.model import ObjectModel
from graspd.worker.scenes import drop, simulate
from graspd.worker.scenes.rest import resting_faces
from graspd.worker.scenes.simulate import REACH, _build
from tests.worker.models import object_from_mesh

#: Rest poses are computed in float64 from hull vertices of size 0.1 m.
ROUNDING_M = 1e-9
#: Vertices this close to the table carry the object: its hull faces are merged up to 0.05 degrees over 0.2 m.
CONTACT_M = 2e-4


def bracket() -> ObjectModel:
    """An L of two boxes: its centre of mass and inertia are far from its hull's."""
    upright = trimesh.creation.box((0.02, 0.06, 0.12))
    foot = trimesh.creation.box((0.1, 0.06, 0.02))
    foot.apply_translation((0.04, 0, -0.05))
    return object_from_mesh(trimesh.boolean.union([upright, foot], engine="manifold"), "bracket")


def scan(shared_data, name: str) -> ObjectModel:
    return object_from_mesh(trimesh.load_mesh(shared_data / "objects" / name / "clean.stl"), name)


def overhang(obj: ObjectModel, pose: np.ndarray) -> float:
    """How far the centre of mass projects outside the polygon of the hull vertices on the table; negative: inside."""
    points = apply(pose, obj.hull_vertices)
    carrying = points[points[:, 2] < CONTACT_M][:, :2]
    centre = apply(pose, obj.centre_of_mass)[:2]
    return float((ConvexHull(carrying).equations @ np.append(centre, 1.0)).max())


def test_the_simulated_inertia_is_the_meshs_and_not_the_hulls():
    obj = bracket()
    table = _build(obj)
    body = table.model.body("object")
    mass = float(body.mass[0])
    expected = np.sort(np.linalg.eigvalsh(obj.inertia))
    np.testing.assert_allclose(np.sort(body.inertia) / mass, expected, rtol=1e-9)
    np.testing.assert_allclose(body.ipos, obj.centre_of_mass, atol=1e-12)
    hull = trimesh.Trimesh(obj.hull_vertices, obj.hull_faces)
    assert np.linalg.norm(hull.center_mass - obj.centre_of_mass) > 0.005


@pytest.mark.parametrize("name", ["025_mug", "037_scissors", "006_mustard_bottle"])
def test_scanned_objects_rest_with_their_centre_of_mass_over_their_support(shared_data, name):
    obj = scan(shared_data, name)
    for pose in drop(obj, count=6, seed=3)["scene/object_pose"]:
        assert overhang(obj, pose) < 0


def test_a_concave_object_rests_stably():
    obj = bracket()
    for pose in drop(obj, count=8, seed=0)["scene/object_pose"]:
        assert overhang(obj, pose) < 0


def test_the_lowest_point_touches_the_table_and_the_object_stays_near_the_middle():
    obj = bracket()
    poses = drop(obj, count=8, seed=1)["scene/object_pose"]
    heights = apply(poses[:, None], obj.hull_vertices)[..., 2].min(axis=1)
    np.testing.assert_allclose(heights, 0.0, atol=ROUNDING_M)
    np.testing.assert_allclose(np.linalg.norm(poses[:, 3:], axis=1), 1.0, atol=1e-12)
    centres = apply(poses, obj.centre_of_mass)
    assert np.hypot(centres[:, 0], centres[:, 1]).max() < REACH


def test_a_can_lies_on_its_side_or_stands():
    radius, height = 0.03, 0.1
    obj = object_from_mesh(trimesh.creation.cylinder(radius=radius, height=height, sections=64), "can")
    result = drop(obj, count=12, seed=2)
    centre = apply(result["scene/object_pose"], obj.centre_of_mass)[:, 2]
    # The side is a polygon of 64 corners: its flats lie r (1 - cos(pi/64)) nearer to the axis.
    flat = radius * np.cos(np.pi / 64)
    assert np.all(np.minimum(np.abs(centre - flat), np.abs(centre - height / 2)) < 1e-6)


def test_a_thin_slab_almost_never_stands_on_an_edge():
    obj = object_from_mesh(trimesh.creation.box((0.1, 0.08, 0.008)), "slab")
    result = drop(obj, count=10, seed=0)
    up = np.abs(quat_rotate(result["scene/object_pose"][:, 3:], np.array([0.0, 0, 1]))[:, 2])
    assert np.all(up > 0.999)
    # Two faces share all drops; the estimate from 64 drops scatters by 0.06.
    assert np.all(np.abs(result["scene/rest_probability"] - 0.5) < 4 * 0.0625)


def test_the_same_seed_gives_the_same_scenes_and_more_scenes_keep_the_first():
    obj = bracket()
    first, again, more = drop(obj, count=3, seed=7), drop(obj, count=3, seed=7), drop(obj, count=5, seed=7)
    for name, values in first.items():
        np.testing.assert_array_equal(values, again[name])
        np.testing.assert_array_equal(values, more[name][:3])
    assert not np.array_equal(first["scene/object_pose"], drop(obj, count=3, seed=8)["scene/object_pose"])


def test_stable_faces_agree_with_trimeshs():
    mesh = trimesh.creation.box((0.06, 0.08, 0.1))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]))
    obj = object_from_mesh(mesh)
    transforms, _ = trimesh.poses.compute_stable_poses(mesh, sigma=0.0, n_samples=1)
    expected = -transforms[:, 2, :3]
    found = resting_faces(obj)
    assert len(found.stable) == len(expected)
    # Each face of ours has a partner of theirs.
    np.testing.assert_allclose((found.normal[found.stable] @ expected.T).max(axis=1), 1.0, atol=1e-9)


@pytest.mark.slow
@pytest.mark.parametrize("size", [(0.04, 0.06, 0.09), (0.05, 0.06, 0.07)])
def test_bricks_rest_on_each_pair_of_faces_as_often_as_the_quasi_static_theory_says(size):
    """Chi-square of 300 drops against Goldberg et al. (1999), which knows no bouncing: contacts here hardly bounce."""
    mesh = trimesh.creation.box(size)
    poses = drop(object_from_mesh(mesh), count=300, seed=0)["scene/object_pose"]
    down = quat_rotate(poses[:, 3:] * np.array([1, -1, -1, -1]), np.array([0.0, 0, -1]))
    counts = np.bincount(np.argmax(np.abs(down), axis=1), minlength=3)
    transforms, probability = trimesh.poses.compute_stable_poses(mesh, sigma=0.0, n_samples=1)
    axis = np.argmax(np.abs(transforms[:, 2, :3]), axis=1)
    expected = np.bincount(axis, weights=probability, minlength=3)
    assert chisquare(counts, 300 * expected / expected.sum()).pvalue > 0.01


def hull_of(points) -> trimesh.Trimesh:
    return trimesh.convex.convex_hull(np.array(points, float))


CONVEX = {
    "prism": hull_of([(x, y, z) for x, y in [(0, 0), (0.06, 0), (0.02, 0.05)] for z in (0, 0.05)]),
    "frustum": hull_of([(x * w, y * w, z) for w, z in ((0.035, 0), (0.022, 0.05)) for x in (-1, 1) for y in (-1, 1)]),
    "tetrahedron": hull_of([(0, 0, 0), (0.07, 0, 0), (0.01, 0.06, 0), (0.02, 0.02, 0.055)]),
    "hexagonal": hull_of(
        [(0.03 * np.cos(a), 0.03 * np.sin(a), z) for a in np.arange(6) * np.pi / 3 for z in (0, 0.05)]
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CONVEX)
def test_convex_objects_rest_on_each_face_as_often_as_the_quasi_static_theory_says(name):
    mesh = CONVEX[name]
    poses = drop(object_from_mesh(mesh, name), count=300, seed=0)["scene/object_pose"]
    down = quat_rotate(poses[:, 3:] * np.array([1, -1, -1, -1]), np.array([0.0, 0, -1]))
    transforms, probability = trimesh.poses.compute_stable_poses(mesh, sigma=0.0, n_samples=1)
    agreement = down @ -transforms[:, 2, :3].T
    # Every drop ends on one of trimesh's stable faces.
    assert agreement.max(axis=1).min() > 1 - 1e-6
    counts = np.bincount(np.argmax(agreement, axis=1), minlength=len(probability))
    assert chisquare(counts, 300 * probability / probability.sum()).pvalue > 0.01


@pytest.fixture
def dropped(monkeypatch, tmp_path) -> list[tuple[int, int]]:
    """Keys of the drops that are simulated, in a cache of their own."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    keys: list[tuple[int, int]] = []
    whole = simulate._redo_until_rest

    def counted(table, name, key):
        keys.append(key)
        return whole(table, name, key)

    monkeypatch.setattr(simulate, "_redo_until_rest", counted)
    return keys


def next_process() -> None:
    simulate._reference_faces.cache_clear()


def test_reference_drops_are_simulated_once_on_a_machine(dropped):
    next_process()
    first = drop(bracket(), count=1, seed=5)
    assert len(dropped) == 1 + simulate.REFERENCE_DROPS
    next_process()
    again = drop(bracket(), count=1, seed=5)
    assert len(dropped) == 2 + simulate.REFERENCE_DROPS
    np.testing.assert_array_equal(first["scene/rest_probability"], again["scene/rest_probability"])


@pytest.mark.parametrize(
    "harm",
    [{"face": np.full(64, 99)}, {"face": np.zeros(3, np.int64)}, {"face": np.zeros(64)}, {"other": np.zeros(64)}],
)
def test_kept_drops_that_cannot_be_those_of_the_object_are_simulated_again(dropped, tmp_path, harm):
    next_process()
    first = drop(bracket(), count=1, seed=5)
    (file,) = tmp_path.rglob("drops/*.npz")
    np.savez(file, **harm)
    next_process()
    again = drop(bracket(), count=1, seed=5)
    assert len(dropped) == 2 * (1 + simulate.REFERENCE_DROPS)
    np.testing.assert_array_equal(first["scene/rest_probability"], again["scene/rest_probability"])


def test_no_scenes_give_empty_arrays():
    result = drop(bracket(), count=0, seed=0)
    assert result["scene/object_pose"].shape == (0, 7)
    assert result["scene/rest_probability"].shape == result["scene/drop_seconds"].shape == (0,)


def test_a_negative_count_is_refused():
    with pytest.raises(InputError, match="must not be negative"):
        drop(bracket(), count=-1, seed=0)


def test_a_flat_object_is_refused_by_name():
    flat = trimesh.Trimesh([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], [[0, 1, 2], [0, 2, 1]], process=False)
    box = bracket()
    obj = ObjectModel(
        name="sheet",
        digest="f" * 32,
        vertices=flat.vertices,
        faces=np.asarray(flat.faces, np.int32),
        corner_normals=np.zeros((2, 3, 3)),
        volume=1e-9,
        centre_of_mass=np.array([0.03, 0.03, 0]),
        inertia=box.inertia,
        radius=0.1,
        hull_vertices=np.asarray(flat.vertices),
        hull_faces=np.asarray(flat.faces, np.int32),
    )
    with pytest.raises(MeshError, match="sheet"):
        drop(obj, count=1, seed=0)
