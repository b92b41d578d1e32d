"""The figures of a card against the same figures computed another way, and what is said of them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from graspd.service.model.metrics import BANDS, SECTORS, evenness
from graspd.service.model.states import Stage
from graspd.service.model.transforms import quat_from_axis_angle
from graspd.service.readers import Grasps
from graspd.service.store.manifests import load_manifest
from graspd.service.store.shards import read_shard
from graspd.studies.cards.findings import findings
from graspd.studies.cards.numbers import share
from graspd.studies.cards.tally import JointUse, cell_counts, elevations
from tests.studies.cards.conftest import Case, case
from tests.studies.cards.makers import SECONDS, STILL_HAND, STILL_JOINT, Array


def changed(tmp_path: Path, change: Any, **options: Any) -> Case:
    found = case(tmp_path, drawn=False, change=change, **options)
    found.made.services.close()
    return found


def test_counts_are_those_of_the_manifests(kitchen: Case) -> None:
    store, shards = kitchen.made.services.store, kitchen.made.snapshot.shards
    base = [load_manifest(store, Stage.SYNTHESIZE, shard.id) for shard in shards if shard.kind == "base"]
    made, valid = kitchen.card["composition"], kitchen.card["validity"]
    assert made["valid"] == sum(one.valid for one in base) and valid["candidates"] == sum(
        one.candidates for one in base
    )
    assert (valid["rechecked"], valid["recheck_dropped"]) == (32, 0)
    assert sum(made["bytes"].values()) == kitchen.made.snapshot.size_bytes
    assert (made["scenes"], made["pictures"]) == (16, 16)
    assert valid["rejected"]["gate"] == len(base)


def test_cost_is_the_sum_of_the_stages(kitchen: Case) -> None:
    making, batches = kitchen.card["making"], 8
    stages = {"base": Stage.SYNTHESIZE, "scene": Stage.SCENE, "views": Stage.RENDER}
    assert making["seconds"] == {kind: batches * SECONDS[stage] for kind, stage in stages.items()}
    assert making["seconds_per_1000_valid"] == pytest.approx(1000 * batches * 4.0 / 160)
    assert making["synthesis_parts"] == {"planner": batches * 1.0}


@pytest.mark.parametrize("name", ["epsilon", "penetration_depth_mm"])
def test_distributions_are_those_of_the_readers(kitchen: Case, name: str) -> None:
    values = Grasps(kitchen.contents.shards.only(hands=["allegro"])).arrays(f"quality/{name}")[f"quality/{name}"]
    values = values[:, 1] if values.ndim == 2 else values  # the threshold of 5 mm
    found = kitchen.card["quality"]["allegro"][name]
    assert kitchen.card["contact_threshold_m"] == 0.005
    # float32 columns: 1e-6 of the value
    assert found["median"] == pytest.approx(np.median(values), rel=1e-5)
    assert found["p95"] == pytest.approx(np.percentile(values, 95), rel=1e-5)


def test_clearance_is_that_of_the_scene_shards(kitchen: Case) -> None:
    clear = pairs = 0
    for file in kitchen.contents.shards.of("scene"):
        scene = read_shard(kitchen.contents.shards.path(file))
        pairs += int((scene["grasp/valid"] == 1).sum())
        clear += len(set(scene["grasp/base_index"][scene["grasp/valid"] == 1].tolist()))
    table = kitchen.card["table"]
    assert (table["clear"], table["clear_pairs"], table["grasps"], table["pairs"]) == (clear, pairs, 160, 320)
    assert table["too_near"] == {"the table at contact": 320 - pairs}


def test_only_valid_grasps_count(tmp_path: Path) -> None:
    def halve(hand: str, obj: str, columns: dict[str, Array]) -> None:
        columns["quality/valid"][::2] = 0
        columns["quality/epsilon"][::2] = 99.0

    found = changed(tmp_path, halve)
    assert found.card["composition"]["grasps"] == 160 and found.card["composition"]["valid"] == 80
    assert found.card["quality"]["allegro"]["epsilon"]["max"] < 10
    assert found.card["table"]["grasps"] == 80 and found.card["directions"]["by_hand"]["allegro"]["grasps"] == 40


def test_audits_that_overturn_a_verdict_are_told_with_an_interval(tmp_path: Path) -> None:
    def drop(hand: str, obj: str, columns: dict[str, Array]) -> None:
        if (hand, obj) == ("barrett", "mug") and "quality/recheck" in columns:
            columns["quality/recheck"][:2] = 0

    found = changed(tmp_path, drop)
    rate = found.card["validity"]["by_hand"]["barrett"]["false_valid"]
    # Wilson's interval of 2 in 16, by its formula
    z, n, p = 1.959964, 16, 2 / 16
    middle, half = (
        (p + z * z / (2 * n)) / (1 + z * z / n),
        z / (1 + z * z / n) * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n)),
    )
    assert (rate["low"], rate["high"]) == pytest.approx((middle - half, middle + half), abs=1e-6)
    assert "**Rechecks overturned 2 of 32 verdicts**" in found.page and "barrett on mug (2 of 8)" in found.page


def test_nothing_is_known_of_no_audits(tmp_path: Path) -> None:
    def without(hand: str, obj: str, columns: dict[str, Array]) -> None:
        columns.pop("quality/recheck", None)

    found = changed(tmp_path, without, scenes=0, views=0)
    assert found.card["validity"]["false_valid"] is None and "**No rechecks**" in found.page


def test_directions_that_no_hand_comes_from_are_told(tmp_path: Path) -> None:
    def from_above(hand: str, obj: str, columns: dict[str, Array]) -> None:
        if obj == "mug":
            # Barrett's palm looks along +z, Allegro's along +x: turned about y both look down.
            angle = np.pi if hand == "barrett" else np.pi / 2
            count = len(columns["grasp/hand_pose"])
            columns["grasp/hand_pose"][:, 3:] = quat_from_axis_angle(np.array([0.0, 1, 0]), np.full(count, angle))

    found = changed(tmp_path, from_above, grasps=160, scenes=0, views=0)
    rows = found.card["directions"]["by_object"]
    assert rows["mug"]["empty"] > 40 > rows["block"]["empty"]
    assert "**Directions never used**" in found.page and f"mug ({rows['mug']['empty']})" in found.page


def test_a_cell_that_ran_out_of_budget_is_told(tmp_path: Path) -> None:
    def few(hand: str, obj: str, columns: dict[str, Array]) -> None:
        if (hand, obj) == ("allegro", "block"):
            for name in [name for name in columns if name != "quality/thresholds_m"]:
                columns[name] = columns[name][:3]

    found = changed(tmp_path, few)
    assert (
        "**1 of 4 cells ran out of budget**" in found.page
        and "allegro on block (6 of 40 after 8 candidates)" in found.page
    )


def test_directions_that_are_preferred_are_told(tmp_path: Path) -> None:
    found = case(tmp_path, drawn=False)
    found.made.services.close()
    level = np.zeros(36, int)
    level[17:19], level[30] = 80, 40
    found.card["elevation"] = {"barrett": {"all": level.tolist(), "clear": level.tolist()}}
    told = "\n".join(findings(found.card))
    # two bins of 5 degrees hold 160 of 200; those within 10 degrees of the horizontal, sin(10 deg) of the sphere
    assert "**Preferred directions**: of all palms over the table, 80 % within 10° of the horizontal (17 % if" in told
    assert "clear of the table 20 % have the palm come from 45° or more" in told and "vertical" not in told


def test_a_joint_that_does_not_move_is_told(kitchen: Case) -> None:
    assert kitchen.card["joints"][STILL_HAND][STILL_JOINT]["used"] < 0.05
    assert f"**{STILL_HAND} hardly moves** `{STILL_JOINT}`" in kitchen.page


def test_grasps_that_repeat_are_counted(tmp_path: Path) -> None:
    def repeat(hand: str, obj: str, columns: dict[str, Array]) -> None:
        for name in ("grasp/hand_pose", "grasp/joint_positions"):
            columns[name][1] = columns[name][0]

    found = changed(tmp_path, repeat, scenes=0, views=0)
    assert found.card["repeated"] == 8 and "**8 valid grasps equal another**" in found.page


def test_a_dataset_without_flaws_gets_no_findings_of_them(kitchen: Case) -> None:
    told = "\n".join(findings(kitchen.card))
    for words in (
        "Rechecks overturned",
        "ran out of budget",
        "equal another",
        "Mixed",
        "Licence not recorded",
        "lacks",
    ):
        assert words not in told


def test_cells_of_the_sphere_have_equal_areas() -> None:
    rng = np.random.default_rng(3)
    vectors = rng.normal(size=(48_000, 3))
    counts = cell_counts(vectors / np.linalg.norm(vectors, axis=1, keepdims=True))
    assert counts.shape == (BANDS, SECTORS) and counts.sum() == 48_000
    assert np.abs(counts - 1000).max() < 6 * np.sqrt(1000)  # six standard deviations of a count
    assert evenness(counts.ravel(), counts.size) == pytest.approx(1.0, abs=0.01)


def test_evenness_of_one_direction_is_one_cell() -> None:
    counts = cell_counts(np.tile([0.0, 0.0, 1.0], (10, 1)))
    assert evenness(counts.ravel(), counts.size) == pytest.approx(1 / 48) and evenness([0] * 48, 48) == 0


def test_elevations_are_degrees_over_the_horizontal() -> None:
    angles = np.radians([-88.0, 2.0, 88.0])
    vectors = np.stack([np.cos(angles), np.zeros(3), np.sin(angles)], axis=1)
    assert np.flatnonzero(elevations(vectors)).tolist() == [0, 18, 35]


def test_the_use_of_a_joint_is_a_share_of_its_limits() -> None:
    use = JointUse.of(("a", "b"), {"lower": {"a": -1.0}, "upper": {"a": 1.0}})
    use.add(("a", "b"), np.stack([np.linspace(-0.5, 0.5, 1001), np.zeros(1001)], axis=1))
    (found,) = use.shares().values()
    # bins are 1/200 of the range
    assert found["used"] == pytest.approx(0.49, abs=0.01) and found["median"] == pytest.approx(0.5, abs=0.005)
    assert list(use.shares()) == ["a"]


def test_a_share_of_nothing_is_not_known() -> None:
    assert share(0, 0) is None
