"""Every bad URDF gets the verdict and the message that the reference table asks for."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from graspd.commands.hands import report_hand
from graspd.service.model.errors import HandError, LimitError
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.robot import MAX_LINKS
from graspd.worker.hands.urdf import MAX_BYTES, read_urdf
from tests.worker.hands.urdfs import chain, joint, link, robot


def test_every_bad_urdf_gets_its_verdict_and_a_message_that_names_the_defect(shared_data: Path) -> None:
    entries = json.loads((shared_data / "bad" / "INDEX.json").read_text())["inputs"]
    urdfs = [entry for entry in entries if entry["kind"].startswith("urdf")]
    assert len(urdfs) >= 20
    wrong = []
    for entry in urdfs:
        report = report_hand(str(shared_data / "bad" / entry["file"]))
        if report["verdict"] != entry["expect"] or entry["message_names"].lower() not in report["message"].lower():
            wrong.append((entry["file"], entry["expect"], report["verdict"], report["message"]))
    assert not wrong


def test_an_external_entity_reads_no_file(tmp_path: Path) -> None:
    secret = tmp_path / "secret.txt"
    secret.write_text("hidden")
    urdf = f'<!DOCTYPE robot [<!ENTITY x SYSTEM "{secret.as_uri()}">]><robot name="&x;"/>'.encode()
    report = check_hand({"h.urdf": urdf}, "h")
    assert report["verdict"] == "refuse" and "hidden" not in report["message"]


def test_a_mesh_behind_a_symbolic_link_out_of_the_folder_is_not_read(tmp_path: Path) -> None:
    outside = tmp_path / "outside.stl"
    outside.write_bytes(b"secret")
    folder = tmp_path / "hand"
    folder.mkdir()
    (folder / "m.stl").symlink_to(outside)
    mesh = '<collision><geometry><mesh filename="m.stl"/></geometry></collision>'
    (folder / "h.urdf").write_bytes(robot(link("palm"), link("a", mesh), joint("j", "palm", "a")))
    report = report_hand(str(folder / "h.urdf"))
    assert report["verdict"] == "refuse" and "not there" in report["message"]


def test_more_links_than_a_hand_can_have_are_refused() -> None:
    parts = [link("l0")]
    for i in range(MAX_LINKS + 1):
        parts += [link(f"l{i + 1}"), joint(f"j{i}", f"l{i}", f"l{i + 1}")]
    with pytest.raises(LimitError, match=str(MAX_LINKS)):
        read_urdf(robot(*parts))


def test_a_urdf_larger_than_the_limit_is_not_parsed() -> None:
    with pytest.raises(LimitError, match="bytes"):
        read_urdf(b"<robot>" + b" " * MAX_BYTES)


@pytest.mark.parametrize("kind", ["floating", "planar", "", "ball"])
def test_a_joint_type_that_no_hand_has_is_refused(kind: str) -> None:
    with pytest.raises(HandError, match="type"):
        read_urdf(chain(joint("j1", "palm", "a", kind=kind), links="a"))


def test_a_path_that_is_neither_file_nor_built_in_is_refused_with_the_names_there_are() -> None:
    report = report_hand("no_such_hand")
    assert report["verdict"] == "refuse" and "allegro" in report["message"]
