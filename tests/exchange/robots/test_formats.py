"""Robots: each format, opened by what reads it before an export ends; trajectories free of the object and in limits."""

import json
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import mujoco
import numpy as np
import pytest
import trimesh
import yaml
from hypothesis import given
from hypothesis import strategies as st

from graspd import service
from graspd.commands.exchange import ROBOTS
from graspd.exchange.inputs import load_case
from graspd.exchange.opening import READERS, check_written_files
from graspd.exchange.plan import prim_name, prim_names
from graspd.service.model.errors import GraspdError, InputError
from graspd.service.model.transforms import IDENTITY_POSE, apply, compose, invert, pose_to_matrix, quat_to_matrix, slerp
from graspd.service.store.shards import read_shard, write_shard
from graspd.worker.episodes import execution
from graspd.worker.episodes.execution import (
    POSTURES,
    Executions,
    build_executions,
    straight_paths,
    time_motions,
    tool_frame,
)
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.rendering.hands import hand_parts
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.model import MujocoOptions, build_scene
from graspd.worker.validation.protocol import Test as Rollout
from tests.conftest import REPOSITORY
from tests.exchange.robots.arms import rows
from tests.exchange.robots.conftest import COMMON
from tests.worker.commands_run import graspd, refused
from tests.worker.models import object_from_mesh, two_finger_hand
from tests.worker.quality.helpers import grasp_set, posture

BLOCK = next(Path(service.__file__).parent.glob("builtin/objects/block/*.stl"))
GRASP = {"id", "pre_grasp_posture", "grasp_posture", "grasp_pose", "grasp_quality", "pre_grasp_approach"}
GRASP |= {"post_grasp_retreat", "post_place_retreat", "max_contact_force", "allowed_touch_objects"}
POINT = {"positions", "velocities", "accelerations", "effort", "time_from_start"}
#: Positions in float32 and poses with seven digits [m].
ROUNDING_M = 2e-6
PAGE = (REPOSITORY / "docs" / "how-to" / "robots.md").read_text()


def export(shard: Path, format_: str, folder: Path, *more: str) -> dict:
    return graspd(f"export --format {format_} --all -o", folder, shard, *more)


def limp(shard: Path, out: Path) -> Path:
    made = read_shard(shard, kind="base")
    squeeze = np.array(made["squeeze/joint_positions"])
    squeeze[:2] = made["pregrasp/joint_positions"][:2]
    out.write_bytes(write_shard("base", {**made.arrays, "squeeze/joint_positions": squeeze}, made.attributes))
    return out


def export_of(hand: str, format_: str, folder: Path) -> Path:
    """Export grasps of a built-in hand on an object whose name no format takes as it is."""
    thing = folder / "003_mug.v2-final.stl"
    thing.write_bytes(BLOCK.read_bytes())
    graspd(f"synth --hand {hand} -n 2 {COMMON} --object", thing, "-o", folder / "grasps.h5")
    export(folder / "grasps.h5", format_, folder / format_)
    return folder / format_


@pytest.mark.parametrize("hand", ["allegro", "barrett", "shadow"])
def test_a_scene_of_every_built_in_hand_compiles_in_mujoco(hand: str, tmp_path: Path) -> None:
    model = mujoco.MjModel.from_xml_path(str(export_of(hand, "mujoco", tmp_path) / "scene.xml"))
    tendons = {model.tendon(k).name for k in range(model.ntendon)}
    # Actuators of a tendon bear its name, which is that of its first degree of freedom.
    assert tendons <= {model.actuator(k).name for k in range(model.nu)} and bool(tendons) == (hand == "shadow")


