"""Area, volume and depth of contact against closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
import trimesh

from graspd.service.model.errors import InputError, TaskCancelled
from graspd.service.model.metrics import GRASP_METRICS
from graspd.service.model.transforms import compose
from graspd.service.store.columns import SCHEMAS
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.surface import sample_surface
from graspd.worker.quality.contact import (
    choose_contacts,
    contact_distance_consistency_mm,
    finger_of_body,
    spread_contacts,
)
from graspd.worker.quality.diversity import explained_variance
from graspd.worker.quality.probe import HAND_POINTS, REACH_M, Probe
from graspd.worker.quality.table import MEASURES, measure
from graspd.worker.quality.volume import SharedVolume, VoxelVolume
from tests.worker.models import object_from_mesh, two_finger_hand
from tests.worker.quality.helpers import grasp_set, plate_hand, posture

#: Single precision of coordinates around 0.1 m.
SINGLE = 1e-6
#: Area is a sum over points: one point more or less at each edge of the zone.
ONE_ROW = 0.03
#: Volume of the tessellated round pieces against the ideal ones.
TESSELLATION = 0.01

BOX = object_from_mesh(trimesh.creation.box((0.06, 0.04, 0.05)))


def closed_on_box(press: float) -> Posture:
    """Plates 5 mm in half thickness, pressed `press` metres into the box's faces at x = -+0.03."""
    slide = 0.1 - 0.03 - 0.005 + press
    return posture(((0, 0, 0), (slide, slide)))


def test_area_of_plates_on_a_box_is_the_covered_face() -> None:
    area = measure(plate_hand((0.03, 0.03, 0.01)), BOX, grasp_set(closed_on_box(0.0)), thresholds_m=[0.002])
    faces, rims = 2 * 3.0 * 3.0, 2 * 4 * 3.0 * 0.2
    assert area["quality/contact_area_cm2"][0, 0] == pytest.approx(faces + rims, rel=ONE_ROW)


def test_area_of_a_sphere_on_a_plane_is_that_of_the_cap() -> None:
    table = object_from_mesh(trimesh.creation.box((0.4, 0.4, 0.1)))
    probe = Probe(two_finger_hand(), table, hand_points=8000)
    # The tips are balls of 11 mm, 68 mm above the finger joints; palm up, they just touch the top at z = 0.05.
    pose = Posture(np.array([[0, 0, 0.05 + 0.068 + 0.011, 0, 1.0, 0, 0]]), np.zeros((1, 2)))
    found = probe.measure(pose)
    near = np.abs(found.distance[0]) < 0.004
    assert probe.points.area[near].sum() == pytest.approx(2 * 2 * math.pi * 0.011 * 0.004, rel=0.1)


def test_area_grows_with_the_threshold() -> None:
    area = measure(
        two_finger_hand(), BOX, grasp_set(posture(((0, 0, -0.09), (0.3, 0.3)))), thresholds_m=[0.001, 0.005, 0.01]
    )
    assert (np.diff(area["quality/contact_area_cm2"][0]) >= 0).all()


@pytest.mark.parametrize("press", [0.001, 0.004])
def test_volume_and_depth_of_pressed_plates(press: float) -> None:
    row = measure(plate_hand((0.03, 0.03, 0.01)), BOX, grasp_set(closed_on_box(press)))
    assert row["quality/intersection_volume_cm3"][0] == pytest.approx(2 * 0.03 * 0.03 * press * 1e6, rel=1e-3)
    assert row["quality/penetration_depth_mm"][0] == pytest.approx(press * 1e3, abs=0.01)


def test_volume_of_overlapping_balls_is_the_lens() -> None:
    r, big = 0.011, 0.03
    ball = object_from_mesh(trimesh.creation.icosphere(subdivisions=5, radius=big))
    gap = r + big - 0.004
    # Left finger's ball on the line to the object's centre; the rest of the hand is clear of it.
    pose = posture(((0.04 + gap * math.sin(0.0), 0, -0.068 - gap), (0.0, 0.0)))
    lens = math.pi * (r + big - gap) ** 2 * (gap**2 + 2 * gap * (r + big) - 3 * (r - big) ** 2) / (12 * gap)
    found = measure(two_finger_hand(), ball, grasp_set(pose))["quality/intersection_volume_cm3"][0]
    assert found == pytest.approx(lens * 1e6, rel=0.03)


def test_overlapping_pieces_are_counted_once() -> None:
    hand = plate_hand((0.03, 0.03, 0.01))
    twice = type(hand)(**{**vars(hand), "pieces": (*hand.pieces, hand.pieces[1])})
    pose = closed_on_box(0.002)
    bodies = Probe(hand, BOX).measure(pose).bodies
    once = SharedVolume(hand, BOX).of(bodies, np.ones((1, 3), bool))
    assert SharedVolume(twice, BOX).of(bodies, np.ones((1, 4), bool)) == pytest.approx(once, rel=SINGLE)


