"""Inputs that users of such tools report, each tried as its report says: `data/reports` beside the checkout."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import trimesh
import yaml

from graspd.commands.hands import report_hand
from graspd.commands.objects import report_object
from graspd.worker.objects.prepare import object_from_path
from tests.worker.commands_run import graspd

Report = dict[str, Any]


def accepted(report: Report, *words: str) -> Report:
    assert report["verdict"] in ("accept", "repair"), report["message"]
    assert all(word in report["message"] for word in words), report["message"]
    return report


def refused(report: Report, *words: str) -> Report:
    assert report["verdict"] == "refuse"
    assert all(word in report["message"] for word in words), report["message"]
    return report


def synthesized(folder: Path, hand: str, obj: Path, count: int) -> Report:
    return graspd(f"synth --hand {hand} --fidelity draft --object", obj, "-n", count, "-o", folder / "g.h5")


def floating_base(folder: Path, _: Path) -> None:
    assert accepted(report_hand(str(folder / "robot.urdf"), {"root": "palm"}))["facts"]["root"] == "palm"
    accepted(report_hand(str(folder / "robot.urdf")), "root")


def zero_limits(folder: Path, _: Path) -> None:
    refused(report_hand(str(folder / "three.urdf")), "all 6 joints have limits 0 .. 0", "fill them in")


def follower_limits(folder: Path, _: Path) -> None:
    for name in ("jaws_mult_minus1", "jaws_follower_zero"):
        assert accepted(report_hand(str(folder / f"{name}.urdf")))["facts"]["opening_m"] == pytest.approx(
            0.08, abs=1e-3
        )


def backslashes(folder: Path, _: Path) -> None:
    accepted(report_hand(str(folder / "three.urdf")))
    accepted(report_hand(str(folder)))


def old_include(folder: Path, _: Path) -> None:
    refused(report_hand(str(folder / "urdf" / "three.urdf.xacro")), "expands to no link at all", "xacro: prefix")


def radial_palm(folder: Path, _: Path) -> None:
    facts = accepted(report_hand(str(folder / "three.urdf")))["facts"]
    assert facts["palm_approach"] == [0, 0, 1] and facts["palm_centre"] == pytest.approx([0, 0, 0], abs=1e-6)
    assert set(facts["closing"].values()) == {1}


def glued_header(folder: Path, _: Path) -> None:
    facts = [
        accepted(report_object(str(folder / f"{name}.off")))["facts"] for name in ("monitor_like", "same_with_newline")
    ]
    assert facts[0] == facts[1] and facts[0]["volume_m3"] == pytest.approx(120e-6)


def concave_polygons(folder: Path, out: Path) -> None:
    accepted(report_object(str(folder / "u_channel.obj")))
    obj = object_from_path(folder / "u_channel.obj")
    assert trimesh.Trimesh(obj.vertices, obj.faces).area == pytest.approx(226e-4, rel=0.01)
    assert synthesized(out, "barrett", folder / "u_channel.obj", 4)["valid"] == 4


def inline_comment(folder: Path, _: Path) -> None:
    assert accepted(report_object(str(folder / "box.obj")))["facts"]["volume_m3"] == pytest.approx(120e-6)


def far_from_origin(folder: Path, out: Path) -> None:
    report = accepted(report_object(str(folder / "box_5m.obj")))
    assert report["facts"]["origin_distance_m"] == pytest.approx(6.16, abs=0.1)
    assert synthesized(out, "barrett", folder / "box_5m.obj", 8)["valid"] == 8


def centimetres(folder: Path, _: Path) -> None:
    for unit in ("cm", "in"):
        report = refused(report_object(str(folder / f"mug_sized_{unit}.obj")), f"--units {unit}")
        assert "mm" not in report["facts"]["units_suggested"]


def lfs_pointer(folder: Path, _: Path) -> None:
    refused(report_object(str(folder / "mug.stl")), "mug.stl is a Git LFS pointer", "git lfs pull")


def prim_names(folder: Path, out: Path) -> None:
    usd = pytest.importorskip("pxr.Usd")
    synthesized(out, "barrett", folder / "003_cracker_box.obj", 2)
    for format_ in ("isaac", "usd"):
        graspd(f"export --format {format_} -o", out / format_, out / "g.h5")
    (isaac,) = (yaml.safe_load(file.read_text()) for file in (out / "isaac").glob("*.yaml"))
    stage = usd.Stage.Open(str(next((out / "usd").glob("*.usd"))))
    assert isaac["object_frame_link"] == "/World/_003_cracker_box"
    assert stage.GetPrimAtPath(isaac["object_frame_link"]).IsValid()


CASES: dict[str, Callable[[Path, Path], None]] = {
    "H01_floating_base": floating_base,
    "H03_zero_limits": zero_limits,
    "H04_follower_limits_junk": follower_limits,
    "H06_backslashes": backslashes,
    "H12b_xacro_old_include": old_include,
    "H16_radial_palm": radial_palm,
    "O01_off_header_glued": glued_header,
    "O02_concave_ngon": concave_polygons,
    "O04b_inline_comment": inline_comment,
    "O12_far_from_origin": far_from_origin,
    "O13_centimetres": centimetres,
    "O17_git_lfs_pointer": lfs_pointer,
    "X01_isaac_prim_names": prim_names,
}


@pytest.mark.parametrize("name", CASES)
def test_a_report_comes_out_as_it_should(name: str, shared_data: Path, tmp_path: Path) -> None:
    CASES[name](shared_data / "reports" / name, tmp_path)
