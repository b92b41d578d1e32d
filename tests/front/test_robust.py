"""Robust grasps from the command line to the reader."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
from typer.testing import CliRunner

import graspd
from worker.commands.synth import app


def test_a_file_of_robust_grasps_says_so_to_every_reader(tmp_path: Path) -> None:
    file = tmp_path / "robust.h5"
    asked = ["--robust", "0.5", "--robust-models", "2", "--fidelity", "draft", "-n", "2", "--json"]
    made = CliRunner().invoke(app, ["--hand", "allegro", "--object", "block", "-o", str(file), *asked])
    assert made.exit_code == 0, made.output
    said = json.loads(made.stdout.splitlines()[-1])
    grasps = graspd.open(file)
    assert said["robust_share"] == float(np.round(grasps.metric("robust_share").mean(), 4)) >= 0.5
    assert json.loads(str(grasps.attributes["robust"])) == {"models": 2, "wanted": 0.5}
    assert grasps.column("quality/robust_weakest").dtype == np.uint8
    assert len(grasps.where(lambda g: g.metric("robust_share") >= 0.5)) == 2


def test_robust_goes_with_no_scene(tmp_path: Path) -> None:
    file = str(tmp_path / "robust.h5")
    asked = ["--hand", "allegro", "--object", "block", "-o", file, "--scene", "table", "--robust", "0.5"]
    refused = CliRunner().invoke(app, asked)
    assert refused.exit_code != 0
    assert "scene free" in refused.output + refused.stderr
