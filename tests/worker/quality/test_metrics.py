"""Area, volume and depth of contact against closed forms; types of grasps by patterns of contacts."""

import dataclasses
import math
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from graspd.exchange.inputs import load_case
from graspd.service.model.errors import InputError, TaskCancelled
from graspd.service.model.grasp_types import TAXONOMY
from graspd.service.model.metrics import DIRECTION_CELLS, GraspType, entropy_bits, evenness
from graspd.service.model.transforms import compose
from graspd.service.store.columns import SCHEMAS
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.surface import farthest_points, sample_surface
from graspd.worker.objects import disk_cache
from graspd.worker.objects.model import ObjectModel
from graspd.worker.quality import diversity, probe
from graspd.worker.quality.contact import contact_distance_consistency_mm, finger_of_body, spread_contacts
from graspd.worker.quality.diversity import direction_cells, distinct_mask, grasp_distances, hand_points, least_distance
from graspd.worker.quality.gate import MAX_PENETRATION_MM, MAX_SELF_PENETRATION_MM, MIN_CONTACT_LINKS, passes_gate
from graspd.worker.quality.grasp_type import RULES, ContactPattern
from graspd.worker.quality.intervals import wilson_interval, wilson_interval_of_mean
from graspd.worker.quality.probe import HAND_POINTS, REACH_M, Probe
from graspd.worker.quality.table import measure
from graspd.worker.quality.volume import VOXEL_M, Overlap, SharedVolume
from tests.worker.models import object_from_mesh, two_finger_hand, unit_vectors
from tests.worker.quality.helpers import BOX, grasp_set, pad_hand, plate_hand, posture
from tests.worker.simulation.rigs import ball

#: Single precision of coordinates around 0.1 m.
SINGLE = 1e-6
#: Area is a sum over points: one point more or less at each edge of the zone.
ONE_ROW = 0.03
SMALL_PLATES = plate_hand((0.03, 0.03, 0.01))
GOOD = {"penetration_depth_mm": 0.5, "self_penetration_depth_mm": 0.0, "contact_links": 3.0}
HAND = plate_hand((0.05, 0.04, 0.01))
EVERY = np.ones((1, len(HAND.pieces)), bool)
FINGERS, BALL = two_finger_hand(), ball(subdivisions=2)
FIRST, SECOND = np.array([0]), np.array([1])


def closed_on_box(press: float) -> Posture:
    """Plates 5 mm in half thickness, pressed `press` metres into the box's faces at x = -+0.03."""
    slide = 0.1 - 0.03 - 0.005 + press
    return posture(((0, 0, 0), (slide, slide)))


def test_area_of_plates_on_a_box_is_the_covered_face() -> None:
    area = measure(SMALL_PLATES, BOX, grasp_set(closed_on_box(0.0)), thresholds_m=[0.002])
    faces, rims = 2 * 3.0 * 3.0, 2 * 4 * 3.0 * 0.2
    assert area["quality/contact_area_cm2"][0, 0] == pytest.approx(faces + rims, rel=ONE_ROW)


@pytest.mark.parametrize("press", [0.001, 0.004])
def test_volume_and_depth_of_pressed_plates(press: float) -> None:
    row = measure(SMALL_PLATES, BOX, grasp_set(closed_on_box(press)))
    assert row["quality/intersection_volume_cm3"][0] == pytest.approx(2 * 0.03 * 0.03 * press * 1e6, rel=1e-3)
    assert row["quality/penetration_depth_mm"][0] == pytest.approx(press * 1e3, abs=0.01)


def test_volume_of_overlapping_balls_is_the_lens() -> None:
    r, big = 0.011, 0.03
    ball = object_from_mesh(trimesh.creation.icosphere(subdivisions=5, radius=big))
    gap = r + big - 0.004
    # Left finger's ball on the line to the object's centre; the rest of the hand is clear of it.
    pose = posture(((0.04, 0, -0.068 - gap), (0.0, 0.0)))
    lens = math.pi * (r + big - gap) ** 2 * (gap**2 + 2 * gap * (r + big) - 3 * (r - big) ** 2) / (12 * gap)
    found = measure(two_finger_hand(), ball, grasp_set(pose))["quality/intersection_volume_cm3"][0]
    assert found == pytest.approx(lens * 1e6, rel=0.03)


