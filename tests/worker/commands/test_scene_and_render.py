"""`graspd scene`, `graspd render` and `graspd pictures` on files, without queue or server."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageSequence
from typer.testing import CliRunner, Result

from service.model.scene_spec import SceneSpec
from service.store.shards import json_attribute, read_shard, write_shard
from worker.commands import grasp_sheet, render
from worker.commands.exchange import app as exchange
from worker.commands.grasp_sheet import AFTER_S, BEFORE_S
from worker.commands.render import app as rendering
from worker.commands.scene import app as scenes
from worker.hands.load import hand_from_path
from worker.objects.prepare import object_from_path
from worker.robots.execution import SHORTEST_S

GRASPS = 3


@pytest.fixture(scope="module")
def base(tmp_path_factory) -> Path:
    """A base shard of the built-in hand above the built-in block: the postures are not good grasps, but well-formed."""
    hand, obj = hand_from_path("allegro"), object_from_path("block")
    joints = np.tile(hand.expand(hand.preshape), (GRASPS, 1))
    pose = np.tile([0.0, 0, 0.25, 1, 0, 0, 0], (GRASPS, 1))
    arrays = {
        f"{name}/{what}": value
        for name in ("grasp", "pregrasp", "squeeze")
        for what, value in (("hand_pose", pose), ("joint_positions", joints))
    }
    per_grasp = np.linspace(0.1, 0.3, GRASPS)
    arrays |= {
        f"quality/{name}": np.repeat(per_grasp[:, None], 2, axis=1)
        for name in ("contact_area_cm2", "epsilon", "wrench_volume")
    }
    arrays |= {
        f"quality/{name}": per_grasp
        for name in ("intersection_volume_cm3", "penetration_depth_mm", "self_penetration_depth_mm", "stability_loss")
    }
    arrays |= {
        "quality/thresholds_m": np.array([0.002, 0.005]),
        "quality/contact_links": np.full(GRASPS, 4),
        "quality/valid": np.ones(GRASPS, np.uint8),
        "quality/success": np.ones(GRASPS, np.int8),
    }
    attributes = {
        "hand": "allegro",
        "hand_digest": hand.digest,
        "object": "block",
        "object_digest": obj.digest,
        "method": "none",
        "fidelity": json_attribute({"face_error_m": 3e-4}),
        "seed": 5,
        "batch": 0,
        "joint_names": list(hand.joint_names),
    }
    path = tmp_path_factory.mktemp("shards") / "base.h5"
    path.write_bytes(write_shard("base", arrays, attributes))
    return path


@pytest.fixture(scope="module")
def scene_shard(base) -> Path:
    path = base.with_name("scenes.h5")
    result = CliRunner().invoke(scenes, [str(base), "--scenes", "2", "-o", str(path), "--json"])
    assert result.exit_code == 0, result.output
    return path


def last_line(result: Result) -> dict[str, object]:
    return json.loads(result.stdout.splitlines()[-1])


def test_scene_writes_every_grasp_in_every_scene(scene_shard):
    shard = read_shard(scene_shard, kind="scene")
    assert shard["scene/object_pose"].shape == (2, 7)
    assert shard["grasp/base_index"].tolist() == [0, 1, 2, 0, 1, 2]
    assert shard.attributes["object"] == "block"
    assert shard.attributes["seed"] == 5


def test_render_makes_a_stereo_pair_per_placement_and_a_page(scene_shard):
    output, page = scene_shard.with_name("views.h5"), scene_shard.with_name("views.png")
    arguments = ["render", str(scene_shard), "--views", "2", "--stereo", "--width", "48", "--height", "36"]
    result = CliRunner().invoke(
        rendering, [*arguments, "--device", "cpu", "-o", str(output), "--page", str(page), "--json"]
    )
    assert result.exit_code == 0, result.output
    assert last_line(result)["pictures"] == 8
    assert read_shard(output, kind="views")["image/rgb"].shape == (8, 36, 48, 3)
    with Image.open(page) as image:
        assert image.size[1] > 4 * 36


def test_pictures_draws_the_best_first(base):
    output = base.with_name("sheet.png")
    arguments = ["pictures", str(base), "-n", "2", "--size", "48", "--device", "cpu", "-o", str(output), "--json"]
    result = CliRunner().invoke(rendering, arguments)
    assert result.exit_code == 0, result.output
    assert last_line(result)["rows"] == [2, 1]
    with Image.open(output) as image:
        assert image.format == "PNG"


@pytest.fixture(scope="module")
def in_bin(base) -> Path:
    """The same grasps as if they had been planned in a bin, in one scene, with their way."""
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
    arguments = ["render", str(in_bin), "--views", "2", "--width", "48", "--height", "36", "--device", "cpu"]
    result = CliRunner().invoke(rendering, [*arguments, "-o", str(output)])
    assert result.exit_code == 0, result.output
    views = read_shard(output, kind="views")
    # Walls all around: less of the picture is background than on a table, which ends.
    assert (views["image/segmentation"] == 0).mean() < 0.2
    assert views["camera/hand_grasp"].tolist() == [2, 2]
    assert (views["image/rgb"] != views["image/rgb_hand"]).any()
    assert json.loads(str(views.attributes["scene"]))["kind"] == "bin"


def test_pictures_of_grasps_in_scenes_show_walls_and_whole_way(in_bin):
    for more, columns in ([], 1), (["--way"], 4), (["--three-sides", "--palette"], 3):
        output = in_bin.with_name("bin.png")
        arguments = ["pictures", str(in_bin), "-n", "1", "--size", "48", "--device", "cpu", "-o", str(output), *more]
        result = CliRunner().invoke(rendering, arguments)
        assert result.exit_code == 0, result.output
        with Image.open(output) as image:
            assert image.width > columns * 48
            assert (image.mode == "P") == ("--palette" in more)


def test_pictures_of_a_way_show_each_posture_of_a_free_grasp(base):
    output = base.with_name("way.png")
    arguments = ["pictures", str(base), "-n", "2", "--size", "48", "--device", "cpu", "-o", str(output), "--json"]
    alone, ways = (CliRunner().invoke(rendering, [*arguments, *more]) for more in ([], ["--way"]))
    assert alone.exit_code == ways.exit_code == 0, ways.output
    assert last_line(ways)["rows"] == [2, 1]
    with Image.open(output) as image:
        # Two rows of three pictures and their margins.
        assert image.width > 3 * 48 and image.height > 2 * 48 + 74
    assert CliRunner().invoke(rendering, [*arguments, "--way", "--three-sides"]).exit_code == 2


def test_a_film_shows_the_way_of_the_grasp_that_is_named(in_bin):
    output = in_bin.with_name("lift.webp")
    arguments = ["pictures", str(in_bin), "--device", "cpu", "--json", "--size", "32", "--row", "1"]
    result = CliRunner().invoke(rendering, [*arguments, "--animate", "-o", str(output)])
    assert result.exit_code == 0, result.output
    assert last_line(result)["rows"] == [1]
    with Image.open(output) as film:
        assert (film.format, film.size) == ("WEBP", (32, 24))
        # How long a picture is shown is known once it is read.
        shown = [frame.convert("RGB") and frame.info["duration"] for frame in ImageSequence.Iterator(film)]
        # The lift alone is seen here: pictures that are the same are one, for as long as four motions of the shortest.
        assert len(shown) > 3
        assert sum(shown) >= 1000 * (BEFORE_S + 5 * SHORTEST_S + AFTER_S)
    for more, said in (
        (["--animate", "-o", "lift.mp4"], "an animation is written as .gif, .webp, .png, not as .mp4"),
        (["--animate", "--way"], "exclude one another"),
        (["--row", "3"], "has the rows 0 to 2: there is no row 3"),
    ):
        refused = CliRunner().invoke(rendering, [*arguments, *more])
        assert refused.exit_code == 2 and said in " ".join(refused.output.split()), refused.output


def test_a_row_that_is_no_valid_grasp_is_drawn_only_with_all(base):
    shard = read_shard(base)
    failed = base.with_name("failed.h5")
    arrays = dict(shard.arrays) | {"quality/valid": np.array([1, 0, 1], np.uint8)}
    failed.write_bytes(write_shard("base", arrays, shard.attributes))
    arguments = ["pictures", str(failed), "--row", "1", "--size", "32", "--device", "cpu"]
    arguments += ["-o", str(base.with_name("row.png")), "--json"]
    refused = CliRunner().invoke(rendering, arguments)
    assert refused.exit_code == 2 and "--all takes any" in refused.output
    assert last_line(CliRunner().invoke(rendering, [*arguments, "--all"]))["rows"] == [1]


def test_another_object_than_the_shards_is_refused(base):
    output = base.with_name("other.h5")
    result = CliRunner().invoke(scenes, [str(base), "--object", "mug", "-o", str(output)])
    assert result.exit_code == 2
    assert "give the file it was made with as --object" in result.output
    assert not output.exists()


def test_a_shard_of_another_kind_is_refused(base):
    result = CliRunner().invoke(rendering, ["render", str(base), "-o", str(base.with_name("none.h5"))])
    assert result.exit_code == 2
    assert "a scene shard is needed here" in result.output


def test_render_writes_the_channels_cameras_and_hand_asked_for(base, scene_shard):
    cameras, output = base.with_name("cameras.json"), base.with_name("more.h5")
    cameras.write_text(
        '{"width": 48, "height": 36, "intrinsics": {"fx": 50, "fy": 50, "cx": 24, "cy": 18},'
        ' "cameras": [{"eye": [0.5, 0, 0.4], "target": [0, 0, 0.05]}]}'
    )
    arguments = ["render", str(scene_shard), "--channels", "all", "--cameras", str(cameras), "--with-hand", str(base)]
    result = CliRunner().invoke(rendering, [*arguments, "--device", "cpu", "-o", str(output), "--json"])
    assert result.exit_code == 0, result.output
    views = read_shard(output, kind="views")
    assert views["image/distance"].shape == (2, 36, 48)
    assert views["image/rgb_hand"].shape == views["image/normals"].shape == (2, 36, 48, 3)
    assert views["box/occlusion_ratio"].tolist() == [0, 0]
    assert views["camera/intrinsics"][0, 0].tolist() == [50, 0, 24]
    # The hand of the base shard is high above the table: its best grasp by epsilon is the last.
    kept = read_shard(scene_shard, kind="scene")["grasp/base_index"][views["camera/hand_grasp"]]
    assert kept.tolist() == [2, 2]


def test_three_sides_of_a_grasp_take_fewer_rays_than_a_picture(base, monkeypatch):
    traced = []

    def count(hand, obj, pose, joints, size, sides, *, samples, **options):
        traced.append(len(sides) * size[0] * size[1] * samples)
        return np.zeros((len(pose), len(sides), size[1], size[0], 3), np.uint8)

    monkeypatch.setattr(grasp_sheet, "grasp_pictures", count)
    for arguments in ([], ["--three-sides"], ["--three-sides", "--size", "300"]):
        output = str(base.with_name("sheet.png"))
        assert CliRunner().invoke(rendering, ["pictures", str(base), "-o", output, *arguments]).exit_code == 0
    assert traced[1] < 0.6 * traced[0] and traced[2] == 2 * traced[0]


def test_neighbours_travel_from_scene_to_labels_of_pictures(base):
    scene, views, folder = (base.with_name(name) for name in ("crowd.h5", "crowd_views.h5", "crowd"))
    result = CliRunner().invoke(scenes, [str(base), "--scenes", "1", "--with", "mug", "-o", str(scene)])
    assert result.exit_code == 0, result.output
    arguments = ["render", str(scene), "--views", "1", "--width", "32", "--height", "24", "--device", "cpu"]
    result = CliRunner().invoke(rendering, [*arguments, "-o", str(views)])
    assert result.exit_code == 0, result.output
    result = CliRunner().invoke(exchange, ["export", str(views), "--depth", "png", "-o", str(folder), "--json"])
    assert result.exit_code == 0, result.output
    # Labels, and per picture colour, depth, segmentation and what is known about it.
    assert last_line(result)["files"] == 5
    assert json.loads((folder / "labels.json").read_text())["3"] == {"class": "mug"}


def test_another_neighbour_than_the_shards_is_refused(base):
    scene = base.with_name("crowd_of_mugs.h5")
    assert CliRunner().invoke(scenes, [str(base), "--scenes", "1", "--with", "mug", "-o", str(scene)]).exit_code == 0
    arguments = ["render", str(scene), "--with", "bottle", "-o", str(base.with_name("none.h5"))]
    result = CliRunner().invoke(rendering, arguments)
    assert result.exit_code == 2
    assert "neighbour 'mug' has digest" in result.output


def test_hands_of_grasps_in_scenes_are_drawn_with_their_wrists(base: Path):
    shard, wrist = read_shard(base), 0.1 * np.arange(2.0 * GRASPS).reshape(GRASPS, 2)
    shard.arrays.update(
        {
            "scene/object_pose": np.tile([0.0, 0, 0, 1, 0, 0, 0], (GRASPS, 1)),
            "grasp/scene_index": np.arange(GRASPS),
            "grasp/wrist_positions": wrist,
        }
    )
    shard.attributes["scene"] = json_attribute({"kind": "table"})
    around, drawn = grasp_sheet.around_of(shard, np.array([2, 0])), render._drawn_in(shard, None)
    assert np.array_equal(around.wrist, wrist[[2, 0]])
    assert drawn is not None
    assert np.array_equal(drawn.wrist, wrist)