def test_isaac_names_prims_that_the_usd_export_has(tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd")
    isaac = yaml.safe_load(next(export_of("barrett", "isaac", tmp_path).glob("*.yaml")).read_text())
    export(tmp_path / "grasps.h5", "usd", tmp_path / "usd")
    file = next((tmp_path / "usd").glob("*.usd"))
    stage = usd.Stage.Open(str(file))
    assert isaac["object_frame_link"] == "/World/_003_mug_v2_final"
    thing, hand = (stage.GetPrimAtPath(isaac[name]) for name in ("object_frame_link", "gripper_frame_link"))
    cache = pytest.importorskip("pxr.UsdGeom").XformCache(usd.TimeCode.Default())
    placed = [np.array(cache.GetLocalToWorldTransform(prim)).T for prim in (thing, hand)]
    grasp = isaac["grasps"][file.stem]
    pose = [*grasp["position"], grasp["orientation"]["w"], *grasp["orientation"]["xyz"]]
    np.testing.assert_allclose(np.linalg.inv(placed[0]) @ placed[1], pose_to_matrix(np.array(pose)), atol=1e-6)


@pytest.mark.parametrize("name", ["3-finger hand", "手 爪", "", "mug (2).v1", "__", "ßÄ"])
def test_every_name_becomes_a_legal_prim_of_its_own(name: str) -> None:
    sdf = pytest.importorskip("pxr.Sdf")
    names = prim_names(["scene", name, name])
    assert len(set(names)) == 3
    for one in names:
        assert sdf.Path.IsValidIdentifier(one) and one.isascii()


@pytest.mark.parametrize("which", ["free_shard", "table_shard", "pressing_shard", "clutter_shard"])
def test_a_mujoco_scene_replays_to_the_verdict_of_the_validator(which: str, request, tmp_path) -> None:
    shard = limp(request.getfixturevalue(which), tmp_path / "limp.h5")
    told = export(shard, "mujoco", tmp_path)
    # A script that has only mujoco and numpy must do: -I keeps this checkout out of its reach.
    command = [sys.executable, "-I", str(tmp_path / "replay.py"), str(tmp_path / "scene.xml"), "--json"]
    found = json.loads(subprocess.run(command, check=True, capture_output=True, text=True).stdout)
    protocol = "dexgraspbench" if load_case(shard).placed is None else "lift"
    verdicts = [one["held"] for one in graspd(f"evaluate --protocol {protocol}", shard)["verdicts"]]
    assert len(found) == told["grasps"] and set(verdicts) == {True, False}
    for name, what in found.items():
        assert (what == "held") == verdicts[int(name.removeprefix("grasp_"))], name


def test_a_mujoco_scene_has_the_hands_names_and_key_frames(table_shard: Path, tmp_path: Path) -> None:
    export(table_shard, "mujoco", tmp_path)
    model = mujoco.MjModel.from_xml_path(str(tmp_path / "scene.xml"))
    data = mujoco.MjData(model)
    case = load_case(table_shard)
    assert {model.actuator(k).name for k in range(model.nu)} == set(case.hand.dof_names)
    shard = read_shard(table_shard, kind="base")
    at = shard["scene/object_pose"][shard["grasp/scene_index"]]
    for row in range(len(case.grasps)):
        mujoco.mj_resetDataKeyframe(model, data, model.key(f"grasp_{row:04}/grasp").id)
        mujoco.mj_forward(model, data)
        pose = compose(at[row], case.grasps.grasp.hand_pose[row])
        bodies = body_poses(case.hand, pose, case.grasps.grasp.joint_positions[row])[0]
        for name, expected in zip(case.hand.body_names, bodies, strict=True):
            # 1e-5: MuJoCo writes the tree's own numbers with six digits.
            np.testing.assert_allclose(data.body(name).xpos, expected[:3], atol=1e-5)
        np.testing.assert_allclose(data.site("object_frame").xpos, at[row, :3], atol=1e-6)


def test_an_isaac_file_has_the_fields_of_its_documentation(free_shard: Path, tmp_path: Path) -> None:
    count = export(free_shard, "isaac", tmp_path)["grasps"]
    found = yaml.safe_load((tmp_path / "barrett_block.yaml").read_text())
    assert found["format"] == "isaac_grasp" and float(found["format_version"]) == 1.0
    assert found["object_frame_link"] == found["object_frame"] == "/World/block"
    assert found["gripper_frame_link"] == found["gripper_frame"] == "/World/barrett/palm"
    assert len(found["grasps"]) == count
    case = load_case(free_shard)
    valid = read_shard(free_shard, kind="base")["quality/valid"]
    for name, grasp in found["grasps"].items():
        row = int(name.removeprefix("grasp_"))
        pose = case.grasps.grasp.hand_pose[row]
        told = [*grasp["position"], grasp["orientation"]["w"], *grasp["orientation"]["xyz"]]
        np.testing.assert_allclose(told, pose, atol=1e-8)
        assert grasp["confidence"] == float(valid[row])
        assert set(grasp["cspace_position"]) == set(grasp["pregrasp_cspace_position"])
        joints = dict(zip(case.hand.joint_names, case.grasps.grasp.joint_positions[row], strict=True))
        for joint, value in grasp["cspace_position"].items():
            assert value == pytest.approx(joints[joint], abs=1e-8)
        assert {"finger_1_spread"} <= set(grasp["cspace_position"]) < set(joints), "driven joints, and no coupled ones"


def test_moveit_grasps_have_the_fields_of_the_messages(table_shard: Path, tmp_path: Path) -> None:
    told = export(table_shard, "urdf+yaml", tmp_path)
    grasps = yaml.safe_load((tmp_path / "grasps.yaml").read_text())
    assert len(grasps) == told["grasps"]
    for grasp in grasps:
        assert set(grasp) == GRASP and grasp["grasp_pose"]["header"]["frame_id"] == "scene"
        x, y, z, w = (grasp["grasp_pose"]["pose"]["orientation"][k] for k in "xyzw")
        assert x * x + y * y + z * z + w * w == pytest.approx(1.0, abs=1e-6)
        for name, points in (("pre_grasp_posture", 1), ("grasp_posture", 2)):
            trajectory = grasp[name]
            assert set(trajectory) == {"header", "joint_names", "points"} and len(trajectory["points"]) == points
            for point in trajectory["points"]:
                assert set(point) == POINT and len(point["positions"]) == len(trajectory["joint_names"])
        assert len(grasp["grasp_posture"]["points"][-1]["effort"]) == len(grasp["grasp_posture"]["joint_names"])
        for name in ("pre_grasp_approach", "post_grasp_retreat", "post_place_retreat"):
            way = grasp[name]
            assert way["desired_distance"] == pytest.approx(0.1, abs=1e-6) and 0 < way["min_distance"] < 0.1
            assert np.linalg.norm(list(way["direction"]["vector"].values())) == pytest.approx(1.0, abs=1e-6)
        assert grasp["post_grasp_retreat"]["direction"]["vector"]["z"] == pytest.approx(1.0, abs=1e-6)
    link = ElementTree.parse(tmp_path / "object" / "bottle.urdf").getroot().find("link")
    assert link is not None and link.get("name") == "bottle"
    meshes = {one.get("filename") for one in link.iter("mesh")}
    assert meshes == {"bottle.obj"} and (tmp_path / "object" / "bottle.obj").is_file()
    assert hand_from_path(tmp_path / "hand").joint_names == load_case(table_shard).hand.joint_names
    export(table_shard, "moveit", tmp_path / "best", "--best", "2")
    files = sorted((tmp_path / "best" / "trajectories").iterdir())
    assert len(files) == 2
    found = yaml.safe_load(files[0].read_text())
    assert set(found) == {"joint_trajectory", "multi_dof_joint_trajectory"}
    points = found["joint_trajectory"]["points"]
    times = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in points]
    assert times == sorted(times) and times[0] == 0.0
    assert len(points) == len(found["multi_dof_joint_trajectory"]["points"])


