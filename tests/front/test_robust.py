"""Robust grasps from the command line to the reader."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

import graspd
from tests.worker.commands_run import graspd as command
from tests.worker.commands_run import refused


def test_a_file_of_robust_grasps_says_so_to_every_reader(tmp_path: Path) -> None:
    file = tmp_path / "robust.h5"
    asked = "synth --hand allegro --object block --robust 0.5 --robust-models 2 --fidelity draft -n 2 -o"
    said, grasps = command(asked, file), graspd.open(file)
    assert said["robust_share"] == float(np.round(grasps.metric("robust_share").mean(), 4)) >= 0.5
    assert json.loads(str(grasps.attributes["robust"])) == {"models": 2, "wanted": 0.5}
    assert grasps.column("quality/robust_weakest").dtype == np.uint8
    assert len(grasps.where(lambda g: g.metric("robust_share") >= 0.5)) == 2


def test_grasps_in_scenes_are_robust_if_other_models_lift_them(tmp_path: Path) -> None:
    (tmp_path / "made").mkdir()
    file, copies = tmp_path / "made" / "table.h5", tmp_path / "validated"
    asked = "synth --hand barrett --object block --scene table --scenes 2 --fidelity draft"
    command(f"{asked} -n 2 --want candidates --robust-models 2 -o", file)
    grasps = graspd.open(file)
    lifted, share = grasps.column("quality/success") == 1, grasps.column("quality/robust_share")
    assert lifted.any() and (np.isfinite(share) == lifted).all()
    lift = ("evaluate --protocol lift --robust 3 -o", copies, tmp_path / "made")
    said, copy = command(*lift), graspd.open(copies / "table.h5")
    again = copy.metric("robust_share")
    assert said["robust_share"] == round(float(again[lifted].mean()), 6) and said["robust_n"] == lifted.sum()
    assert [one["robust_share"] is None for one in said["verdicts"]] == (~lifted).tolist() == np.isnan(again).tolist()
    assert json.loads(str(copy.attributes["robust"])) == {"models": 3, "wanted": 0}
    assert copy.attributes["shard_id"] == grasps.attributes["shard_id"]
    for path in ("grasp/hand_pose", "quality/success"):
        assert np.array_equal(copy.column(path), grasps.column(path))
    assert "needs --protocol lift" in refused("evaluate --robust 2 -o", tmp_path / "no.h5", file)
    assert "no --hard" in refused("evaluate --robust 2 --protocol lift --hard -o", tmp_path / "no.h5", file)
    assert "exists already" in refused(*lift) and not (tmp_path / "no.h5").exists()
