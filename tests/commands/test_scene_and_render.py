"""`graspd scene`, `render`, `pictures`, `hands check` and `objects check` on files, without queue or server."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image, ImageSequence
from typer.testing import CliRunner

from graspd.cli import build_app
from graspd.commands import grasp_sheet, render
from graspd.commands.grasp_sheet import AFTER_S, BEFORE_S
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.store.shards import json_attribute, read_shard, write_shard
from graspd.worker.episodes.execution import SHORTEST_S
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.rendering import portraits
from tests.worker.commands_run import graspd, refused
from tests.worker.models import attributes_of, quality_columns

GRASPS = 3
SMALL = "--width 48 --height 36 --device cpu"
PICTURES = "--size 48 --device cpu"


@pytest.fixture(scope="module")
def base(tmp_path_factory) -> Path:
    """A base shard of the built-in hand above the built-in block: the postures are not good grasps, but well-formed."""
    hand, obj = hand_from_path("allegro"), object_from_path("block")
    arrays = quality_columns(GRASPS)
    for name in ("grasp", "pregrasp", "squeeze"):
        arrays[f"{name}/hand_pose"] = np.tile([0.0, 0, 0.25, 1, 0, 0, 0], (GRASPS, 1))
        arrays[f"{name}/joint_positions"] = np.tile(hand.expand(hand.preshape), (GRASPS, 1))
    path = tmp_path_factory.mktemp("shards") / "base.h5"
    path.write_bytes(write_shard("base", arrays, attributes_of(hand, obj)))
    return path


@pytest.fixture(scope="module")
def scene_shard(base) -> Path:
    graspd("scene --scenes 2 -o", base.with_name("scenes.h5"), base)
    return base.with_name("scenes.h5")


def test_each_grasp_is_in_each_scene_and_each_placement_a_stereo_pair(scene_shard):
    shard = read_shard(scene_shard, kind="scene")
    assert shard["scene/object_pose"].shape == (2, 7)
    assert shard["grasp/base_index"].tolist() == [0, 1, 2, 0, 1, 2]
    assert (shard.attributes["object"], shard.attributes["seed"]) == ("block", 5)
    output, page = scene_shard.with_name("views.h5"), scene_shard.with_name("views.png")
    assert graspd(f"render --views 2 --stereo {SMALL} -o", output, "--page", page, scene_shard)["pictures"] == 8
    assert read_shard(output, kind="views")["image/rgb"].shape == (8, 36, 48, 3)
    with Image.open(page) as image:
        assert image.size[1] > 4 * 36


@pytest.fixture(scope="module")
def in_bin(base) -> Path:
    shard = read_shard(base)
    pose = np.asarray(shard["grasp/hand_pose"])
    arrays = dict(shard.arrays) | {
        "scene/object_pose": np.array([[0, 0, 0.04, 1.0, 0, 0, 0]]),
        "scene/rest_probability": np.ones(1),
        "grasp/scene_index": np.zeros(GRASPS, np.int32),
        "grasp/approach": np.repeat(pose[:, None], 2, axis=1),
        "grasp/approach_joint_positions": np.asarray(shard["grasp/joint_positions"]),
        "grasp/lift": pose + np.array([0, 0, 0.1, 0, 0, 0, 0]),
    }
    spec = json_attribute(SceneSpec(kind="bin").model_dump(mode="json"))
    path = base.with_name("bin.h5")
    path.write_bytes(write_shard("base", arrays, shard.attributes | {"scene": spec}))
    return path


def test_render_shows_the_supports_and_the_best_grasp(in_bin):
    output = in_bin.with_name("bin_views.h5")
    graspd(f"render --views 2 {SMALL} -o", output, in_bin)
    views = read_shard(output, kind="views")
    # Walls all around: less of the picture is background than on a table, which ends.
    assert (views["image/segmentation"] == 0).mean() < 0.2
    assert views["camera/hand_grasp"].tolist() == [2, 2]
    assert (views["image/rgb"] != views["image/rgb_hand"]).any()
    assert json.loads(str(views.attributes["scene"]))["kind"] == "bin"
    assert "is a views shard; a scene shard is needed" in refused("render -o", in_bin.with_name("v.h5"), output)


def test_pictures_of_grasps_in_scenes_show_walls_and_whole_way(in_bin):
    for more, columns in ("", 1), ("--trajectory", 4), ("--three-sides --palette", 3):
        output = in_bin.with_name("bin.png")
        graspd(f"pictures -n 1 {PICTURES} {more} -o", output, in_bin)
        with Image.open(output) as image:
            assert image.width > columns * 48 and (image.mode == "P") == ("--palette" in more)


def test_pictures_draw_the_best_first_and_each_posture_of_a_way(base):
    output = base.with_name("way.png")
    for more, columns in ("", 1), ("--trajectory", 3):
        assert graspd(f"pictures -n 2 {PICTURES} {more} -o", output, base)["rows"] == [2, 1]
        with Image.open(output) as image:
            # Two rows of three pictures and their margins, where the way is asked for.
            assert image.width > columns * 48 and (not more or image.height > 2 * 48 + 74)
    refused(f"pictures {PICTURES} --trajectory --three-sides -o", output, base)


def test_a_film_shows_the_way_of_the_grasp_that_is_named(in_bin):
    output, words = in_bin.with_name("lift.webp"), "pictures --device cpu --size 32"
    assert graspd(f"{words} --row 1 --animate -o", output, in_bin)["rows"] == [1]
    with Image.open(output) as film:
        assert (film.format, film.size) == ("WEBP", (32, 24))
        # How long a picture is shown is known once it is read.
        shown = [frame.convert("RGB") and frame.info["duration"] for frame in ImageSequence.Iterator(film)]
        # The lift alone is seen here: pictures that are the same are one, for as long as four motions of the shortest.
        assert len(shown) > 3
        assert sum(shown) >= 1000 * (BEFORE_S + 5 * SHORTEST_S + AFTER_S)
    for more, said in (
        ("--row 1 --animate -o lift.mp4", "an animation is written as .gif, .webp, .png, not as .mp4"),
        ("--row 1 --animate --trajectory", "exclude one another"),
        ("--row 3", "has the rows 0 to 2: there is no row 3"),
    ):
        assert said in refused(f"{words} {more}", in_bin)


def test_a_row_that_is_no_valid_grasp_is_drawn_only_with_all(base):
    shard = read_shard(base)
    failed = base.with_name("failed.h5")
    arrays = dict(shard.arrays) | {"quality/valid": np.array([1, 0, 1], np.uint8)}
    failed.write_bytes(write_shard("base", arrays, shard.attributes))
    words = ("pictures --row 1 --size 32 --device cpu -o", base.with_name("row.png"), failed)
    assert "--all permits every row" in refused(*words)
    assert graspd(*words, "--all")["rows"] == [1]


def test_other_objects_neighbours_and_kinds_are_refused(base):
    output, crowd = base.with_name("none.h5"), base.with_name("crowd_of_mugs.h5")
    said = refused("scene --object mug -o", output, base)
    assert "give the file it was made with as --object" in said and not output.exists()
    graspd("scene --scenes 1 --with mug -o", crowd, base)
    assert "neighbour 'mug' has digest" in refused("render --with bottle -o", output, crowd)
    assert "1 neighbours; give each of them" in refused("render --with mug --with mug -o", output, crowd)
    assert "a scene shard is needed here" in refused("render -o", output, base)


def test_render_writes_the_channels_cameras_and_hand_asked_for(base, scene_shard):
    cameras, output = base.with_name("cameras.json"), base.with_name("more.h5")
    cameras.write_text(
        '{"width": 48, "height": 36, "intrinsics": {"fx": 50, "fy": 50, "cx": 24, "cy": 18},'
        ' "cameras": [{"eye": [0.5, 0, 0.4], "target": [0, 0, 0.05]}]}'
    )
    more = ("--cameras", cameras, "--with-hand", base, "-o", output)
    graspd("render --channels all --device cpu", scene_shard, *more)
    views = read_shard(output, kind="views")
    assert views["image/distance"].shape == (2, 36, 48)
    assert views["image/rgb_hand"].shape == views["image/normals"].shape == (2, 36, 48, 3)
    assert views["box/occlusion_ratio"].tolist() == [0, 0]
    assert views["camera/intrinsics"][0, 0].tolist() == [50, 0, 24]
    # The hand of the base shard is high above the table: its best grasp by epsilon is the last.
    assert read_shard(scene_shard, kind="scene")["grasp/base_index"][views["camera/hand_grasp"]].tolist() == [2, 2]


def test_a_hand_is_drawn_from_the_grasps_of_the_scenes_if_any(base, scene_shard):
    shard, output = read_shard(base), base.with_name("few.h5")
    none, one, scenes = (base.with_name(name) for name in ("none.h5", "one.h5", "scenes_of_none.h5"))
    for count, file in enumerate((none, one)):
        few = {name: column[:count] for name, column in shard.arrays.items() if name != "quality/thresholds_m"}
        file.write_bytes(write_shard("base", {**shard.arrays, **few}, shard.attributes))
    graspd("scene --scenes 1 -o", scenes, none)
    assert graspd(f"render --views 1 {SMALL} --with-hand", none, "-o", output, scenes)["pictures"] == 1
    assert "give the base shard of these scenes" in refused("render -o", output, "--with-hand", one, scene_shard)


def test_neighbours_travel_from_scene_to_labels_of_pictures(base):
    scene, views, folder = (base.with_name(name) for name in ("crowd.h5", "crowd_views.h5", "crowd"))
    graspd("scene --scenes 1 --with mug -o", scene, base)
    graspd("render --views 1 --width 32 --height 24 --device cpu -o", views, scene)
    # Labels, and per picture colour, depth, segmentation and what is known about it.
    assert graspd("export --depth png -o", folder, views)["files"] == 5
    assert json.loads((folder / "labels.json").read_text())["3"] == {"class": "mug"}


def test_hands_of_grasps_in_scenes_are_drawn_with_their_wrists(base: Path):
    shard, wrist = read_shard(base), 0.1 * np.arange(2.0 * GRASPS).reshape(GRASPS, 2)
    at = {"scene/object_pose": np.tile([0.0, 0, 0, 1, 0, 0, 0], (GRASPS, 1)), "grasp/scene_index": np.arange(GRASPS)}
    shard.arrays.update(at | {"grasp/wrist_positions": wrist})
    shard.attributes["scene"] = json_attribute({"kind": "table"})
    around, drawn = grasp_sheet.surroundings_of(shard, np.array([2, 0])), render._drawn_hand(shard, None, None)
    assert np.array_equal(around.wrist, wrist[[2, 0]])
    assert np.array_equal(drawn.wrist, wrist)


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
