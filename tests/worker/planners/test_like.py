"""Option `like`: grasps near a demonstrated wrist pose, of a free object, on a table, and of a gripper."""

import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

import graspd
from graspd.cli import build_app
from graspd.service.model.contact_region import parse_pose
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError
from graspd.service.model.local_options import LocalOptions
from graspd.service.model.options import validate
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.store.shards import read_shard, write_shard
from graspd.worker.files.synthesis import SynthesisResult, synthesize_with_options, wrist_pose
from graspd.worker.generation import ValidatedBatch, validated_grasps
from graspd.worker.grasps import Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners.requirements import LIKE_DEG, LIKE_M, Requirements
from graspd.worker.scenes.kinds import supports_of
from graspd.worker.simulation.environment import Scenes
from tests.worker.hands.urdfs import gripper
from tests.worker.models import object_from_mesh, quality_columns

COLUMNS = ("quality/like_distance_m", "quality/like_angle_deg")
DRAFT = {"fidelity": "draft", "device": "cpu", "seed": 3}


def synth(obj: str = "mug", **options) -> SynthesisResult:
    return synthesize_with_options("allegro", obj, validate(LocalOptions, DRAFT | options), processes=1)


def text_of(made: SynthesisResult, row: int = 0) -> str:
    return ", ".join(f"{value:.6f}" for value in made.arrays["grasp/hand_pose"][row])


@pytest.fixture(scope="module")
def plain() -> SynthesisResult:
    return synth(grasps=2)


@pytest.fixture(scope="module")
def on_table() -> SynthesisResult:
    return synth(grasps=1, scene="table", scenes=1)


def assert_near(made: SynthesisResult, pose: str) -> None:
    """The columns are the distance and the angle of every stored wrist, and within the limits."""
    found, wanted = made.arrays["grasp/hand_pose"], np.array(parse_pose(pose))
    distance, angle = (made.arrays[path] for path in COLUMNS)
    assert len(found)
    assert np.allclose(distance, np.linalg.norm(found[:, :3] - wanted[:3], axis=1), atol=1e-6)
    cosine = 2 * (found[:, 3:] @ wanted[3:]) ** 2 - 1
    assert np.allclose(np.cos(np.deg2rad(angle)), cosine, atol=1e-5)
    assert distance.max() <= LIKE_M and angle.max() <= LIKE_DEG


def test_a_pose_is_seven_numbers_with_a_unit_quaternion() -> None:
    assert parse_pose("0.1, -.2,3e-2, 1,0, 0, 0.02") == (0.1, -0.2, 0.03, 1, 0, 0, 0.02)
    assert JobOptions(like="0, 0, 0, 1, 0, 0, 0").requirements == {"like": "0, 0, 0, 1, 0, 0, 0"}
    for text, words in (
        ("0, 0, 0, 1, 1, 0, 0", "norm 1; got 1.414"),
        ("0, 0, 0, 1.0011, 0, 0, 0", "norm 1"),
        ("0, 0, 0, 1, 0, 0", "x, y, z, qw, qx, qy, qz"),
        ("0, 0, nan, 1, 0, 0, 0", "x, y, z, qw, qx, qy, qz"),
        ("mug", "x, y, z, qw, qx, qy, qz"),
    ):
        for model in (JobOptions, LocalOptions):
            with pytest.raises(InputError, match=words):
                validate(model, {"like": text})
    with pytest.raises(InputError, match="x, y, z, qw"):
        validate(JobOptions, {"like": "grasps.h5"})  # a job has no files
    with pytest.raises(InputError, match="like requires method fast_graspd"):
        validate(JobOptions, {"like": "0, 0, 0, 1, 0, 0, 0", "method": "dfc"})


def test_a_grasp_file_stands_for_a_row_by_default_the_first_valid_one(tmp_path: Path) -> None:
    columns = quality_columns(3)
    pose = np.tile([0, 0, 0, 1.0, 0, 0, 0], (3, 1))
    pose[:, 0] = [0.1, 0.2, 0.3]
    for posture in ("grasp", "pregrasp", "squeeze"):
        columns |= {f"{posture}/hand_pose": pose, f"{posture}/joint_positions": np.zeros((3, 2))}
    said = {"hand": "allegro", "object": "mug", "batch": 0, "shard_id": "0" * 32, "seed": 0}
    for name, valid in (("some.h5", [0, 1, 1]), ("none.h5", [0, 0, 0])):
        (tmp_path / name).write_bytes(write_shard("base", columns | {"quality/valid": np.array(valid, np.uint8)}, said))
    some = f"{tmp_path}/some.h5"
    for text, x in ((some, 0.2), (f"{some}:0", 0.1), (f"{some}:2", 0.3)):
        assert parse_pose(wrist_pose(text, "allegro", "mug", {})) == (x, 0, 0, 1, 0, 0, 0)
    for text, words in ((f"{some}:3", "has 3 grasps"), (f"{tmp_path}/none.h5", "no valid grasp: choose a row")):
        with pytest.raises(InputError, match=words):
            wrist_pose(text, "allegro", "mug", {})
    assert wrist_pose("", "", "", {}) == "" and wrist_pose("0, 0, 0, 1, 0, 0, 0", "", "", {}) == "0, 0, 0, 1, 0, 0, 0"


def test_free_grasps_are_near_the_pose_and_columns_exist_only_then(plain: SynthesisResult) -> None:
    assert not any("like" in path for path in plain.arrays)
    made = synth(grasps=6, like=text_of(plain))
    assert made.arrays["quality/valid"].all()
    assert_near(made, text_of(plain))
    assert json.loads(str(made.attributes["requirements"])) == {"like": made.request.like}
    assert np.ptp(made.arrays["grasp/hand_pose"][:, :3], axis=0).max() > 0.002, "noise makes the grasps differ"


