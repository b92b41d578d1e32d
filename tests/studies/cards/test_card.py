"""A card as a whole: its files agree with the shards, with each other, and wherever the shards lie."""

from __future__ import annotations

import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
import yaml
from typer.testing import CliRunner

from graspd.commands.exchange import app
from graspd.service.model.errors import InputError, NotFoundError
from graspd.studies.cards.card import write_card
from graspd.studies.cards.contents import contents_of_folder, contents_of_store, with_provenance
from graspd.studies.cards.findings import _qualities
from tests.studies.cards.conftest import Case, case
from tests.studies.cards.makers import HANDS, OBJECTS, dataset


def test_the_head_of_the_page_is_yaml_that_says_licence_and_size(kitchen: Case) -> None:
    head = yaml.safe_load(kitchen.page.split("---")[1])
    assert head["pretty_name"] == "kitchen" and head["license"] == "cc-by-4.0"
    assert head["size_categories"] == ["n<1K"] and set(HANDS) < set(head["tags"])


def test_every_link_and_picture_of_the_page_is_there(kitchen: Case) -> None:
    targets = re.findall(r"\]\(([^)]+)\)", kitchen.page)
    assert {name for name in targets if name.endswith((".png", ".jpg"))} == set(kitchen.card["plots"])
    assert [target for target in targets if not (kitchen.folder / target).is_file()] == []


def test_the_plots_of_a_dataset_with_scenes_are_all_there(kitchen: Case) -> None:
    names = {"yield.png", "quality.png", "directions.png", "table.png", "joints.png", "sizes.png", "samples.jpg"}
    assert names <= set(kitchen.card["plots"])


def test_the_checksums_are_those_of_an_export(kitchen: Case, export: Path, tmp_path: Path) -> None:
    folder = tmp_path / "kitchen"
    shutil.copytree(export, folder)
    shutil.copy(kitchen.folder / "checksums.sha256", folder)
    command = ["sha256sum", "-c", "--strict", "checksums.sha256"]
    assert subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode == 0
    shard = next(folder.rglob("base-*.h5"))
    shard.write_bytes(shard.read_bytes()[:-1] + b"?")
    assert subprocess.run(command, cwd=folder, capture_output=True, check=False).returncode == 1


def test_what_the_page_says_of_opening_it_works(kitchen: Case, export: Path) -> None:
    code = re.findall(r"```python\n(.*?)```", kitchen.page, re.DOTALL)[0]
    done = subprocess.run([sys.executable, "-c", code], cwd=export.parent, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("80 (80, 7) ['index_abduction'")  # the first hand's grasps of two cells of 40


def test_the_figures_are_on_the_page_and_in_json(kitchen: Case) -> None:
    stored = json.loads((kitchen.folder / "card.json").read_text())
    assert stored["composition"] == kitchen.card["composition"]
    assert f"{stored['composition']['valid']:,} valid grasps of 2 robot hands on 2 objects" in kitchen.page
    assert stored["snapshot"]["digest"] == kitchen.made.snapshot.digest
    assert kitchen.made.snapshot.digest in kitchen.page


def test_a_folder_of_shards_has_the_same_figures(kitchen: Case, export: Path, tmp_path: Path) -> None:
    found = write_card(contents_of_folder(export), tmp_path / "card")
    for part in ("quality", "table", "elevation", "directions", "joints", "contact_threshold_m"):
        assert found[part] == kitchen.card[part], part
    for key in ("grasps", "valid", "scenes", "pairs", "pictures", "shards", "bytes"):
        assert found["composition"][key] == kitchen.card["composition"][key]
    assert found["snapshot"] == kitchen.card["snapshot"]


def test_what_a_folder_does_not_know_is_said_to_be_missing(export: Path, tmp_path: Path) -> None:
    shutil.copytree(export, tmp_path / "plain")
    (tmp_path / "plain" / "snapshot.json").unlink()
    write_card(contents_of_folder(tmp_path / "plain"), tmp_path / "card")
    page = (tmp_path / "card" / "README.md").read_text()
    assert "| revisions of the stages | not recorded |" in page
    assert "No licence was stated for this dataset" in page and "Not measured: robustness" in page


def test_the_checksums_of_plain_files_are_computed(export: Path, tmp_path: Path) -> None:
    shutil.copytree(export, tmp_path / "plain")
    (tmp_path / "plain" / "snapshot.json").unlink()
    write_card(contents_of_folder(tmp_path / "plain"), tmp_path / "plain")
    command = ["sha256sum", "-c", "--strict", "checksums.sha256"]
    assert subprocess.run(command, cwd=tmp_path / "plain", capture_output=True, check=False).returncode == 0


def test_few_pictures_are_fetched(kitchen: Case) -> None:
    views = {shard.sha256 for shard in kitchen.made.snapshot.shards if shard.kind == "views"}
    cached = {path.stem for path in (kitchen.folder.parent / "cache").iterdir()}
    # but for the few that are shown: at most one of each pair of hand and object
    assert len(views) == 8 and len(views & cached) <= 4


@pytest.mark.s3
def test_a_snapshot_on_s3_has_the_same_card(kitchen: Case, tmp_path: Path, s3_url: str) -> None:
    made = dataset(tmp_path, s3_url)
    try:
        contents = contents_of_store(made.services.store, "kitchen", cache=tmp_path / "cache")
        found = write_card(contents, tmp_path / "card")
    finally:
        made.services.close()
    for part in ("quality", "table", "directions", "joints", "cells"):
        assert found[part] == kitchen.card[part], part


def test_a_dataset_without_a_snapshot_says_how_to_take_one(kitchen: Case) -> None:
    with pytest.raises(NotFoundError, match="graspd datasets snapshot pantry"):
        contents_of_store(kitchen.made.services.store, "pantry")


def test_licences_can_be_given_for_what_was_added_without(kitchen: Case, tmp_path: Path) -> None:
    said = tmp_path / "assets.json"
    said.write_text(json.dumps({"objects": {"*": {"licence": "CC0-1.0"}, "mug": {"source": "a potter"}}}))
    objects = with_provenance(kitchen.contents, said).objects
    assert (objects["block"].licence, objects["mug"].licence, objects["mug"].source) == (
        "CC0-1.0",
        "Apache-2.0",
        "a potter",
    )


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[", "is not as"),
        ('{"objects": {"teapot": {"licence": "x"}}}', "teapot"),
        ('{"hands": {"barrett": {"colour": "x"}}}', "colour"),
    ],
)
def test_a_file_of_licences_that_cannot_be_used_is_told(kitchen: Case, tmp_path: Path, text: str, words: str) -> None:
    said = tmp_path / "assets.json"
    said.write_text(text)
    with pytest.raises(InputError, match=words):
        with_provenance(kitchen.contents, said)


