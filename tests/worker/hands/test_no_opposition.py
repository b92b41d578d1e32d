"""A hand that can hold nothing is refused before any work, wherever it comes in."""

from __future__ import annotations

from pathlib import Path

import pytest
import trimesh

from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import HandError
from graspd.worker.generation import validated_grasps
from graspd.worker.hands import pinch_postures as oppositions
from graspd.worker.hands.load import load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.pinch_postures import require_opposing
from tests.worker.hands.grippers import gripper
from tests.worker.models import object_from_mesh

_LINK = (
    '<link name="{name}"><collision><origin xyz="0 0 0.02"/><geometry><box size="0.01 0.01 0.04"/></geometry>'
    "</collision></link>"
)
_JOINT = (
    '<joint name="{name}" type="revolute"><parent link="{parent}"/><child link="{child}"/><origin xyz="0 0 0.04"/>'
    '<axis xyz="0 1 0"/><limit lower="0" upper="0.3" effort="1" velocity="1"/></joint>'
)


def pointer() -> HandModel:
    """A stick of three links that bends a little: none of them ever faces another."""
    links = "".join(_LINK.format(name=name) for name in "abc")
    joints = _JOINT.format(name="one", parent="a", child="b") + _JOINT.format(name="two", parent="b", child="c")
    files = {"pointer.urdf": f'<robot name="pointer">{links}{joints}</robot>'.encode()}
    return load_hand(files, name="pointer", digest="0" * 32)


def test_grasps_of_a_hand_without_opposing_digits_are_not_even_planned() -> None:
    ball = object_from_mesh(trimesh.creation.icosphere(2, 0.02))
    with pytest.raises(HandError, match=r"pointer: no two opposing digits.*--root"):
        validated_grasps(pointer(), ball, JobOptions(want="candidates", grasps=1), count=1)


def test_a_gripper_opposes() -> None:
    require_opposing(gripper())


def test_what_a_hand_can_hold_is_asked_once_on_a_machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    answer = oppositions.opposes

    def opposes(hand: HandModel) -> bool:
        asked.append(hand.name)
        return answer(hand)

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(oppositions, "opposes", opposes)
    for _ in range(2):
        oppositions._holding.clear()  # as a process that begins
        require_opposing(gripper())
        with pytest.raises(HandError, match="no two opposing digits"):
            require_opposing(pointer())
    assert sorted(asked) == sorted([gripper().name, "pointer"])
    for file in (tmp_path / "graspd" / "opposing").iterdir():
        file.write_bytes(file.read_bytes()[:-1])
    oppositions._holding.clear()
    require_opposing(gripper())
    assert len(asked) == 3, "an entry that was cut off is none"