def test_voxels_agree_with_the_exact_volume() -> None:
    hand = SMALL_PLATES
    bodies = Probe(hand, BOX).measure(closed_on_box(0.004)).bodies[0]
    surface_cm2 = 2 * (2 * 9 + 4 * 3 * 0.4)
    bound = surface_cm2 * VOXEL_M * 100 / 2
    assert SharedVolume(hand, BOX).voxel_volume(bodies, np.array([1, 2])) == pytest.approx(7.2, abs=bound)
    # Pieces that overlap are counted once.
    twice = dataclasses.replace(hand, pieces=(*hand.pieces, hand.pieces[1]))
    once = SharedVolume(hand, BOX).volumes(bodies[None], np.ones((1, 3), bool))
    assert SharedVolume(twice, BOX).volumes(bodies[None], np.ones((1, 4), bool)) == pytest.approx(once, rel=SINGLE)


def test_thin_wall_between_hand_points_is_noticed() -> None:
    """A 1 mm needle pierces a plate: no hand point is in it, so only the object's own points can tell."""
    needle = object_from_mesh(trimesh.creation.box((0.06, 0.001, 0.001)))
    row = measure(SMALL_PLATES, needle, grasp_set(posture(((0, 0, 0), (0.068, 0.0)))))
    assert row["quality/penetration_depth_mm"][0] == pytest.approx(3.0, abs=0.5)


def test_self_penetration_of_plates() -> None:
    far = object_from_mesh(trimesh.creation.box((0.01, 0.01, 0.01)).apply_translation([0, 0, 0.5]))
    grasps = grasp_set(posture(((0, 0, 0), (0.096, 0.096)), ((0, 0, 0), (0.05, 0.05))))
    rows = measure(SMALL_PLATES, far, grasps)
    assert rows["quality/self_penetration_depth_mm"] == pytest.approx([2.0, 0.0], abs=0.01)


def test_links_in_contact_are_those_within_two_millimetres() -> None:
    hand = SMALL_PLATES
    gap = posture(((0, 0, 0), (0.065, 0.0625)), ((0, 0, 0), (0.064, 0.064)))
    assert measure(hand, BOX, grasp_set(gap))["quality/contact_links"].tolist() == [1, 2]


def test_moving_hand_and_object_together_changes_nothing() -> None:
    mesh = trimesh.creation.box((0.06, 0.04, 0.05))
    moved = mesh.copy().apply_translation([0.3, -0.2, 0.1])
    here = closed_on_box(0.001)
    there = Posture(compose(np.array([0.3, -0.2, 0.1, 1.0, 0, 0, 0]), here.hand_pose), here.joint_positions)
    a = measure(plate_hand(), object_from_mesh(mesh), grasp_set(here))
    b = measure(plate_hand(), object_from_mesh(moved), grasp_set(there))
    for name in ("quality/contact_area_cm2", "quality/intersection_volume_cm3", "quality/epsilon"):
        assert a[name] == pytest.approx(b[name], rel=1e-3, abs=1e-3), name


def test_columns_are_schema_and_same_for_any_number_of_threads() -> None:
    poses = posture(*(((0, 0, -0.09), (a, a)) for a in np.linspace(0.1, 0.5, 20)))
    one, two = (measure(two_finger_hand(), BOX, grasp_set(poses), run=ExecutionContext(threads=n)) for n in (1, 2))
    codes = {f"quality/{name}" for name in ("grasp_type", "taxonomy_type", "digits", "approach_cell")}
    # What is optional comes from the validator, or older shards lack it; `valid` comes from the gate.
    wanted = {n for n, column in SCHEMAS["base"].items() if n.startswith("quality/") and not column.optional}
    assert set(one) - codes == wanted - {"quality/valid"}
    for name in one:
        assert np.array_equal(one[name], two[name], equal_nan=True), name