def test_a_cell_that_failed_is_told_with_its_reason(tmp_path: Path) -> None:
    found = case(tmp_path, drawn=False, fails=("barrett", "mug"))
    found.made.services.close()
    assert "**barrett on mug lacks 6 of its shards**: the mesh is torn." in found.page
    assert "**Not complete**" in found.page
    failed = next(cell for cell in found.card["cells"] if cell["hand"] == "barrett" and cell["object"] == "mug")
    assert (failed["grasps"], failed["of_validated"]) == (0, None)


def test_a_dataset_without_scenes_has_a_card(tmp_path: Path) -> None:
    found = case(tmp_path, scenes=0, views=0)
    found.made.services.close()
    assert "table.png" not in found.card["plots"] and "clearance of the table (no scenes)" in found.page
    assert found.card["composition"]["pictures"] == 0


def test_the_card_of_a_dataset_in_scenes_says_where_its_grasps_are_valid(tmp_path: Path) -> None:
    made = case(tmp_path, drawn=False, scene="bin", neighbours=("mug",), views=0)
    try:
        assert (made.card["making"]["scenes"], made.card["making"]["neighbours"]) == (["bin"], ["mug"])
        assert made.card["validity"]["lift_hard"]["share"] == pytest.approx(0.5, abs=0.02)
        assert "valid grasps in scenes (bin beside mug) of 2 robot hands" in made.page
        assert "At half the friction 50 % of them lift too." in made.page
        # What is said of free grasps is not said of these.
        assert "planned around a free object" not in made.page and "clearance of the table (no scenes)" not in made.page
    finally:
        made.made.services.close()


def graspd(*arguments: str, folder: Path) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "graspd", "datasets", "card", *arguments]
    environment = {"GRASPD_DATA_DIR": str(folder), "XDG_CACHE_HOME": str(folder / "home"), "PATH": "/usr/bin:/bin"}
    root = Path(__file__).resolve().parents[3]
    return subprocess.run(command, cwd=root, env=environment, capture_output=True, text=True, timeout=120, check=False)


def test_the_command_writes_the_card_of_a_dataset(kitchen: Case, tmp_path: Path) -> None:
    folder = kitchen.folder.parent
    done = graspd("kitchen", "-o", str(tmp_path / "out"), "--licence", "CC0-1.0", "--json", folder=folder)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["valid"] == kitchen.card["composition"]["valid"] and "yield.png" in told["plots"]
    assert 'license: "cc0-1.0"' in (tmp_path / "out" / "README.md").read_text()


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("pantry",), "has no snapshot"),
        (("./nowhere",), "does not exist"),
        (("kitchen", "--snapshot", "0" * 32), "0" * 32),
    ],
)
def test_a_mistake_is_one_line_and_exit_2(
    kitchen: Case, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], words: str
) -> None:
    monkeypatch.setenv("GRASPD_DATA_DIR", str(kitchen.folder.parent))
    done = CliRunner().invoke(app, ["card", *arguments, "-o", str(tmp_path / "out")])
    assert done.exit_code == 2 and len(done.stderr.strip().splitlines()) == 1
    assert words in done.stderr and not (tmp_path / "out").exists()


def test_the_matrix_is_that_of_the_dataset(kitchen: Case) -> None:
    pairs = [(cell["hand"], cell["object"]) for cell in kitchen.card["cells"]]
    assert pairs == [(hand, obj) for hand in HANDS for obj in OBJECTS]


def test_a_card_says_in_how_many_models_half_of_its_grasps_hold() -> None:
    told = [_qualities({"quality": {"allegro": {"robust_share": {"median": median}}}}) for median in (0.625, 1.0)]
    assert "allegro: half hold in 62 % or less of the models around the nominal one" in told[0]
    assert told[1] == ""
