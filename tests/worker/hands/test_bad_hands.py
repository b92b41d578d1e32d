"""Hands and inputs as others publish and report them: what does not matter is passed over, what is wrong is named."""

import re
from functools import partial

import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from typer.testing import CliRunner

from graspd.cli import build_app
from graspd.commands.hands import report_hand
from graspd.commands.objects import report_object
from graspd.service.model.errors import InputError, LimitError
from graspd.service.model.states import AssetKind
from graspd.service.store.assets import builtin_files
from graspd.service.store.store import open_store
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.load import load_hand
from graspd.worker.hands.robot import MAX_LINKS
from graspd.worker.hands.urdf import MAX_BYTES, read_urdf
from graspd.worker.objects.prepare import object_from_path
from tests.api.factories import zipped
from tests.worker.commands_run import graspd
from tests.worker.hands.mjcfs import CLAW, FOUR_BAR
from tests.worker.hands.urdfs import joint, link, report, robot
from tests.worker.objects.shapes import damaged
from tests.worker.objects.test_colours import BOMB, SCENE, dae
from tests.worker.stages.test_ingest import bad_files, is_expected, upload

LIMIT, MIMIC = '<limit lower="0" upper="0.04"/>', '<mimic joint="jl" multiplier="-1"/>'
#: The claw without its mesh.
PLAIN_CLAW = re.sub('<geom type="mesh" [^>]*/>|<mesh name="tip"[^>]*/>', "", CLAW)
_THUMB = '<position joint="thumb" kp="5"/>'
_SITES = '<site name="a"/><body name="thumb" pos="-0.02 0 0.01"><site name="b" pos="0 0 0.03"/>'
_CORD = '<tendon><spatial name="cord"><site site="a"/><site site="b"/></spatial></tendon><actuator>'
_PULL = {'<body name="thumb" pos="-0.02 0 0.01">': _SITES, _THUMB: '<motor name="pull" tendon="cord"/>'}
_GLUE = '<equality><weld name="glue" body1="thumb" body2="base"/>'
_TURNED = 'euler="10 20 30">'
_AGAIN = '<equality><joint joint1="left_spread" joint2="right_curl" polycoef="0.2 -2 0 0 0"/>'
_WRIST = '<joint name="wrist" axis="0 1 0" range="-30 30"/>'
_LEG = (
    '<body name="leg"><geom type="sphere" size="0.05"/><body name="knee"><joint name="knee" axis="0 1 0"/>'
    '<geom fromto="0 0 0 0 0 0.3" size="0.01"/></body></body><body name="mount"'
)
EMPTY = '<limit lower="0" upper="0"/>'
_ARM = link("world", "") + joint("arm", "world", "base")
_RING = link("a") + link("b") + joint("ab", "a", "b") + joint("ba", "b", "a")
_WELD = link("tip") + joint("weld", "left", "tip", kind="fixed")
_BASE = b'<box size="0.12 0.04 0.04"/>'
BARE = robot(link("base"), link("a", ""), link("b", ""), joint("j", "base", "a"), joint("k", "a", "b"))
_DEBT = '<inertial><mass value="-0.1"/></inertial>'
_FREE = '<link name="ball"/><joint name="loose" type="floating"><parent link="base"/><child link="ball"/></joint>'
SOURCE = builtin_files(AssetKind.HAND, "barrett")
WORDS = [b"nan", b"-1e308", b"inf", b"0", b"", b"<", b'"', b"&x;", b"../../", b"palm", b"finger_1_medial", b"\xff\xfe"]
URDFS, ASSETS = (damaged(SOURCE[name], WORDS) for name in ("barrett.urdf", "asset.json"))
XACRO = '<robot name="x" xmlns:xacro="http://www.ros.org/wiki/xacro">{}</robot>'
INCLUDES = CLAW.replace('<light pos="0 0 1"/>', '<include file="/etc/passwd"/>').encode()
PART_MESH = '<collision><geometry><mesh filename="part.dae"/></geometry></collision>'
PARTS = robot(link("palm", PART_MESH), link("a", PART_MESH), joint("j", "palm", "a"))
BOMB_DAE = dae(SCENE.replace("<library_nodes>", f"<library_nodes>{BOMB}").replace("#part", "#n0"))
#: The first file is the description; what the refusal says.
HANDS: list[tuple[dict[str, bytes], str]] = [
    ({"runs.xacro": XACRO.format("""<a b="${__import__('os').system('touch ran')}"/>""").encode()}, "__import__"),
    ({"reads.xacro": XACRO.format('<xacro:include filename="/etc/passwd"/>').encode()}, "outside the hand's folder"),
    ({"macros.xacro": XACRO.format('<xacro:macro name="m" params=""/>').encode()}, "it only defines macros"),
    ({"includes.xml": INCLUDES}, "outside its folder"),
    ({"bomb.urdf": PARTS, "part.dae": BOMB_DAE}, "too deep"),
]


