"""The way of a grasp: its postures in turn, and those between them."""

import numpy as np
import pytest

from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.transforms import quat_from_axis_angle
from graspd.service.readers.trajectories import (
    Waypoint,
    scene_spec_of,
    slider_positions,
    trajectory_of,
    waypoint_at,
    wrist_angles,
)
from graspd.service.store.shards import Shard, json_attribute

WAYPOINTS = 4


def shard(*, in_scene: bool) -> Shard:
    arrays: dict[str, np.ndarray] = {}
    for k, name in enumerate(("pregrasp", "grasp", "squeeze")):
        arrays[f"{name}/hand_pose"] = np.array([[0.1, 0, 0, 1, 0, 0, 0]], float)
        arrays[f"{name}/joint_positions"] = np.full((1, 2), 0.1 * k)
    if in_scene:
        coming = np.tile([0.1, 0, 0, 1, 0, 0, 0], (1, WAYPOINTS, 1)).astype(float)
        coming[0, :, 0] = np.linspace(0.2, 0.1, WAYPOINTS)
        arrays |= {
            "grasp/approach": coming,
            "grasp/approach_joint_positions": np.full((1, 2), -0.3),
            "grasp/lift": np.array([[0.1, 0, 0.1, 1, 0, 0, 0]]),
        }
    return Shard("base", {}, arrays)


def test_a_way_goes_from_standoff_or_pregrasp_to_lift_or_squeeze():
    free, way = trajectory_of(shard(in_scene=False), 0), trajectory_of(shard(in_scene=True), 0)
    assert [point.name for point in free] == ["pregrasp", "grasp", "squeeze"]
    assert [point.name for point in way if point.name] == ["standoff", "pregrasp", "grasp", "squeeze", "lift"]
    assert way[0].hand_pose[0] == 0.2
    assert all((point.joint_positions == -0.3).all() for point in way[:WAYPOINTS])
    assert way[-1].carried.tolist() == [0, 0, 0.1] and not any(point.carried.any() for point in way[:-1])
    np.testing.assert_allclose(slider_positions(way), [0, 0.25, 0.5, 0.75, 1, 2, 3, 4])
    assert waypoint_at(way, 3.5).carried == pytest.approx([0, 0, 0.05]), "half way up"


@pytest.mark.parametrize("at", [(-1, 0.2, -0.3), (0.375, 0.15, -0.3), (1.5, 0.1, 0.05), (9, 0.1, 0.2)])
def test_between_two_postures_positions_and_joints_go_straight(at: tuple[float, float, float]):
    place, x, joint = at
    point = waypoint_at(trajectory_of(shard(in_scene=True), 0), place)
    assert point.hand_pose[0] == pytest.approx(x) and point.joint_positions == pytest.approx([joint, joint])


def test_a_turn_is_divided_evenly():
    ends = quat_from_axis_angle(np.array([0, 0, 1.0]), np.array([0.0, 1.2]))
    first, last = (
        Waypoint(name, np.concatenate([np.zeros(3), q]), np.zeros(0), np.zeros(3))
        for name, q in zip(("grasp", "squeeze"), ends, strict=True)
    )
    third = waypoint_at([first, last], 1 / 3).hand_pose[3:]
    assert third == pytest.approx(quat_from_axis_angle(np.array([0, 0, 1.0]), np.array(0.4)))


def test_a_shard_says_its_scene_or_none_and_nonsense_is_refused():
    spec = SceneSpec(kind="bin")
    assert scene_spec_of(Shard("base", {}, {})) is None
    assert scene_spec_of(Shard("base", {"scene": json_attribute(spec.model_dump(mode="json"))}, {})) == spec
    with pytest.raises(InputError, match="is not a valid scene"):
        scene_spec_of(Shard("base", {"scene": '{"kind": "moon"}'}, {}))


def test_wrists_are_those_of_the_rows_asked_for():
    one = shard(in_scene=True)
    assert wrist_angles(one, np.array([0])) is None
    one.arrays["grasp/wrist_positions"] = np.array([[0.1, 0.2], [0.3, 0.4]])
    assert np.array_equal(wrist_angles(one, np.array([1, 1])), [[0.3, 0.4]] * 2)
