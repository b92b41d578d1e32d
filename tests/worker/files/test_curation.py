"""Parts of datasets: chosen by an expression or by kind, balanced, and as files of clouds."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from graspd.commands.curate import app
from graspd.exchange.inputs import expand_path
from graspd.service.model.errors import InputError
from graspd.service.readers import Grasps, Pictures, open_shards
from graspd.service.readers.clouds import OF_GRASPS
from graspd.service.store.shards import Shard, read_shard, write_shard
from graspd.worker.files.curation import Balance, face_numbers
from graspd.worker.files.subsets import select_grasps
from tests.service.readers import box_scenes
from tests.worker.models import quality_columns

COUNT = 40


def columns(seed: int) -> dict:
    """40 valid grasps, three in four of type power."""
    rng = np.random.default_rng(seed)
    pose = np.concatenate([rng.normal(0, 0.1, (COUNT, 3)), np.tile([1.0, 0, 0, 0], (COUNT, 1))], axis=1)
    found = quality_columns(COUNT) | {"quality/epsilon": np.repeat(rng.random((COUNT, 1)), 2, axis=1)}
    for posture in ("grasp", "pregrasp", "squeeze"):
        found |= {f"{posture}/hand_pose": pose, f"{posture}/joint_positions": rng.random((COUNT, 2))}
    found["quality/grasp_type"] = np.where(np.arange(COUNT) % 4 < 3, 1, 2).astype(np.int32)
    return found | {"quality/approach_cell": rng.integers(0, 2, COUNT).astype(np.int32)}


def shard(path: Path, number: int, obj: str = "mug", batch: int = 0, **changes) -> Path:
    said = {"hand": "allegro", "object": obj, "batch": batch, "shard_id": f"{number:032x}", "seed": 0, **changes}
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(write_shard("base", columns(number), said))
    return path


def run(*words: str | Path):
    return CliRunner().invoke(app, [str(word) for word in words])


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    shard(tmp_path / "all" / "a.h5", 1)
    shard(tmp_path / "all" / "b.h5", 2, batch=1)
    shard(tmp_path / "all" / "c.h5", 3, obj="drill")
    (tmp_path / "all" / "snapshot.json").write_text("{}")
    return tmp_path / "all"


def test_subset_holds_what_expression_chooses_and_nothing_else(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "subset"
    where = "type = precision and epsilon >= 0.2"
    told = json.loads(run("grasps", "where", where, "--from", folder, "-o", out, "--json").stdout)
    every = Grasps(open_shards(folder), ["quality/epsilon", "grasp/hand_pose"])
    chosen = Grasps(open_shards(out), ["quality/epsilon", "grasp/hand_pose", "quality/grasp_type"])
    poses = {sample["grasp/hand_pose"].tobytes() for sample in every}
    assert 0 < len(chosen) == told["kept"] < told["looked_at"] == 3 * COUNT
    for sample in chosen:
        assert sample["grasp/hand_pose"].tobytes() in poses and sample["quality/grasp_type"] == 2
    for beside in ("card.json", "clouds.json"):
        (out / beside).write_text("{}")
    names = {file.name for file in expand_path(out)}
    assert names <= {"base-00000.h5", "base-00001.h5"}, "what tells of the subset is no file of grasps"


def test_a_subset_of_nothing_or_over_a_folder_is_refused(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "none"
    nothing = run("grasps", "where", "epsilon > 1e6", "--from", folder, "-o", out)
    assert nothing.exit_code == 2 and "none of 120 grasps" in nothing.stderr and not out.exists()
    again = run("grasps", "where", "valid", "--from", folder, "-o", folder)
    assert again.exit_code == 2 and "exists already" in again.stderr


def test_no_kind_is_more_frequent_than_the_median_one(folder: Path, tmp_path: Path) -> None:
    out = tmp_path / "even"
    assert run("balance", folder, "--by", "type", "-o", out).exit_code == 0
    for obj, each in (("mug", 2 * COUNT), ("drill", COUNT)):
        types = Grasps(open_shards(out).select(objects=[obj])).arrays("quality/grasp_type")["quality/grasp_type"]
        power, precision = int((types == 1).sum()), int((types == 2).sum())
        # Kinds have 3/4 and 1/4 of each: the median of the two is half.
        assert (power, precision) == (each // 2, each // 4)
    kept = [read_shard(file) for file in sorted(out.rglob("*.h5"))]
    again = tmp_path / "again"
    run("balance", folder, "--by", "type", "-o", again)
    for one, other in zip(kept, sorted(again.rglob("*.h5")), strict=True):
        assert np.array_equal(one["grasp/hand_pose"], read_shard(other)["grasp/hand_pose"])


def test_faces_are_told_by_what_lies_below() -> None:
    for by in (["beauty"], []):
        with pytest.raises(InputError, match="type, direction, face"):
            Balance(by)
    tilted = [np.sin(0.1), 0.0, -np.cos(0.1)]
    down = np.array([[0, 0, -1.0], [0, 1.0, 0], tilted, [0.0, 0, 0], [0, 0, 1.0]])
    assert face_numbers(down).tolist() == [0, 1, 0, -1, 2]


def base_of(valid: list[int], feasible: list[int], success: list[int] | None) -> Shard:
    arrays = {"quality/valid": np.array(valid, np.uint8), "quality/feasible": np.array(feasible, np.uint8)}
    return Shard("base", {}, arrays | ({} if success is None else {"quality/success": np.array(success, np.int8)}))


VALIDATED = base_of([1, 0, 0], [1, 1, 0], [1, 0, 1])
UNVALIDATED = base_of([0, 0], [1, 0], None)


def test_valid_grasps_are_taken_unless_others_are_asked_for() -> None:
    for base, wish, mask, words in (
        (VALIDATED, {}, [True, False, False], "valid grasps"),
        (VALIDATED, {"every": True}, [True] * 3, "grasps of any kind"),
        (UNVALIDATED, {"unvalidated": True}, [True, False], "feasible grasps that are not validated"),
    ):
        found, name = select_grasps(base, **wish)
        assert (found.tolist(), name) == (mask, words)


@pytest.mark.parametrize(
    "base, wish, fix",
    [
        (UNVALIDATED, {}, "select them with --unvalidated"),
        (VALIDATED, {"unvalidated": True}, "leave out --unvalidated"),
        (base_of([0], [1], [0]), {}, "select them with --all"),
        (base_of([], [], []), {"every": True}, "it has no grasps"),
        (VALIDATED, {"unvalidated": True, "every": True}, "exclude each other"),
    ],
)
def test_none_of_that_kind_is_told_with_the_mend(base: Shard, wish: dict[str, bool], fix: str) -> None:
    with pytest.raises(InputError, match=fix):
        select_grasps(base, **wish)


def test_grasps_whose_type_is_not_recorded_are_not_balanced() -> None:
    with pytest.raises(InputError, match="does not record the type"):
        Balance(["type"])([VALIDATED])


@pytest.fixture(scope="module")
def boxes(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return box_scenes.write(tmp_path_factory.mktemp("box"))


def test_files_hold_every_sample_whole(boxes: Path, tmp_path: Path) -> None:
    said = ["--points", "200", "--noise", "stereo", "--seed", "4", "-o", tmp_path / "out", "--json"]
    done = run("clouds", boxes, *said)
    assert done.exit_code == 0, done.output
    assert json.loads(done.output) == {"folder": str(tmp_path / "out"), "files": 1, "clouds": 6, "empty": 0}
    samples = Pictures(open_shards(boxes)).clouds(200, noise="stereo", seed=4)
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


def test_what_cannot_be_written_is_told_in_a_line(boxes: Path, tmp_path: Path) -> None:
    (tmp_path / "full").mkdir()
    (tmp_path / "full" / "thesis.tex").write_text("")
    (tmp_path / "none").mkdir()
    (tmp_path / "none" / "base.h5").write_bytes((boxes / "base.h5").read_bytes())
    for source, out, words in (
        (boxes, tmp_path / "full", "exists already"),
        (tmp_path / "none", tmp_path / "new", "has no pictures"),
        (tmp_path / "away", tmp_path / "new", "does not exist"),
    ):
        done = run("clouds", source, "-o", out)
        assert done.exit_code == 2
        assert words in done.output and len(done.output.strip().splitlines()) == 1
    assert not (tmp_path / "new").exists()
