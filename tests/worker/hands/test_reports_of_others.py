"""Robots as others publish them: what does not matter is passed over, what is wrong is told for what it is."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from graspd.commands.hands import report_hand
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.load import load_hand
from graspd.worker.hands.model import HandModel
from tests.worker.hands.mjcfs import CLAW, FOUR_BAR
from tests.worker.hands.urdfs import joint, link, robot

LIMIT = '<limit lower="0" upper="0.04"/>'


def jaws(follower: str = LIMIT, drive: str = LIMIT, *more: str) -> bytes:
    """Two jaws that open 80 mm; the right one follows the left one."""
    pad = '<collision><origin xyz="0 0 0.05"/><geometry><box size="0.01 0.02 0.06"/></geometry></collision>'
    base = '<collision><geometry><box size="0.12 0.04 0.04"/></geometry></collision>'
    return robot(
        *more,
        link("base", base),
        link("left", pad),
        link("right", pad),
        joint("jl", "base", "left", kind="prismatic", axis="1 0 0", origin="-0.045 0 0", limit=drive),
        joint(
            "jr",
            "base",
            "right",
            kind="prismatic",
            axis="1 0 0",
            origin="0.045 0 0",
            limit=follower,
            extra='<mimic joint="jl" multiplier="-1"/>',
        ),
    )


def hand(data: bytes, **options: object) -> HandModel:
    return load_hand({"h.urdf": data}, name="h", digest="0" * 32, options=options)


@pytest.mark.parametrize(
    "limit",
    [
        '<limit lower="0" upper="0.04"/>',
        '<limit lower="0" upper="0"/>',
        '<limit lower="0" upper="-0.001"/>',
        '<limit lower="0.04" upper="-0.04"/>',
        '<limit effort="1" velocity="1"/>',
        '<limit lower="nan" upper="inf"/>',
    ],
    ids=["turned round", "zero", "a sliver", "reversed", "absent", "no numbers"],
)
def test_limits_of_a_follower_do_not_hold_its_drive(limit: str) -> None:
    report = check_hand({"h.urdf": jaws(limit)}, "h")
    assert report["verdict"] == "accept", report["message"]
    assert report["facts"]["opening_m"] == pytest.approx(0.08, abs=1e-4)
    assert hand(jaws(limit)).upper == pytest.approx([0.04])


def test_limits_of_a_follower_that_would_bind_are_told() -> None:
    report = check_hand({"h.urdf": jaws('<limit lower="-0.01" upper="0"/>')}, "h")
    assert "limits of jr are not used, as in ROS" in report["message"]
    assert "not used" not in check_hand({"h.urdf": jaws('<limit lower="-0.04" upper="0"/>')}, "h")["message"]


def test_a_coupling_of_ones_own_that_leaves_no_room_names_both_joints() -> None:
    free = jaws().replace(b'<mimic joint="jl" multiplier="-1"/>', b"")
    report = check_hand({"h.urdf": free}, "h", {"couplings": {"jr": {"of": "jl", "multiplier": -1.0}}})
    assert report["verdict"] == "refuse"
    assert "joint 'jr' may only go 0 .. 0.04, but follows 'jl' with -1" in report["message"]


def test_a_joint_whose_limits_leave_one_value_stands_still_and_is_told() -> None:
    wrist = joint("wrist", "left", "tip", limit='<limit lower="0.2" upper="0.2"/>')
    report = check_hand({"h.urdf": jaws().replace(b"</robot>", (link("tip") + wrist + "</robot>").encode())}, "h")
    assert report["verdict"] == "accept" and report["facts"]["dofs"] == ["jl"]
    assert "wrist cannot move: the limits leave one value" in report["message"]


@pytest.mark.parametrize("limit", ['<limit lower="0" upper="0"/>', '<limit lower="0.0" upper="-0.0"/>'])
def test_limits_that_were_left_empty_are_told_as_that(limit: str) -> None:
    message = check_hand({"h.urdf": jaws(limit, limit)}, "h")["message"]
    assert "joint 'jl' has limits 0 .. 0: the exporter left them empty" in message


@pytest.mark.parametrize("kind", ["floating", "planar"])
@pytest.mark.parametrize("root", [None, "base"])
def test_a_free_joint_above_the_hand_does_not_matter_and_is_told(kind: str, root: str | None) -> None:
    above = f'<joint name="free" type="{kind}"><parent link="world"/><child link="base"/></joint>'
    data = jaws(LIMIT, LIMIT, '<link name="world"/>', above)
    report = check_hand({"h.urdf": data}, "h", {"root": root} if root else {})
    assert report["verdict"] == "accept" and report["facts"]["root"] == "base"
    assert ("free above the palm left out" in report["message"]) == (root is None)


def test_a_free_joint_within_the_hand_is_refused_by_its_name() -> None:
    loose = '<link name="ball"/><joint name="loose" type="floating"><parent link="base"/><child link="ball"/></joint>'
    message = check_hand({"h.urdf": jaws().replace(b"</robot>", (loose + "</robot>").encode())}, "h")["message"]
    assert "joint 'loose': type 'floating' cannot be used" in message


@pytest.mark.parametrize(
    "written",
    [
        "meshes\\pad.stl",
        ".\\meshes\\pad.stl",
        "package://any/meshes/pad.stl",
        "model:\\\\any\\meshes\\pad.stl",
        "file:///meshes/pad.stl",
        "model://meshes/pad.stl",
    ],
)
def test_a_file_and_its_folder_are_read_by_one_rule(written: str, tmp_path: Path, box_stl: bytes) -> None:
    mesh = f'<collision><geometry><mesh filename="{written}"/></geometry></collision>'
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "pad.stl").write_bytes(box_stl)
    (tmp_path / "h.urdf").write_bytes(jaws().replace(b'<link name="left">', f'<link name="left">{mesh}'.encode()))
    reports = [report_hand(str(path)) for path in (tmp_path / "h.urdf", tmp_path)]
    assert [report["verdict"] for report in reports] == ["accept", "accept"], reports[0]["message"]


@pytest.fixture
def box_stl() -> bytes:
    import trimesh

    return bytes(trimesh.creation.box((0.01, 0.02, 0.06)).export(file_type="stl"))


@pytest.mark.parametrize("name", ["h.urdf", "h.xacro", "h.xml"])
def test_a_pointer_to_a_description_is_told_for_what_it_is(name: str) -> None:
    data = b"version https://git-lfs.github.com/spec/v1\noid sha256:12\nsize 5\n"
    report = check_hand({name: data}, "h", {"file": name})
    assert report["verdict"] == "refuse"
    assert f"{name} is a Git LFS pointer, not the file itself: git lfs pull" in report["message"]


def test_a_xacro_that_only_defines_macros_is_told_as_that() -> None:
    text = b'<robot name="h" xmlns:xacro="http://www.ros.org/wiki/xacro"><xacro:macro name="m" params=""/></robot>'
    message = check_hand({"h.xacro": text}, "h")["message"]
    assert "expands to no link at all: it only defines macros" in message and "cycle" not in message


@pytest.mark.parametrize(
    ("drives", "told"),
    [
        (("drive", "back"), "has 2 drivers (drive and back), and only loops of one are solved"),
        ((), "has no driver; give one of its joints an actuator"),
    ],
)
def test_drivers_of_a_loop_are_counted_truly(drives: tuple[str, ...], told: str) -> None:
    actuators = "".join(f'<position joint="{name}" kp="5"/>' for name in (*drives, "thumb"))
    text = re.sub("<actuator>.*</actuator>", f"<actuator>{actuators}</actuator>", FOUR_BAR, flags=re.DOTALL)
    assert told in check_hand({"h.xml": text.encode()}, "h")["message"]


def test_actuators_on_spatial_tendons_are_told() -> None:
    thumb = '<body name="thumb" pos="-0.02 0 0.01">'
    sites = FOUR_BAR.replace(thumb, f'<site name="a"/>{thumb}<site name="b" pos="0 0 0.03"/>')
    tendon = '<tendon><spatial name="cord"><site site="a"/><site site="b"/></spatial></tendon><actuator>'
    text = sites.replace("<actuator>", tendon)
    text = text.replace('<position joint="thumb" kp="5"/>', '<motor name="pull" tendon="cord"/>')
    report = check_hand({"h.xml": text.encode()}, "h")
    assert report["verdict"] == "accept"
    assert any("pull on spatial tendons, which are passed over" in note for note in report["facts"]["notes"])
    assert not any("spatial" in note for note in check_hand({"h.xml": FOUR_BAR.encode()}, "h")["facts"]["notes"])


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ('<position joint="thumb" kp="5"/>', '<muscle name="pull" joint="thumb"/>', "pull passed over: only motors"),
        ('<position joint="thumb" kp="5"/>', '<adhesion body="thumb" ctrlrange="0 1"/>', "adhesion passed over"),
        ("<equality>", '<equality><weld name="glue" body1="thumb" body2="base"/>', "glue passed over: what it holds"),
    ],
)
def test_drives_and_constraints_that_are_passed_over_are_told(old: str, new: str, told: str) -> None:
    report = check_hand({"h.xml": FOUR_BAR.replace(old, new).encode()}, "h")
    assert any(told in note for note in report["facts"]["notes"])


def test_a_name_that_is_nearly_a_built_in_is_answered_with_that() -> None:
    assert report_hand("alegro")["message"].endswith("; did you mean allegro?")


def claw(old: str = "", new: str = "", *more: str) -> bytes:
    """The MJCF claw without its mesh, some of it written otherwise."""
    text = CLAW.replace('<geom type="mesh" mesh="tip" pos="0 0 0.03"/>', "")
    text = re.sub('<mesh name="tip"[^>]*/>', "", text)
    for before, after in zip((old, *more[::2]), (new, *more[1::2]), strict=True):
        assert before in text
        text = text.replace(before, after)
    return text.encode()


_WRIST = '<joint name="wrist" axis="0 1 0" range="-30 30"/>'
_LEG = (
    '<body name="leg"><geom type="sphere" size="0.05"/><body name="knee"><joint name="knee" axis="0 1 0"/>'
    '<geom fromto="0 0 0 0 0 0.3" size="0.01"/></body></body><body name="mount"'
)


@pytest.mark.parametrize("root", [None, "palm"])
@pytest.mark.parametrize(
    "model",
    [
        claw(_WRIST, '<joint name="wrist" type="ball"/>'),
        claw(_WRIST, '<joint name="wrist" axis="0 1 0" range="-9000 9000"/>'),
        claw('<body name="mount"', _LEG, "<equality>", '<equality><connect body1="knee" body2="leg" anchor="0 0 .1"/>'),
    ],
    ids=["a ball joint", "a range of many turns", "a loop that nothing drives"],
)
def test_what_a_model_has_beside_its_hand_does_not_matter(model: bytes, root: str | None) -> None:
    report = check_hand({"h.xml": model}, "h", {"root": root} if root else {})
    assert report["verdict"] == "accept", report["message"]
    assert report["facts"]["root"] == "palm"


def test_a_model_that_floats_is_told_to_stand() -> None:
    report = check_hand({"h.xml": claw('euler="10 20 30">', 'euler="10 20 30"><freejoint/>')}, "h")
    assert "'mount' is free to float, and taken as fixed" in report["facts"]["notes"]


def test_a_loop_that_turns_on_a_ball_joint_is_told_as_that() -> None:
    model = FOUR_BAR.replace('<joint name="back" axis="0 -1 0" range="-1 1"/>', '<joint name="back" type="ball"/>')
    message = check_hand({"h.xml": model.encode()}, "h")["message"]
    assert "turns on back, which is no hinge or slide joint" in message


def test_two_joints_that_follow_each_other_are_coupled_once() -> None:
    again = '<equality><joint joint1="left_spread" joint2="right_curl" polycoef="0.2 -2 0 0 0"/>'
    report = check_hand({"h.xml": claw("<equality>", again)}, "h")
    assert report["verdict"] == "accept", report["message"]
    assert "a second equality of 'right_curl' was left out" in report["facts"]["notes"]


def test_a_drive_that_its_followers_limits_cut_is_told() -> None:
    free = jaws().replace(b'<mimic joint="jl" multiplier="-1"/>', b"").replace(b'xyz="1 0 0"', b'xyz="-1 0 0"')
    report = check_hand({"h.urdf": free}, "h", {"couplings": {"jr": {"of": "jl", "multiplier": 2.0}}})
    assert "limits of what follows jl leave it 0 .. 0.02" in report["message"]


def test_a_follower_whose_coupling_is_junk_is_refused_by_its_way() -> None:
    message = check_hand({"h.urdf": jaws().replace(b'multiplier="-1"', b'multiplier="-1000"')}, "h")["message"]
    assert "joint 'jr' follows 'jl' with -1000 and offset 0, which moves it by 40 m" in message


@pytest.mark.parametrize(
    "fault",
    [
        '<joint name="above" type="floating">{}</joint>',
        '<joint name="above" type="revolute">{}</joint>',
        '<joint name="above" type="prismatic">{}<limit lower="-90" upper="90"/></joint>',
        '<joint name="above" type="revolute">{}<axis xyz="0 0 0"/><limit lower="-1" upper="1"/></joint>',
        '<joint name="above" type="revolute">{}<limit lower="-1" upper="1"/><mimic joint="none"/></joint>',
    ],
    ids=["free", "no limits", "a long rail", "no axis", "follows nothing"],
)
def test_a_joint_above_a_named_root_does_not_matter_and_is_told(fault: str) -> None:
    above = fault.format('<parent link="world"/><child link="base"/>')
    report = check_hand({"h.urdf": jaws(LIMIT, LIMIT, '<link name="world"/>', above)}, "h", {"root": "base"})
    assert report["verdict"] == "accept", report["message"]
    assert re.search(r"above \(\w+\) above the palm taken as fixed", report["message"])


def test_fingers_whose_limits_were_left_empty_are_told_on_an_arm_as_well() -> None:
    arm = '<link name="world"/>' + joint("arm", "world", "base")
    empty = '<limit lower="0" upper="0"/>'
    message = check_hand({"h.urdf": jaws(empty, empty, arm)}, "h")["message"]
    assert "the limits of jl leave one value; fill them in" in message


def test_a_root_below_which_nothing_moves_is_told_as_that() -> None:
    assert "nothing below 'left' moves" in check_hand({"h.urdf": jaws()}, "h", {"root": "left"})["message"]


@pytest.mark.parametrize(
    ("options", "told"),
    [
        ({"root": "bse"}, "the URDF has no link 'bse'; did you mean base?"),
        ({"fix": {"wrist": 0}}, "the URDF has no joint 'wrist'"),
        ({"palm": "bace"}, "the hand has no link 'bace' to be its palm; did you mean base?"),
        ({"fingertips": ["lefd"]}, "the hand has no link 'lefd' to be a fingertip; did you mean left?"),
        ({"preshape": {"jll": 0}}, "'jll' is no joint of the hand (jl); did you mean jl?"),
    ],
)
def test_an_option_that_names_nothing_is_told_without_a_word_of_a_file(options: dict[str, object], told: str) -> None:
    assert check_hand({"h.urdf": jaws()}, "h", options)["message"] == told


def test_a_flat_mesh_is_told_with_its_link(tmp_path: Path) -> None:
    import trimesh

    flat = trimesh.Trimesh([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0.01, 0.01, 0]], [[0, 1, 2], [1, 3, 2]])
    mesh = '<link name="left"><collision><geometry><mesh filename="pad.stl"/></geometry></collision>'
    data = jaws().replace(b'<link name="left">', mesh.encode())
    files = {"h.urdf": data, "pad.stl": bytes(flat.export(file_type="stl"))}
    assert "collision mesh 'pad.stl' of link 'left': " in check_hand(files, "h")["message"]
