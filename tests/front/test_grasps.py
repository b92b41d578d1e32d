"""`graspd.Grasps`: what a file holds, chosen, sorted, saved and read again."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import graspd
from graspd.service.model.metrics import GRASP_METRICS
from graspd.service.model.transforms import compose
from graspd.service.store.shards import write_shard

THRESHOLDS = np.array([0.001, 0.005, 0.01])


def columns(count: int, *, scenes: int = 0, seed: int = 0) -> dict[str, Any]:
    """A base shard of noise; the first metric at 5 mm counts up, every second grasp is valid."""
    rng = np.random.default_rng(seed)
    made: dict[str, Any] = {"quality/thresholds_m": THRESHOLDS}
    for name in ("grasp", "pregrasp", "squeeze"):
        pose = rng.normal(size=(count, 7))
        pose[:, 3:] /= np.linalg.norm(pose[:, 3:], axis=1, keepdims=True)
        made[f"{name}/hand_pose"], made[f"{name}/joint_positions"] = pose, rng.normal(size=(count, 3))
    for metric in GRASP_METRICS:
        if not metric.optional:
            values = np.arange(count, dtype=float)
            made[metric.path] = np.stack([values - 100, values, values + 100], axis=1) if metric.swept else values
    made["quality/valid"] = np.arange(count) % 2
    made["quality/feasible"] = np.ones(count)
    made["quality/success"] = np.arange(count) % 2
    if scenes:
        made["scene/object_pose"] = np.tile([0.0, 0, 0.1, 1, 0, 0, 0], (scenes, 1)) + seed * np.eye(7)[0]
        made["grasp/scene_index"] = np.arange(count) % scenes
    return made


def shard(
    path: Path, count: int = 6, *, obj: str = "mug", joints: str = "abc", hand: str = "claw", **more: Any
) -> Path:
    said = {"hand": hand, "object": obj, "joint_names": list(joints)}
    path.write_bytes(write_shard("base", columns(count, **more), said))
    return path


@pytest.fixture
def grasps(tmp_path: Path) -> graspd.Grasps:
    return graspd.open(shard(tmp_path / "g.h5"))


def test_a_file_is_read_with_its_names_and_metrics_and_saved(grasps: graspd.Grasps, tmp_path: Path) -> None:
    assert (len(grasps), grasps.hand, grasps.objects, grasps.joint_names) == (6, "claw", ["mug"], ["a", "b", "c"])
    assert str(grasps) == "<6 grasps of claw on mug, 3 valid>"
    assert grasps.valid().metric("epsilon").tolist() == [1, 3, 5]
    assert grasps.metric("epsilon", threshold_m=0.009).tolist() == [100, 101, 102, 103, 104, 105]
    again = graspd.open(grasps.valid().save(tmp_path / "valid.h5"))
    np.testing.assert_array_equal(again.hand_pose, grasps.valid().hand_pose)
    assert again.joint_names == grasps.joint_names
    for call, words in ((lambda: grasps.metric("beauty"), "epsilon"), (lambda: grasps.column("grasp/lift"), "valid")):
        with pytest.raises(graspd.InputError, match=words):
            call()


def test_top_is_the_best_first_of_what_is_known(grasps: graspd.Grasps, tmp_path: Path) -> None:
    assert grasps.top("epsilon", 2).metric("epsilon").tolist() == [5, 4]
    assert grasps.top("penetration_depth_mm", 2).metric("epsilon").tolist() == [0, 1], "less is better"
    made = columns(3)
    made["quality/penetration_depth_mm"] = np.array([np.nan, 2.0, 1.0])
    (tmp_path / "g.h5").write_bytes(write_shard("base", made, {"hand": "claw", "object": "mug"}))
    found = graspd.open(tmp_path / "g.h5").top("penetration_depth_mm", 3)
    assert found.metric("penetration_depth_mm").tolist() == [1, 2]


@pytest.mark.parametrize("rows", [slice(1, 3), [1, 2], np.array([False, True, True, False, False, False])])
def test_rows_are_chosen_as_in_numpy(grasps: graspd.Grasps, rows: Any) -> None:
    assert grasps[rows].metric("epsilon").tolist() == [1, 2]
    assert len(grasps[[]]) == len(grasps.where(lambda g: g.metric("epsilon") > 1e9)) == 0


def test_one_grasp_has_its_joints_by_name(grasps: graspd.Grasps) -> None:
    one = grasps[-1]
    assert one.joints["b"] == grasps.joint_positions[5, 1]
    assert (one.valid, one.metrics["epsilon"]) == (True, 5.0)
    with pytest.raises(IndexError, match="no grasp 6; of 6 the last is 5"):
        _ = grasps[6]


def test_grasps_of_several_files_stay_in_their_scenes(tmp_path: Path) -> None:
    first, second = shard(tmp_path / "a.h5", 3, scenes=2), shard(tmp_path / "b.h5", 2, scenes=1, seed=4)
    both = graspd.open([first, second])
    assert both.object_pose[:, 0].tolist() == [0, 0, 0, 4, 4]
    np.testing.assert_allclose(both.hand_pose_in_scene, compose(both.object_pose, both.hand_pose))


def test_a_folder_may_hold_several_objects_but_one_file_may_not(tmp_path: Path) -> None:
    shard(tmp_path / "a.h5"), shard(tmp_path / "b.h5", obj="bowl")
    both = graspd.open(tmp_path)
    assert (len(both), sorted(both.objects)) == (12, ["bowl", "mug"])
    with pytest.raises(graspd.InputError, match="bowl, mug"):
        both.save(tmp_path / "c.h5")


def test_hands_are_not_mixed(tmp_path: Path) -> None:
    shard(tmp_path / "a.h5"), shard(tmp_path / "b.h5", hand="fist", joints="abd")
    with pytest.raises(graspd.InputError, match="hand='claw'"):
        graspd.open(tmp_path)
    assert graspd.open(tmp_path, hand="fist").joint_names == ["a", "b", "d"]
    with pytest.raises(graspd.InputError, match="claw, fist"):
        graspd.open(tmp_path, hand="foot")


def test_a_source_without_grasps_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for name in ("absent.h5", "empty"):
        with pytest.raises(graspd.NotFoundError, match=name):
            graspd.open(tmp_path / name)