def test_grasps_on_a_table_are_near_the_pose(on_table: SynthesisResult) -> None:
    assert_near(synth(grasps=2, scene="table", scenes=1, budget=16, like=text_of(on_table)), text_of(on_table))


def test_grasps_use_the_scenes_in_which_the_palm_has_room() -> None:
    """The object in the second scene is upside down, so that the pose above it is below the table."""
    hand, obj = hand_from_path("allegro"), object_from_mesh(trimesh.creation.box((0.05, 0.05, 0.14)))
    upright, turned = np.array([0, 0, 0.07, 1.0, 0, 0, 0]), np.array([0, 0, 0.07, 0, 1.0, 0, 0])
    table = supports_of(SceneSpec(kind="table"))
    common = {"fidelity": "draft", "seed": 2, "validation": "none", "scene": "table", "want": "candidates"}

    def made(count: int, *poses: np.ndarray, **required: str) -> ValidatedBatch:
        scenes = Scenes(table, np.array(poses))
        return validated_grasps(hand, obj, JobOptions(**common, **required), count=count, scenes=scenes)

    pose = made(1, upright, approach_cone="0, 0, -1, 30").grasps.grasp.hand_pose[0]
    like = ", ".join(f"{value:.6f}" for value in pose)
    both = made(3, turned, upright, like=like)
    assert both.grasps.scene.tolist() == [1, 1, 1]
    with pytest.raises(InputError, match=r"blocks the palm of allegro at the demonstrated .* 2 scenes"):
        made(1, turned, turned, like=like)


def test_a_file_with_grasps_of_another_object_or_hand_is_refused(plain: SynthesisResult, tmp_path: Path) -> None:
    file = tmp_path / "demo.h5"
    file.write_bytes(write_shard("base", plain.arrays, plain.attributes | {"shard_id": "0" * 32}))
    for hand, obj, mesh, words in (
        ("allegro", "block", {}, r"are of another object \(mug\) than block"),
        ("allegro", "mug", {"scale_to": 0.1}, "or of other mesh options"),
        ("barrett", "mug", {}, "wrist frames of hands differ: use graspd transfer .* --hand barrett"),
    ):
        with pytest.raises(InputError, match=words) as caught:
            wrist_pose(str(file), hand, obj, mesh)
        assert "\n" not in str(caught.value)
    assert parse_pose(wrist_pose(str(file), "allegro", "mug", {}))


def test_grasps_of_a_gripper_are_near_the_pose() -> None:
    hand, obj = gripper(), object_from_path("block", face_error_m=1e-3)
    common = {"fidelity": "draft", "seed": 2, "rechecks": 0, "validation": "none"}
    pose = validated_grasps(hand, obj, JobOptions(**common, grasps=1), count=1).grasps.grasp.hand_pose[0]
    like = ", ".join(f"{value:.6f}" for value in pose)
    made = validated_grasps(hand, obj, JobOptions(**common, grasps=4, like=like), count=4)
    assert len(made.grasps) == 4 and made.columns["quality/like_distance_m"].max() <= LIKE_M


@pytest.mark.parametrize("scene", ["free", "table"])
def test_a_pose_out_of_reach_or_inside_the_object_is_refused_in_a_line(scene: str, tmp_path: Path) -> None:
    trimesh.creation.box((0.2, 0.2, 0.2)).export(tmp_path / "box.stl")
    for x, words in ((1, "does not reach box from the"), (0, "at the demonstrated wrist pose")):
        with pytest.raises(InputError, match=words) as caught:
            synth(str(tmp_path / "box.stl"), grasps=1, scene=scene, scenes=1, like=f"{x}, 0, 0, 1, 0, 0, 0")
        assert "\n" not in str(caught.value)


def test_a_grasp_far_from_the_pose_fails_the_requirement() -> None:
    hand, request = hand_from_path("allegro"), JobOptions(like="0, 0, 0.1, 1, 0, 0, 0")
    wanted = Requirements.of(request, hand, origin=(0.0, 0.0, 0.02))
    pose = np.tile([0, 0, 0.08, 1.0, 0, 0, 0], (3, 1))
    pose[1, 0] = 0.041
    pose[2, 3:] = np.cos(np.deg2rad(15.5)), 0, 0, np.sin(np.deg2rad(15.5))
    grasp = Posture(pose, np.zeros((3, len(hand.joint_names))))
    columns = {"quality/digits": np.zeros(3)}
    assert wanted.failed(hand, grasp, None, columns).tolist() == ["", "other_wrist_pose", "other_wrist_pose"]
    assert np.allclose(wanted.like_columns(grasp)["quality/like_angle_deg"], [0, 0, 31])


def test_command_and_function_take_a_grasp_file(plain: SynthesisResult, tmp_path: Path) -> None:
    file, out = tmp_path / "demo.h5", tmp_path / "out.h5"
    file.write_bytes(write_shard("base", plain.arrays, plain.attributes | {"shard_id": "0" * 32}))
    words = f"synth --hand allegro --object mug -n 2 --fidelity draft --device cpu --like {file}:1 -o {out}"
    done = CliRunner().invoke(build_app(), words.split())
    assert done.exit_code == 0, done.output
    assert read_shard(out)[COLUMNS[0]].max() <= LIKE_M
    found = graspd.synthesize("allegro", "mug", grasps=2, fidelity="draft", device="cpu", like=f"{file}:1")
    assert len(found) == 2
