"""Files of readers of the docs, for `docs/commands.py`: hands, meshes, shards, scenes, datasets."""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Mapping
from functools import cache
from pathlib import Path
from typing import Any, Final

from graspd.service.model.states import AssetKind
from graspd.service.store.assets import builtin_files

_PROGRAM: Final = (sys.executable, "-m", "graspd")
REPOSITORY: Final = Path(__file__).resolve().parent.parent
#: Output -> commands that make it. The demo uses Shadow, because its free grasps clear the table more often.
_MADE: Final = {
    "demo-out": ("demo --out demo-out --hand shadow --object mug -n 8 --fidelity draft --scenes 4 --views 1",),
    "grasps.h5": ("synth --hand allegro --object mug -n 8 --fidelity draft -o grasps.h5",),
    "shards/block.h5": (
        "synth --hand barrett --object block --scene table -n 8 --fidelity draft -o shards/block.h5",
        "render shards/block.h5 --views 2 -o shards/block-views.h5",
    ),
}
#: Function that runs a graspd command for the files of a page.
Graspd = Callable[..., None]


def files_for(page: Path, folder: Path, data: Path, environment: Mapping[str, str]) -> None:
    """Make the files that commands of a page read but do not make; `data` is the folder of the service."""

    def graspd(*words: str) -> None:
        subprocess.run([*_PROGRAM, *words], cwd=folder, env=dict(environment), check=True, capture_output=True)

    text = page.read_text()
    _meshes(folder)
    _hands(folder)
    for name in ("benchmarks", "examples", "tests"):
        (folder / name).symlink_to(REPOSITORY / name)
    (folder / "graspd-data").symlink_to(data)
    shutil.copytree(
        REPOSITORY / "docs" / "results", folder / "docs" / "results", ignore=shutil.ignore_patterns("*.png", "*.jpg")
    )
    if re.search(r"^ *graspd .*demo-out", text, re.MULTILINE):
        shutil.copytree(_made("demo-out").name, folder, dirs_exist_ok=True)
    if re.search(r"^ *graspd .*(grasps\.h5|shards\b|views\.h5)", text, re.MULTILINE):
        shutil.copytree(_made("grasps.h5", "shards/block.h5").name, folder, dirs_exist_ok=True)
        shutil.copy(folder / "shards" / "block-views.h5", folder / "views.h5")
        if "mkdir shards" in text:
            shutil.rmtree(folder / "shards")
    for name in ("kitchen", "million", "tables"):
        if re.search(rf"^graspd datasets (status|snapshot|card) {name}", text, re.MULTILINE):
            _dataset(name, graspd)
    _OF_PAGE.get(page.name, lambda *_: None)(text, folder, graspd)


def _meshes(folder: Path) -> None:
    """Make meshes in metres and millimetres, an open mesh, overlapping components, and a folder of meshes."""
    import trimesh

    for name in ("mug", "bottle", "block"):
        files = (REPOSITORY / "service" / "builtin" / "objects" / name).rglob("*")
        mesh = trimesh.load(next(file for file in files if file.suffix in {".stl", ".obj", ".ply"}), force="mesh")
        mesh.export(folder / f"{name}.stl")
    shutil.copy(folder / "mug.stl", folder / "my_mug.stl")
    (folder / "ycb").mkdir()
    shutil.copy(folder / "mug.stl", folder / "ycb" / "025_mug.stl")
    shutil.copy(folder / "bottle.stl", folder / "ycb" / "006_mustard_bottle.stl")
    (folder / "my-objects").symlink_to("ycb")
    _write_usd(folder / "mug.usda", trimesh.load_mesh(folder / "mug.stl"))
    mesh.export(folder / "koala.obj")
    mesh.copy().apply_scale(1000).export(folder / "banana.stl")
    trimesh.creation.box((0.12, 0.07, 0.015)).export(folder / "scissors.stl")
    trimesh.creation.box((0.05, 0.04, 0.03)).export(folder / "bracket.stl")
    box = trimesh.creation.box((0.06, 0.06, 0.06))
    trimesh.util.concatenate([box, box.copy().apply_translation((0.03, 0, 0))]).export(folder / "overlap.stl")
    box.update_faces(box.face_normals[:, 2] < 0.5)
    box.export(folder / "bowl.stl")


def _write_usd(path: Path, mesh: Any) -> None:
    points, corners = (", ".join(map(str, part)) for part in (map(tuple, mesh.vertices.tolist()), mesh.faces.ravel()))
    counts = ", ".join(["3"] * len(mesh.faces))
    path.write_text(
        f'#usda 1.0\n(defaultPrim = "Mug"\nmetersPerUnit = 1\n)\ndef Mesh "Mug" {{\npoint3f[] points = [{points}]\n'
        f"int[] faceVertexCounts = [{counts}]\nint[] faceVertexIndices = [{corners}]\n}}\n"
    )