def test_a_cancelled_table_stops_and_wide_thresholds_are_refused() -> None:
    with pytest.raises(TaskCancelled):
        measure(two_finger_hand(), BOX, grasp_set(closed_on_box(0)), run=ExecutionContext(cancelled=lambda: True))
    with pytest.raises(InputError, match="at most 12 mm"):
        measure(two_finger_hand(), BOX, grasp_set(closed_on_box(0)), thresholds_m=[0.05])


def test_no_more_contacts_than_the_limit_and_they_span_the_patch() -> None:
    place = np.stack(np.meshgrid(np.linspace(0, 1, 30), np.linspace(0, 1, 30), [0.0]), axis=-1).reshape(-1, 3)
    normal = np.tile([0, 0, 1.0], (1, 900, 1))
    chosen, count = spread_contacts(np.ones((1, 1, 900), bool), place[None], normal, scale=1.0, limit=12)
    assert count == 12 and np.ptp(place[chosen[0, 0]], axis=0)[:2] == pytest.approx([1.0, 1.0])


def test_consistency_is_the_spread_of_finger_distances() -> None:
    hand = two_finger_hand()
    assert finger_of_body(hand).tolist() == [-1, 0, 1]
    distance = np.array([[0.0, -0.001, 0.003], [0.0, 0.002, 0.5]])
    assert contact_distance_consistency_mm(hand, distance) == pytest.approx([3.0, 8.0])


def test_grasps_along_one_line_have_no_diversity() -> None:
    line = posture(*(((x, 0, 0), (0.0, 0.0)) for x in (0.0, 0.1, 0.2)))
    cloud = posture(*(((x, y, z), (0.0, 0.0)) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)))
    assert diversity.explained_variance(line)[0] == pytest.approx(1.0)
    assert diversity.explained_variance(cloud)[0] == pytest.approx(1 / 3)


def test_held_out_points_differ_from_the_planner_s() -> None:
    hand = two_finger_hand()
    ours, theirs = Probe(hand, BOX).points.position, sample_surface(hand, HAND_POINTS).position
    assert not (ours[:, None] == theirs[None]).all(axis=-1).any()


def test_the_volume_is_measured_where_the_index_tells_it() -> None:
    grasps = grasp_set(closed_on_box(0.0))
    told, every = measure(plate_hand(), BOX, grasps), measure(plate_hand(), BOX, grasps, every_volume=True)
    assert np.isfinite(told["quality/wrench_volume"][0]).tolist() == [False, True, False]
    assert np.isfinite(every["quality/wrench_volume"]).all()
    # One is the hull's nearest facet, the other that of a part of the hull: the same plane, rounded otherwise.
    np.testing.assert_allclose(told["quality/epsilon"], every["quality/epsilon"], atol=1e-9)


def test_points_beyond_reach_are_told_apart_and_not_looked_up() -> None:
    ball = object_from_mesh(trimesh.creation.icosphere(subdivisions=4, radius=0.03))
    probe = Probe(two_finger_hand(), ball)
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (4000, 3))
    gap = np.linalg.norm(points, axis=1) - 0.03
    # The facets of the ball lie 0.04 mm below its sphere.
    np.testing.assert_allclose(probe.signed_distance(points)[0], np.minimum(gap, REACH_M), atol=1e-4)


@pytest.mark.parametrize("reach", [0.0005, 0.005, REACH_M])
def test_bodies_of_many_postures_are_as_far_as_their_points_say(reach: float) -> None:
    """In double precision down to points in float32: 1e-7 m at 0.2 m."""
    hand, ball = hand_from_path("allegro"), object_from_mesh(trimesh.creation.icosphere(subdivisions=2, radius=0.04))
    probe, rng = Probe(hand, ball, hand_points=400), np.random.default_rng(5)
    turned = unit_vectors(rng, 40, 4)
    pose = np.column_stack([rng.uniform(-0.12, 0.12, (40, 3)), turned])
    joints = hand.expand(rng.uniform(hand.lower, hand.upper, (40, hand.dofs)))
    points = probe.posed_points(body_poses(hand, pose, joints))
    by_point = probe.signed_distance(points.reshape(-1, 3), reach=reach)[0].reshape(40, -1)
    wanted = np.full((40, hand.bodies), np.inf)
    np.minimum.at(wanted.T, probe.points.body, by_point.T)
    assert (wanted < 0.9 * reach).any() and (wanted > 0.9 * reach).any()
    np.testing.assert_allclose(probe.body_gaps(pose, joints, reach=reach), wanted, atol=1e-7)


