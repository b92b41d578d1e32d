"""`graspd synth`: validated as a job, called what it is, and a file that finds its hand and object again."""

import json
import re
import signal
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

import graspd
from graspd.cli import build_app
from graspd.commands.synth import _format_summary
from graspd.service.cli import write_output
from graspd.service.model.errors import ConflictError, NotFoundError
from graspd.service.readers import Grasps, open_shards
from graspd.service.store.shards import Shard, read_shard
from graspd.worker import generation
from graspd.worker.files import synthesis
from graspd.worker.files.provenance import object_of_shard
from tests.worker.commands_run import graspd as graspd_command
from tests.worker.commands_run import refused

DRAFT = "--fidelity draft --device cpu"


def synth(out: Path, more: str, obj: str | Path = "block") -> dict:
    return graspd_command(f"synth --hand allegro -n 3 {DRAFT} {more} --object", obj, "-o", out)


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("synth")


@pytest.fixture(scope="module")
def validated(folder: Path) -> tuple[Path, dict]:
    return folder / "validated.h5", synth(folder / "validated.h5", "--budget 8")


@pytest.fixture(scope="module")
def unvalidated(folder: Path) -> tuple[Path, dict]:
    return folder / "unvalidated.h5", synth(folder / "unvalidated.h5", "--validation none")


@pytest.fixture(scope="module")
def own_mesh(folder: Path) -> Path:
    """A box beside a small ball, in a folder that says what it is."""
    (folder / "brick").mkdir()
    box, ball = trimesh.creation.box((0.05, 0.06, 0.07)), trimesh.creation.icosphere(radius=0.005)
    ball.apply_translation([0.1, 0, 0])
    trimesh.util.concatenate([box, ball]).export(folder / "brick" / "clean.obj")
    return folder / "brick" / "clean.obj"


@pytest.fixture(scope="module")
def of_own_mesh(folder: Path, own_mesh: Path) -> Path:
    synth(folder / "own.h5", "--validation none --keep-largest", own_mesh)
    return folder / "own.h5"


def test_grasps_called_valid_were_validated_as_in_a_job(validated: tuple[Path, dict]) -> None:
    file, said = validated
    shard = read_shard(file, kind="base")
    assert (said["grasps"], said["valid"], said["feasible"], said["validation"]) == (3, 3, 3, "standard")
    assert said["candidates"] >= 3 and shard.attributes["candidates"] == said["candidates"]
    assert (shard["quality/success"] == 1).all()
    assert shard.attributes["verdict_level"] == "standard" and "verdict_key" in shard.attributes
    assert said["reason"] is None and "reason" not in shard.attributes


def test_grasps_that_nobody_validated_are_sound_and_never_valid(unvalidated: tuple[Path, dict]) -> None:
    file, said = unvalidated
    shard = read_shard(file, kind="base")
    assert (said["grasps"], said["valid"], said["feasible"], said["validation"]) == (3, 0, 3, "none")
    assert shard.attributes["verdict_level"] == "none" and "quality/success" not in shard.arrays
    assert not shard["quality/valid"].any()
    line = _format_summary({"file": "g.h5", **said})
    assert "3 feasible of" in line and "not validated" in line and not re.search(r"\bvalid\b", line)


def test_evaluate_gives_a_verdict_of_each_grasp_that_agrees(validated: tuple) -> None:
    told = graspd_command("evaluate", validated[0])
    expected = [(str(validated[0]), row, True) for row in range(3)]
    assert [(one["file"], one["row"], one["held"]) for one in told["verdicts"]] == expected
    assert "verdicts" not in told["files"][0]


def test_readers_take_grasps_that_nobody_validated_only_when_told(validated, unvalidated: tuple) -> None:
    both = open_shards([validated[0], unvalidated[0]])
    rows = [Grasps(both, columns=["quality/epsilon"], **wish) for wish in ({}, {"unvalidated": True}, {"valid": False})]
    assert [len(found) for found in rows] == [3, 3, 6]
    assert {both.by_id(sample["shard_id"]).path for sample in rows[1]} == {unvalidated[0]}


@pytest.mark.parametrize("command", ["export --format dexgraspbench", "pictures -n 1 --size 32 --device cpu"])
def test_export_and_pictures_take_grasps_that_nobody_validated_only_when_told(unvalidated, tmp_path, command) -> None:
    assert "select them with --unvalidated" in refused(command, unvalidated[0], "-o", tmp_path / "out.png")
    assert not list(tmp_path.iterdir())
    graspd_command(f"{command} --unvalidated", unvalidated[0], "-o", tmp_path / "out.png")


@pytest.mark.parametrize("words", ["--want good", "--validation validate"])
def test_a_word_that_is_none_is_refused_before_the_files_are_read(words: str, tmp_path: Path) -> None:
    said = refused(f"synth --hand absent.urdf --object block {words} -o", tmp_path / "g.h5")
    assert f"{words.split()[0]}: must be one of" in said