def test_tables_name_their_columns_and_hold_what_the_shard_holds(free_shard: Path, tmp_path: Path) -> None:
    export(free_shard, "csv", tmp_path, "--tool-frame", "0 0 0.1 1 0 0 0")
    postures, trajectories, grasps = (rows(tmp_path, name) for name in ("postures", "trajectories", "grasps"))
    case = load_case(free_shard)
    for row in (row for row in postures if row["posture"] == "grasp"):
        number = int(row["grasp"].removeprefix("grasp_"))
        tool = np.array([float(row[part]) for part in ("x", "y", "z", "qw", "qx", "qy", "qz")])
        root = compose(tool, invert(np.array([0, 0, 0.1, 1, 0, 0, 0])))
        np.testing.assert_allclose(root, case.grasps.grasp.hand_pose[number], atol=1e-8)
        joints = [float(row[name]) for name in case.hand.joint_names]
        np.testing.assert_allclose(joints, case.grasps.grasp.joint_positions[number], atol=1e-8)
    assert {row["phase"] for row in trajectories} == {"approach", "shape", "close", "squeeze", "lift"}
    assert {row["tool_frame"] for row in grasps} == {"tool"}


@pytest.mark.parametrize(
    ("options", "said"),
    [
        ("csv --tool-frame finger_1_distal_link", "moves with a finger"),
        ("csv --speed 1.5", "at most 1"),
        ("graspgen --held-out 1", "between 0 and 1"),
    ],
)
def test_a_mistake_is_one_line_and_writes_nothing(options: str, said: str, free_shard: Path, tmp_path: Path) -> None:
    assert said in refused(f"export --format {options}", free_shard, "-o", tmp_path / "out")
    assert not (tmp_path / "out").exists()


