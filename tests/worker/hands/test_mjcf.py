"""Hands from MJCF: where their bodies are is what MuJoCo says, and nothing outside their folder is read."""

import re
from dataclasses import dataclass, field, fields, make_dataclass

import mujoco
import numpy as np
import pytest
import trimesh

from graspd.commands.hands import report_hand
from graspd.service.model.errors import HandError
from graspd.service.model.transforms import IDENTITY_POSE, compose, invert, pose_to_matrix
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import files_from_path, hand_from_path, load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.tendons import Tendon, actuator_matrix
from graspd.worker.objects.disk_cache import TOLD_IF_SET, content_digest
from tests.worker.hands.mjcfs import CLAW, FOUR_BAR, TENDON_CLAW

#: Both sides compute in float64; what is left is rounding over a chain of a dozen rotations [m, and entries of R].
FK_TOLERANCE = 1e-6
POSTURES = 200
FINGERS = ("FF", "MF", "RF", "LF")


def tip() -> bytes:
    return bytes(trimesh.creation.box((8.0, 8.0, 16.0)).export(file_type="stl"))


def load(text: str = CLAW, **options: object) -> HandModel:
    files = {"h.xml": text.encode(), "meshes/tip.stl": tip()}
    return load_hand(files, name="claw", digest="0" * 32, options=options)


def report_of(text: str = CLAW, **others: bytes) -> dict:
    return check_hand({"h.xml": text.encode(), "meshes/tip.stl": tip(), **others}, "h")


def agree(hand: HandModel, links: list[str]) -> None:
    """Poses of bodies relative to the hand's root, in random postures within the limits."""
    # Without the texture, whose file tests do not have.
    model = mujoco.MjModel.from_xml_string(re.sub("<texture[^>]*>", "", CLAW), {"meshes/tip.stl": tip()})
    data, rng = mujoco.MjData(model), np.random.default_rng(5)
    joints = [(model.joint(name).qposadr[0], name) for name in hand.joint_names]
    assert len(joints) == len(hand.joint_names)
    for _ in range(POSTURES):
        q = hand.expand(rng.uniform(hand.lower, hand.upper))
        values = dict(zip(hand.joint_names, q, strict=True))
        for address, name in joints:
            data.qpos[address] = values[name]
        mujoco.mj_kinematics(model, data)
        poses = body_poses(hand, IDENTITY_POSE, q)[0]
        at = {name: np.concatenate([data.body(name).xpos, data.body(name).xquat]) for name in (*links, hand.root_link)}
        for link in links:
            expected = pose_to_matrix(compose(invert(at[hand.root_link]), at[link]))
            found = pose_to_matrix(poses[hand.body_names.index(link)])
            np.testing.assert_allclose(found, expected, atol=FK_TOLERANCE, err_msg=link)


def test_bodies_are_where_mujoco_puts_them() -> None:
    # The body of `left` stands at an anchor of its own, so its frame is not that of the joint that carries it.
    agree(load(), ["left_end", "right", "right_end"])
    agree(load(root="mount"), ["palm", "left_end", "right", "right_end"])


def test_the_arm_is_kept_apart_and_what_is_no_hand_left_out() -> None:
    hand = load()
    assert hand.root_link == "palm"
    assert [joint.name for joint in hand.arm] == ["wrist"]
    assert "wrist" not in hand.joint_names
    hand = load(root="mount")
    assert not {"ball", "world"} & set(hand.body_names)


def test_an_equality_couples_joints() -> None:
    hand = load()
    assert set(hand.dof_names) == {"left_spread", "left_bend", "left_curl", "right_slide"}
    values = dict(zip(hand.dof_names, (0.2, 0.6, 0.5, 0.01), strict=True))
    q = dict(zip(hand.joint_names, hand.expand(np.array([values[dof] for dof in hand.dof_names])), strict=True))
    # q1 - q1_0 = 0.1 - 0.5 (q2 - q2_0), both at rest at 0.
    assert q["right_curl"] == pytest.approx(0.1 - 0.5 * values["left_spread"])


def test_joints_on_tendons_and_servos_go_as_far_as_limits_let() -> None:
    hand = load(TENDON_CLAW)
    assert hand.dof_names == ("left", "right")
    q = dict(zip(hand.joint_names, hand.expand(np.array([0.6, 0.4])), strict=True))
    # left - 2 left_end keeps its length; the right end would have to bend to -0.4, and its range begins at 0.
    assert q["left_end"] == pytest.approx(0.3) and "right_end" not in q and "right_tip" not in q
    # 20 (u - q) with u to 0.7; and 0.2 u - 20 q with u to 70. The joints alone would go to 1.4.
    assert hand.upper.tolist() == pytest.approx([0.7, 0.7])


def test_angles_that_would_be_no_motion_in_degrees_are_radians() -> None:
    assert "angles read as radians" in report_of(TENDON_CLAW)["message"]
    stated = TENDON_CLAW.replace("<worldbody>", '<compiler angle="degree"/><worldbody>', 1)
    assert "radians" not in report_of(stated)["message"] + report_of()["message"]


