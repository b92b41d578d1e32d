"""An arm that carries the hand: it is where the hand should be, within its limits, and runs into nothing."""

import re
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
import yourdfpy

from graspd.service.model.transforms import IDENTITY_POSE, compose, pose_from_matrix
from graspd.worker.episodes.execution import ASSUMED_RAD_S
from graspd.worker.episodes.reach import read_arm
from tests.exchange.robots.arms import JOINTS, rows, write_arm
from tests.worker.commands_run import graspd, refused

MOUNT_POSE = "0 0 0.11 1 0 0 0"
#: The search ends at 0.1 mm and 1 mrad; between two of its points, 5 mm apart, joints move straight.
NEAR_M = 5e-4
NAMES = [name for name, *_ in JOINTS]


@pytest.fixture(scope="module")
def arm(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_arm(tmp_path_factory.mktemp("arm"))


def export(shard: Path, arm: Path, folder: Path, format_: str = "csv", base: str = "-0.45 0 0 1 0 0 0"):
    carried = ["--arm", arm, "--mount-pose", MOUNT_POSE, "--base", base]
    return graspd(f"export --format {format_} --all --mount flange -o", folder, shard, *carried)


@pytest.fixture(scope="module")
def carried(table_shard: Path, arm: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[dict, Path]:
    folder = tmp_path_factory.mktemp("carried")
    return export(table_shard, arm, folder), folder


def test_the_share_of_grasps_that_the_arm_reaches_is_told(carried: tuple[dict, Path]) -> None:
    told, folder = carried
    assert told["candidates"] == 6 and told["grasps"] == len({row["grasp"] for row in rows(folder)}) >= 2
    assert told["reach_share"] == pytest.approx(told["grasps"] / told["candidates"], abs=1e-4)
    assert sum(told["refused"].values()) == told["candidates"] - told["grasps"]


def test_the_arm_holds_the_hand_where_the_grasp_has_it_all_along(carried, arm: Path) -> None:
    """yourdfpy's forward kinematics is the oracle; poses are told in the frame of the arm's base."""
    robot = yourdfpy.URDF.load(str(arm), load_meshes=False, build_scene_graph=True)
    for row in rows(carried[1])[::5]:
        robot.update_cfg({name: float(row[name]) for name in NAMES})
        flange = pose_from_matrix(robot.get_transform("flange", "base"))
        root = compose(flange, np.array([float(part) for part in MOUNT_POSE.split()]))
        told = np.array([float(row[part]) for part in ("x", "y", "z", "qw", "qx", "qy", "qz")])
        np.testing.assert_allclose(root[:3], told[:3], atol=NEAR_M)
        assert abs(root[3:] @ told[3:]) > np.cos(0.005)


def test_joints_stay_within_their_limits_of_place_and_speed(carried: tuple[dict, Path]) -> None:
    by_grasp: dict[str, list[dict[str, str]]] = {}
    for row in rows(carried[1]):
        by_grasp.setdefault(row["grasp"], []).append(row)
    for points in by_grasp.values():
        time = np.array([float(row["time_s"]) for row in points])
        for name, _, _, limit, speed, *_ in JOINTS:
            values = np.array([float(row[name]) for row in points])
            assert np.abs(values).max() <= limit + 1e-6
            # Half the limits is the default; 1e-6: rounding of the table.
            assert np.abs(np.diff(values) / np.diff(time)).max() <= 0.5 * speed + 1e-6


def test_arms_scene_opens_in_mujoco_and_nothing_of_arm_touches(table_shard: Path, arm: Path, tmp_path: Path) -> None:
    export(table_shard, arm, tmp_path, "mujoco")
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "arm.xml"))
    data = mujoco.MjData(model)
    assert model.nkey % 6 == 0 and model.nkey >= 12
    for key in range(model.nkey):
        mujoco.mj_resetDataKeyframe(model, data, key)
        mujoco.mj_forward(model, data)
        assert not [c for c in data.contact if c.dist < 0], model.key(key).name
        low, high = model.jnt_range[:6].T
        assert (data.qpos[:6] >= low - 1e-5).all() and (data.qpos[:6] <= high + 1e-5).all()
    assert model.body("flange").id and model.body("palm").id
    assert mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_BODY, "gripper") == -1, "what the mount carried is left out"


def test_moveit_is_told_poses_in_the_arms_base_and_all_joints(table_shard: Path, arm: Path, tmp_path: Path) -> None:
    export(table_shard, arm, tmp_path, "moveit")
    grasps = yaml.safe_load((tmp_path / "grasps.yaml").read_text())
    assert {grasp["grasp_pose"]["header"]["frame_id"] for grasp in grasps} == {"base"}
    file = min((tmp_path / "trajectories").iterdir())
    assert yaml.safe_load(file.read_text())["joint_trajectory"]["joint_names"][:6] == NAMES


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--mount", "flange", "--base", "-5 0 0 1 0 0 0"], r"reaches none of (\d) grasps \(\1 out of reach\)"),
        (["--mount", "flage"], "no link 'flage'"),  # codespell:ignore flage
        (["--mount", "base"], "no joint of the arm six moves the link 'base'"),
        ([], "--mount LINK"),
        (["--mount", "flange", "--base", "0 0 0"], "--base '0 0 0' is no pose"),
    ],
)
def test_an_arm_that_cannot_is_refused_in_a_line(options, said: str, free_shard: Path, arm: Path, tmp_path) -> None:
    told = refused("export --format csv", free_shard, "--arm", arm, *options, "-o", tmp_path / "out")
    assert re.search(said, told) and not (tmp_path / "out").exists()


def test_base_without_an_arm_and_an_arm_that_is_unknown_are_refused(free_shard, tmp_path) -> None:
    words = "export --format csv"
    assert "--arm ARM.urdf" in refused(words, free_shard, "--base", "0 0 0 1 0 0 0", "-o", tmp_path)
    said = refused(f"{words} --arm ur10", free_shard, "-o", tmp_path)
    assert "neither a file nor a built-in arm (franka, ur10e); did you mean ur10e?" in said


def test_speeds_that_the_arm_does_not_state_are_assumed_and_told(free_shard: Path, tmp_path: Path) -> None:
    found = export(free_shard, write_arm(tmp_path, velocities=False), tmp_path / "out", base="-0.45 0 -0.3 1 0 0 0")
    notes = found["notes"]
    assert any(f"6 joints have no velocity limit (pan, shoulder, elbow, ...): {ASSUMED_RAD_S:g}" in n for n in notes)


@pytest.mark.parametrize("kind", ["floating", "planar"])
def test_an_arm_on_a_base_that_floats_stands_still_there(kind: str, tmp_path: Path) -> None:
    urdf = write_arm(tmp_path)
    free = f'<link name="world"/><joint name="free" type="{kind}"><parent link="world"/><child link="base"/></joint>'
    urdf.write_text(urdf.read_text().replace("</robot>", f"{free}</robot>"))
    assert read_arm(urdf, "flange", IDENTITY_POSE).model.joint_names == tuple(NAMES)