def expected(shard: Path, row: int) -> tuple[dict[str, np.ndarray], np.ndarray]:
    """Vertices of the hand's bodies in the frame of the scene or the object, and the object's matrix there."""
    case = load_case(shard)
    at = IDENTITY_POSE if case.placed is None else case.placed.object_pose[case.placed.index[row]]
    grasp, names = case.grasps.grasp, case.hand.body_names
    poses = body_poses(case.hand, grasp.hand_pose[row], grasp.joint_positions[row])[0]
    bodies = pose_to_matrix(at) @ pose_to_matrix(poses)
    parts = [(names[part.body], part.solid.vertices, bodies[part.body]) for part in hand_parts(case.hand)]
    return {name: trimesh.transform_points(points, body) for name, points, body in parts}, pose_to_matrix(at)


@pytest.mark.parametrize("which", ["free_shard", "table_shard"])
def test_trimesh_reads_grasp_whose_parts_stand_where_they_should(which: str, request, tmp_path) -> None:
    shard = request.getfixturevalue(which)
    told = export(shard, "glb", tmp_path)
    files = sorted(tmp_path.glob("*.glb"))
    assert len(files) == told["grasps"]
    upright = np.eye(4)
    upright[:3, :3] = quat_to_matrix(np.array([np.sqrt(0.5), -np.sqrt(0.5), 0, 0]))
    for file in files[:2]:
        scene = trimesh.load(file)
        bodies, thing = expected(shard, int(file.stem.removeprefix("grasp_")))
        case = load_case(shard)
        wanted = bodies | {case.obj.name: trimesh.transform_points(case.obj.vertices, thing)}
        assert ("support_0" in scene.graph.nodes) == (which == "table_shard")
        assert "tool_frame" in scene.graph.nodes
        for name, vertices in wanted.items():
            matrix, geometry = scene.graph[name]
            found = trimesh.transform_points(scene.geometry[geometry].vertices, matrix)
            turned = trimesh.transform_points(vertices, upright)
            np.testing.assert_allclose(found.min(axis=0), turned.min(axis=0), atol=ROUNDING_M)
            np.testing.assert_allclose(found.max(axis=0), turned.max(axis=0), atol=ROUNDING_M)


