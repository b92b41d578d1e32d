"""Robust grasps from the command line to the reader."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

import graspd
from graspd.commands.evaluate import app as evaluate
from graspd.commands.synth import app as synth


def test_a_file_of_robust_grasps_says_so_to_every_reader(tmp_path: Path) -> None:
    file = tmp_path / "robust.h5"
    asked = ["--robust", "0.5", "--robust-models", "2", "--fidelity", "draft", "-n", "2", "--json"]
    made = CliRunner().invoke(synth, ["--hand", "allegro", "--object", "block", "-o", str(file), *asked])
    assert made.exit_code == 0, made.output
    said = json.loads(made.stdout.splitlines()[-1])
    grasps = graspd.open(file)
    assert said["robust_share"] == float(np.round(grasps.metric("robust_share").mean(), 4)) >= 0.5
    assert json.loads(str(grasps.attributes["robust"])) == {"models": 2, "wanted": 0.5}
    assert grasps.column("quality/robust_weakest").dtype == np.uint8
    assert len(grasps.where(lambda g: g.metric("robust_share") >= 0.5)) == 2


def test_grasps_in_scenes_are_robust_if_other_models_lift_them(tmp_path: Path) -> None:
    (tmp_path / "made").mkdir()
    file, copies = tmp_path / "made" / "table.h5", tmp_path / "validated"
    asked = ["--hand", "barrett", "--object", "block", "--scene", "table", "--scenes", "2", "--fidelity", "draft"]
    wanted = ["-n", "2", "--want", "candidates", "--robust-models", "2", "--json"]
    made = CliRunner().invoke(synth, [*asked, *wanted, "-o", str(file)])
    assert made.exit_code == 0, made.output
    grasps = graspd.open(file)
    lifted, share = grasps.column("quality/success") == 1, grasps.column("quality/robust_share")
    assert lifted.any() and (np.isfinite(share) == lifted).all()
    lift = ["--protocol", "lift", "--robust", "3", "--json"]
    validated = CliRunner().invoke(evaluate, [str(tmp_path / "made"), *lift, "-o", str(copies)])
    assert validated.exit_code == 0, validated.output
    said, copy = json.loads(validated.stdout.splitlines()[-1]), graspd.open(copies / "table.h5")
    again = copy.metric("robust_share")
    assert said["robust_share"] == round(float(again[lifted].mean()), 6) and said["robust_n"] == lifted.sum()
    assert [one["robust_share"] is None for one in said["verdicts"]] == (~lifted).tolist() == np.isnan(again).tolist()
    assert json.loads(str(copy.attributes["robust"])) == {"models": 3, "wanted": 0}
    assert copy.attributes["shard_id"] == grasps.attributes["shard_id"]
    for path in ("grasp/hand_pose", "quality/success"):
        assert np.array_equal(copy.column(path), grasps.column(path))
    for wrong, words in (([], "needs --protocol lift"), (["--protocol", "lift", "--hard"], "no --hard")):
        refused = CliRunner().invoke(evaluate, [str(file), "--robust", "2", *wrong, "-o", str(tmp_path / "no.h5")])
        assert refused.exit_code == 2 and words in refused.output + refused.stderr
    refused = CliRunner().invoke(evaluate, [str(tmp_path / "made"), *lift, "-o", str(copies)])
    assert refused.exit_code == 2 and "already exists" in refused.output + refused.stderr
    assert not (tmp_path / "no.h5").exists()
