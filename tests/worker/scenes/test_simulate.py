"""Rest poses: drops, faces that carry, scenes of every kind, and neighbours laid in them."""

import dataclasses
from functools import partial

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull
from scipy.stats import chisquare

from graspd.service.model.errors import InputError, MeshError, SceneError
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.transforms import apply, quat_conjugate, quat_rotate
from graspd.worker.objects.model import ObjectModel
from graspd.worker.scenes import drop, simulate
from graspd.worker.scenes.kinds import GAP, rest_poses, supports_of, walled_area
from graspd.worker.scenes.neighbours import BETWEEN, drop_together
from graspd.worker.scenes.placement import gaps_between, neighbour_of, scenes_of
from graspd.worker.scenes.rest import RestingFaces, count_rolling_poses, resting_faces, rolling_note
from graspd.worker.scenes.simulate import REACH, _build_table
from tests.worker.models import object_from_mesh

#: Rest poses are computed in float64 from hull vertices of size 0.1 m.
ROUNDING_M = 1e-9
#: Vertices this close to the table carry the object: its hull faces are merged up to 0.05 degrees over 0.2 m.
CONTACT_M = 2e-4
UP = np.array([0.0, 0, 1])


def box(*size: float, name: str = "box") -> ObjectModel:
    return object_from_mesh(trimesh.creation.box(size), name)


BLOCK = box(0.05, 0.07, 0.11, name="block")


def bracket() -> ObjectModel:
    """An L of two boxes: its centre of mass and inertia are far from its hull's."""
    upright = trimesh.creation.box((0.02, 0.06, 0.12))
    foot = trimesh.creation.box((0.1, 0.06, 0.02))
    foot.apply_translation((0.04, 0, -0.05))
    return object_from_mesh(trimesh.boolean.union([upright, foot], engine="manifold"), "bracket")


def overhang(obj: ObjectModel, pose: np.ndarray) -> float:
    points = apply(pose, obj.hull_vertices)
    carrying = points[points[:, 2] < CONTACT_M][:, :2]
    centre = apply(pose, obj.centre_of_mass)[:2]
    return float((ConvexHull(carrying).equations @ np.append(centre, 1.0)).max())


def test_a_drop_has_the_inertia_of_the_mesh_and_ends_on_the_table_near_the_middle():
    obj = bracket()
    body = _build_table(obj).model.body("0")
    mass = float(body.mass[0])
    expected = np.sort(np.linalg.eigvalsh(obj.inertia))
    np.testing.assert_allclose(np.sort(body.inertia) / mass, expected, rtol=1e-9)
    np.testing.assert_allclose(body.ipos, obj.centre_of_mass, atol=1e-12)
    hull = trimesh.Trimesh(obj.hull_vertices, obj.hull_faces)
    assert np.linalg.norm(hull.center_mass - obj.centre_of_mass) > 0.005
    poses = drop(obj, count=8, seed=1)["scene/object_pose"]
    heights = apply(poses[:, None], obj.hull_vertices)[..., 2].min(axis=1)
    np.testing.assert_allclose(heights, 0.0, atol=ROUNDING_M)
    np.testing.assert_allclose(np.linalg.norm(poses[:, 3:], axis=1), 1.0, atol=1e-12)
    assert all(overhang(obj, pose) < 0 for pose in poses)
    centres = apply(poses, obj.centre_of_mass)
    assert np.hypot(centres[:, 0], centres[:, 1]).max() < REACH


def test_stable_faces_agree_with_trimeshs():
    mesh = trimesh.creation.box((0.06, 0.08, 0.1))
    mesh.apply_transform(trimesh.transformations.rotation_matrix(0.7, [1, 2, 3]))
    obj = object_from_mesh(mesh)
    transforms, _ = trimesh.poses.compute_stable_poses(mesh, sigma=0.0, n_samples=1)
    expected = -transforms[:, 2, :3]
    found = resting_faces(obj)
    assert len(found.stable_faces) == len(expected)
    # Each face of ours has a partner of theirs.
    np.testing.assert_allclose((found.normal[found.stable_faces] @ expected.T).max(axis=1), 1.0, atol=1e-9)


def hull_of(points) -> trimesh.Trimesh:
    return trimesh.convex.convex_hull(np.array(points, float))


