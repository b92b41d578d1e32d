"""The results of an object do not depend on where the origin of its mesh lies."""

import io
from pathlib import Path

import numpy as np
import pytest
import trimesh

from graspd.exchange.inputs import load_case
from graspd.service.model.domain import JobOptions
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.scene_spec import SceneSpec, parse_scene
from graspd.service.model.transforms import apply
from graspd.service.store.shards import read_shard, write_shard
from graspd.studies.evaluation import evaluate
from graspd.worker.files.synthesis import SynthesisResult, synthesize_grasps
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.rendering.pictures import grasp_pictures
from graspd.worker.scenes.placement import scenes_of
from graspd.worker.stages.models import object_glb
from tests.worker.commands_run import graspd

#: The far one is a place in UTM coordinates.
PLACES = {"origin": (0.0, 0.0, 0.0), "far": (500_000.0, 4_500_000.0, 300.0)}
SCENES = pytest.mark.parametrize("scene", ["free", "table"])
REQUEST = JobOptions(grasps=2, want="candidates", rechecks=0, fidelity=FIDELITIES["draft"], seed=1)
ROUNDING_M = 1e-6  # of positions in the frame of the file [m]


@pytest.fixture(scope="module")
def boxes(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    folder, box = tmp_path_factory.mktemp("boxes"), trimesh.creation.box((0.06, 0.05, 0.1))
    found = {name: folder / name / "box.obj" for name in PLACES}
    for name, path in found.items():
        path.parent.mkdir()
        trimesh.Trimesh(box.vertices + PLACES[name], box.faces, process=False).export(path, digits=6)
    return found


@pytest.fixture(scope="module")
def made(boxes: dict[str, Path]) -> dict[tuple[str, str], SynthesisResult]:
    def one(place: str, scene: str) -> SynthesisResult:
        where = SceneSpec() if scene == "free" else parse_scene(scene, faces="drawn", touch=None, beside=[])
        return synthesize_grasps("barrett", str(boxes[place]), REQUEST, place=where, scenes=1, device="cpu", threads=1)

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


def test_pictures_are_the_same(made, boxes: dict[str, Path], tmp_path: Path) -> None:
    seen = []
    for at in ("origin", "far"):
        hand = load_case(file_of(made[at, "free"], tmp_path / f"{at}.h5")).hand
        pose, joints = (made[at, "free"].arrays[f"grasp/{name}"][:1] for name in ("hand_pose", "joint_positions"))
        seen.append(grasp_pictures(hand, object_from_path(boxes[at]), pose, joints, (48, 48), samples=2))
    np.testing.assert_array_equal(*seen)


def test_views_of_scenes_are_the_same(made, tmp_path: Path) -> None:
    seen = []
    for at in ("origin", "far"):
        shard, views = file_of(made[at, "table"], tmp_path / f"{at}.h5"), tmp_path / f"{at}-views.h5"
        graspd("render --views 1 --width 48 --height 36 --device cpu -o", views, shard)
        seen.append(read_shard(views, kind="views").arrays)
    for name in seen[0]:
        np.testing.assert_array_equal(seen[1][name], seen[0][name], err_msg=name)


def test_a_model_stands_where_its_file_says(boxes: dict[str, Path]) -> None:
    scene = trimesh.load(io.BytesIO(object_glb(object_from_path(boxes["far"]))), file_type="glb")
    (name,) = scene.graph.nodes_geometry
    np.testing.assert_allclose(scene.graph[name][0][:3, 3], PLACES["far"], atol=1e-7)
    np.testing.assert_allclose(np.abs(next(iter(scene.geometry.values())).bounds), [[0.03, 0.025, 0.05]] * 2, atol=1e-7)


def test_a_neighbour_may_lie_anywhere_in_its_file_as_well(boxes: dict[str, Path]) -> None:
    spec = SceneSpec(kind="bin", neighbours=[{"object": "box"}])
    block, other = object_from_path("block"), object_from_path(boxes["origin"])
    _, here = scenes_of(spec, block, [other], count=1, seed=0)
    far = object_from_path(boxes["far"])
    scenes, there = scenes_of(spec, block, [far], count=1, seed=0)
    np.testing.assert_array_equal(there["scene/object_pose"], here["scene/object_pose"])
    middle = apply(there["scene/neighbour_pose"][0], np.array(far.centre))
    np.testing.assert_allclose(middle, here["scene/neighbour_pose"][0, :, :3], atol=1e-8)
    (room,) = scenes.centred(block).neighbour_pose
    np.testing.assert_array_equal(room, here["scene/neighbour_pose"][0])