def test_voxels_agree_with_the_exact_volume() -> None:
    hand = plate_hand((0.03, 0.03, 0.01))
    bodies = Probe(hand, BOX).measure(closed_on_box(0.004)).bodies[0]
    voxels = VoxelVolume(hand, BOX)
    surface_cm2 = 2 * (2 * 9 + 4 * 3 * 0.4)
    bound = surface_cm2 * voxels.edge * 100 / 2
    assert voxels.volume_cm3(bodies, np.array([1, 2])) == pytest.approx(7.2, abs=bound)


def test_thin_wall_between_hand_points_is_noticed() -> None:
    """A 1 mm needle pierces a plate: no hand point is in it, so only the object's own points can tell."""
    needle = object_from_mesh(trimesh.creation.box((0.06, 0.001, 0.001)))
    row = measure(plate_hand((0.03, 0.03, 0.01)), needle, grasp_set(posture(((0, 0, 0), (0.068, 0.0)))))
    assert row["quality/penetration_depth_mm"][0] == pytest.approx(3.0, abs=0.5)


def test_self_penetration_of_plates() -> None:
    far = object_from_mesh(trimesh.creation.box((0.01, 0.01, 0.01)).apply_translation([0, 0, 0.5]))
    rows = measure(
        plate_hand((0.03, 0.03, 0.01)), far, grasp_set(posture(((0, 0, 0), (0.096, 0.096)), ((0, 0, 0), (0.05, 0.05))))
    )
    assert rows["quality/self_penetration_depth_mm"] == pytest.approx([2.0, 0.0], abs=0.01)


def test_links_in_contact_are_those_within_two_millimetres() -> None:
    hand = plate_hand((0.03, 0.03, 0.01))
    gap = posture(((0, 0, 0), (0.065, 0.0625)), ((0, 0, 0), (0.064, 0.064)))
    assert measure(hand, BOX, grasp_set(gap))["quality/contact_links"].tolist() == [1, 2]


def test_hand_far_away_has_zero_in_every_column() -> None:
    row = measure(two_finger_hand(), BOX, grasp_set(posture(((0, 0, 1.0), (0.0, 0.0)))))
    for name in row:
        if name not in ("quality/thresholds_m", "quality/stability_loss", "quality/approach_cell"):
            assert not row[name].any(), name


def test_moving_hand_and_object_together_changes_nothing_but_rounding() -> None:
    mesh = trimesh.creation.box((0.06, 0.04, 0.05))
    moved = mesh.copy().apply_translation([0.3, -0.2, 0.1])
    here = closed_on_box(0.001)
    there = Posture(compose(np.array([0.3, -0.2, 0.1, 1.0, 0, 0, 0]), here.hand_pose), here.joint_positions)
    a = measure(plate_hand(), object_from_mesh(mesh), grasp_set(here))
    b = measure(plate_hand(), object_from_mesh(moved), grasp_set(there))
    for name in ("quality/contact_area_cm2", "quality/intersection_volume_cm3", "quality/epsilon"):
        assert a[name] == pytest.approx(b[name], rel=1e-3, abs=1e-3), name


def test_columns_are_the_schema_and_the_same_for_any_number_of_threads() -> None:
    poses = posture(*(((0, 0, -0.09), (a, a)) for a in np.linspace(0.1, 0.5, 20)))
    one, two = (measure(two_finger_hand(), BOX, grasp_set(poses), run=ExecutionContext(threads=n)) for n in (1, 2))
    # What is optional comes from the validator, or older shards lack it; `valid` comes from the gate.
    wanted = {n for n, column in SCHEMAS["base"].items() if n.startswith("quality/") and not column.optional}
    assert set(one) - {"quality/grasp_type", "quality/approach_cell"} == wanted - {"quality/valid"}
    for name in one:
        assert np.array_equal(one[name], two[name], equal_nan=True), name


def test_cancelled_table_stops() -> None:
    with pytest.raises(TaskCancelled):
        measure(two_finger_hand(), BOX, grasp_set(closed_on_box(0)), run=ExecutionContext(cancelled=lambda: True))


def test_threshold_beyond_reach_is_refused() -> None:
    with pytest.raises(InputError, match="at most 12 mm"):
        measure(two_finger_hand(), BOX, grasp_set(closed_on_box(0)), thresholds_m=[0.05])