SIXTHS = np.arange(6) * np.pi / 3
CONVEX = {
    "brick": trimesh.creation.box((0.04, 0.06, 0.09)),
    "prism": hull_of([(x, y, z) for x, y in [(0, 0), (0.06, 0), (0.02, 0.05)] for z in (0, 0.05)]),
    "frustum": hull_of([(x * w, y * w, z) for w, z in ((0.035, 0), (0.022, 0.05)) for x in (-1, 1) for y in (-1, 1)]),
    "tetrahedron": hull_of([(0, 0, 0), (0.07, 0, 0), (0.01, 0.06, 0), (0.02, 0.02, 0.055)]),
    "hexagonal": hull_of([(0.03 * np.cos(a), 0.03 * np.sin(a), z) for a in SIXTHS for z in (0, 0.05)]),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CONVEX)
def test_convex_objects_rest_on_faces_as_often_as_theory_says(name):
    """Chi-square of 300 drops against Goldberg et al. (1999), which knows no bouncing: contacts here hardly bounce."""
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
def dropped(monkeypatch, own_cache) -> list[tuple[int, int]]:
    """Keys of the drops that are simulated, with a disk cache of their own and none in memory."""
    monkeypatch.setattr(simulate, "REFERENCE_DROPS", 8)
    keys: list[tuple[int, int]] = []
    whole = simulate._drop_until_rest
    monkeypatch.setattr(simulate, "_drop_until_rest", lambda table, key: keys.append(key) or whole(table, key))
    monkeypatch.setattr(simulate, "_reference_faces", simulate._reference_faces.__wrapped__)
    return keys


@pytest.mark.parametrize(
    "kept", [None, {"face": np.full(8, 99)}, {"face": np.zeros(3, np.int64)}, {"face": np.zeros(8)}, {"other": UP}]
)
def test_reference_drops_are_simulated_once_or_if_not_kept_whole(dropped, own_cache, kept) -> None:
    first = drop(bracket(), count=1, seed=5)
    assert len(dropped) == 1 + simulate.REFERENCE_DROPS
    (file,) = own_cache.rglob("drops/*.npz")
    if kept is not None:
        np.savez(file, **kept)
    again = drop(bracket(), count=1, seed=5)
    assert len(dropped) == 2 + simulate.REFERENCE_DROPS * (1 if kept is None else 2)
    np.testing.assert_array_equal(first["scene/rest_probability"], again["scene/rest_probability"])


def test_no_scenes_are_empty_and_negative_counts_refused() -> None:
    result = drop(bracket(), count=0, seed=0)
    assert result["scene/object_pose"].shape == (0, 7)
    assert result["scene/rest_probability"].shape == result["scene/drop_seconds"].shape == (0,)
    with pytest.raises(InputError, match="must not be negative"):
        drop(bracket(), count=-1, seed=0)


def test_a_flat_object_is_refused_by_name():
    corners, sheet = np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0]], float), np.array([[0, 1, 2], [0, 2, 1]], np.int32)
    flat = {"vertices": corners, "hull_vertices": corners, "faces": sheet, "hull_faces": sheet}
    thin = dataclasses.replace(bracket(), name="sheet", digest="f" * 32, volume=1e-9, **flat)
    with pytest.raises(MeshError, match="sheet"):
        drop(thin, count=1, seed=0)
    with pytest.raises(MeshError, match="hull of 'sheet' is flat"):
        resting_faces(dataclasses.replace(thin, hull_vertices=corners * UP[::-1]))


def rolling_can() -> ObjectModel:
    return object_from_mesh(trimesh.creation.cylinder(radius=0.03, height=0.1, sections=60))


def face_along(faces: RestingFaces, normal: tuple[float, float, float]) -> int:
    return int((faces.normal @ np.array(normal)).argmax())


def test_plate_topples_from_an_edge_whose_tilt_passes_its_middle() -> None:
    # Height 30 mm, half the thickness t / 2 inside: 1 mm of change tilts by 1 / t, so t t / 2 must pass 30 mm^2.
    for thickness, falls in ((0.0074, True), (0.0080, False)):
        faces = resting_faces(box(0.06, 0.06, thickness))
        assert faces.can_topple(face_along(faces, (1, 0, 0))) is falls
        assert not faces.can_topple(face_along(faces, (0, 0, 1)))