@pytest.mark.parametrize(("kind", "report_of"), [("urdf", report_hand), ("mesh", report_object)])
def test_every_bad_file_gets_a_verdict_that_names_the_defect(shared_data, kind: str, report_of) -> None:
    entries = [entry for entry in bad_files(shared_data) if entry["kind"].startswith(kind)]
    assert len(entries) >= 20
    found = [(entry, report_of(str(shared_data / "bad" / entry["file"]))) for entry in entries]
    assert not [(entry, told["verdict"], told["message"]) for entry, told in found if not is_expected(told, entry)]


def test_a_urdf_beyond_the_limits_is_not_read() -> None:
    parts = [link("l0")]
    for i in range(MAX_LINKS + 1):
        parts += [link(f"l{i + 1}"), joint(f"j{i}", f"l{i}", f"l{i + 1}")]
    with pytest.raises(LimitError, match=str(MAX_LINKS)):
        read_urdf(robot(*parts))
    with pytest.raises(LimitError, match="bytes"):
        read_urdf(b"<robot>" + b" " * MAX_BYTES)


def test_a_path_of_nothing_is_refused_with_the_names_there_are() -> None:
    assert report_hand("alegro")["message"].endswith("; did you mean allegro?")
    found = report_hand("no_such_hand")
    assert found["verdict"] == "refuse" and "allegro" in found["message"]


def jaws(follower: str = LIMIT, drive: str = LIMIT, *more: str) -> bytes:
    """Two jaws that open 80 mm; the right one follows the left one."""
    pad = '<collision><origin xyz="0 0 0.05"/><geometry><box size="0.01 0.02 0.06"/></geometry></collision>'
    base = '<collision><geometry><box size="0.12 0.04 0.04"/></geometry></collision>'
    slide = partial(joint, parent="base", kind="prismatic", axis="1 0 0")
    return robot(
        *more,
        *(link("base", base), link("left", pad), link("right", pad)),
        slide("jl", child="left", origin="-0.045 0 0", limit=drive),
        slide("jr", child="right", origin="0.045 0 0", limit=follower, extra=MIMIC),
    )


@pytest.mark.parametrize("limit", ['lower="0" upper="0"', 'lower="0.04" upper="-0.04"', "", 'lower="nan" upper="inf"'])
def test_limits_of_a_follower_do_not_hold_its_drive(limit: str) -> None:
    found = report(jaws(f"<limit {limit}/>"))
    assert found["verdict"] == "accept", found["message"]
    assert found["facts"]["opening_m"] == pytest.approx(0.08, abs=1e-4)
    assert found["facts"]["upper"] == {"jl": 0.04}


def test_limits_of_a_follower_that_would_bind_are_told() -> None:
    found = report(jaws('<limit lower="-0.01" upper="0"/>'))
    assert "limits of jr are not used, as in ROS" in found["message"]
    assert "not used" not in report(jaws('<limit lower="-0.04" upper="0"/>'))["message"]


def test_a_joint_whose_limits_leave_one_value_stands_still() -> None:
    wrist = joint("wrist", "left", "tip", limit='<limit lower="0.2" upper="0.2"/>')
    found = report(jaws(LIMIT, LIMIT, link("tip"), wrist))
    assert found["verdict"] == "accept" and found["facts"]["dofs"] == ["jl"]
    assert "wrist cannot move: the limits leave one value" in found["message"]