def test_usd_opens_a_grasp_in_metres_that_moves_to_the_lift(table_shard: Path, tmp_path: Path) -> None:
    usd = pytest.importorskip("pxr.Usd")
    geometry = pytest.importorskip("pxr.UsdGeom")
    export(table_shard, "usd", tmp_path)
    file = min(tmp_path.glob("*.usd"))
    stage = usd.Stage.Open(str(file))
    assert geometry.GetStageMetersPerUnit(stage) == 1.0 and geometry.GetStageUpAxis(stage) == "Z"
    assert stage.GetDefaultPrim().GetPath() == "/World"
    bodies, thing = expected(table_shard, int(file.stem.removeprefix("grasp_")))

    def vertices(path: str, time: float | None) -> np.ndarray:
        code = usd.TimeCode.Default() if time is None else usd.TimeCode(time)
        mesh = geometry.Mesh(stage.GetPrimAtPath(f"{path}/mesh"))
        matrix = np.array(geometry.Xformable(mesh).ComputeLocalToWorldTransform(code)).T
        return trimesh.transform_points(np.array(mesh.GetPointsAttr().Get()), matrix)

    for name, points in bodies.items():
        np.testing.assert_allclose(vertices(f"/World/barrett/{name}", None), points, atol=ROUNDING_M)
    end = stage.GetEndTimeCode()
    rest, lifted = vertices("/World/bottle", 0.0), vertices("/World/bottle", end)
    bottle = load_case(table_shard).obj
    np.testing.assert_allclose(rest, trimesh.transform_points(bottle.vertices, thing), atol=ROUNDING_M)
    np.testing.assert_allclose(lifted - rest, np.tile([0, 0, 0.1], (len(rest), 1)), atol=1e-5)
    palm = vertices("/World/barrett/palm", 0.0), vertices("/World/barrett/palm", None)
    assert np.linalg.norm((palm[1] - palm[0]).mean(axis=0)) >= 0.1 - 1e-3, "the standoff"
    assert stage.GetPrimAtPath("/World/scene/support_0/mesh").IsValid()


def test_without_usd_core_a_line_says_what_to_install(free_shard: Path, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "pxr", None)
    assert "pip install 'graspd[usd]'" in refused("export --format usd", free_shard, "-o", tmp_path)


def test_every_format_of_the_command_is_on_the_page() -> None:
    on_page = {line.partition("|")[2].partition("|")[0].strip(" `") for line in PAGE.splitlines()}
    assert {*ROBOTS} - {"urdf+yaml"} <= on_page and "urdf+yaml" in PAGE


TOOL = tool_frame(None, "palm", {})
LINKS = {"palm": (0, IDENTITY_POSE), "tcp": (0, np.array([0, 0, 0.1, 1, 0, 0, 0.0])), "tip": (2, IDENTITY_POSE)}


def of_shard(file: Path) -> Executions:
    case = load_case(file)
    given = {"rows": np.arange(len(case.grasps)), "placed": case.placed, "tool": TOOL}
    quality = {"valid": read_shard(file, kind="base")["quality/valid"]}
    return build_executions(case.hand, case.obj, case.grasps, **given, quality=quality)


@pytest.fixture(scope="module")
def free(free_shard: Path) -> Executions:
    return of_shard(free_shard)


def test_a_free_grasp_is_reached_and_left_over_ten_centimetres(free: Executions) -> None:
    for start, end in (("standoff", "arrival"), ("squeeze", "lift")):
        way = free.postures[end].hand_pose[:, :3] - free.postures[start].hand_pose[:, :3]
        assert (np.linalg.norm(way, axis=1) >= 0.1 - 1e-9).all()