def test_contacts_of_many_sets_are_those_chosen_one_set_at_time() -> None:
    rng = np.random.default_rng(5)
    place, normal = rng.normal(size=(3, 300, 3)), rng.normal(size=(3, 300, 3))
    near = rng.uniform(size=(3, 4, 300)) < np.array([0.0, 0.02, 0.3, 1.0])[:, None]
    index, count = spread_contacts(near, place, normal, scale=0.5, limit=12)
    for b in range(3):
        for t in range(4):
            alone = np.flatnonzero(near[b, t])
            if len(alone) > 12:
                alone = alone[farthest_points(np.hstack([place[b, alone] / 0.5, normal[b, alone]]), 12)]
            assert index[b, t, : count[b, t]].tolist() == alone.tolist()
    assert (count[:, 0] == 0).all() and (count[:, 1] > 0).all() and (count[:, 1] <= 12).all()


def gate(**changes: float) -> bool:
    return bool(passes_gate({f"quality/{name}": np.array([value]) for name, value in (GOOD | changes).items()})[0])


@pytest.mark.parametrize(
    ("name", "bound", "worse"),
    [
        ("penetration_depth_mm", MAX_PENETRATION_MM, 1e-9),
        ("self_penetration_depth_mm", MAX_SELF_PENETRATION_MM, 1e-9),
        ("contact_links", MIN_CONTACT_LINKS, -1),
    ],
)
def test_each_bound_is_inclusive_and_decides_alone(name: str, bound: float, worse: float) -> None:
    assert gate(**{name: bound}) and not gate(**{name: bound + worse}) and not gate(**{name: math.nan})


def test_bars_of_shares_and_means_cover_the_truth() -> None:
    counts = np.random.default_rng(2).binomial(20, 0.2, size=4000)
    bounds = np.array([wilson_interval(k, 20) for k in range(21)])[counts]
    assert np.mean((bounds[:, 0] <= 0.2) & (bounds[:, 1] >= 0.2)) == pytest.approx(0.95, abs=0.025)
    assert wilson_interval(0, 16)[1] > 0.1 and wilson_interval(16, 16)[0] < 0.9
    for part, whole in ((0, 5), (3, 8), (8, 8), (41, 120)):
        assert wilson_interval_of_mean(float(part), whole) == pytest.approx(wilson_interval(part, whole), abs=1e-12)
    assert wilson_interval(2, 8)[0] < wilson_interval_of_mean(2.5, 8)[0] < wilson_interval(3, 8)[0]


def kept_and_shared(obj: ObjectModel, postures: Posture) -> tuple[np.ndarray, np.ndarray]:
    """(B, P) what the test keeps, and the volume that each piece shares with the object by the boolean [cm^3]."""
    probe, volume = Probe(HAND, obj, hand_points=300, object_points=500), SharedVolume(HAND, obj)
    found, overlap = probe.measure(postures), Overlap(HAND, probe)
    kept = overlap.overlapping_pieces(found, np.repeat(EVERY, len(found.bodies), axis=0))
    alone = [volume.volumes(found.bodies, np.arange(len(HAND.pieces)) == np.full((len(kept), 1), p)) for p in range(3)]
    return kept, np.stack(alone, axis=1)


def test_no_piece_that_shares_volume_is_left_out_many_others_are() -> None:
    rng = np.random.default_rng(4)
    turn = Rotation.random(200, rng=rng).as_quat(scalar_first=True)
    # Plates that slide by 0 to 0.1 m around a ball of 0.04 m: in it, at it, beside it.
    postures = Posture(np.hstack([rng.uniform(-0.05, 0.05, (200, 3)), turn]), rng.uniform(0.0, 0.1, (200, 2)))
    ball = object_from_mesh(trimesh.creation.icosphere(subdivisions=3, radius=0.04))
    kept, shared = kept_and_shared(ball, postures)
    assert not (shared[~kept] > 0).any() and (shared > 0).sum() > 100 and (~kept).sum() > 100
    assert (shared[kept] > 0).mean() > 0.9, "only edges beside edges are kept for nothing"


