"""Cards of datasets with known contents: files agree with the shards, with each other, wherever the shards lie."""

import json
import re
import shutil
import sys
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from PIL import Image
from typer.testing import CliRunner

from graspd.cli import build_app
from graspd.service.model import names
from graspd.service.model.errors import InputError
from graspd.service.model.metrics import BANDS, SECTORS, evenness
from graspd.service.model.planning import create_task_message, plan_tasks
from graspd.service.model.records import JobRecord, Snapshot
from graspd.service.model.states import Stage
from graspd.service.model.transforms import quat_from_axis_angle
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.export import export_shards
from graspd.service.pipeline.datasets.spec import DatasetRequest
from graspd.service.readers import Grasps, Shards
from graspd.service.settings import Settings
from graspd.service.store.manifests import load_manifest, publish_shard
from graspd.service.store.records import read_record
from graspd.service.store.shards import json_attribute, read_shard
from graspd.studies.cards import contents as card_contents
from graspd.studies.cards.card import write_card
from graspd.studies.cards.contents import AssetFacts, Contents, add_provenance, contents_of_folder, contents_of_store
from graspd.studies.cards.numbers import card_content, share
from graspd.studies.cards.page import findings, render_card, yaml_head
from graspd.studies.cards.plots import draw
from graspd.studies.cards.tally import CellTally, JointUse, Tally, cell_counts, elevations, tally_of
from graspd.worker.hands.load import hand_from_path
from graspd.worker.stages.context import Output, build_shard
from tests.api import factories
from tests.fakes import fail_task, plan_all
from tests.indexes import open_services
from tests.shell import completed
from tests.worker.commands_run import graspd

HANDS = ("allegro", "barrett")
OBJECTS = ("block", "mug")
NAME = "kitchen"
#: Of this joint of this hand the card must say that it never moves.
STILL_HAND, STILL_JOINT = "barrett", "finger_1_spread"
SECONDS = {Stage.SYNTHESIZE: 2.0, Stage.SCENE: 0.5, Stage.RENDER: 1.5, Stage.EPISODE: 3.0}
Array = NDArray[Any]
CHECK = ("sha256sum", "-c", "--strict", "checksums.sha256")
MANY = [f"object-{number:03}" for number in range(200)]


def no_progress(done: int, total: int) -> None:
    pass


@dataclass
class Case:
    """A dataset's services and snapshot, its contents, the folder of its card, and the card's figures."""

    services: Any
    snapshot: Snapshot
    contents: Contents
    folder: Path
    card: dict[str, Any]

    @property
    def page(self) -> str:
        return (self.folder / "README.md").read_text()


def case(folder: Path, *, drawn: bool = True, **options: Any) -> Case:
    services = dataset(folder, **options)
    snapshot = actions.take_snapshot(services, NAME)[0]
    contents = contents_of_store(services.store, NAME, cache=folder / "cache")
    if drawn:
        card = write_card(contents, folder / "card", licence="CC-BY-4.0", progress=no_progress)
    else:
        card = undrawn(contents)
        (folder / "card").mkdir()
        (folder / "card" / "README.md").write_text(render_card(card, {}))
    return Case(services, snapshot, contents, folder / "card", card)


def undrawn(contents: Contents) -> dict[str, Any]:
    return card_content(contents, tally_of(contents, card_contents.read_shards(contents)))


@pytest.fixture(scope="module")
def kitchen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Case]:
    """A whole dataset of two hands and two objects; tests only read it."""
    made = case(tmp_path_factory.mktemp(NAME))
    yield made
    made.services.close()


