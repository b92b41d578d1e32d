"""The study of seeds from a network runs both methods in the same scenes, and tells both."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks import learned
from graspd.baselines.learned.network import save
from graspd.worker.hands.load import hand_from_path
from tests.networks import random_network


def test_both_methods_are_told_side_by_side(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(learned, "BUDGET", 2.0)
    hand = hand_from_path("barrett")
    save(random_network(hand.joint_names, hand=hand.name, digest=hand.digest), tmp_path / "net.npz")
    words = ["--network", str(tmp_path / "net.npz"), "--objects", "block", "--many", "2", "--seeds", "1"]
    assert learned.main([*words, "--starts", "2", "--out", str(tmp_path / "out")]) == 0
    found = json.loads((tmp_path / "out" / "learned.json").read_text())
    own, other = found["rows"]
    assert [own["method"], other["method"]] == ["fast_graspd", "learned starts=2"]
    for row in found["rows"]:
        assert (row["hand"], row["object"]) == ("barrett", "block")
        assert row["first"] == pytest.approx(row["firsts"][0], abs=1e-3) and row["first"] > 0 and row["found"] in (0, 1)
        assert row["rate"] == pytest.approx(2 * row["valid"] / row["seconds"])
    assert list(found["networks"].values()) == ["barrett. drawn by chance"]
    page = (tmp_path / "out" / "learned.md").read_text()
    assert learned.table(found["rows"]) in page and learned.table(found["rows"]) + "\n" == capsys.readouterr().out
    assert str(tmp_path) not in page


def test_a_file_that_is_no_network_is_said_in_a_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "net.npz").write_bytes(b"no network")
    assert learned.main(["--network", str(tmp_path / "net.npz")]) == 2
    assert capsys.readouterr().err.count("\n") == 1