def _hands(folder: Path) -> None:
    from tests.exchange.robots.arms import write_arm
    from tests.worker.hands.my_hand import write_all

    write_all(folder)
    shutil.copy(folder / "my_hand" / "my_hand.urdf", folder / "my_hand.urdf")
    write_arm(folder).rename(folder / "arm.urdf")


@cache
def _made(*names: str) -> tempfile.TemporaryDirectory[str]:
    place = tempfile.TemporaryDirectory()
    alone = {name: value for name, value in os.environ.items() if not name.startswith("GRASPD_")}
    for name in names:
        (Path(place.name) / name).parent.mkdir(exist_ok=True)
        for line in _MADE[name]:
            subprocess.run([*_PROGRAM, *line.split()], cwd=place.name, env=alone, check=True, capture_output=True)
    return place


def _dataset(name: str, graspd: Graspd) -> None:
    few = ("--hands", "barrett", "--objects", "mug,block", "--grasps", "16", "--fidelity", "draft")
    graspd("datasets", "create", name, *few, "--scene", "table", "--views", "1", "--yes", "--wait")


def _for_datasets(text: str, folder: Path, graspd: Graspd) -> None:
    """Make the printed files, the reader's hand, and a second version of the export."""
    graspd("hands", "add", "my_hand/my_hand.urdf", "--no-self-test")
    (folder / "kitchen.toml").write_text(_printed(text, "```toml\nname"))
    (folder / "assets.json").write_text(_printed(text, '```json\n{"objects"'))
    (folder / "kitchen-v2").symlink_to("kitchen-v1")


def _for_million(text: str, folder: Path, graspd: Graspd) -> None:
    """Make the file of sources and licences of objects in datasets.md, and that of the pilot."""
    del text, graspd
    datasets = (REPOSITORY / "docs" / "how-to" / "datasets.md").read_text()
    (folder / "assets.json").write_text(_printed(datasets, '```json\n{"objects"'))
    # The original file lists objects that the small dataset lacks, and would be refused.
    (folder / "docs" / "results" / "pilot" / "assets.json").write_text('{"objects": {"*": {"licence": "CC-BY-4.0"}}}')


def _printed(text: str, begin: str) -> str:
    return text[text.index(begin) :].partition("\n")[2].partition("```")[0]


def _for_scaling(text: str, folder: Path, graspd: Graspd) -> None:
    del text, folder
    few = ("--hand", "barrett", "--object", "block", "--grasps", "8", "--fidelity", "draft")
    graspd("submit", *few, "--scenes", "1", "--views", "1", "--wait")


def _for_planners(text: str, folder: Path, graspd: Graspd) -> None:
    """Make a network with random weights, and a folder of maps of scenes."""
    del text, graspd
    from graspd.baselines.learned.network import save
    from graspd.worker.hands.load import hand_from_path
    from tests.networks import random_network

    hand = hand_from_path("barrett")
    save(random_network(hand.joint_names, hand=hand.name, digest=hand.digest), folder / "barrett.npz")
    shutil.copytree(folder / "docs" / "results" / "scenes-stability", folder / "scenes")


def _for_quality(text: str, folder: Path, graspd: Graspd) -> None:
    """Export the shard in DexGraspBench's layout; copy the hand and the mesh."""
    import trimesh

    del text
    graspd("export", "grasps.h5", "--format", "dexgraspbench", "-o", "benchmark")
    (folder / "folder").symlink_to("benchmark/output/graspd_graspd_allegro")
    files = builtin_files(AssetKind.HAND, "allegro")
    (folder / "hand.urdf").write_bytes(files["allegro.urdf"])
    (folder / "other").mkdir()
    (folder / "other" / "hand.xml").write_bytes(files["allegro.urdf"])
    trimesh.load(folder / "mug.stl").export(folder / "mesh.obj")


def _for_scenes(text: str, folder: Path, graspd: Graspd) -> None:
    """Make a shard planned in a scene, and the first scene file of the page."""
    few = ("--fidelity", "draft", "-n", "4", "-o", "folder/block.h5")
    (folder / "folder").mkdir()
    graspd("synth", "--hand", "barrett", "--object", "block", "--scene", "table", *few)
    (folder / "shelf.yaml").write_text(text.partition("```yaml\n")[2].partition("```")[0])


_OF_PAGE: Final[dict[str, Callable[[str, Path, Graspd], None]]] = {
    "datasets.md": _for_datasets,
    "million.md": _for_million,
    "planners.md": _for_planners,
    "quality.md": _for_quality,
    "scaling.md": _for_scaling,
    "scenes.md": _for_scenes,
}