def test_a_can_rolls_on_its_side_and_stands_on_its_bottom() -> None:
    obj, faces = rolling_can(), resting_faces(rolling_can())
    angle, sinks = faces.possible_motion(face_along(faces, (1, 0, 0)))
    assert angle > np.radians(170)
    assert sinks == pytest.approx(0.0, abs=1e-6)
    assert faces.possible_motion(face_along(faces, (0, 0, 1)))[0] < np.radians(1)
    lying, standing = [0.0, 0, 0.03, np.sqrt(0.5), 0, np.sqrt(0.5), 0], [0.0, 0, 0.05, 1, 0, 0, 0]
    assert count_rolling_poses(obj, np.array([lying, standing, lying])) == 2
    assert "in 2 of 3 scenes" in str(rolling_note(2, 3))
    assert rolling_note(0, 3) is None


@pytest.mark.parametrize(
    ("obj", "height", "seeds"),
    [
        # Half as high as wide: about a half of the drops end on its side.
        (object_from_mesh(trimesh.creation.cylinder(radius=0.03, height=0.05, sections=60)), 0.025, (1, 3)),
        (box(0.06, 0.06, 0.007), 0.0035, (8, 35)),
    ],
    ids=["can", "plate"],
)
def test_what_rolls_or_topples_is_put_on_its_ends(obj: ObjectModel, height: float, seeds: tuple[int, int]) -> None:
    poses = [
        drop(obj, count=12, seed=seeds[0])["scene/object_pose"],
        rest_poses(SceneSpec(kind="table", faces="all"), obj, count=1, seed=0)["scene/object_pose"],
        drop_together(box(0.06, 0.06, 0.05), [obj], count=8, seed=seeds[1])["scene/neighbour_pose"][:, 0],
    ]
    for pose in np.concatenate(poses):
        assert abs(quat_rotate(quat_conjugate(pose[3:]), UP)[2]) == pytest.approx(1.0, abs=1e-6)
        assert pose[2] == pytest.approx(height, abs=1e-6)


def test_a_ball_stays_as_it_lies() -> None:
    ball = object_from_mesh(trimesh.creation.icosphere(2, 0.03))
    assert count_rolling_poses(ball, drop(ball, count=3, seed=1)["scene/object_pose"]) == 3


@pytest.mark.parametrize("kind", ["table", "bin", "shelf"])
def test_the_object_stands_on_its_support_and_in_nothing_else(kind: str) -> None:
    spec = SceneSpec(kind=kind)
    for pose in rest_poses(spec, BLOCK, count=6, seed=3)["scene/object_pose"]:
        distances = [support.distance(apply(pose, BLOCK.hull_vertices)).min() for support in supports_of(spec)]
        assert min(distances) == pytest.approx(0.0, abs=1e-6), "rest poses are exact"
        assert sorted(distances)[1:] == sorted(d for d in distances if d > 1e-4)[-len(distances) + 1 :]


def test_all_faces_are_those_that_enough_drops_end_on() -> None:
    found = rest_poses(SceneSpec(kind="table", faces="all"), BLOCK, count=1, seed=0)
    heights = sorted(np.round(2 * found["scene/object_pose"][:, 2], 6).tolist())
    # The block's frame stands in its middle. A narrow end is a face that few drops end on.
    assert set(heights) <= {0.05, 0.07, 0.11} and {0.05, 0.07} <= set(heights)
    assert len(heights) == len({tuple(np.round(p[3:], 6)) for p in found["scene/object_pose"]})
    ball = object_from_mesh(trimesh.creation.icosphere(subdivisions=2, radius=0.03), "ball")
    found = rest_poses(SceneSpec(kind="table", faces="all"), ball, count=1, seed=0)
    # Of 320 alike faces 64 drops meet most once, which is no more than 1.6 %.
    assert 1 <= len(found["scene/object_pose"]) <= 20


def test_object_too_large_for_a_bin_is_refused_with_both_sizes() -> None:
    plank = box(0.5, 0.05, 0.05, name="plank")
    with pytest.raises(InputError, match=r"plank needs .* mm and there is room for 380 x 280 mm"):
        rest_poses(SceneSpec(kind="bin"), plank, count=2, seed=0)


def test_a_target_stands_where_told_and_not_under_its_support() -> None:
    spec = SceneSpec(kind="file", supports=({"kind": "half_space"},), target=(0.1, 0, 0.055, 1, 0, 0, 0))
    found = rest_poses(spec, BLOCK, count=2, seed=0)["scene/object_pose"]
    assert np.array_equal(found, np.tile([0.1, 0, 0.055, 1, 0, 0, 0], (2, 1)))
    spec = SceneSpec(kind="file", supports=({"kind": "half_space"},), target=(0, 0, 0, 1, 0, 0, 0))
    with pytest.raises(InputError, match="deep in support 0"):
        rest_poses(spec, BLOCK, count=1, seed=0)


