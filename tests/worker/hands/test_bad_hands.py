"""Hands as others publish them: what does not matter is passed over, what is wrong is told for what it is."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from graspd.cli import build
from graspd.commands.hands import report_hand
from graspd.service.model.errors import HandError, InputError, LimitError
from graspd.service.model.states import AssetKind
from graspd.service.store.assets import builtin_files
from graspd.service.store.store import open_store
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.load import load_hand
from graspd.worker.hands.robot import MAX_LINKS
from graspd.worker.hands.urdf import MAX_BYTES, read_urdf
from tests.worker.hands.mjcfs import CLAW, FOUR_BAR
from tests.worker.hands.urdfs import chain, joint, link, load, report, robot
from tests.worker.objects.test_colours import BOMB, SCENE, dae
from tests.worker.stages.test_ingest import upload, zipped


def test_every_bad_urdf_gets_a_verdict_that_names_the_defect(shared_data: Path) -> None:
    entries = json.loads((shared_data / "bad" / "INDEX.json").read_text())["inputs"]
    urdfs = [entry for entry in entries if entry["kind"].startswith("urdf")]
    assert len(urdfs) >= 20
    wrong = []
    for entry in urdfs:
        found = report_hand(str(shared_data / "bad" / entry["file"]))
        if found["verdict"] != entry["expect"] or entry["message_names"].lower() not in found["message"].lower():
            wrong.append((entry["file"], entry["expect"], found["verdict"], found["message"]))
    assert not wrong


def test_an_external_entity_reads_no_file(tmp_path: Path) -> None:
    secret = tmp_path / "secret.txt"
    secret.write_text("hidden")
    urdf = f'<!DOCTYPE robot [<!ENTITY x SYSTEM "{secret.as_uri()}">]><robot name="&x;"/>'.encode()
    found = report(urdf)
    assert found["verdict"] == "refuse" and "hidden" not in found["message"]


def test_mesh_behind_symbolic_link_out_of_the_folder_is_not_read(tmp_path: Path) -> None:
    outside = tmp_path / "outside.stl"
    outside.write_bytes(b"secret")
    folder = tmp_path / "hand"
    folder.mkdir()
    (folder / "m.stl").symlink_to(outside)
    mesh = '<collision><geometry><mesh filename="m.stl"/></geometry></collision>'
    (folder / "h.urdf").write_bytes(robot(link("palm"), link("a", mesh), joint("j", "palm", "a")))
    found = report_hand(str(folder / "h.urdf"))
    assert found["verdict"] == "refuse" and "not there" in found["message"]


def test_a_urdf_beyond_the_limits_is_not_read() -> None:
    parts = [link("l0")]
    for i in range(MAX_LINKS + 1):
        parts += [link(f"l{i + 1}"), joint(f"j{i}", f"l{i}", f"l{i + 1}")]
    with pytest.raises(LimitError, match=str(MAX_LINKS)):
        read_urdf(robot(*parts))
    with pytest.raises(LimitError, match="bytes"):
        read_urdf(b"<robot>" + b" " * MAX_BYTES)


@pytest.mark.parametrize("kind", ["floating", "planar", "", "ball"])
def test_a_joint_type_that_no_hand_has_is_refused(kind: str) -> None:
    with pytest.raises(HandError, match="type"):
        read_urdf(chain(joint("j1", "palm", "a", kind=kind), links="a"))


def test_a_path_of_nothing_is_refused_with_the_names_there_are() -> None:
    assert report_hand("alegro")["message"].endswith("; did you mean allegro?")
    found = report_hand("no_such_hand")
    assert found["verdict"] == "refuse" and "allegro" in found["message"]


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
    found = report(jaws(limit))
    assert found["verdict"] == "accept", found["message"]
    assert found["facts"]["opening_m"] == pytest.approx(0.08, abs=1e-4)
    assert load(jaws(limit)).upper == pytest.approx([0.04])


def test_limits_of_a_follower_that_would_bind_are_told() -> None:
    found = report(jaws('<limit lower="-0.01" upper="0"/>'))
    assert "limits of jr are not used, as in ROS" in found["message"]
    assert "not used" not in report(jaws('<limit lower="-0.04" upper="0"/>'))["message"]


def test_a_joint_whose_limits_leave_one_value_stands_still() -> None:
    wrist = joint("wrist", "left", "tip", limit='<limit lower="0.2" upper="0.2"/>')
    found = report(jaws().replace(b"</robot>", (link("tip") + wrist + "</robot>").encode()))
    assert found["verdict"] == "accept" and found["facts"]["dofs"] == ["jl"]
    assert "wrist cannot move: the limits leave one value" in found["message"]


@pytest.mark.parametrize("kind", ["floating", "planar"])
@pytest.mark.parametrize("root", [None, "base"])
def test_a_free_joint_above_the_hand_does_not_matter_and_is_told(kind: str, root: str | None) -> None:
    above = f'<joint name="free" type="{kind}"><parent link="world"/><child link="base"/></joint>'
    data = jaws(LIMIT, LIMIT, '<link name="world"/>', above)
    found = report(data, **({"root": root} if root else {}))
    assert found["verdict"] == "accept" and found["facts"]["root"] == "base"
    assert ("free above the palm left out" in found["message"]) == (root is None)


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
def test_a_file_and_its_folder_are_read_by_one_rule(written: str, tmp_path: Path) -> None:
    mesh = f'<collision><geometry><mesh filename="{written}"/></geometry></collision>'
    (tmp_path / "meshes").mkdir()
    (tmp_path / "meshes" / "pad.stl").write_bytes(trimesh.creation.box((0.01, 0.02, 0.06)).export(file_type="stl"))
    (tmp_path / "h.urdf").write_bytes(jaws().replace(b'<link name="left">', f'<link name="left">{mesh}'.encode()))
    reports = [report_hand(str(path)) for path in (tmp_path / "h.urdf", tmp_path)]
    assert [found["verdict"] for found in reports] == ["accept", "accept"], reports[0]["message"]


@pytest.mark.parametrize("name", ["h.urdf", "h.xacro", "h.xml"])
def test_a_pointer_to_a_description_is_told_for_what_it_is(name: str) -> None:
    data = b"version https://git-lfs.github.com/spec/v1\noid sha256:12\nsize 5\n"
    found = check_hand({name: data}, "h", {"file": name})
    assert found["verdict"] == "refuse"
    assert f"{name} is a Git LFS pointer, not the file itself: git lfs pull" in found["message"]


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
    found = check_hand({"h.xml": text.encode()}, "h")
    assert found["verdict"] == "accept"
    assert any("pull on spatial tendons, which are passed over" in note for note in found["facts"]["notes"])
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
    found = check_hand({"h.xml": FOUR_BAR.replace(old, new).encode()}, "h")
    assert any(told in note for note in found["facts"]["notes"])


def mjcf_claw(old: str = "", new: str = "", *more: str) -> bytes:
    """The MJCF mjcf_claw without its mesh, some of it written otherwise."""
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
        mjcf_claw(_WRIST, '<joint name="wrist" type="ball"/>'),
        mjcf_claw(_WRIST, '<joint name="wrist" axis="0 1 0" range="-9000 9000"/>'),
        mjcf_claw(
            '<body name="mount"', _LEG, "<equality>", '<equality><connect body1="knee" body2="leg" anchor="0 0 .1"/>'
        ),
    ],
    ids=["a ball joint", "a range of many turns", "a loop that nothing drives"],
)
def test_what_a_model_has_beside_its_hand_does_not_matter(model: bytes, root: str | None) -> None:
    found = check_hand({"h.xml": model}, "h", {"root": root} if root else {})
    assert found["verdict"] == "accept", found["message"]
    assert found["facts"]["root"] == "palm"


def test_models_and_loops_are_passed_over_told_or_coupled() -> None:
    found = check_hand({"h.xml": mjcf_claw('euler="10 20 30">', 'euler="10 20 30"><freejoint/>')}, "h")
    assert "'mount' is free to float, and taken as fixed" in found["facts"]["notes"]
    again = '<equality><joint joint1="left_spread" joint2="right_curl" polycoef="0.2 -2 0 0 0"/>'
    found = check_hand({"h.xml": mjcf_claw("<equality>", again)}, "h")
    assert found["verdict"] == "accept", found["message"]
    assert "a second equality of 'right_curl' was left out" in found["facts"]["notes"]


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
    found = report(jaws(LIMIT, LIMIT, '<link name="world"/>', above), root="base")
    assert found["verdict"] == "accept", found["message"]
    assert re.search(r"above \(\w+\) above the palm taken as fixed", found["message"])


def without_mimic() -> bytes:
    return jaws().replace(b'<mimic joint="jl" multiplier="-1"/>', b"")


def jaws_and(*more: str) -> bytes:
    return jaws().replace(b"</robot>", ("".join(more) + "</robot>").encode())


EMPTY = '<limit lower="0" upper="0"/>'
_BALL = FOUR_BAR.replace('<joint name="back" axis="0 -1 0" range="-1 1"/>', '<joint name="back" type="ball"/>')
_FREE = '<link name="ball"/><joint name="loose" type="floating"><parent link="base"/><child link="ball"/></joint>'


@pytest.mark.parametrize(
    ("data", "options", "told"),
    [
        (jaws(), {"root": "bse"}, "the URDF has no link 'bse'; did you mean base?"),
        (jaws(), {"fix": {"wrist": 0}}, "the URDF has no joint 'wrist'"),
        (jaws(), {"palm": "bace"}, "the hand has no link 'bace' to be its palm; did you mean base?"),
        (jaws(), {"fingertips": ["lefd"]}, "the hand has no link 'lefd' to be a fingertip; did you mean left?"),
        (jaws(), {"preshape": {"jll": 0}}, "'jll' is no joint of the hand (jl); did you mean jl?"),
        (jaws(), {"root": "left"}, "nothing below 'left' moves"),
        (
            without_mimic(),
            {"couplings": {"jr": {"of": "jl", "multiplier": -1.0}}},
            "joint 'jr' may only go 0 .. 0.04, but follows 'jl' with -1",
        ),
        (
            without_mimic().replace(b'xyz="1 0 0"', b'xyz="-1 0 0"'),
            {"couplings": {"jr": {"of": "jl", "multiplier": 2.0}}},
            "limits of what follows jl leave it 0 .. 0.02",
        ),
        (
            jaws().replace(b'multiplier="-1"', b'multiplier="-1000"'),
            {},
            "joint 'jr' follows 'jl' with -1000 and offset 0, which moves it by 40 m",
        ),
        (jaws(EMPTY, EMPTY), {}, "joint 'jl' has limits 0 .. 0: the exporter left them empty"),
        (
            jaws(*2 * ['<limit lower="0.0" upper="-0.0"/>']),
            {},
            "joint 'jl' has limits 0 .. 0: the exporter left them empty",
        ),
        (
            jaws(EMPTY, EMPTY, '<link name="world"/>' + joint("arm", "world", "base")),
            {},
            "the limits of jl leave one value; fill them in",
        ),
        (jaws_and(_FREE), {}, "joint 'loose': type 'floating' cannot be used"),
    ],
)
def test_what_is_wrong_with_a_urdf_is_told_by_name(data: bytes, options: dict[str, Any], told: str) -> None:
    assert told in report(data, **options)["message"]


def test_a_loop_that_turns_on_a_ball_joint_is_told_as_that() -> None:
    assert "turns on back, which is no hinge or" in check_hand({"h.xml": _BALL.encode()}, "h")["message"]


def test_a_flat_mesh_is_told_with_its_link(tmp_path: Path) -> None:
    import trimesh

    flat = trimesh.Trimesh([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0.01, 0.01, 0]], [[0, 1, 2], [1, 3, 2]])
    mesh = '<link name="left"><collision><geometry><mesh filename="pad.stl"/></geometry></collision>'
    data = jaws().replace(b'<link name="left">', mesh.encode())
    files = {"h.urdf": data, "pad.stl": bytes(flat.export(file_type="stl"))}
    assert "collision mesh 'pad.stl' of link 'left': " in check_hand(files, "h")["message"]


XACRO = '<robot name="x" xmlns:xacro="http://www.ros.org/wiki/xacro">{}</robot>'
PART_MESH = '<collision><geometry><mesh filename="part.dae"/></geometry></collision>'
BALL = '<collision><geometry><sphere radius="{}"/></geometry></collision>'
#: Both balls turn about their own centres: nothing comes closer to anything.
FORK = robot(
    link("palm", BALL.format(0.01)),
    link("a", BALL.format(0.0005)),
    link("b", BALL.format(0.0005)),
    joint("ja", "palm", "a", origin="0.03 0 0.05", axis="0 0 1"),
    joint("jb", "palm", "b", origin="-0.03 0 0.05", axis="0 0 1"),
)
HANDS: dict[str, tuple[dict[str, bytes], str]] = {
    "runs.xacro": (
        {"runs.xacro": XACRO.format("""<a b="${__import__('os').system('touch ran')}"/>""").encode()},
        "__import__",
    ),
    "reads.xacro": (
        {"reads.xacro": XACRO.format('<xacro:include filename="/etc/passwd"/>').encode()},
        "outside the hand's folder",
    ),
    "includes.xml": (
        {"includes.xml": CLAW.replace('<light pos="0 0 1"/>', '<include file="/etc/passwd"/>').encode()},
        "outside the hand's folder",
    ),
    "far_mesh.xml": (
        {"far_mesh.xml": CLAW.replace('file="tip.stl"', 'file="../../../etc/passwd.stl"').encode()},
        "outside the hand's folder",
    ),
    "bomb.urdf": (
        {
            "bomb.urdf": robot(link("palm", PART_MESH), link("a", PART_MESH), joint("j", "palm", "a")),
            "part.dae": dae(SCENE.replace("<library_nodes>", f"<library_nodes>{BOMB}").replace("#part", "#n0")),
        },
        "too deep",
    ),
    "fork.urdf": ({"fork.urdf": FORK}, "no two opposing digits"),
}


@pytest.mark.parametrize("name", HANDS)
def test_a_bad_hand_is_refused_in_one_line_here_and_as_an_upload(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    files, says = HANDS[name]
    folder = tmp_path / "hand"
    folder.mkdir()
    monkeypatch.chdir(folder)
    for file, data in files.items():
        (folder / file).write_bytes(data)
    told = CliRunner().invoke(build(), ["hands", "check", name])
    assert told.exit_code == 2 and told.stdout == ""
    (line,) = told.stderr.splitlines()
    assert line.startswith("graspd: refused: ") and says in line and len(line) < 400

    found = upload(open_store("memory://"), AssetKind.HAND, "hand.zip", zipped(files))
    assert found["verdict"] == "refuse" and says in found["message"] and "\n" not in found["message"]
    assert "root:" not in line + found["message"] and set(files) == {path.name for path in folder.iterdir()}


SOURCE = builtin_files(AssetKind.HAND, "barrett")
WORDS = [b"nan", b"-1e308", b"inf", b"0", b"", b"<", b'"', b"&x;", b"../../", b"palm", b"finger_1_medial", b"\xff\xfe"]


@st.composite
def mutated(draw: st.DrawFn, source: bytes) -> bytes:
    """A file with a few spans replaced, dropped or repeated."""
    data = source
    for _ in range(draw(st.integers(1, 4))):
        start = draw(st.integers(0, len(data)))
        end = min(len(data), start + draw(st.integers(0, 60)))
        data = data[:start] + draw(st.sampled_from(WORDS) | st.binary(max_size=12)) + data[end:]
    return data


def answers(urdf: bytes, asset: bytes) -> None:
    try:
        hand = load_hand({"barrett.urdf": urdf, "asset.json": asset}, name="h", digest="0" * 32)
    except InputError as error:
        assert "\n" not in str(error)
        return
    assert hand.dofs >= 1


@settings(max_examples=120)
@given(mutated(SOURCE["barrett.urdf"]), mutated(SOURCE["asset.json"]))
def test_a_damaged_urdf_or_asset_json_loads_or_is_refused(urdf: bytes, asset: bytes) -> None:
    answers(urdf, SOURCE["asset.json"])
    answers(SOURCE["barrett.urdf"], asset)


@pytest.mark.slow
@settings(derandomize=False, max_examples=10_000)
@given(mutated(SOURCE["barrett.urdf"]), mutated(SOURCE["asset.json"]) | st.just(SOURCE["asset.json"]))
def test_ten_thousand_damaged_hands_load_or_are_refused(urdf: bytes, asset: bytes) -> None:
    answers(urdf, asset)