def changed(text: str, changes: dict[str, str]) -> bytes:
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    return text.encode()


@pytest.mark.parametrize(
    ("old", "new", "told"),
    [
        ("<actuator>", '<actuator><motor joint="back"/>', "has 2 drivers (drive and back)"),
        ('<position joint="drive" kp="5"/>', "", "has no driver; give one of its joints an actuator"),
        ('name="back" axis="0 -1 0" range="-1 1"', 'name="back" type="ball"', "back is no hinge or slide joint"),
        ('axis="0 -1 0" range="0 0.8"', 'axis="0 -1 0" range="0 3"', "moves 'top' nonlinearly (error 0.63); write an"),
        ('pos="0.03 0 0.01"', 'pos="0.03 0 0.05"', "loop of 'drive' is open by 0.8 mm at 0.25; correct its"),
    ],
)
def test_a_loop_that_is_not_solved_is_told_as_that(old: str, new: str, told: str) -> None:
    assert told in check_hand({"h.xml": FOUR_BAR.replace(old, new).encode()}, "h")["message"]


@pytest.mark.parametrize(
    ("text", "changes", "told"),
    [
        (FOUR_BAR, {_THUMB: '<muscle name="pull" joint="thumb"/>'}, "pull ignored: only motors"),
        (FOUR_BAR, {_THUMB: '<adhesion body="thumb" ctrlrange="0 1"/>'}, "adhesion ignored"),
        (FOUR_BAR, {"<equality>": _GLUE}, "glue ignored: the bodies"),
        (FOUR_BAR, {**_PULL, "<actuator>": _CORD}, "pull on spatial tendons, which are ignored"),
        (PLAIN_CLAW, {_TURNED: f"{_TURNED}<freejoint/>"}, "'mount' has a free joint, which is replaced by a fixed one"),
        (PLAIN_CLAW, {"<equality>": _AGAIN}, "a second equality of 'right_curl' was left out"),
    ],
)
def test_what_is_passed_over_in_a_model_is_told(text: str, changes: dict[str, str], told: str) -> None:
    found = check_hand({"h.xml": changed(text, changes)}, "h")
    assert found["verdict"] == "accept" and any(told in note for note in found["facts"]["notes"])
    assert not any(told in note for note in check_hand({"h.xml": text.encode()}, "h")["facts"]["notes"])


@pytest.mark.parametrize("root", [None, "palm"])
@pytest.mark.parametrize(
    "model",
    [
        {_WRIST: '<joint name="wrist" type="ball"/>'},
        {_WRIST: '<joint name="wrist" axis="0 1 0" range="-9000 9000"/>'},
        {'<body name="mount"': _LEG, "<equality>": '<equality><connect body1="knee" body2="leg" anchor="0 0 .1"/>'},
    ],
    ids=["a ball joint", "a range of many turns", "a loop that nothing drives"],
)
def test_what_a_model_has_beside_its_hand_does_not_matter(model: dict[str, str], root: str | None) -> None:
    found = check_hand({"h.xml": changed(PLAIN_CLAW, model)}, "h", {"root": root} if root else {})
    assert found["verdict"] == "accept", found["message"]
    assert found["facts"]["root"] == "palm"


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


WITHOUT_MIMIC = jaws().replace(MIMIC.encode(), b"")


def coupled(multiplier: float) -> dict:
    return {"couplings": {"jr": {"of": "jl", "multiplier": multiplier}}}