def test_a_piece_in_the_object_and_an_object_in_a_piece_are_kept() -> None:
    at_rest = Posture(np.array([[0, 0, 0, 1.0, 0, 0, 0]]), np.zeros((1, 2)))
    around = object_from_mesh(trimesh.creation.box((0.6, 0.6, 0.6)))
    kept, shared = kept_and_shared(around, at_rest)
    assert kept.all() and (shared > 0).all()
    crumb = trimesh.creation.box((0.004, 0.004, 0.004))
    crumb.apply_translation([-0.1, 0, 0])  # in the middle of the left plate
    kept, shared = kept_and_shared(object_from_mesh(crumb), at_rest)
    assert kept.tolist() == [[False, True, False]] and shared[0, 1] > 0


def distances_of(found: Probe) -> tuple[np.ndarray, ...]:
    points = np.random.default_rng(0).uniform(-0.05, 0.05, (500, 3))
    return (found.skin.coarse.numpy(), *found.signed_distance(points))


def same(one: tuple[np.ndarray, ...], other: tuple[np.ndarray, ...]) -> bool:
    return all(np.array_equal(a, b) and a.dtype == b.dtype for a, b in zip(one, other, strict=True))


def test_later_process_measures_with_what_the_first_one_computed(own_cache, monkeypatch) -> None:
    first = distances_of(Probe(FINGERS, BALL, hand_points=100, object_points=64))
    assert len(list(own_cache.rglob("coarse_grids/*"))) == 1

    def never(self, points, reach: float = 0.0):
        raise AssertionError("it is there already")

    with monkeypatch.context() as patched:
        patched.setattr(Probe, "_query", never)
        again = Probe(FINGERS, BALL, hand_points=200, object_points=64)
    assert same(distances_of(again), first)
    monkeypatch.setattr(probe, "binary_identity", lambda module: "that of another processor")
    Probe(FINGERS, BALL, hand_points=100, object_points=64)
    assert len(list(own_cache.rglob("coarse_grids/*"))) == 2


@pytest.mark.parametrize("harm", ["shape", "kind", "name"])
def test_an_entry_that_is_not_sound_is_made_again(own_cache, harm: str) -> None:
    first = distances_of(Probe(FINGERS, BALL, hand_points=100, object_points=64))
    (file,) = own_cache.rglob("coarse_grids/*")
    whole, grid = file.read_bytes(), first[0]
    harms = {"shape": {"coarse": grid[1:]}, "kind": {"coarse": grid.astype(float)}, "name": {"other": grid}}
    disk_cache._write(file, harms[harm])
    assert same(distances_of(Probe(FINGERS, BALL, hand_points=100, object_points=64)), first)
    assert file.read_bytes() == whole


def moved(hand: HandModel, by: float) -> np.ndarray:
    """Points of a hand at rest and of the same shifted by `by` [m]."""
    joints = np.zeros((2, len(hand.joint_names)))
    pose = np.array([[0, 0, 0, 1, 0, 0, 0], [0.6 * by, 0, 0.8 * by, 1, 0, 0, 0]], float)
    return hand_points(hand, Posture(pose, joints))


def test_shifted_hand_is_off_by_the_shift_a_joint_by_its_points() -> None:
    # To rounding: every point moves by the same.
    assert grasp_distances(moved(pad_hand(), 0.003), FIRST, SECOND) == pytest.approx([0.003], abs=1e-12)
    points = hand_points(plate_hand(), posture(((0, 0, 0), (0.02, 0.02)), ((0, 0, 0), (0.03, 0.02))))
    slid = np.linalg.norm(points[0] - points[1], axis=1) > 1e-9
    assert 0 < slid.sum() < diversity.POINTS
    assert grasp_distances(points, FIRST, SECOND) == pytest.approx([0.010 * slid.mean()], abs=1e-12)