def elsewhere(file: Path, folder: Path) -> Shard:
    moved = folder / "shard" / "own.h5"
    moved.parent.mkdir()
    moved.write_bytes(file.read_bytes())
    shard = read_shard(moved)
    shard.attributes["object_source"] = str(folder / "gone.obj")
    return shard


def test_a_shard_finds_its_object_in_its_own_folder(of_own_mesh: Path, own_mesh: Path, tmp_path: Path) -> None:
    shard = elsewhere(of_own_mesh, tmp_path)
    (tmp_path / "shard" / "brick").mkdir()
    (tmp_path / "shard" / "brick" / "clean.obj").write_bytes(own_mesh.read_bytes())
    assert object_of_shard(shard, None).digest == shard.attributes["object_digest"]


def test_a_file_of_the_right_name_and_another_content_is_not_taken(of_own_mesh: Path, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("GRASPD_DATA_DIR", str(tmp_path / "data"))
    shard = elsewhere(of_own_mesh, tmp_path)
    trimesh.creation.box((0.05, 0.06, 0.07)).export(tmp_path / "shard" / "clean.obj")
    with pytest.raises(NotFoundError) as caught:
        object_of_shard(shard, None)
    for place in ("gone.obj", str(tmp_path / "data"), str(tmp_path / "shard"), "--object"):
        assert place in str(caught.value)
    assert not (tmp_path / "data").exists(), "to look makes nothing"


def test_a_given_file_is_read_with_the_options_of_the_shard(of_own_mesh: Path, own_mesh: Path) -> None:
    shard = read_shard(of_own_mesh)
    assert shard.attributes["object"] == "brick", "named after its folder"
    assert object_of_shard(shard, str(own_mesh)).digest == shard.attributes["object_digest"]
    with pytest.raises(ConflictError):
        object_of_shard(shard, "mug")


def test_every_command_finds_hand_and_object_of_a_file_by_itself(of_own_mesh: Path, tmp_path: Path) -> None:
    graspd_command("scene --scenes 1", of_own_mesh, "-o", tmp_path / "s.h5")
    graspd_command("render --views 1 --width 32 --height 24 --device cpu", tmp_path / "s.h5", "-o", tmp_path / "v.h5")


def test_fewer_grasps_than_asked_are_told_with_the_reason_and_exit_code_3(folder: Path, monkeypatch) -> None:
    out = folder / "few.h5"
    monkeypatch.setattr(generation, "passes_gate", lambda columns: np.zeros(len(columns["quality/success"]), np.uint8))
    said = graspd_command(f"synth --hand barrett --object block -n 2 --budget 1 {DRAFT} -o", out, code=3)
    assert (said["grasps"], said["valid"], said["wanted"]) == (0, 0, 2)
    assert sum(said["outcomes"].values()) == said["candidates"] == 2
    assert said["reason"].startswith("found 0 of 2 valid grasps in 2 candidates: ")
    shard = read_shard(out, kind="base")
    assert shard.attributes["reason"] == said["reason"]
    assert json.loads(str(shard.attributes["outcomes"])) == said["outcomes"]
    again = graspd.open(out)
    assert (again.reason, again.outcomes) == (said["reason"], said["outcomes"])


@pytest.mark.parametrize("asked", [signal.SIGINT, signal.SIGTERM])
def test_who_stops_it_keeps_what_was_validated(folder: Path, monkeypatch, asked: signal.Signals) -> None:
    real, out = synthesis.synthesize_grasps, folder / f"stopped-{asked}.h5"

    def stopped(*given, progress, **named):
        def tell(done: float, total: float, message: str) -> None:
            if done >= 32 and signal.getsignal(asked) is not before:
                signal.raise_signal(asked)

        return real(*given, progress=tell, **named)

    before = signal.getsignal(asked)
    monkeypatch.setattr(synthesis, "synthesize_grasps", stopped)
    words = f"synth --hand barrett --object block -n 64 --budget 1 --validation none --json {DRAFT} -o"
    done = CliRunner().invoke(build_app(), [*words.split(), str(out)])
    shard = read_shard(out, kind="base")
    kept = len(shard["quality/valid"])
    assert done.exit_code == 128 + asked and 0 < kept <= 32
    assert f"interrupted: {out} contains {kept} of 64" in done.stderr
    assert shard.attributes["grasps_wanted"] == 64 and signal.getsignal(asked) is before


def test_a_file_is_written_whole_or_not_at_all(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = folder / "whole.h5"
    out.write_bytes(b"before")

    def half(path: Path, content: bytes) -> int:
        with path.open("wb") as opened:
            opened.write(content[:2])
        raise KeyboardInterrupt

    monkeypatch.setattr(Path, "write_bytes", half)
    with pytest.raises(KeyboardInterrupt):
        write_output(out, b"after")
    assert out.read_bytes() == b"before" and not list(folder.glob("*.part")) and not list(folder.glob(".*.part"))