@pytest.mark.parametrize(
    ("data", "options", "told"),
    [
        (jaws(), {"root": "bse"}, "the URDF has no link 'bse'; did you mean base?"),
        (jaws(), {"fix": {"wrist": 0}}, "the URDF has no joint 'wrist'"),
        (jaws(), {"palm": "bace"}, "the hand has no link 'bace' to be its palm; did you mean base?"),
        (jaws(), {"fingertips": ["lefd"]}, "the hand has no link 'lefd' to be a fingertip; did you mean left?"),
        (jaws(), {"preshape": {"jll": 0}}, "'jll' is no joint of the hand (jl); did you mean jl?"),
        (jaws(), {"root": "left"}, "nothing below 'left' moves"),
        (WITHOUT_MIMIC, coupled(-1), "joint 'jr' may only go 0 .. 0.04, but follows 'jl' with -1"),
        (WITHOUT_MIMIC.replace(b'"1 0 0"', b'"-1 0 0"'), coupled(2), "joints that follow jl limit it to 0 .. 0.02"),
        (jaws().replace(b'"-1"', b'"-1000"'), {}, "with -1000 and offset 0, which moves it by 40 m"),
        (jaws(EMPTY, EMPTY), {}, "joint 'jl' has limits 0 .. 0: the exporter left them empty"),
        (jaws(EMPTY, EMPTY, _ARM), {}, "limits of jl leave one value; fill"),
        (jaws(LIMIT, LIMIT, _FREE), {}, "joint 'loose': type 'floating' cannot be used"),
        (jaws().replace(b'"1 0 0"', b'"1 0"'), {}, "axis of joint 'jl': xyz='1 0' must be three finite numbers"),
        (jaws(LIMIT, LIMIT, link("tip", _DEBT)), {}, "mass of link 'tip' is negative; give it in kilograms"),
        (jaws().replace(_BASE, b""), {}, "collision of link 'base' has no geometry; give a box"),
        (jaws().replace(_BASE, b'<box size="0 1 1"/>'), {}, "sizes must lie between 0.01 mm and 10 m"),
        (jaws().replace(_BASE, b"<mesh/>"), {}, "collision of link 'base': the mesh has no file name"),
        (jaws().replace(_BASE, b'<mesh filename="a" scale="0 1 1"/>'), {}, "0.001 turns millimetres into metres"),
        (jaws().replace(b"-0.045", b"-45"), {}, "origin of joint 'jl' lies 45 m away; URDF lengths are metres"),
        (jaws(LIMIT, LIMIT, _RING), {}, "the joints above link 'a' form a loop without a root"),
        (jaws(), {"drop": ["base"]}, "'base' is dropped and has 2 children; name the new root"),
        (jaws(LIMIT, LIMIT, _WELD), {"fix": {"weld": 0}}, "joint 'weld' is fixed, so it cannot have a value"),
        (BARE, {"root": "a"}, "no link of the hand, from 'a' on, has collision geometry, so nothing can touch; add"),
    ],
)
def test_what_is_wrong_with_a_urdf_is_told_by_name(data: bytes, options: dict, told: str) -> None:
    assert told in report(data, **options)["message"]


def test_a_flat_mesh_is_told_with_its_link() -> None:
    flat = trimesh.Trimesh([[0, 0, 0], [0.01, 0, 0], [0, 0.01, 0], [0.01, 0.01, 0]], [[0, 1, 2], [1, 3, 2]])
    mesh = '<link name="left"><collision><geometry><mesh filename="pad.stl"/></geometry></collision>'
    data = jaws().replace(b'<link name="left">', mesh.encode())
    files = {"h.urdf": data, "pad.stl": bytes(flat.export(file_type="stl"))}
    assert "collision mesh 'pad.stl' of link 'left': " in check_hand(files, "h")["message"]


@pytest.mark.parametrize(("files", "says"), HANDS, ids=[next(iter(files)) for files, _ in HANDS])
def test_a_bad_hand_is_refused_in_one_line_here_and_as_an_upload(files, says: str, tmp_path, monkeypatch) -> None:
    folder = tmp_path / "hand"
    folder.mkdir()
    monkeypatch.chdir(folder)
    for file, data in files.items():
        (folder / file).write_bytes(data)
    told = CliRunner().invoke(build_app(), ["hands", "check", next(iter(files))])
    assert told.exit_code == 2 and told.stdout == ""
    (line,) = told.stderr.splitlines()
    assert line.startswith("graspd: refused: ") and says in line and len(line) < 400
    found = upload(open_store("memory://"), AssetKind.HAND, "hand.zip", zipped(files))
    assert found["verdict"] == "refuse" and says in found["message"] and "\n" not in found["message"]
    assert "root:" not in line + found["message"] and set(files) == {path.name for path in folder.iterdir()}