THING, LOW, TALL = box(0.05, 0.05, 0.05), box(0.08, 0.06, 0.03, name="low"), box(0.03, 0.04, 0.12, name="tall")


def laid(kind: str, others, *, count: int, faces: str = "drawn", thing=THING, seed: int = 5):
    spec = SceneSpec(kind=kind, faces=faces, neighbours=tuple({"object": one.name} for one in others))
    return spec, *scenes_of(spec, thing, others, count=count, seed=seed)


def together(poses: dict[str, np.ndarray], things: list[ObjectModel]) -> tuple[np.ndarray, float]:
    """(S, things, 7) poses of an object and its neighbours, and the least gap between two of them [m]."""
    found = np.concatenate([poses["scene/object_pose"][:, None], poses["scene/neighbour_pose"]], axis=1)
    gaps = gaps_between([neighbour_of(one) for one in things], found)
    return found, min(gap.min() for gap in gaps.values())


@pytest.mark.parametrize("kind", ["table", "bin", "shelf"])
def test_neighbours_stand_within_walls_apart_and_on_the_floor(kind: str) -> None:
    others = [LOW, TALL, LOW]
    spec, scenes, poses = laid(kind, others, count=4)
    room = np.asarray(walled_area(spec) or (np.inf, np.inf)) / 2 - GAP
    places, gap = together(poses, [THING, *others])
    for number, one in enumerate([THING, *others]):
        found = apply(places[:, number, None], one.hull_vertices)
        assert (np.abs(found[..., :2]) <= room + 1e-9).all()
        np.testing.assert_allclose(found[..., 2].min(axis=1), 0.0, atol=1e-9)
        # The supports' own planes, the boards above and below among them.
        for support in scenes.supports:
            assert min(support.distance(one_scene).min() for one_scene in found) > -1e-9
    assert gap > (0 if kind == "table" else BETWEEN - 1e-6)  # MuJoCo's meshes are float32
    assert len(scenes.placed(np.zeros(1, int)).scenes[0].obstacles) == len(scenes.supports) + len(others)
    assert not np.allclose(poses["scene/neighbour_pose"][:, 0], poses["scene/neighbour_pose"][:, 2]), "two lie apart"


@pytest.mark.parametrize(
    "scenes",
    [
        partial(drop, bracket()),
        partial(drop_together, box(0.05, 0.06, 0.07), [box(0.04, 0.04, 0.12)]),
        partial(rest_poses, SceneSpec(kind="bin"), BLOCK),
        lambda count, seed: laid("bin", [LOW], count=count, seed=seed)[2],
    ],
    ids=["dropped", "dropped together", "in a bin", "beside another in a bin"],
)
def test_same_seed_gives_same_scenes_and_more_scenes_keep_first(scenes) -> None:
    first, again, more = scenes(count=3, seed=7), scenes(count=3, seed=7), scenes(count=5, seed=7)
    for name, values in first.items():
        np.testing.assert_array_equal(values, again[name])
        np.testing.assert_array_equal(values, more[name][:3])
    assert not np.array_equal(first["scene/object_pose"], scenes(count=3, seed=8)["scene/object_pose"])


def test_neighbours_do_not_move_the_object() -> None:
    few, alone = (laid("bin", others, count=2)[2]["scene/object_pose"] for others in ([LOW], []))
    np.testing.assert_array_equal(few, alone)


def test_on_a_table_each_face_has_its_neighbours() -> None:
    _, _, poses = laid("table", [LOW, TALL], count=1, faces="all", thing=box(0.04, 0.06, 0.09))
    ups = [quat_rotate(pose[3:] * [1, -1, -1, -1], np.array([0, 0, 1.0])) for pose in poses["scene/object_pose"]]
    assert len(np.unique(np.round(ups, 6), axis=0)) == len(ups) >= 4
    assert poses["scene/neighbour_pose"].shape == (len(ups), 2, 7)


def test_as_many_as_may_be_find_room_around_one_like_them() -> None:
    """Dropped together their bounding balls would never fit on one ring."""
    assert together(laid("table", [THING] * 8, count=1)[2], [THING] * 9)[1] > 0


def test_a_bin_without_room_says_so_in_a_line() -> None:
    with pytest.raises(SceneError, match=r"no room for 2 neighbours beside box in scene 0: .* wider scene") as told:
        laid("bin", [box(0.3, 0.2, 0.05, name="tray")] * 2, count=1)
    assert "\n" not in str(told.value)