def test_servos_give_force_limits_and_gains() -> None:
    hand = load()
    at = {name: number for number, name in enumerate(hand.dof_names)}
    # A tendon of length bend + 0.5 curl pulls curl half as hard; two joints in a row give way twice as far as one.
    for joint, pull in (("left_bend", 1.0), ("left_curl", 0.5)):
        assert hand.effort[at[joint]] == pytest.approx(2 * pull)
        assert hand.stiffness[at[joint]] == pytest.approx(2 * 4 * pull**2)
    assert hand.effort[at["right_slide"]] == pytest.approx(15 * 2)
    assert hand.stiffness[at["right_slide"]] == pytest.approx(300 * 2**2)
    assert hand.effort[at["left_spread"]] == pytest.approx(0.3)


def test_shapes_that_touch_are_told_from_seen_ones_meshes_placed() -> None:
    hand = load()
    palm = [piece for piece in hand.pieces if piece.link == "palm"]
    assert [piece.size for piece in palm] == [(0.08, 0.06, 0.02)]
    (seen,) = [mesh for mesh in hand.visuals.meshes if mesh.body == 0]
    assert np.ptp(seen.vertices[:, 0]) == pytest.approx(0.1) and seen.colour == pytest.approx((0.2, 0.4, 0.6))
    (piece,) = [p for p in load().pieces if p.link == "left_end" and p.kind == "hull"]
    # 8 x 8 x 16 mm about 30 mm above the body; MuJoCo keeps mesh vertices in single precision.
    np.testing.assert_allclose(piece.vertices.min(axis=0), [-0.004, -0.004, 0.022], atol=1e-6)
    np.testing.assert_allclose(piece.vertices.max(axis=0), [0.004, 0.004, 0.038], atol=1e-6)


def test_a_closed_loop_becomes_a_coupling_with_its_error_told() -> None:
    report = report_of(FOUR_BAR)
    assert report["verdict"] == "accept" and set(report["facts"]["dofs"]) == {"drive", "thumb"}
    assert "top, back follow drive within" in report["message"] and "ignored" not in report["message"]
    hand = load(FOUR_BAR)
    joints = dict(zip(hand.joint_names, hand.expand(np.array([0.5, 0.0])), strict=True))
    # A parallelogram: the rocker turns as the crank does, the coupler stays upright.
    assert joints["back"] == pytest.approx(0.5, abs=1e-6) and joints["top"] == pytest.approx(-0.5, abs=1e-6)


def with_inside(text: str) -> str:
    return CLAW.replace('<light pos="0 0 1"/>', text)


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (with_inside('<include file="../../etc/passwd"/>'), "outside its folder"),
        (with_inside('<include file="h.xml"/>'), "includes itself"),
        (CLAW.replace('file="tip.stl"', 'file="/etc/passwd"'), "outside its folder"),
        (CLAW.replace('file="tip.stl"', 'file="../../tip.stl"'), "outside its folder"),
        (CLAW.replace('file="tip.stl"', 'file="../h.xml"'), "the mesh 'h.xml' is no file of type .stl"),
        pytest.param(with_inside("<light/>" * 50_001), "more than 50000 elements", id="too many elements"),
        (with_inside('<attach model="other" prefix="x"/>'), "<attach>"),
        (with_inside('<replicate count="1000000000"><body/></replicate>'), "<replicate>"),
        (with_inside('<composite type="cable" count="100000 1 1"/>'), "<composite>"),
        ('<!DOCTYPE m [<!ENTITY a "aaa">]><mujoco>&a;</mujoco>', "entities"),
        ("<mujoco><worldbody><body></mujoco>", "well-formed"),
        ("<mujoco><worldbody><body><geom/></body></worldbody></mujoco>", "MuJoCo rejects it"),
        ('<mujoco><worldbody><body><geom size="1"/></body></worldbody></mujoco>', "no moving joint"),
        (CLAW.replace('name="left_curl" axis', 'type="ball" name="left_curl" axis2'), "MuJoCo rejects it"),
        (CLAW.replace('<joint name="right_curl" axis="0 1 0" range="0 50"/>', '<joint type="ball"/>'), "right_curl"),
        (CLAW.replace(' range="0 0.025"', ""), "slides without a range"),
    ],
)
def test_bad_model_is_refused_in_one_line_that_names_the_defect(text: str, named: str) -> None:
    report = report_of(text)
    assert report["verdict"] == "refuse" and named in report["message"]
    assert "\n" not in report["message"] and len(report["message"]) < 400


def test_nothing_but_the_upload_is_read(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:
    # MuJoCo would find these on the disk: the reader must not let it look.
    monkeypatch.chdir(tmp_path)
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "secret.stl").write_bytes(tip())
    (tmp_path / "secret.xml").write_text("<mujocoinclude/>")
    for text in (CLAW.replace("tip.stl", "secret.stl"), with_inside('<include file="secret.xml"/>')):
        with pytest.raises(HandError, match="secret"):
            load(text)


