"""`graspd view`: it serves a page, its slider moves hand and object, grasps follow one another, it ends cleanly."""

import os
import re
import signal
import subprocess
import sys
import urllib.request
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.transforms import quat_from_axis_angle
from graspd.service.store.shards import Shard, json_attribute, write_shard
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.rendering.hands import drawn_bodies
from graspd.worker.viewing import Viewer, ViewerContent, _metrics_text
from tests.worker.commands_run import refused
from tests.worker.models import attributes_of, object_from_mesh, quality_columns, two_finger_hand

viser = pytest.importorskip("viser", reason="needs the extra: pip install graspd[view]")
HAND = two_finger_hand()
BLOCK = object_from_mesh(trimesh.creation.box((0.05, 0.04, 0.06)), "block")
GRASPS = 3
LIFT_M = 0.1
SCENE = json_attribute(SceneSpec(kind="bin").model_dump(mode="json"))


def arrays(joints: int) -> dict[str, np.ndarray]:
    turned = quat_from_axis_angle(np.array([1.0, 0, 0]), np.asarray(np.pi))
    pose = np.tile(np.concatenate([[0, 0, 0.06], turned]), (GRASPS, 1))
    pose[:, 0] = 0.01 * np.arange(GRASPS)
    coming = np.repeat(pose[:, None], 3, axis=1)
    coming[..., 2] += [0.1, 0.05, 0]
    lift = pose + np.array([0, 0, LIFT_M, 0, 0, 0, 0])
    made: dict[str, np.ndarray] = {}
    for k, name in enumerate(("pregrasp", "grasp", "squeeze")):
        made |= {f"{name}/hand_pose": pose, f"{name}/joint_positions": np.full((GRASPS, joints), 0.1 * k)}
    made |= {"grasp/approach": coming, "grasp/approach_joint_positions": np.full((GRASPS, joints), -0.1)}
    made |= {"grasp/lift": lift, "grasp/scene_index": np.array([0, 0, 1])}
    made["scene/object_pose"] = np.array([[0.05, 0, 0.03, 1, 0, 0, 0], [-0.05, 0, 0.03, 1, 0, 0, 0]])
    made["scene/rest_probability"] = np.ones(2)
    made |= quality_columns(GRASPS)
    return made | {"quality/valid": np.array([0, 1, 0], np.uint8), "quality/success": np.array([0, 1, 0], np.int8)}


@contextmanager
def viewing(hand, obj, columns: dict[str, np.ndarray]):
    said = {"hand": "two fingers", "object": "block", "scene": SCENE}
    made = Viewer(ViewerContent(Shard("base", said, columns), hand, obj), port=0)
    try:
        yield made
    finally:
        made.close()


@pytest.fixture(scope="module")
def viewer():
    with viewing(HAND, BLOCK, arrays(2)) as made:
        yield made


@pytest.fixture(autouse=True)
def first(request) -> None:
    if "viewer" in request.fixturenames:
        request.getfixturevalue("viewer").choose("all")


def shown_at(viewer, place: float) -> None:
    viewer.slider.value = place
    viewer.show()


@pytest.mark.parametrize(("place", "height", "joint"), [(0, 0.16, -0.1), (1, 0.06, 0), (2, 0.06, 0.1), (4, 0.16, 0.2)])
def test_slider_moves_bodies_of_hand_where_its_kinematics_say(viewer, place, height, joint):
    shown_at(viewer, place)
    root = np.concatenate([[0, 0, height], arrays(2)["grasp/hand_pose"][0, 3:]])
    (bodies,) = body_poses(HAND, root[None], np.full((1, 2), float(joint)))
    for node, body in zip(viewer.models.bodies, drawn_bodies(HAND), strict=True):
        # The nodes keep single precision.
        np.testing.assert_allclose(node.position, bodies[body, :3], atol=1e-6)
        assert abs(node.wxyz @ bodies[body, 3:]) == pytest.approx(1, abs=1e-6)


def test_page_is_on_loopback_and_object_goes_up_with_the_hand(viewer):
    assert viewer.url.startswith("http://127.0.0.1:")
    with urllib.request.urlopen(viewer.url, timeout=60) as answer:
        assert b"<html" in answer.read().lower()
    for place, height in ((0, 0.0), (3, 0.0), (3.5, LIFT_M / 2), (4, LIFT_M)):
        shown_at(viewer, place)
        np.testing.assert_allclose(viewer.models.thing.position, [0, 0, height], atol=1e-9)


