"""Parts of datasets, chosen, balanced, and as clouds; results do not depend on where the origin of a mesh lies."""

import io
import json
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from graspd.commands.curate import app
from graspd.exchange.inputs import expand_path, load_case
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.scene_spec import SceneSpec, parse_scene
from graspd.service.model.transforms import apply
from graspd.service.readers import Grasps, Pictures, open_shards
from graspd.service.readers.clouds import OF_GRASPS
from graspd.service.store.shards import Shard, read_shard, write_shard
from graspd.studies.evaluation import evaluate
from graspd.worker.files.curation import Balance, face_numbers
from graspd.worker.files.subsets import select_grasps
from graspd.worker.files.synthesis import SynthesisResult, synthesize_grasps
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.quality.diversity import select_farthest
from graspd.worker.rendering.pictures import grasp_pictures
from graspd.worker.scenes.placement import scenes_of
from graspd.worker.stages.models import object_glb
from tests.service.readers import box_scenes
from tests.worker.commands_run import graspd
from tests.worker.models import quality_columns, two_finger_hand

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


def test_the_farthest_grasp_is_selected_next() -> None:
    line = np.zeros((5, 7, 3))
    line[..., 0] = np.array([2.0, 0, 10, 6, 7])[:, None]
    for count in range(7):
        assert select_farthest(line, count).tolist() == [0, 2, 3, 1, 4][:count]
    assert len(select_farthest(line[:0], 3)) == 0


def test_spread_grasps_are_more_different_than_random_ones(folder: Path, tmp_path: Path, monkeypatch) -> None:
    hand = two_finger_hand()
    monkeypatch.setattr("graspd.worker.files.curation.hand_of_shard", lambda shard, given: hand)
    for name, more in (("few", []), ("again", []), ("other", ["--seed", "5"]), ("types", ["--by", "type"])):
        assert run("balance", folder, "--spread", "6", "-o", tmp_path / name, *more).exit_code == 0
    poses = {}
    for name in ("few", "again", "other", "types"):
        found = Grasps(open_shards(tmp_path / name).select(objects=["mug"])).arrays(
            "grasp/hand_pose", "quality/grasp_type"
        )
        poses[name] = found["grasp/hand_pose"]
    assert len(poses["few"]) == 6 and np.array_equal(poses["few"], poses["again"])
    assert not np.array_equal(poses["few"], poses["other"]), "the seed draws the first grasp"
    assert np.bincount(found["quality/grasp_type"]).tolist() == [0, 6, 6], "six of each type"
    every = np.asarray(Grasps(open_shards(folder).select(objects=["mug"])).arrays("grasp/hand_pose")["grasp/hand_pose"])
    rng = np.random.default_rng(0)
    drawn = np.mean([mean_least(every[rng.choice(len(every), 6, replace=False)]) for _ in range(20)])
    assert mean_least(poses["few"]) > 1.3 * drawn
    assert json.loads((tmp_path / "few" / "subset.json").read_text())["spread"] == 6
    both = run("balance", folder, "--spread", "6", "--at-most", "3", "-o", tmp_path / "both")
    assert both.exit_code == 2 and "exclude each other" in both.stderr


def mean_least(pose: np.ndarray) -> float:
    apart = np.linalg.norm(pose[:, None, :3] - pose[None, :, :3], axis=2)
    return float((apart + 9 * np.eye(len(pose))).min(axis=1).mean())


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


#: The far one is a place in UTM coordinates.
PLACES = {"origin": (0.0, 0.0, 0.0), "far": (500_000.0, 4_500_000.0, 300.0)}
SCENES = pytest.mark.parametrize("scene", ["free", "table"])
REQUEST = JobOptions(grasps=2, want="candidates", rechecks=0, fidelity=FIDELITIES["draft"], seed=1)
ROUNDING_M = 1e-6  # of positions in the frame of the file [m]


@pytest.fixture(scope="module")
def placed_boxes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder, box = tmp_path_factory.mktemp("boxes"), trimesh.creation.box((0.06, 0.05, 0.1))
    found = {name: folder / name / "box.obj" for name in PLACES}
    for name, path in found.items():
        path.parent.mkdir()
        trimesh.Trimesh(box.vertices + PLACES[name], box.faces, process=False).export(path, digits=6)
    return found


@pytest.fixture(scope="module")
def made(placed_boxes: dict[str, Path]) -> dict[tuple[str, str], SynthesisResult]:
    def one(place: str, scene: str) -> SynthesisResult:
        where = SceneSpec() if scene == "free" else parse_scene(scene, faces="drawn", touch=None, beside=[])
        return synthesize_grasps(
            "barrett", str(placed_boxes[place]), REQUEST, place=where, scenes=1, device="cpu", threads=1
        )

    return {(place, scene): one(place, scene) for place in PLACES for scene in ("free", "table")}


