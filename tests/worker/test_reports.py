"""Inputs that users of such tools report, each tried as its report says: `data/reports` beside the checkout."""

import pytest
import trimesh

from graspd.commands.hands import report_hand
from graspd.commands.objects import report_object
from graspd.worker.objects.prepare import object_from_path
from tests.worker.commands_run import graspd

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