def test_open_hand_touches_nothing_of_a_free_object_on_its_way(free: Executions) -> None:
    """MuJoCo is the oracle: its convex pieces of the object stand out from the surface by up to 2 mm."""
    rollout = Rollout(build_scene(free.hand, free.obj, decompose(free.obj), MujocoOptions()))
    assert len(free) >= 4
    for start, end in (("standoff", "arrival"), ("arrival", "pregrasp")):
        a, b = free.postures[start], free.postures[end]
        for row in range(len(free)):
            for share in np.linspace(0, 1, 21):
                place = (1 - share) * a.hand_pose[row, :3] + share * b.hand_pose[row, :3]
                turn = slerp(a.hand_pose[row, 3:], b.hand_pose[row, 3:], float(share))
                joints = (1 - share) * a.joint_positions[row] + share * b.joint_positions[row]
                rollout._set_posture(np.concatenate([place, turn]), joints)
                mujoco.mj_forward(rollout.scene.model, rollout.data)
                assert rollout.penetration()[0] < 0.002


def test_grasps_without_a_free_way_are_left_out_none_is_refused() -> None:
    hand = two_finger_hand()
    shell = trimesh.creation.icosphere(subdivisions=3, radius=0.12)
    inner = trimesh.creation.icosphere(subdivisions=3, radius=0.105)
    inner.invert()
    ball = object_from_mesh(trimesh.util.concatenate([shell, inner]))
    caught = grasp_set(posture(((0.0, 0, 0), (0.0, 0.0))))
    with pytest.raises(InputError, match="free straight approach"):
        build_executions(hand, ball, caught, rows=np.zeros(1, int), placed=None, tool=TOOL, quality={})


def test_in_scene_ways_of_shard_are_kept_in_frame_of_the_scene(table_shard: Path) -> None:
    shard, on_table = read_shard(table_shard, kind="base"), of_shard(table_shard)
    at = shard["scene/object_pose"][shard["grasp/scene_index"]]
    np.testing.assert_array_equal(on_table.object_pose, at)
    back = compose(invert(at), on_table.postures["standoff"].hand_pose)
    np.testing.assert_allclose(back[:, :3], shard["grasp/approach"][:, 0, :3], atol=1e-12)
    rise = on_table.postures["lift"].hand_pose[:, :3] - on_table.postures["squeeze"].hand_pose[:, :3]
    np.testing.assert_allclose(rise, np.tile([0, 0, 0.1], (len(on_table), 1)), atol=1e-9)
    assert on_table.frame == "scene"
    part = on_table.postures["grasp"]
    bodies = body_poses(on_table.hand, part.hand_pose, part.joint_positions)
    assert (bodies[:, :, 2] > -0.01).all(), "below the table"


def test_the_tool_frame_is_a_link_or_a_pose(free: Executions) -> None:
    root = free.postures["grasp"].hand_pose
    for text in ("tcp", "0 0 0.1 1 0 0 0", "0,0,0.1,1,0,0,0"):
        found = replace(free, tool=tool_frame(text, "palm", LINKS))
        np.testing.assert_allclose(found.tool_pose("grasp")[:, :3], apply(root, np.array([0, 0, 0.1])), atol=1e-12)
    assert tool_frame("palm", "palm", LINKS).name == "palm"
    rounded = execution.parse_pose("0 0 0 0.7071 0 0 0.7071", "--base")
    assert np.linalg.norm(rounded[3:]) == pytest.approx(1.0, abs=1e-12)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("tcpp", "did you mean 'tcp'"),
        ("wrist", "no link 'wrist'"),
        ("tip", "moves with a finger"),
        ("0 0 0.1", "seven numbers"),
        ("0 0 0 1 1 0 0", "length 1.41"),
        ("0 0 0 nan 0 0 0", "seven numbers"),
    ],
)
def test_a_tool_frame_that_is_none_is_refused_in_a_line(text: str, said: str) -> None:
    with pytest.raises(InputError, match=said):
        tool_frame(text, "palm", LINKS)