def test_of_grasps_that_are_near_the_first_is_kept() -> None:
    rng = np.random.default_rng(11)
    points = rng.normal(0, 0.02, (200, 1, 3)) + rng.normal(0, 0.002, (200, 8, 3))
    kept = distinct_mask(points, 0.01)
    apart = np.linalg.norm(points[:, None] - points[None], axis=3).mean(axis=2)
    among = apart[np.ix_(kept, kept)] + np.eye(int(kept.sum()))
    assert among.min() >= 0.01 and kept[0]
    for row in np.flatnonzero(~kept):
        assert apart[row, :row][kept[:row]].min() < 0.01  # nobody is dropped for one that is dropped itself


def test_distinct_grasps_keep_the_given_nearest_sees_all_pairs() -> None:
    points = np.zeros((3, 4, 3))
    assert distinct_mask(points, 0.0).all() and distinct_mask(points, 0.005).tolist() == [True, False, False]
    assert distinct_mask(points, 0.005, given=2).tolist() == [True, True, False]
    rng = np.random.default_rng(17)
    # Turned about their middles too, so that near middles are no near grasps.
    points = rng.normal(0, 0.05, (60, 1, 3)) + rng.normal(0, 0.03, (60, 8, 3))
    rows, others = np.triu_indices(len(points), 1)
    assert least_distance(points) == pytest.approx(grasp_distances(points, rows, others).min(), rel=1e-12)
    assert least_distance(points[:1]) is None and least_distance(np.zeros((3, 8, 3))) == 0


def test_entropy_of_even_kinds_is_the_logarithm_of_their_number() -> None:
    even = [7] * 48
    assert (entropy_bits(even), evenness(even, DIRECTION_CELLS)) == pytest.approx((math.log2(48), 1))
    assert entropy_bits([9, 0]) == 0 and entropy_bits([]) == 0 and evenness([], 3) == 0
    assert entropy_bits([1, 1, 2]) == pytest.approx(1.5)


def test_cell_of_approach_is_that_of_where_the_palm_comes_from() -> None:
    hand = pad_hand()  # its palm looks along z
    upright, upside_down = [1.0, 0, 0, 0], [0.0, 1, 0, 0]
    low, high = diversity.approach_cells(hand, np.array([upright, upside_down]))
    assert low // 12 == 0 and high // 12 == 3
    assert direction_cells(np.array([[-1.0, -1e-9, -0.9], [1.0, 0, 0.1]])).tolist() == [0, 2 * 12 + 6]


def pattern(normals: list[tuple[float, float, float]], width: float = 0.05, **how: object) -> ContactPattern:
    """Contacts of a thumb and fingers at `normals` on a solid `width` wide; a digit without a normal is clear."""
    normal = np.zeros((1, 5, 3))
    normal[0, : len(normals)] = np.array(normals) / np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-9)
    wraps, by_side = (np.isin(np.arange(5), how.get(name, ()))[None] for name in ("wraps", "by_side"))
    touches, palm = np.linalg.norm(normal, axis=-1) > 0, np.array([bool(how.get("palm"))])
    return ContactPattern(palm, touches, wraps, by_side, 0.5 * width * normal, normal)


def around(*degrees: float, lift: float = 0.0) -> list[tuple[float, float, float]]:
    """Normals around a cylinder's axis z, alternately lifted towards -z and +z."""
    return [(np.cos(a), np.sin(a), lift * (-1) ** k) for k, a in enumerate(np.deg2rad(degrees).tolist())]


def plate(fingers: int) -> list[tuple[float, float, float]]:
    return [(0, 0, 1.0), *[(0, 0, -1.0)] * fingers]


FIVE = (0, 72, 144, 216, 288)
#: The order of digits is thumb, index, middle, ring, little.
CASES = {
    "palmar_pinch": pattern(plate(1)),
    "prismatic_2_finger": pattern(plate(2)),
    "prismatic_3_finger": pattern(around(0, 175, 180, 185)),
    "prismatic_4_finger": pattern(plate(4)),
    "tripod": pattern(around(0, 120, 240)),
    "quadpod": pattern(around(0, 100, 180, 260, lift=0.5)),
    "precision_disk": pattern(around(*FIVE)),
    "precision_sphere": pattern(around(*FIVE, lift=1.0)),
    "ring": pattern(around(0, 180), wraps=(0, 1)),
    "sphere_3_finger": pattern(around(0, 120, 240), wraps=(1, 2)),
    "sphere_4_finger": pattern(around(0, 90, 180, 270), wraps=(1, 2)),
    "distal": pattern(around(*FIVE), wraps=range(1, 5)),
    "small_diameter": pattern(plate(4), 0.02, palm=True),
    "medium_wrap": pattern(plate(4), 0.04, palm=True),
    "large_diameter": pattern(plate(4), 0.08, palm=True),
    "power_disk": pattern(around(*FIVE), palm=True),
    "power_sphere": pattern(around(*FIVE, lift=1.0), palm=True),
    "fixed_hook": pattern([(0, 0, 0.0), *plate(4)[1:]], palm=True, wraps=range(1, 5)),
    "lateral": pattern(plate(1), by_side=(1,)),
}


