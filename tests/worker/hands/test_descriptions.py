"""What lies beside a URDF says the same of the hand to `hands check`, `hands add` and `synth`."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path
from typing import Any

import pytest

from graspd.api.uploads import files_of_upload
from graspd.client.add_commands import upload_of
from graspd.commands.hands import report_hand
from graspd.service.model.errors import HandError
from graspd.service.model.states import AssetKind
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.load import hand_from_path
from tests.worker.hands.urdfs import joint, link, robot

NOTES = {
    "urdf": "leap.urdf",
    "palm_link": "palm_lower",
    "palm_normal_in_palm_link": [0, 0, -1],
    "fingertips": {"one": "b"},
    "physical": {"torque_limit_Nm_measured": 0.95},
}


@pytest.fixture
def urdf(tmp_path: Path) -> Path:
    """A hand whose palm is fixed turned on a base, so that root and approach differ with and without the notes."""
    folder = tmp_path / "leap"
    folder.mkdir()
    turned = '<origin rpy="0 1.5707963 0" xyz="0 0 0.1"/>'
    base = f'<joint name="mount" type="fixed"><parent link="base"/><child link="palm_lower"/>{turned}</joint>'
    parts = [link("base"), link("palm_lower"), link("a"), link("b"), base]
    parts += [joint("j1", "palm_lower", "a"), joint("j2", "palm_lower", "b")]
    (folder / "leap.urdf").write_bytes(robot(*parts))
    return folder / "leap.urdf"


def facts(report: dict[str, Any]) -> tuple[str, list[float], list[str], list[float]]:
    assert report["verdict"] == "accept", report["message"]
    said = report["facts"]
    return said["root"], said["palm_approach"], said["fingertips"], list(said["effort"].values())


def added(path: Path) -> dict[str, Any]:
    """The report of the files that the service gets from `hands add`."""
    with upload_of(path) as (upload, main):
        said = json.dumps({"file": main}) if main else ""
        files = files_of_upload(AssetKind.HAND, upload.name, upload.read_bytes(), limit_bytes=10**7, options=said)
    return check_hand(files, "leap")


def zipped(folder: Path) -> Path:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        for file in folder.iterdir():
            archive.write(file, file.name)
    path = folder.with_suffix(".zip")
    path.write_bytes(buffer.getvalue())
    return path


@pytest.mark.parametrize("described", ["hand.json", "asset.json", "both", "neither"])
def test_check_add_and_use_agree_whatever_lies_beside_the_urdf(urdf: Path, described: str) -> None:
    if described in ("hand.json", "both"):
        urdf.with_name("hand.json").write_text(json.dumps(NOTES))
    if described in ("asset.json", "both"):
        said = {"file": "leap.urdf", "root": "palm_lower", "palm": {"link": "palm_lower", "approach": [0, 1, 0]}}
        urdf.with_name("asset.json").write_text(json.dumps(said))
    expected = facts(report_hand(str(urdf)))
    folder, archive = urdf.parent, zipped(urdf.parent)
    # However a path is given, its files are read alike: each is checked, added and used from two of the three.
    assert [facts(report_hand(str(path))) for path in (folder, archive)] == [expected] * 2
    assert [facts(added(path)) for path in (urdf, archive)] == [expected] * 2
    hand = hand_from_path(urdf)
    assert (hand.root_link, hand.palm.approach.round(6).tolist()) == expected[:2]
    approach = {"hand.json": [0, 0, -1], "neither": expected[1]}.get(described, [0, 1, 0])
    assert (expected[0], expected[1]) == ("base" if described == "neither" else "palm_lower", approach)
    noted = described in ("hand.json", "both")
    assert expected[3] == ([0.95, 0.95] if noted else [1.0, 1.0])


def test_notes_on_another_urdf_say_nothing(urdf: Path) -> None:
    bare = facts(report_hand(str(urdf)))
    urdf.with_name("hand.json").write_text(json.dumps(NOTES | {"urdf": "other.urdf"}))
    assert facts(report_hand(str(urdf))) == facts(added(urdf)) == bare


@pytest.mark.parametrize(
    ("text", "named"), [("[]", "hand.json"), ('{"palm_link": "nowhere"}', "nowhere"), ('{"palm_link": 5}', "hand.json")]
)
def test_unreadable_notes_are_told_and_refused_alike(urdf: Path, text: str, named: str) -> None:
    urdf.with_name("hand.json").write_text(text)
    with pytest.raises(HandError, match=named):
        hand_from_path(urdf)
    for report in (report_hand(str(urdf)), added(urdf)):
        assert report["verdict"] == "refuse" and named in report["message"]


def test_a_hand_without_torque_limits_says_that_they_were_assumed(urdf: Path) -> None:
    assert "effort" not in report_hand(str(urdf))["facts"]["guessed"]
    urdf.write_text(urdf.read_text().replace('effort="1"', ""))
    assert "effort" in report_hand(str(urdf))["facts"]["guessed"]
