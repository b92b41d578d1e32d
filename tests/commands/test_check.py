"""`graspd hands check` and `graspd objects check` through the entry point: the JSON contract and the exit codes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner

from graspd.cli import build_app
from graspd.worker.rendering import portraits
from tests.worker.commands_run import refused

#: Colours of the arrow on the palm and of the prepared mesh: red exceeds blue by at least this [of 255].
WARM = 60


def check(*arguments: str) -> tuple[int, dict[str, Any]]:
    untried = ["--no-self-test"] if arguments[0] == "hands" else []
    result = CliRunner().invoke(build_app(), [*arguments, *untried, "--json"])
    return result.exit_code, json.loads(result.stdout.splitlines()[-1])


def test_a_folder_gets_a_verdict_each_and_code_2_if_refused(shared_data: Path, tmp_path: Path) -> None:
    for source, name in (("quads_and_ngons.obj", "prism"), ("inverted_normals.stl", "mug"), ("garbage.stl", "noise")):
        folder = tmp_path / "set" / name
        folder.mkdir(parents=True)
        (folder / source).write_bytes((shared_data / "bad" / source).read_bytes())
    code, report = check("objects", "check", str(tmp_path / "set"))
    assert code == 2 and report["refused"] == ["noise"]
    said = {one["name"]: one["verdict"] for one in report["objects"]}
    assert said == {"mug": "repair", "noise": "refuse", "prism": "accept"}
    assert "--picture draws one object" in refused("objects check --picture p.png", tmp_path / "set")
    told = CliRunner().invoke(build_app(), ["objects", "check", str(tmp_path / "set")])
    assert [line.split()[0] for line in told.stdout.splitlines()] == ["repair", "refuse", "accept"]
    assert "1 of 3 objects were refused: noise" in told.stderr
    (tmp_path / "set" / "noise" / "garbage.stl").unlink()
    code, report = check("objects", "check", str(tmp_path / "set"))
    assert code == 0 and report["refused"] == []


@pytest.mark.parametrize(
    ("file", "options", "verdict"),
    [
        ("mimic_chain.urdf", (), "accept"),
        ("inverted_normals.stl", (), "repair"),
        ("banana_in_millimetres.stl", (), "refuse"),
        ("banana_in_millimetres.stl", ("--units", "mm"), "accept"),
        ("open_shell.stl", ("--allow-open",), "accept"),
        ("two_components.stl", ("--keep-largest",), "repair"),
    ],
)
def test_files_get_verdict_and_exit_code(shared_data: Path, file: str, options: tuple[str, ...], verdict: str) -> None:
    kind = "hands" if file.endswith(".urdf") else "objects"
    code, report = check(kind, "check", str(shared_data / "bad" / file), *options)
    assert report["verdict"] == verdict, report["message"]
    assert code == (2 if verdict == "refuse" else 0)
    assert bool(report["repairs"]) == (verdict == "repair")


def test_without_json_refusals_are_one_line_and_guesses_are_told(tmp_path: Path) -> None:
    for kind in ("hands", "objects"):
        code, report = check(kind, "check", "nowhere")
        assert (code, report["verdict"]) == (2, "refuse") and ("allegro" in report["message"]) == (kind == "hands")
    (tmp_path / "o.stl").write_bytes(b"")
    (tmp_path / "none").mkdir()
    result = CliRunner().invoke(build_app(), ["objects", "check", str(tmp_path / "o.stl")])
    told = CliRunner().invoke(build_app(), ["objects", "check", str(tmp_path / "none")])
    assert told.exit_code == 2 and "no mesh" in told.stderr
    assert (result.exit_code, result.stdout) == (2, "")
    assert len(result.stderr.splitlines()) == 1 and "o.stl" in result.stderr
    said = CliRunner().invoke(build_app(), ["hands", "check", "barrett", "--no-self-test"]).stdout
    for word in ("palm", "approach", "fingertips", "dofs", "pre-shape"):
        assert word in said


def test_options_go_over_guesses_drop_fingers_and_weigh() -> None:
    _, report = check("hands", "check", "allegro", "--fix", "thumb_rotation=1.0,index_distal=0.2")
    assert len(report["facts"]["dofs"]) == 14
    _, report = check("hands", "check", "allegro", "--drop", "ring_proximal_link")
    assert not [name for name in report["facts"]["fingertips"] if name.startswith("ring")]
    _, report = check("objects", "check", "block", "--density", "500")
    assert report["facts"]["mass_kg"] == pytest.approx(500 * report["facts"]["volume_m3"])


@pytest.mark.parametrize("option", ["--approach 1,2", "--approach a,b,c", "--fix thumb", "--pre-shape thumb=x"])
def test_an_option_that_cannot_be_read_is_the_callers_mistake(option: str) -> None:
    result = CliRunner().invoke(build_app(), ["hands", "check", "allegro", *option.split()])
    assert result.exit_code == 2 and option.split()[0] in result.stderr


@pytest.mark.parametrize(("kind", "name"), [("hands", "shadow"), ("objects", "mug")])
def test_a_built_in_is_accepted_and_its_picture_shows_it(kind: str, name: str, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(portraits, "_SAMPLES", 2)  # grainy, and shown all the same
    path = tmp_path / "p.png"
    code, report = check(kind, "check", name, "--picture", str(path))
    assert (code, report["verdict"], report["repairs"]) == (0, "accept", []) and report["message"] and report["facts"]
    pixels = np.asarray(Image.open(path).convert("RGB")).astype(int)
    thirds = np.array_split(pixels, 3, axis=1)
    assert all((third[..., 0] - third[..., 2] > WARM).sum() > 100 for third in thirds)