def file_of(found: SynthesisResult, path: Path) -> Path:
    path.write_bytes(write_shard("base", found.arrays, found.attributes))
    return path


@SCENES
def test_grasps_are_the_same_in_the_frame_of_the_file(made, scene: str) -> None:
    here, there = made["origin", scene].arrays, made["far", scene].arrays
    ways = [name for name in here if name.endswith("hand_pose") or name in ("grasp/approach", "grasp/lift")]
    for name in ways:
        np.testing.assert_allclose(there[name][..., :3] - PLACES["far"], here[name][..., :3], rtol=0, atol=ROUNDING_M)
        np.testing.assert_array_equal(there[name][..., 3:], here[name][..., 3:])
    for name in set(here) - {*ways, "scene/object_pose"}:
        np.testing.assert_array_equal(there[name], here[name], err_msg=name)


def test_the_object_stands_in_its_scenes_where_it_would(made) -> None:
    here, there = (made[at, "table"].arrays["scene/object_pose"] for at in ("origin", "far"))
    np.testing.assert_array_equal(there[:, 3:], here[:, 3:])
    np.testing.assert_allclose(apply(there, np.array(PLACES["far"])), here[:, :3], rtol=0, atol=1e-8)


@SCENES
def test_an_evaluation_says_the_same(made, tmp_path: Path, scene: str) -> None:
    protocol = "lift" if scene == "table" else "dexgraspbench"
    rows = []
    for at in ("origin", "far"):
        row = evaluate(load_case(file_of(made[at, scene], tmp_path / f"{at}.h5")), protocol=protocol)
        told = {name: value for name, value in row.items() if "seconds" not in name and not name.startswith("sgs")}
        rows.append({name: value for name, value in told.items() if name != "verdict_key"})
    assert rows[0] == rows[1]


def test_pictures_are_the_same(made, placed_boxes: dict[str, Path], tmp_path: Path) -> None:
    seen = []
    for at in ("origin", "far"):
        hand = load_case(file_of(made[at, "free"], tmp_path / f"{at}.h5")).hand
        pose, joints = (made[at, "free"].arrays[f"grasp/{name}"][:1] for name in ("hand_pose", "joint_positions"))
        seen.append(grasp_pictures(hand, object_from_path(placed_boxes[at]), pose, joints, (48, 48), samples=2))
    np.testing.assert_array_equal(*seen)


def test_views_of_scenes_are_the_same(made, tmp_path: Path) -> None:
    seen = []
    for at in ("origin", "far"):
        shard, views = file_of(made[at, "table"], tmp_path / f"{at}.h5"), tmp_path / f"{at}-views.h5"
        graspd("render --views 1 --width 48 --height 36 --device cpu -o", views, shard)
        seen.append(read_shard(views, kind="views").arrays)
    for name in seen[0]:
        np.testing.assert_array_equal(seen[1][name], seen[0][name], err_msg=name)


def test_a_model_stands_where_its_file_says(placed_boxes: dict[str, Path]) -> None:
    scene = trimesh.load(io.BytesIO(object_glb(object_from_path(placed_boxes["far"]))), file_type="glb")
    (name,) = scene.graph.nodes_geometry
    np.testing.assert_allclose(scene.graph[name][0][:3, 3], PLACES["far"], atol=1e-7)
    np.testing.assert_allclose(np.abs(next(iter(scene.geometry.values())).bounds), [[0.03, 0.025, 0.05]] * 2, atol=1e-7)


def test_a_neighbour_may_lie_anywhere_in_its_file_as_well(placed_boxes: dict[str, Path]) -> None:
    spec = SceneSpec(kind="bin", neighbours=[{"object": "box"}])
    block, other = object_from_path("block"), object_from_path(placed_boxes["origin"])
    _, here = scenes_of(spec, block, [other], count=1, seed=0)
    far = object_from_path(placed_boxes["far"])
    scenes, there = scenes_of(spec, block, [far], count=1, seed=0)
    np.testing.assert_array_equal(there["scene/object_pose"], here["scene/object_pose"])
    middle = apply(there["scene/neighbour_pose"][0], np.array(far.centre))
    np.testing.assert_allclose(middle, here["scene/neighbour_pose"][0, :, :3], atol=1e-8)
    (room,) = scenes.centred(block).neighbour_pose
    np.testing.assert_array_equal(room, here["scene/neighbour_pose"][0])