def test_no_more_contacts_than_the_limit_and_they_span_the_patch() -> None:
    place = np.stack(np.meshgrid(np.linspace(0, 1, 30), np.linspace(0, 1, 30), [0.0]), axis=-1).reshape(-1, 3)
    chosen = choose_contacts(np.ones(900, bool), place, np.tile([0, 0, 1.0], (900, 1)), scale=1.0, limit=12)
    assert len(chosen) == 12
    assert np.ptp(place[chosen], axis=0)[:2] == pytest.approx([1.0, 1.0])


def test_consistency_is_the_spread_of_finger_distances() -> None:
    hand = two_finger_hand()
    assert finger_of_body(hand).tolist() == [-1, 0, 1]
    distance = np.array([[0.0, -0.001, 0.003], [0.0, 0.002, 0.5]])
    assert contact_distance_consistency_mm(hand, distance) == pytest.approx([3.0, 8.0])


def test_grasps_along_one_line_have_no_diversity() -> None:
    line = posture(*(((x, 0, 0), (0.0, 0.0)) for x in (0.0, 0.1, 0.2)))
    cloud = posture(*(((x, y, z), (0.0, 0.0)) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)))
    assert explained_variance(line)[0] == pytest.approx(1.0)
    assert explained_variance(cloud)[0] == pytest.approx(1 / 3)


def test_held_out_points_differ_from_the_planner_s() -> None:
    hand = two_finger_hand()
    ours, theirs = Probe(hand, BOX).points.position, sample_surface(hand, HAND_POINTS).position
    assert not (ours[:, None] == theirs[None]).all(axis=-1).any()


def test_a_function_that_is_added_to_the_measures_is_measured_of_every_grasp(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(MEASURES, "least_distance_m", lambda chunk: chunk.found.distance.min(axis=1))
    hand = plate_hand((0.03, 0.03, 0.01))
    table = measure(hand, BOX, grasp_set(closed_on_box(0.0)), thresholds_m=[0.002])
    assert table["quality/least_distance_m"] == pytest.approx(0, abs=1e-5)
    assert measure(hand, BOX, grasp_set(closed_on_box(0.0)).take(np.arange(0)))["quality/least_distance_m"].shape == (
        0,
    )


def test_every_measure_has_its_row_in_the_table_of_metrics() -> None:
    assert set(MEASURES) <= {metric.name for metric in GRASP_METRICS}


def test_the_volume_is_measured_where_the_index_tells_it_and_everywhere_if_asked() -> None:
    grasps = grasp_set(closed_on_box(0.0))
    told, every = measure(plate_hand(), BOX, grasps), measure(plate_hand(), BOX, grasps, every_volume=True)
    assert np.isfinite(told["quality/wrench_volume"][0]).tolist() == [False, True, False]
    assert np.isfinite(every["quality/wrench_volume"]).all()
    # One is the hull's nearest facet, the other that of a part of the hull: the same plane, rounded otherwise.
    np.testing.assert_allclose(told["quality/epsilon"], every["quality/epsilon"], atol=1e-9)


def test_points_beyond_reach_are_told_apart_without_being_looked_up() -> None:
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
    turned = rng.normal(size=(40, 4))
    pose = np.column_stack([rng.uniform(-0.12, 0.12, (40, 3)), turned / np.linalg.norm(turned, axis=1, keepdims=True)])
    joints = hand.expand(rng.uniform(hand.lower, hand.upper, (40, hand.dofs)))
    bodies = body_poses(hand, pose, joints)
    points = probe.posed_points(bodies)
    by_point = probe.signed_distance(points.reshape(-1, 3), reach=reach)[0].reshape(40, -1)
    wanted = np.full((40, hand.bodies), np.inf)
    np.minimum.at(wanted.T, probe.points.body, by_point.T)
    assert (wanted < 0.9 * reach).any() and (wanted > 0.9 * reach).any()
    np.testing.assert_allclose(probe.body_gaps(pose, joints, reach=reach), wanted, atol=1e-7)


def test_contacts_of_many_sets_are_those_chosen_one_set_at_a_time() -> None:
    rng = np.random.default_rng(5)
    place, normal = rng.normal(size=(3, 300, 3)), rng.normal(size=(3, 300, 3))
    near = rng.uniform(size=(3, 4, 300)) < np.array([0.0, 0.02, 0.3, 1.0])[:, None]
    index, count = spread_contacts(near, place, normal, scale=0.5, limit=12)
    for b in range(3):
        for t in range(4):
            alone = choose_contacts(near[b, t], place[b], normal[b], scale=0.5, limit=12)
            assert index[b, t, : count[b, t]].tolist() == alone.tolist()
    assert (count[:, 0] == 0).all() and (count[:, 1] > 0).all() and (count[:, 1] <= 12).all()