@pytest.mark.parametrize("speed", [0.2, 1.0])
def test_trajectories_stay_within_limits_and_reach_every_posture(free: Executions, speed: float) -> None:
    velocity = np.linspace(0.3, 2.0, len(free.hand.joint_names))
    for row in range(len(free)):
        found = time_motions(straight_paths(free, row), free.hand.joint_names, velocity, speed=speed)
        step = np.diff(found.time)
        assert (step > 0).all()
        # Secants of a motion are no steeper than its steepest tangent; 1e-9: rounding.
        assert (np.abs(np.diff(found.joints, axis=0)) / step[:, None] <= speed * velocity * (1 + 1e-9)).all()
        along = np.linalg.norm(np.diff(found.hand_pose[:, :3], axis=0), axis=1) / step
        assert along.max() <= speed * execution.HAND_M_S * (1 + 1e-9) and not found.velocity[[0, -1]].any()
        ends = [0] + [k for k in range(len(step)) if found.phase[k] != found.phase[k + 1]] + [len(step)]
        ends = sorted(set(ends) - {0}) if len(ends) > len(POSTURES) else ends
        for posture_name, k in zip(POSTURES, ends, strict=True):
            joints = free.postures[posture_name].joint_positions[row]
            np.testing.assert_allclose(found.joints[k], joints, atol=1e-9, err_msg=posture_name)


def test_limits_are_those_of_the_hand_or_assumed(free: Executions) -> None:
    hand = replace(free.hand, velocity=np.concatenate([[3.0], np.zeros(free.hand.dofs - 1)]))
    found = execution.velocity_limits(hand)
    leads = hand.dof[hand.joint_body] == 0
    np.testing.assert_allclose(found.velocity[leads], 3.0 * np.abs(hand.multiplier[hand.joint_body][leads]))
    assert (found.velocity[~leads] == execution.ASSUMED_RAD_S).all()
    assert set(found.assumed) == {name for name, led in zip(hand.joint_names, leads, strict=True) if not led}


@pytest.mark.parametrize(
    ("suffix", "content"),
    [*((suffix, b"\x00<broken\n1,2\xff") for suffix in READERS), (".csv", b"1,2\n3\n"), (".usd", b"#usda 1.0\n")],
)
def test_a_file_that_its_library_cannot_read_is_named(suffix: str, content: bytes, tmp_path) -> None:
    with (
        pytest.raises(GraspdError, match=rf"broken\{suffix} was written but .* cannot read it"),
        check_written_files(tmp_path),
    ):
        (tmp_path / f"broken{suffix}").write_bytes(content)


def test_only_files_that_are_written_anew_are_looked_at(tmp_path) -> None:
    (tmp_path / "old.xml").write_bytes(b"broken")
    with check_written_files(tmp_path):
        (tmp_path / "new.json").write_text("{}")
    (tmp_path / "scene.xml").write_text("<mujoco/>")
    with pytest.raises(GraspdError, match="scene"), check_written_files(tmp_path):
        (tmp_path / "scene.xml").write_text("<mujoco><tendon><fixed/></tendon></mujoco>")


@given(st.text(max_size=30))
def test_any_name_becomes_one_that_usd_takes_for_a_prim(name: str) -> None:
    assert pytest.importorskip("pxr.Sdf").Path.IsValidIdentifier(prim_name(name))


@pytest.mark.parametrize(
    ("name", "prim"),
    [("003_cracker_box", "_003_cracker_box"), ("mug.v2.final", "mug_v2_final"), ("tasse-caf-1", "tasse_caf_1")],
)
def test_a_prim_keeps_what_it_can_of_the_name(name: str, prim: str) -> None:
    assert prim_name(name) == prim


def test_siblings_whose_names_become_the_same_are_told_apart() -> None:
    assert prim_names(["a-b", "a_b", "a.b", "a_b_2"]) == ["a_b", "a_b_2", "a_b_3", "a_b_2_2"]