@pytest.mark.parametrize("name", TAXONOMY)
def test_a_pattern_has_its_type_of_the_taxonomy_and_no_other(name: str) -> None:
    seen = CASES[name]
    fitting = {kind for kind, rule in RULES.items() if rule.applies(seen)[0]}
    broad = {GraspType(seen.types[0]).name.lower()}
    assert fitting == {name} | broad | ({"pinch"} if name == "palmar_pinch" else set())
    assert seen.taxonomy().tolist() == [TAXONOMY[name]]


def test_numbers_are_those_of_the_published_taxonomy() -> None:
    """Feix et al. 2016: 33 types, of which some have no rule by contacts."""
    numbers = {
        "medium_wrap": 3,
        "palmar_pinch": 9,
        "tripod": 14,
        "fixed_hook": 15,
        "lateral": 16,
        "distal": 19,
        "quadpod": 27,
        "ring": 31,
    }
    assert numbers.items() <= TAXONOMY.items() and len(set(TAXONOMY.values())) == len(TAXONOMY)
    assert set(TAXONOMY) == set(RULES) - {"power", "precision", "pinch"}


def test_palm_grasps_need_the_fingers_of_their_type() -> None:
    """Feix et al. 2016: the palm opposes fingers 2 to 5 in a large diameter grasp, a fixed hook and a distal grasp."""
    few = {
        "large_diameter": pattern([*plate(3), (0, 0, 0.0)], 0.08, palm=True),
        "fixed_hook": pattern([(0, 0, 0.0), *plate(3)[1:]], palm=True, wraps=range(1, 4)),
        "distal": pattern(around(*FIVE[:4]), wraps=range(1, 4)),
    }
    assert not any(RULES[name].applies(seen)[0] for name, seen in few.items())
    for name in ("fixed_hook", "distal"):
        by_pad = replace(CASES[name], wraps=np.arange(5)[None] % 4 > 0)
        assert not RULES[name].applies(by_pad)[0], "the little finger touches with its last link only"
    for name in ("small_diameter", "medium_wrap", "power_disk", "power_sphere"):
        without_thumb = replace(CASES[name], touches=np.arange(5)[None] > 0)
        assert not RULES[name].applies(without_thumb)[0]


@pytest.mark.parametrize(
    ("seen", "kind", "digits"),
    [
        (pattern([(0, 0, 1)]), GraspType.NONE, 0b1),
        (pattern(plate(1), by_side=(0, 1)), GraspType.LATERAL, 0b11),
        (pattern(plate(2), by_side=(1,), wraps=(1,)), GraspType.PRECISION, 0b111),
    ],
)
def test_oppositions_depend_on_palm_sides_and_wrapping_digits(seen: ContactPattern, kind: int, digits: int) -> None:
    assert (seen.types.tolist(), seen.digits.tolist()) == ([kind], [digits])
    assert not RULES["lateral"].applies(seen)[0], "the thumb of a lateral grasp presses with its pad"
    fingers = replace(seen, touches=np.roll(seen.touches, 1, axis=1))
    assert not fingers.taxonomy()[0] and fingers.digits == 2 * digits, "without the thumb"