def answers(urdf: bytes, asset: bytes) -> None:
    try:
        hand = load_hand({"barrett.urdf": urdf, "asset.json": asset}, name="h", digest="0" * 32)
    except InputError as error:
        assert "\n" not in str(error)
        return
    assert hand.dofs >= 1


@settings(max_examples=120)
@given(URDFS, ASSETS)
def test_a_damaged_urdf_or_asset_json_loads_or_is_refused(urdf: bytes, asset: bytes) -> None:
    answers(urdf, SOURCE["asset.json"])
    answers(SOURCE["barrett.urdf"], asset)


@pytest.mark.slow
@settings(derandomize=False, max_examples=10_000)
@given(URDFS, ASSETS | st.just(SOURCE["asset.json"]))
def test_ten_thousand_damaged_hands_load_or_are_refused(urdf: bytes, asset: bytes) -> None:
    answers(urdf, asset)


VOLUME = {"volume_m3": pytest.approx(120e-6)}
JAWS = {"opening_m": pytest.approx(0.08, abs=1e-3)}
FAR = {"origin_distance_m": pytest.approx(6.16, abs=0.1)}
RADIAL = {"palm_approach": [0, 0, 1], "palm_centre": pytest.approx([0, 0, 0], abs=1e-6)}
RADIAL |= {"closing": dict.fromkeys(("jf0_prox", "jf1_prox", "jf2_prox"), 1)}


@pytest.mark.parametrize(
    ("file", "options", "is_refused", "words", "facts"),
    [
        ("H01_floating_base/robot.urdf", {"root": "palm"}, False, [], {"root": "palm"}),
        ("H01_floating_base/robot.urdf", {}, False, ["root"], {}),
        ("H03_zero_limits/three.urdf", {}, True, ["all 6 joints have limits 0 .. 0", "fill them in"], {}),
        ("H04_follower_limits_junk/jaws_mult_minus1.urdf", {}, False, [], JAWS),
        ("H04_follower_limits_junk/jaws_follower_zero.urdf", {}, False, [], JAWS),
        ("H06_backslashes/three.urdf", {}, False, [], {}),
        ("H06_backslashes", {}, False, [], {}),
        ("H12b_xacro_old_include/urdf/three.urdf.xacro", {}, True, ["expands to no link at all", "xacro: prefix"], {}),
        ("H16_radial_palm/three.urdf", {}, False, [], RADIAL),
        ("O01_off_header_glued/monitor_like.off", {}, False, [], VOLUME),
        ("O01_off_header_glued/same_with_newline.off", {}, False, [], VOLUME),
        ("O02_concave_ngon/u_channel.obj", {}, False, [], {}),
        ("O04b_inline_comment/box.obj", {}, False, [], VOLUME),
        ("O12_far_from_origin/box_5m.obj", {}, False, [], FAR),
        ("O13_centimetres/mug_sized_cm.obj", {}, True, ["--units cm"], {"units_suggested": ["cm", "in"]}),
        ("O13_centimetres/mug_sized_in.obj", {}, True, ["--units in"], {"units_suggested": ["in", "cm"]}),
        ("O17_git_lfs_pointer/mug.stl", {}, True, ["mug.stl is a Git LFS pointer", "git lfs pull"], {}),
    ],
)
def test_a_report_comes_out_as_it_should(shared_data, file, options, is_refused, words, facts: dict) -> None:
    check = report_hand if file.startswith("H") else report_object
    found = check(str(shared_data / "reports" / file), options)
    assert (found["verdict"] == "refuse") is is_refused, found["message"]
    assert [word for word in words if word not in found["message"]] == []
    assert {name: found["facts"][name] for name in facts} == facts


@pytest.mark.parametrize("file", ["O02_concave_ngon/u_channel.obj", "O12_far_from_origin/box_5m.obj"])
def test_reported_meshes_are_grasped(shared_data, tmp_path, file: str) -> None:
    mesh = shared_data / "reports" / file
    words = "synth --hand barrett --fidelity draft -n 4 --object"
    assert graspd(words, mesh, "-o", tmp_path / "g.h5")["valid"] == 4
    if "concave" in file:
        obj = object_from_path(mesh)
        assert trimesh.Trimesh(obj.vertices, obj.faces).area == pytest.approx(226e-4, rel=0.01)
