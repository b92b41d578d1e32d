"""Clouds in files are the samples that the reader makes."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from graspd.commands.curate import app
from graspd.service.readers import Pictures, open_shards
from graspd.service.readers.clouds import OF_GRASPS
from tests.service.readers import box_scenes


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return box_scenes.write(tmp_path_factory.mktemp("box"))


def test_files_hold_every_sample_whole(folder: Path, tmp_path: Path) -> None:
    said = ["--points", "200", "--noise", "stereo", "--seed", "4", "-o", str(tmp_path / "out"), "--json"]
    done = CliRunner().invoke(app, ["clouds", str(folder), *said])
    assert done.exit_code == 0, done.output
    assert json.loads(done.output) == {"folder": str(tmp_path / "out"), "files": 1, "clouds": 6, "empty": 0}
    samples = Pictures(open_shards(folder)).clouds(200, noise="stereo", seed=4)
    ends = None
    with np.load(tmp_path / "out" / "clouds-00000.npz") as found:
        ends = np.cumsum(found["grasp/count"])
        for index, sample in enumerate(samples):
            for name, value in sample.items():
                of_grasps = slice(ends[index] - found["grasp/count"][index], ends[index])
                part = found[name]
                part = part[of_grasps] if name.startswith(OF_GRASPS) else part if part.ndim == 0 else part[index]
                np.testing.assert_array_equal(part, value)
    told = json.loads((tmp_path / "out" / "clouds.json").read_text())
    assert (told["noise"], told["seed"], told["frame"], told["clouds"]) == ("stereo", 4, "camera", 6)


def test_what_cannot_be_written_is_told_in_a_line(folder: Path, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("")
    (tmp_path / "none").mkdir()
    (tmp_path / "none" / "base.h5").write_bytes((folder / "base.h5").read_bytes())
    for source, out, words in (
        (folder, tmp_path / "full", "is there already"),
        (tmp_path / "none", tmp_path / "new", "has no pictures"),
        (tmp_path / "away", tmp_path / "new", "does not exist"),
    ):
        done = CliRunner().invoke(app, ["clouds", str(source), "-o", str(out)])
        assert done.exit_code == 2
        assert words in done.output and len(done.output.strip().splitlines()) == 1
    assert not (tmp_path / "new").exists()