def test_contacts_are_averaged_by_area_over_the_points_within_two_millimetres() -> None:
    hand = two_finger_hand()
    points = sample_surface(hand, 400)
    normal = np.where(points.body[:, None] == 1, [1.0, 0, 0], [-1.0, 0, 0])
    place = 0.02 * normal + np.outer(np.arange(len(points)) % 2, [0, 0, 0.01])
    near = np.isin(points.body, (1, 2)) & (points.position[:, 2] > 0.06)
    found = SimpleNamespace(distance=np.where(near, 0.001, 0.0021)[None], normal=normal[None], closest=place[None])
    seen = ContactPattern.of(SimpleNamespace(hand=hand, points=points), found, np.array([[0.005, 0.001, -0.001]]))
    assert (seen.palm[0], seen.touches[0].tolist(), seen.wraps.any()) == (False, [True, True], False)
    assert np.abs(seen.normal[0, :, 0]) == pytest.approx([1.0, 1.0]) and seen.width == pytest.approx(0.04, abs=1e-3)
    ours = near & (points.body == 1)
    expected = np.average(place[ours], axis=0, weights=points.area[ours])
    assert np.abs(seen.place[0] - expected).max(axis=1).min() < 1e-12


def hand_on(radius: float, at: float, q: np.ndarray) -> int:
    """Type of a grasp of an Allegro hand with dofs q (16,) of a ball that lies before its palm, `at` [m] from it."""
    hand = hand_from_path("allegro")
    centre = hand.palm.centre + hand.palm.approach * (at + radius)
    ball = object_from_mesh(trimesh.creation.icosphere(subdivisions=3, radius=radius))
    grasp = grasp_set(Posture(np.array([[*-centre, 1, 0, 0, 0]]), hand.expand(q[None])))
    return int(measure(hand, ball, grasp)["quality/grasp_type"][0])


def test_a_ball_is_held_in_a_power_grasp_in_the_palm_or_by_pads() -> None:
    hand = hand_from_path("allegro")
    closed = np.where(hand.closing != 0, hand.lower + 0.7 * hand.span, hand.preshape)
    assert hand_on(0.03, 0.0, closed) == GraspType.POWER and hand_on(0.01, 0.5, hand.preshape) == GraspType.NONE
    ball = object_from_mesh(trimesh.creation.icosphere(subdivisions=3, radius=0.03))
    # Pads stand 65 mm from the middle and slide inwards by 65 - 30 - 5 mm.
    found = measure(pad_hand(), ball, grasp_set(posture(((0, 0, 0), (0.065, 0.065)))))
    told = [found[f"quality/{name}"].tolist() for name in ("grasp_type", "digits", "taxonomy_type")]
    assert told == [[GraspType.PRECISION], [0b11], [TAXONOMY["palmar_pinch"]]]


def test_fingers_that_touch_by_their_sides_are_a_lateral_grasp() -> None:
    """A thin card between two straight fingers: what they touch it with looks along their axes of flexion."""
    hand = hand_from_path("allegro")
    straight = np.clip(np.zeros(hand.dofs), hand.lower, hand.upper)
    poses = body_poses(hand, np.array([[0.0, 0, 0, 1, 0, 0, 0]]), hand.expand(straight[None]))[0]
    first, second = (poses[body, :3] for body in hand.fingertips[:2])
    middle, across = (first + second) / 2, second - first
    size = np.full(3, 0.02)
    size[np.argmax(np.abs(across))] = np.linalg.norm(across) - 2 * 0.0135
    card = object_from_mesh(trimesh.creation.box(size))
    pose = np.array([[*-middle, 1, 0, 0, 0]])
    found = measure(hand, card, grasp_set(Posture(pose, hand.expand(straight[None]))))
    assert found["quality/contact_links"][0] >= 2
    told = [found[f"quality/{name}"].tolist() for name in ("grasp_type", "digits", "taxonomy_type")]
    assert told == [[GraspType.LATERAL], [0b110], [0]], "index and middle finger, so no thumb presses"


def test_published_fingertip_grasps_are_precision_grasps(shared_data) -> None:
    """FRoGGeR plans with four fixed points on the fingertips, so whoever plans nothing else holds nothing else."""
    case = load_case(shared_data / "reference_grasps" / "frogger_allegro" / "056_tennis_ball.json")
    some = case.grasps.take(np.arange(6))
    types = measure(case.hand, case.obj, some, thresholds_m=[0.005])["quality/grasp_type"]
    assert (types == GraspType.PRECISION).all()