def test_grasps_follow_one_another_each_in_its_own_scene(viewer) -> None:
    assert viewer.row == 0
    viewer.step(2)
    assert viewer.row == 2
    np.testing.assert_allclose(viewer.models.rest.position, [-0.05, 0, 0.03])
    viewer.step(1)
    assert viewer.row == 0
    np.testing.assert_allclose(viewer.models.rest.position, [0.05, 0, 0.03])
    assert viewer.filters == ("valid only", "all")
    viewer.choose("valid only")
    assert viewer.row == 1
    viewer.step(1)
    assert viewer.row == 1


def test_what_grasp_lifts_and_whether_it_survives_shake_is_told() -> None:
    found = {"quality/payload_kg": np.array([np.nan, 0.8, 1.5]), "quality/shake_margin": np.array([np.nan, 0.2, 1.0])}
    shard = Shard("base", {}, {**arrays(2), **found})
    plain, good, bad = (_metrics_text(shard, row) for row in range(GRASPS))
    assert "payload" not in plain and "shaken" not in plain
    assert "| payload | 0.80 kg |" in good and "| shaken | holds |" in good and "| shaken | fails |" in bad


def test_dots_are_where_the_hand_is_near_the_object(viewer):
    shown_at(viewer, 0)
    assert len(viewer.models.contacts.points) == 0
    shown_at(viewer, 2)
    points = np.asarray(viewer.models.contacts.points)
    assert len(points) and (np.abs(points) < np.array([0.025, 0.02, 0.03]) + 0.006).all()


def test_a_grasp_in_a_bin_has_five_supports_that_can_be_hidden(viewer):
    nodes = [viewer.server.scene.get_handle_by_name(f"/scene/support{k}") for k in range(6)]
    assert sum(node is not None for node in nodes) == 5
    viewer.models.show_scene(False)
    assert not any(node.visible for node in nodes if node is not None)


def test_a_file_without_grasps_is_not_shown() -> None:
    none = {path: column[:0] for path, column in arrays(2).items()}
    with pytest.raises(InputError, match="holds no grasps"), viewing(HAND, BLOCK, none):
        pass


def test_without_viser_or_a_shard_one_line_says_so(tmp_path, monkeypatch):
    file = tmp_path / "grasps.h5"
    file.write_text("nothing")
    assert "grasps.h5 is not a readable HDF5 file" in refused("view", file)
    monkeypatch.setitem(sys.modules, "viser", None)
    assert refused("view", file).endswith("run pip install 'graspd[view]'")


@pytest.mark.timeout(180)
def test_the_command_tells_its_address_and_ends_with_ctrl_c(tmp_path):
    hand, block = hand_from_path("barrett"), object_from_path("block")
    file = tmp_path / "grasps.h5"
    file.write_bytes(write_shard("base", arrays(len(hand.joint_names)), attributes_of(hand, block, scene=SCENE)))
    command = [sys.executable, "-m", "graspd", "view", str(file), "--port", "0"]
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, text=True, env=os.environ | {"SSH_CONNECTION": ""}
    ) as process:
        address, forwarding = process.stdout.readline(), process.stdout.readline()
        found = re.search(r"http://127\.0\.0\.1:(\d+)$", address.strip())
        assert found, address
        assert f"ssh -L {found[1]}:127.0.0.1:{found[1]}" in forwarding
        with urllib.request.urlopen(found[0], timeout=60) as answer:
            assert answer.status == 200
        process.send_signal(signal.SIGINT)
        assert process.wait(60) == 0


def test_links_above_the_root_are_drawn_at_each_grasps_wrist() -> None:
    # A copy of the hand behind its root serves as a forearm with two wrist joints.
    forearm, mounted = HAND, replace(HAND, mounting=HAND)
    angles = np.array([[0.0, 0], [0.3, 0.6], [0.9, 0.1]])
    with viewing(mounted, BLOCK, arrays(2) | {"grasp/wrist_positions": angles}) as made:
        made.choose("all")
        own = len(drawn_bodies(HAND))
        assert len(made.models.bodies) == own + len(drawn_bodies(forearm))
        for row in range(GRASPS):
            shown_at(made, 2)
            root = arrays(2)["grasp/hand_pose"][[row]]
            (poses,) = body_poses(forearm, root, forearm.expand(angles[[row]]))
            for node, body in zip(made.models.bodies[own:], drawn_bodies(forearm), strict=True):
                np.testing.assert_allclose(node.position, poses[body, :3], atol=1e-6)
                assert abs(node.wxyz @ poses[body, 3:]) == pytest.approx(1, abs=1e-6)
            made.step(1)
