"""`graspd scene`, `graspd render` and `graspd pictures` on files, without queue or server."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from typer.testing import CliRunner, Result

from service.shards import json_attribute, read_shard, write_shard
from worker.hands.load import hand_from_path
from worker.objects.prepare import object_from_path
from worker.rendering.commands import app as rendering
from worker.scenes.commands import app as scenes

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
    }
    attributes = {
        "hand": "allegro", "hand_digest": hand.digest, "object": "block", "object_digest": obj.digest,
        "method": "none", "fidelity": json_attribute({"face_error_m": 3e-4}), "seed": 5, "batch": 0,
        "joint_names": list(hand.joint_names),
    }  # fmt: skip
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