def test_a_model_brings_what_it_includes_and_reads_nothing_else(tmp_path) -> None:
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "tip.stl").write_bytes(tip())
    (tmp_path / "meshes" / "other.stl").write_bytes(tip())
    (tmp_path / "extra.xml").write_text("<mujocoinclude/>")
    (tmp_path / "claw.xml").write_text(with_inside('<include file="extra.xml"/>'))
    name, found, stated = files_from_path(tmp_path / "claw.xml")
    assert set(found) == {"claw.xml", "extra.xml", "meshes/tip.stl"}
    assert (name, stated) == ("claw", {"file": "claw.xml"})
    assert report_hand(str(tmp_path))["verdict"] == "accept"
    part = b'<mujocoinclude><body name="extra"><geom type="sphere" size="0.01"/></body></mujocoinclude>'
    text = with_inside('<include file="parts/extra.xml"/>')
    text = text.replace('file="tip.stl"', 'file="Tip.STL"')
    assert report_of(text, **{"parts/extra.xml": part})["verdict"] == "accept"


def pulls(hand: HandModel) -> dict[str, dict[str, float]]:
    return {t.name: {hand.dof_names[d]: c for d, c in zip(t.dofs, t.coefficients, strict=True)} for t in hand.tendons}


def test_joints_on_one_actuated_tendon_are_free_and_share_it() -> None:
    hand = load()
    ((name, pulled),) = pulls(hand).items()
    assert pulled == {"left_bend": 1.0, "left_curl": 0.5}
    assert name.startswith("tendon")
    # The model's servo: 4 N m/rad of length, 2 N m at most; joints get the pull times their coefficients.
    assert hand.tendons[0].gain(hand.stiffness) == pytest.approx(4.0)
    assert hand.tendons[0].limit(hand.effort) == pytest.approx(2.0)


def test_a_command_of_torques_pulls_jaws_keep_their_ratio() -> None:
    tendon, stiffness = Tendon("t", (0, 2), (1.0, 0.4)), np.array([5.0, 9.0, 2.0])
    pull = 0.7
    told = pull * np.array([1.0, 0.0, 0.4]) / stiffness
    length = actuator_matrix((tendon,), 3) @ told
    assert length.tolist() == pytest.approx([told[0] + 0.4 * told[2], told[1]])
    assert tendon.gain(stiffness) * length[0] == pytest.approx(pull)
    text = re.sub('<joint joint="left_curl" coef="0.5"/>', '<joint joint="right_slide" coef="0.5"/>', CLAW)
    hand = load(re.sub('<position joint="right_slide"[^>]*>', "", text))
    assert not hand.tendons and "right_slide" not in hand.dof_names


def test_asset_json_puts_joints_on_a_tendon_and_takes_it_away() -> None:
    barrett = hand_from_path("barrett")
    assert "finger_1_distal" not in barrett.dof_names
    said = {"cord": {"finger_1_medial": 1.0, "finger_1_distal": 0.3}}
    hand = hand_from_path("barrett", {"tendons": said})
    assert pulls(hand) == said
    assert set(hand.dof_names) - set(barrett.dof_names) == {"finger_1_distal"}
    assert not load(tendons={}).tendons


@pytest.mark.parametrize(
    ("tendons", "says"),
    [
        ({"t": {"left_bend": 1, "nothing": 1}}, "'nothing', which is no moving joint"),
        ({"t": {"left_bend": 1, "left_curl": 0}}, "fewer than two joints"),
        ({"t": {"left_bend": 1, "left_curl": 1}, "u": {"left_curl": 1, "left_spread": 1}}, "'left_curl' is on two"),
    ],
)
def test_a_tendon_that_cannot_be_is_refused_in_one_line(tendons: dict, says: str) -> None:
    with pytest.raises(HandError, match=says) as error:
        load(tendons=tendons)
    assert "\n" not in str(error.value)


def test_what_a_hand_does_not_have_does_not_change_its_content() -> None:
    @dataclass
    class Hand:
        tendons: tuple[str, ...] = field(default=(), metadata=TOLD_IF_SET)

    # What is known of a hand is kept under it.
    assert content_digest(Hand()) == content_digest(make_dataclass("Hand", [])())
    assert content_digest(Hand(("t",))) != content_digest(Hand())
    assert {f.name for f in fields(HandModel) if "told_if_set" in f.metadata} == {"tendons", "drag", "mounting"}


def test_a_shadow_urdf_has_the_tendons_that_urdf_cannot_say(shared_data) -> None:
    path = shared_data / "hands/shadow/shadow_hand_right.urdf"
    hand = hand_from_path(path)
    assert pulls(hand) == {f"{f}J0": {f"{f}J2": 1.0, f"{f}J1": 1.0} for f in FINGERS}
    assert hand.dofs == 22
    assert not hand_from_path(path, {"tendons": {}}).tendons
    name, given, stated = files_from_path(path)
    told = ", ".join(f"{finger}J2 and {finger}J1" for finger in FINGERS) + " on one tendon each"
    assert told in check_hand(given, name, stated)["message"]
