"""Specs of datasets in files, and options over them: what they say, and what is wrong with them."""

import json
from pathlib import Path
from typing import Any

import pytest

from graspd.client.dataset_commands import DatasetPlan, dataset_plan, read_spec
from graspd.service.command_options import parse_pairs
from graspd.service.model.errors import InputError
from graspd.service.pipeline.datasets.spec import MAX_CELLS

ROOT = Path(__file__).resolve().parents[3]
TOML = """
name = "kitchen"
hands = ["allegro", "barrett"]
objects = ["mug", "block"]
total_grasps = 1000
scenes = 2
stereo = true
fidelity = "draft"
"""


def spec(folder: Path, text: str, name: str = "kitchen.toml") -> Path:
    (folder / name).write_text(text)
    return folder / name


def asked(file: Path | None, *, hands: str | None = None, objects: str | None = None, **options: Any) -> DatasetPlan:
    return dataset_plan(file, name=None, hands=hands, objects=objects, options=options)


def test_a_spec_says_it_all_in_toml_and_in_json(tmp_path: Path) -> None:
    found = asked(spec(tmp_path, TOML))
    assert (found.name, found.hands, found.objects) == ("kitchen", "allegro,barrett", "mug,block")
    assert found.options == {"scenes": 2, "stereo": True, "fidelity": "draft"}
    assert found.matrix_per_cell({"hands": ["a", "b"]}, 3)["grasps"] == 167  # a sixth of 1000, rounded up
    text = json.dumps({"hands": ["allegro"], "objects": ["mug"], "grasps": 7, "options": {"steps": 20}})
    found = asked(spec(tmp_path, text, "kitchen.json"))
    assert found.options == {"grasps": 7, "options": {"steps": 20}} and found.total is None


def test_an_option_goes_before_the_spec(tmp_path: Path) -> None:
    found = asked(spec(tmp_path, TOML), hands="shadow", fidelity="fine", grasps=5, options=["steps=3"])
    assert (found.hands, found.objects) == ("shadow", "mug,block")
    assert found.options["fidelity"] == "fine" and found.options["options"] == {"steps": 3}
    assert found.total is None and found.options["grasps"] == 5


def test_a_folder_of_objects_lies_beside_the_spec(tmp_path: Path) -> None:
    (tmp_path / "meshes").mkdir()
    assert Path(asked(spec(tmp_path, 'hands = ["allegro"]\nobjects = "./meshes"')).objects) == tmp_path / "meshes"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("hands = [", "is no TOML"),
        ('hands = ["allegro"]\ncolour = 1', "colour"),
        ('hands = ["allegro"]\ngrasps = 0', "grasps"),
        ("grasps = 3\ntotal_grasps = 4", "give one of them"),
        ('hands = ["allegro"]', "give the objects"),
        ('objects = ["mug"]', "give the hands"),
        ("[1]", "must contain the keys of a dataset"),
    ],
)
def test_a_spec_that_cannot_be_used_says_what_is_wrong(tmp_path: Path, text: str, words: str) -> None:
    with pytest.raises(InputError, match=words):
        asked(spec(tmp_path, text, "k.json" if text == "[1]" else "k.toml"))
    with pytest.raises(InputError, match=r"none\.toml cannot be read"):
        read_spec(tmp_path / "none.toml")


@pytest.mark.parametrize(
    ("text", "value"), [("20", 20), ("-3", -3), ("0.5", 0.5), ("007", "007"), ("nan", "nan"), ("", ""), ("a=b", "a=b")]
)
def test_what_is_written_as_a_number_is_one(text: str, value: object) -> None:
    """`--option keep=20` is the job that `{"keep": 20}` is over HTTP: a string would be another."""
    found = parse_pairs([f"keep={text}"])
    assert found == {"keep": value} and type(found["keep"]) is type(value)
    with pytest.raises(InputError, match="name=value"):
        parse_pairs(["keep"])


def test_the_million_of_the_examples_is_a_spec() -> None:
    found = asked(ROOT / "examples" / "million" / "million.toml", objects="mug,block")
    hands = found.hands.split(",")
    assert found.total == 1_000_000 and len(hands) == 3
    assert found.matrix_per_cell({"hands": hands}, 100)["grasps"] * 3 * 100 >= 1_000_000
    assert len(hands) * 10_000 < MAX_CELLS


def test_a_scene_is_a_kind_or_a_file_beside_the_spec(tmp_path: Path) -> None:
    (tmp_path / "shelf.yaml").write_text("supports: [{kind: half_space}]\n")
    text = 'hands = ["allegro"]\nobjects = ["mug"]\nscene = '
    assert asked(spec(tmp_path, text + '"table"')).options["scene"] == "table"
    inline = {"supports": [{"kind": "half_space", "normal": [0, 0, 1], "offset": 0}]}
    assert asked(spec(tmp_path, text + '"shelf.yaml"')).options["scene"] == inline
    assert asked(spec(tmp_path, text + '"table"'), scene="bin").options["scene"] == "bin"
    with pytest.raises(InputError, match="unknown scene 'moon'"):
        asked(spec(tmp_path, text + '"moon"'))


def test_neighbours_are_named_in_spec_option_and_scene_file(tmp_path: Path) -> None:
    text = 'hands = ["allegro"]\nobjects = ["mug"]\nscene = "table"\n'
    told = asked(spec(tmp_path, text + 'neighbours = ["block", "bottle"]')).options["neighbours"]
    assert [one["object"] for one in told] == ["block", "bottle"]
    assert asked(spec(tmp_path, text), neighbours=["mug"]).options["neighbours"] == ["mug"]
    (tmp_path / "shelf.yaml").write_text("supports: [{kind: half_space}]\nneighbours: [{object: block}]\n")
    document = asked(spec(tmp_path, text.replace("table", "shelf.yaml"))).options["scene"]
    assert [one["object"] for one in document["neighbours"]] == ["block"]
    words, part = "parts/bracket.stl is a file: run `graspd objects add parts/bracket.stl` first", "parts/bracket.stl"
    for file, options in ((text + f'neighbours = ["{part}"]', {}), (text, {"neighbours": [part]})):
        with pytest.raises(InputError, match=words):
            asked(spec(tmp_path, file), **options)