@pytest.fixture(scope="module")
def export(kitchen: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("export") / NAME
    export_shards(kitchen.snapshot, folder, lambda shard: kitchen.services.store.stream(shard.key))
    return folder


def dataset(folder: Path, change: Any = None, fails: Any = None, grasps: int = 40, **options: Any):
    """Grasps of each hand on each object; `change` may change the columns of a base shard before it is written."""
    services = open_services(Settings(data_dir=folder))
    factories.add_builtins(services)
    given = {"scenes": 2, "views": 1, "width": 24, "height": 16, "stereo": False, **options}
    wanted = {"name": NAME, "hands": HANDS, "objects": OBJECTS, "grasps": grasps, **given}
    actions.create(services, DatasetRequest.model_validate(wanted))
    plan_all(services)
    for cell in services.index.datasets.cells(NAME, limit=200).items:
        record = read_record(JobRecord, services.store, names.job_record_key(cell.job_id))
        if (cell.hand, cell.object) == fails:
            fail_task(services, record.id, next(plan_tasks(record)), kind="MeshError", reason="the mesh is torn")
        else:
            _finish(services, record, change)
    return services


def _finish(services, record: JobRecord, change: Any) -> None:
    request, base = record.request, dict[str, Array]()
    place = {"scene": json_attribute(request.scene_spec.model_dump(mode="json"))} if request.in_scene else {}
    for task in plan_tasks(record):
        rng = np.random.default_rng([task.batch, *map(ord, request.hand + request.object)])
        if task.stage is Stage.SYNTHESIZE:
            joints = hand_from_path(request.hand).joint_names
            base = factories._base(rng, task.count, request)
            for posture in ("grasp", "pregrasp", "squeeze"):
                base[f"{posture}/joint_positions"] = rng.uniform(0.0, 0.5, (task.count, len(joints)))
            if STILL_JOINT in joints:
                base["grasp/joint_positions"][:, joints.index(STILL_JOINT)] = -1.0
            base |= {"quality/valid": np.ones(task.count, np.uint8), "quality/success": np.ones(task.count, np.int8)}
            base["quality/simulated_displacement_cm"] = rng.gamma(2.0, 0.025, task.count)
            if task.batch == 0:
                base["quality/recheck"] = np.where(np.arange(task.count) < 8, 1, -1).astype(np.int8)
                base["quality/agreement"] = np.full(task.count, np.nan)
                base["quality/agreement"][:4] = [1.0, 0.5] * 2
            if change is not None:
                change(request.hand, request.object, base)
            made = len(base["quality/valid"])
            if place:
                # At half the friction every other grasp of a scene lifts.
                base["quality/lift_hard"] = (np.arange(made) % 2).astype(np.int8)
            attributes: dict[str, Any] = {"joint_names": list(joints), "mu": 1.0, "want": "valid", **place}
            attributes |= {"candidates": made + made // 4 + 1, "verdict_level": "standard", "verdict_key": "k"}
            rejected = {"diverged": 0, "dropped": made // 4, "gate": 1}
            output = Output(base, attributes, {"planner_seconds": 1.0, "rejected": rejected})
        elif task.stage is Stage.SCENE:
            count = 0 if place else len(base["quality/valid"])
            columns = factories.scene_columns(rng, count, request.scenes, clear=0.1)
            columns["grasp/rejection"] = (1 - columns["grasp/valid"]).astype(np.uint8)
            output = Output(columns, place or {"base_shard": task.inputs[0]})
        else:
            made_from = {"base_shard" if task.stage is Stage.EPISODE else "scene_shard": task.inputs[0]}
            output = Output(factories._ARRAYS[task.stage](rng, task.count, request), made_from | place)
        message = create_task_message(record, task, attempt=1, max_attempt=3)
        manifest, data = build_shard(message, output, device="cpu", seconds=SECONDS[task.stage], worker="w1")
        publish_shard(services.store, manifest, data)
        services.index.write.add_manifests([manifest])


def test_the_page_its_links_and_figures_agree_with_the_card(kitchen: Case) -> None:
    head = yaml.safe_load(kitchen.page.split("---")[1])
    assert head["pretty_name"] == "kitchen" and head["license"] == "cc-by-4.0"
    assert head["size_categories"] == ["n<1K"] and set(HANDS) < set(head["tags"])
    targets = re.findall(r"\]\(([^)]+)\)", kitchen.page)
    assert {name for name in targets if name.endswith((".png", ".jpg"))} == set(kitchen.card["plots"])
    assert [target for target in targets if not (kitchen.folder / target).is_file()] == []
    names = {"yield.png", "quality.png", "directions.png", "table.png", "joints.png", "sizes.png", "samples.jpg"}
    assert names <= set(kitchen.card["plots"])
    stored = json.loads((kitchen.folder / "card.json").read_text())
    assert [(cell["hand"], cell["object"]) for cell in stored["cells"]] == [(h, o) for h in HANDS for o in OBJECTS]
    assert f"{stored['composition']['valid']:,} valid grasps of 2 robot hands on 2 objects" in kitchen.page
    assert stored["snapshot"]["digest"] == kitchen.snapshot.digest and kitchen.snapshot.digest in kitchen.page


def test_the_checksums_are_those_of_an_export(kitchen: Case, export: Path, tmp_path: Path) -> None:
    folder = tmp_path / "kitchen"
    shutil.copytree(export, folder)
    shutil.copy(kitchen.folder / "checksums.sha256", folder)
    assert completed(CHECK, cwd=folder).returncode == 0
    shard = next(folder.rglob("base-*.h5"))
    shard.write_bytes(shard.read_bytes()[:-1] + b"?")
    assert completed(CHECK, cwd=folder).returncode == 1


def test_what_the_page_says_of_opening_it_works(kitchen: Case, export: Path) -> None:
    code = re.findall(r"```python\n(.*?)```", kitchen.page, re.DOTALL)[0]
    done = completed([sys.executable, "-c", code], cwd=export.parent)
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith("80 (80, 7) ['index_abduction'")  # the first hand's grasps of two cells of 40


def test_a_folder_of_shards_has_the_same_figures(kitchen: Case, export: Path) -> None:
    found = undrawn(contents_of_folder(export))
    for part in ("quality", "table", "elevation", "directions", "joints", "contact_threshold_m"):
        assert found[part] == kitchen.card[part], part
    for key in ("grasps", "valid", "scenes", "pairs", "pictures", "shards", "bytes"):
        assert found["composition"][key] == kitchen.card["composition"][key]
    assert found["snapshot"] == kitchen.card["snapshot"]


def test_what_a_folder_does_not_know_is_said_to_be_missing(export: Path, tmp_path: Path) -> None:
    shutil.copytree(export, tmp_path / "plain")
    (tmp_path / "plain" / "snapshot.json").unlink()
    write_card(contents_of_folder(tmp_path / "plain"), tmp_path / "plain", progress=no_progress)
    page = (tmp_path / "plain" / "README.md").read_text()
    assert completed(CHECK, cwd=tmp_path / "plain").returncode == 0
    assert "| revisions of the stages | not recorded |" in page
    assert "No licence was stated for this dataset" in page and "Not measured: robustness" in page


def test_pictures_without_their_grasps_have_no_card(kitchen: Case, tmp_path: Path) -> None:
    pictures = replace(kitchen.contents, shards=Shards(kitchen.contents.shards.of_kind("views")))
    with pytest.raises(InputError, match="has no base shard"):
        write_card(pictures, tmp_path, progress=no_progress)


def test_licences_can_be_given_for_what_was_added_without(kitchen: Case, tmp_path: Path) -> None:
    said = tmp_path / "assets.json"
    said.write_text(json.dumps({"objects": {"*": {"licence": "CC0-1.0"}, "mug": {"source": "a potter"}}}))
    objects = add_provenance(kitchen.contents, said).objects
    assert (objects["block"].licence, objects["mug"].licence) == ("CC0-1.0", "Apache-2.0")
    assert objects["mug"].source == "a potter"


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[", "assets.json"),
        ('{"objects": {"teapot": {"licence": "x"}}}', "teapot"),
        ('{"hands": {"barrett": {"colour": "x"}}}', "colour"),
    ],
)
def test_a_file_of_licences_that_cannot_be_used_is_told(kitchen: Case, tmp_path: Path, text: str, words: str) -> None:
    said = tmp_path / "assets.json"
    said.write_text(text)
    with pytest.raises(InputError, match=words):
        add_provenance(kitchen.contents, said)


def test_a_cell_that_failed_is_told_with_its_reason(tmp_path: Path) -> None:
    found = closed(tmp_path, fails=("barrett", "mug"))
    assert "**barrett on mug lacks 6 of its shards**: the mesh is torn." in found.page
    assert "**Not complete**" in found.page
    failed = next(cell for cell in found.card["cells"] if cell["hand"] == "barrett" and cell["object"] == "mug")
    assert (failed["grasps"], failed["of_validated"]) == (0, None)


def test_the_card_of_a_dataset_says_where_its_grasps_are_valid(tmp_path: Path) -> None:
    made = closed(tmp_path, scene="bin", neighbours=("mug",), views=0, episodes="flying")
    assert (made.card["making"]["scenes"], made.card["making"]["neighbours"]) == (["bin"], ["mug"])
    assert made.card["validity"]["lift_hard"]["share"] == pytest.approx(0.5, abs=0.02)
    assert "valid grasps in scenes (bin with neighbours mug) of 2 robot hands" in made.page
    assert "| validation | MuJoCo, lift out of the scene |" in made.page
    assert "At half friction 50 % of them are also lifted. Of their episodes, " in made.page
    assert made.card["validity"]["episodes"]["share"] == pytest.approx(0.8, abs=0.05), "every fifth is out of reach"
    # What is said of free grasps is not said of these.
    assert "planned around a free object" not in made.page and "clearance of the table (no scenes)" not in made.page


def test_the_command_writes_the_card_of_a_dataset(kitchen: Case, tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setenv("GRASPD_DATA_DIR", str(kitchen.folder.parent))
    told = graspd("datasets card kitchen --licence CC0-1.0 -o", tmp_path / "out")
    assert told["valid"] == kitchen.card["composition"]["valid"] and "yield.png" in told["plots"]
    assert 'license: "cc0-1.0"' in (tmp_path / "out" / "README.md").read_text()


@pytest.mark.parametrize(
    ("words", "says"),
    [("pantry", "datasets snapshot pantry"), ("./nowhere", "not exist"), (f"kitchen --snapshot {'0' * 32}", "0" * 32)],
)
def test_a_mistake_is_one_line_and_exit_2(kitchen, tmp_path, monkeypatch, words: str, says: str) -> None:
    monkeypatch.setenv("GRASPD_DATA_DIR", str(kitchen.folder.parent))
    done = CliRunner().invoke(build_app(), [*f"datasets card {words} -o".split(), str(tmp_path / "out")])
    assert done.exit_code == 2 and len(done.stderr.strip().splitlines()) == 1
    assert says in done.stderr and not (tmp_path / "out").exists()


def matrix(valid: int) -> tuple[Contents, Tally]:
    """One hand on 200 objects, so many valid grasps each, without their shards."""
    rng = np.random.default_rng(0)
    tally = Tally()
    for name in MANY:
        columns = {"epsilon": [rng.random(50).astype(np.float32)]}
        made = Counter(grasps=valid, valid=valid, candidates=2 * valid, validated=2 * valid)
        tally.cells["claw", name] = CellTally(made, columns=columns)
    extents = {"extents_m": [0.05, 0.06, 0.1]}
    assets = {name: AssetFacts(name, "d" * 32, facts=extents) for name in MANY}
    return Contents("many", Shards(()), {"claw": AssetFacts("claw")}, assets), tally


def test_the_card_of_many_objects_is_folded_and_bounded(tmp_path: Path) -> None:
    contents, tally = matrix(40)
    text = render_card(card_content(contents, tally), {})
    assert "<details><summary>Objects: 200</summary>" in text
    assert "Licence not recorded** for 200 objects" in text and "and 192 more" in text
    plots = draw(card_content(contents, tally), tally, tmp_path)
    assert {"yield.png", "quality.png", "sizes.png"} == set(plots)
    for name in plots:
        with Image.open(tmp_path / name) as picture:
            assert picture.height < 1200, name
    for valid, words in ((4, "n<1K"), (40, "1K<n<10K"), (5_000, "1M<n<10M")):
        contents, tally = matrix(valid)
        assert yaml_head(card_content(contents, tally))["size_categories"] == [words]


def closed(tmp_path: Path, *, drawn: bool = False, **options) -> Case:
    found = case(tmp_path, drawn=drawn, **options)
    found.services.close()
    return found


def test_counts_costs_and_clearance_are_those_of_the_dataset(kitchen: Case) -> None:
    store, shards = kitchen.services.store, kitchen.snapshot.shards
    base = [load_manifest(store, Stage.SYNTHESIZE, shard.id) for shard in shards if shard.kind == "base"]
    made, valid = kitchen.card["composition"], kitchen.card["validity"]
    assert made["valid"] == sum(one.valid for one in base)
    assert valid["candidates"] == sum(one.candidates for one in base)
    assert (valid["rechecked"], valid["recheck_dropped"]) == (32, 0)
    assert (valid["second_tested"], valid["second_held"]["share"]) == (16, 0.5)
    assert "**Second engine**: of 16 valid grasps, 50 % hold in all engines" in kitchen.page
    assert sum(made["bytes"].values()) == kitchen.snapshot.size_bytes
    assert (made["scenes"], made["pictures"]) == (16, 16) and valid["rejected"]["gate"] == len(base)
    making, batches = kitchen.card["making"], 8
    stages = {"base": Stage.SYNTHESIZE, "scene": Stage.SCENE, "views": Stage.RENDER}
    assert making["seconds"] == {kind: batches * SECONDS[stage] for kind, stage in stages.items()}
    assert making["seconds_per_1000_valid"] == pytest.approx(1000 * batches * 4.0 / 160)
    assert making["synthesis_parts"] == {"planner": batches * 1.0}
    clear = pairs = 0
    for file in kitchen.contents.shards.of_kind("scene"):
        scene = read_shard(kitchen.contents.shards.path(file))
        pairs += int((scene["grasp/valid"] == 1).sum())
        clear += len(set(scene["grasp/base_index"][scene["grasp/valid"] == 1].tolist()))
    table = kitchen.card["table"]
    assert (table["clear"], table["clear_pairs"], table["grasps"], table["pairs"]) == (clear, pairs, 160, 320)
    assert table["too_near"] == {"the table at contact": 320 - pairs}
    views = {shard.sha256 for shard in kitchen.snapshot.shards if shard.kind == "views"}
    # but for the few that are shown: at most one of each pair of hand and object
    assert len(views) == 8 and len(views & {path.stem for path in (kitchen.folder.parent / "cache").iterdir()}) <= 4


@pytest.mark.parametrize("name", ["epsilon", "penetration_depth_mm"])
def test_distributions_are_those_of_the_readers(kitchen: Case, name: str) -> None:
    values = Grasps(kitchen.contents.shards.select(hands=["allegro"])).arrays(f"quality/{name}")[f"quality/{name}"]
    values = values[:, 1] if values.ndim == 2 else values  # the threshold of 5 mm
    found = kitchen.card["quality"]["allegro"][name]
    assert kitchen.card["contact_threshold_m"] == 0.005
    # float32 columns: 1e-6 of the value
    assert found["median"] == pytest.approx(np.median(values), rel=1e-5)
    assert found["p95"] == pytest.approx(np.percentile(values, 95), rel=1e-5)


def test_only_valid_grasps_count(tmp_path: Path) -> None:
    def halve(hand: str, obj: str, columns: dict[str, Array]) -> None:
        columns["quality/valid"][::2] = 0
        columns["quality/epsilon"][::2] = 99.0

    found = closed(tmp_path, change=halve)
    assert found.card["composition"]["grasps"] == 160 and found.card["composition"]["valid"] == 80
    assert found.card["quality"]["allegro"]["epsilon"]["max"] < 10
    assert found.card["table"]["grasps"] == 80 and found.card["directions"]["by_hand"]["allegro"]["grasps"] == 40


def test_audits_that_overturn_verdict_are_told_with_an_interval(tmp_path: Path) -> None:
    def drop(hand: str, obj: str, columns: dict[str, Array]) -> None:
        if (hand, obj) == ("barrett", "mug") and "quality/recheck" in columns:
            columns["quality/recheck"][:2] = 0

    found = closed(tmp_path, change=drop, scenes=0, views=0)
    rate = found.card["validity"]["by_hand"]["barrett"]["false_valid"]
    # Wilson's interval of 2 in 16, by its formula
    z, n, p = 1.959964, 16, 2 / 16
    half = z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    ends = (p + z * z / (2 * n) + half * np.array([-1, 1])) / (1 + z * z / n)
    assert (rate["low"], rate["high"]) == pytest.approx(ends, abs=1e-6)
    assert "**Rechecks overturned 2 of 32 verdicts**" in found.page and "barrett on mug (2 of 8)" in found.page


def test_no_scenes_no_audits_and_repeats_are_told(tmp_path: Path) -> None:
    def change(hand: str, obj: str, columns: dict[str, Array]) -> None:
        columns.pop("quality/recheck", None)
        for name in ("grasp/hand_pose", "grasp/joint_positions"):
            columns[name][1] = columns[name][0]

    found = closed(tmp_path, drawn=True, change=change, scenes=0, views=0)
    assert found.card["validity"]["false_valid"] is None and "**No rechecks**" in found.page
    assert found.card["repeated"] == 8 and "**8 valid grasps equal another**" in found.page
    assert "table.png" not in found.card["plots"] and "clearance of the table (no scenes)" in found.page
    assert found.card["composition"]["pictures"] == 0


def test_directions_that_no_hand_comes_from_are_told(tmp_path: Path) -> None:
    def from_above(hand: str, obj: str, columns: dict[str, Array]) -> None:
        if obj == "mug":
            # Barrett's palm looks along +z, Allegro's along +x: turned about y both look down.
            angle = np.pi if hand == "barrett" else np.pi / 2
            count = len(columns["grasp/hand_pose"])
            columns["grasp/hand_pose"][:, 3:] = quat_from_axis_angle(np.array([0.0, 1, 0]), np.full(count, angle))

    found = closed(tmp_path, change=from_above, grasps=160, scenes=0, views=0)
    rows = found.card["directions"]["by_object"]
    assert rows["mug"]["empty"] > 40 > rows["block"]["empty"]
    assert "**Unused directions**" in found.page and f"mug ({rows['mug']['empty']})" in found.page


def test_a_cell_that_ran_out_of_budget_is_told(tmp_path: Path) -> None:
    def few(hand: str, obj: str, columns: dict[str, Array]) -> None:
        if (hand, obj) == ("allegro", "block"):
            for name in [name for name in columns if name != "quality/thresholds_m"]:
                columns[name] = columns[name][:3]

    page = closed(tmp_path, change=few, scenes=0, views=0).page
    assert "**1 of 4 cells ran out of budget**" in page and "allegro on block (6 of 40 after 8 candidates)" in page


def test_what_stands_out_in_the_figures_is_told(kitchen: Case) -> None:
    level = np.zeros(36, int)
    level[17:19], level[30] = 80, 40
    card = kitchen.card | {"elevation": {"barrett": {"all": level.tolist(), "clear": level.tolist()}}}
    told = "\n".join(findings(card | {"quality": {"allegro": {"robust_share": {"median": 0.625}}}}))
    assert "allegro: half of them hold in at most 62 % of the models around the nominal one" in told
    # two bins of 5 degrees hold 160 of 200; those within 10 degrees of the horizontal, sin(10 deg) of the sphere
    assert "of all palms over the table, 80 % approach within 10° of the horizontal (17 %" in told
    assert "In 20 % of the pairs that are clear of the table, the palm approaches from 45° or more" in told
    assert "vertical" not in told


def test_a_still_joint_is_told_and_no_flaw_that_is_not_there(kitchen: Case) -> None:
    assert kitchen.card["joints"][STILL_HAND][STILL_JOINT]["used"] < 0.05
    assert f"**{STILL_HAND} hardly moves** `{STILL_JOINT}`" in kitchen.page
    told = "\n".join(findings(kitchen.card))
    flaws = ("Rechecks overturned", "ran out of budget", "equal another", "Mixed", "Licence not recorded", "lacks")
    assert not any(words in told for words in flaws)


def test_cells_of_sphere_are_equal_and_one_direction_is_one_cell() -> None:
    vectors = np.random.default_rng(3).normal(size=(48_000, 3))
    counts = cell_counts(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
    assert counts.shape == (BANDS, SECTORS) and counts.sum() == 48_000
    assert np.abs(counts - 1000).max() < 6 * np.sqrt(1000)  # six standard deviations of a count
    assert evenness(counts.ravel(), counts.size) == pytest.approx(1.0, abs=0.01)
    counts = cell_counts(np.tile([0.0, 0.0, 1.0], (10, 1)))
    assert evenness(counts.ravel(), counts.size) == pytest.approx(1 / 48) and evenness([0] * 48, 48) == 0
    angles = np.radians([-88.0, 2.0, 88.0])
    vectors = np.stack([np.cos(angles), np.zeros(3), np.sin(angles)], axis=1)
    assert np.flatnonzero(elevations(vectors)).tolist() == [0, 18, 35]


def test_the_use_of_a_joint_is_a_share_of_its_limits() -> None:
    use = JointUse.from_hand_facts(("a", "b"), {"lower": {"a": -1.0}, "upper": {"a": 1.0}})
    use.add(("a", "b"), np.stack([np.linspace(-0.5, 0.5, 1001), np.zeros(1001)], axis=1))
    (found,) = use.shares().values()
    # bins are 1/200 of the range
    assert found["used"] == pytest.approx(0.49, abs=0.01) and found["median"] == pytest.approx(0.5, abs=0.005)
    assert list(use.shares()) == ["a"] and share(0, 0) is None
