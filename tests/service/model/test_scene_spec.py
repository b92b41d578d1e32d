"""What users may say of a scene, and what they are told when it is nonsense."""

import json
from pathlib import Path

import pytest

from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import MAX_FILE_BYTES, SceneSpec, parse_scene, parse_scene_option
from tests.conftest import REPOSITORY

TABLE = {"supports": [{"kind": "half_space"}]}
POSE, NAMES = [0, 0, 0, 1, 0, 0, 0], ("cup.stl", "mug")


def test_a_kind_is_a_scene_and_an_unknown_one_lists_them() -> None:
    for kind in ("free", "table", "bin", "shelf"):
        assert parse_scene(kind) == SceneSpec(kind=kind)
    with pytest.raises(InputError, match="free, table, bin, shelf"):
        parse_scene("garden")
    with pytest.raises(InputError, match="cannot be read"):
        parse_scene("nowhere.yaml")


def test_a_file_says_supports_neighbours_and_the_targets_pose(tmp_path: Path) -> None:
    (tmp_path / "cup.stl").write_bytes(b"")
    supports = [{"kind": "half_space", "normal": [0, 0, 1]}, {"kind": "box", "size": [0.1, 0.2, 0.3]}]
    poses = {"target": [0, 0, 0.1, 1, 0, 0, 0], "neighbours": [{"object": name, "pose": POSE} for name in NAMES]}
    for suffix in (".json", ".yaml"):  # JSON is YAML
        path = tmp_path / f"scene{suffix}"
        path.write_text(json.dumps({"supports": supports} | poses))
        found = parse_scene(str(path))
        assert (found.kind, [s.kind for s in found.supports]) == ("file", ["half_space", "box"])
        assert found.target == (0, 0, 0.1, 1, 0, 0, 0)
        assert [one.object for one in found.neighbours] == [str(tmp_path / "cup.stl"), "mug"]


@pytest.mark.parametrize(
    ("said", "reason"),
    [
        ({}, "supports"),
        ({"supports": [{"kind": "ball"}]}, "supports"),
        ({"supports": [{"kind": "half_space", "normal": [0, 0, 0]}]}, "not zero"),
        ({"supports": [{"kind": "half_space", "offset": 1e9}]}, "offset"),
        ({"supports": [{"kind": "box", "size": [1, 0, 1]}]}, "size"),
        ({"supports": [{"kind": "box", "size": [1, 1, 1], "pose": [0, 0, 0, 0, 0, 0, 0]}]}, "unit length"),
        ({"supports": [{"kind": "box"}] * 33}, "supports"),
        ({**TABLE, "target": [0, 0, 0, 2, 0, 0, 0]}, "unit length"),
        ({**TABLE, "colour": "red"}, "colour"),
        ([1, 2], "one mapping"),
        ({**TABLE, "neighbours": [{"object": "mug", "pose": POSE}] * 9}, "neighbours"),
        ({**TABLE, "neighbours": [{"object": ""}]}, "object"),
        ({**TABLE, "neighbours": [{"object": "mug", "pose": [0, 0, 0, 2, 0, 0, 0]}]}, "unit length"),
        ({**TABLE, "neighbours": [{"object": "mug"}, {"object": "mug", "pose": POSE}]}, "neighbours a pose, or none"),
        ({**TABLE, "touch": -3}, "touch: must be at least -1"),
        ({**TABLE, "kind": "table"}, "has its own supports"),
        ({"kind": "table", "neighbours": [{"object": "mug", "pose": POSE}]}, "poses need a scene file"),
    ],
)
def test_nonsense_in_a_file_is_told_in_one_line(tmp_path: Path, said: object, reason: str) -> None:
    path = tmp_path / "scene.json"
    path.write_text(json.dumps(said))
    with pytest.raises(InputError) as error:
        parse_scene(str(path))
    text = str(error.value)
    assert "scene.json" in text and reason in text and "\n" not in text


@pytest.mark.parametrize(
    ("data", "named"),
    [
        *((data, "scene file") for data in (b"{", b"\xff\xfe", b"[" * 20_000, b"a: &x [*x, *x]\n")),
        (b" " * (MAX_FILE_BYTES + 1), "is larger than"),
    ],
)
@pytest.mark.parametrize("suffix", [".json", ".yaml"])
def test_a_file_that_is_none_is_refused(tmp_path: Path, data: bytes, named: str, suffix: str) -> None:
    path = tmp_path / f"scene{suffix}"
    path.write_bytes(data)
    with pytest.raises(InputError, match=named):
        parse_scene(str(path))


def test_how_near_fingertips_come_is_said_by_the_file_or_over_it(tmp_path: Path) -> None:
    path = tmp_path / "scene.yaml"
    path.write_text("supports: [{kind: half_space}]\ntouch: -0.5\n")
    assert (parse_scene(str(path)).touch, parse_scene(str(path), touch=1.0).touch) == (-0.5, 1.0)
    assert parse_scene_option(str(path))["touch"] == -0.5


def test_a_free_object_has_no_faces_to_choose() -> None:
    with pytest.raises(InputError, match="free"):
        parse_scene("free", faces="all")


def test_the_example_scenes_are_scenes():
    found = [parse_scene(str(path)) for path in (REPOSITORY / "examples" / "scenes").glob("*.yaml")]
    assert found and all(spec.kind == "file" for spec in found)
