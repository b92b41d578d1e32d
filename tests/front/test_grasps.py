"""`graspd.Grasps`: what a file holds, chosen, sorted, saved, as a table, in a notebook and in the viewer."""

import base64
import io
import json
import re
import sys
import urllib.request
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

import graspd
from graspd import display as showing
from graspd.service.model.metrics import GRASP_METRICS
from graspd.service.model.transforms import compose
from graspd.service.store.shards import write_shard
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from tests.api.factories import poses, scene_columns
from tests.worker.commands_run import graspd as command
from tests.worker.commands_run import refused
from tests.worker.models import attributes_of

THRESHOLDS = np.array([0.001, 0.005, 0.01])


def columns(count: int, *, scenes: int = 0, seed: int = 0, thresholds: Any = THRESHOLDS) -> dict[str, Any]:
    """A base shard of noise; the first metric at 5 mm counts up, every second grasp is valid."""
    rng = np.random.default_rng(seed)
    made: dict[str, Any] = {"quality/thresholds_m": thresholds}
    for name in ("grasp", "pregrasp", "squeeze"):
        made[f"{name}/hand_pose"], made[f"{name}/joint_positions"] = poses(rng, count), rng.normal(size=(count, 3))
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


def shard(path: Path, count: int = 6, *, obj: str = "mug", joints: str = "abx", hand: str = "claw", **of: Any) -> Path:
    said = {"hand": hand, "object": obj, "joint_names": list(joints)}
    path.write_bytes(write_shard("base", columns(count, **of), said))
    return path


@pytest.fixture
def grasps(tmp_path: Path) -> graspd.Grasps:
    return graspd.open(shard(tmp_path / "g.h5"))


def test_a_file_is_read_with_its_names_and_metrics_and_saved(grasps: graspd.Grasps, tmp_path: Path) -> None:
    assert (len(grasps), grasps.hand, grasps.objects, grasps.joint_names) == (6, "claw", ["mug"], ["a", "b", "x"])
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
    with pytest.raises(graspd.InputError, match="must be at least 0"):
        grasps.top("epsilon", -1)


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
    first, second = both.objects
    of = {name: both.where(lambda g, name=name: g.column("object") == name) for name in (first, second)}
    with pytest.raises(graspd.InputError, match=f"open the file of {second} alone"):
        of[second].save(tmp_path / "c.h5")
    assert graspd.open(of[first].save(tmp_path / "d.h5")).objects == [first]


def test_hands_are_not_mixed(tmp_path: Path) -> None:
    shard(tmp_path / "a.h5"), shard(tmp_path / "b.h5", hand="fist", joints="abd")
    with pytest.raises(graspd.InputError, match="hand='claw'"):
        graspd.open(tmp_path)
    assert graspd.open(tmp_path, hand="fist").joint_names == ["a", "b", "d"]
    with pytest.raises(graspd.InputError, match="claw, fist"):
        graspd.open(tmp_path, hand="foot")
    for of, words in (({"joints": "abd"}, "different joints"), ({"thresholds": THRESHOLDS / 2}, "contact thresholds")):
        shard(tmp_path / "b.h5", **of)
        with pytest.raises(graspd.InputError, match=words):
            graspd.open(tmp_path)


def test_a_source_without_grasps_is_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for name in ("absent.h5", "empty"):
        with pytest.raises(graspd.NotFoundError, match=name):
            graspd.open(tmp_path / name)
    scene = scene_columns(np.random.default_rng(0), 3, 1)
    (tmp_path / "empty" / "s.h5").write_bytes(write_shard("scene", scene, {"hand": "claw", "object": "mug"}))
    with pytest.raises(graspd.InputError, match="no file of grasps"):
        graspd.open(tmp_path / "empty")


@pytest.fixture(scope="module")
def known(tmp_path_factory: pytest.TempPathFactory) -> graspd.Grasps:
    hand, obj = hand_from_path("barrett"), object_from_path("block", face_error_m=3e-4)
    made = columns(3)
    for name in ("grasp", "pregrasp", "squeeze"):
        made[f"{name}/hand_pose"] = np.tile([0.0, 0, 0.2, 1, 0, 0, 0], (3, 1))
        made[f"{name}/joint_positions"] = np.tile(hand.expand(hand.preshape), (3, 1))
    file = tmp_path_factory.mktemp("known") / "g.h5"
    file.write_bytes(write_shard("base", made, attributes_of(hand, obj)))
    return graspd.open(file)


def test_a_table_has_poses_joints_and_metrics_by_name(grasps: graspd.Grasps) -> None:
    pytest.importorskip("pandas", reason="needs the extra: pip install graspd[pandas]")
    table = grasps.to_pandas()
    pose, joints = grasps.hand_pose, grasps.joint_positions
    np.testing.assert_array_equal(table[["x", "y", "z", "qw", "qx", "qy", "qz"]], pose)
    # The joint x does not hide the coordinate.
    np.testing.assert_array_equal(table[["a", "b", "joint.x"]], joints)
    np.testing.assert_array_equal(table[["squeeze.x", "squeeze.qz"]], grasps.squeeze.hand_pose[:, [0, 6]])
    np.testing.assert_array_equal(table["pregrasp.joint.x"], grasps.pregrasp.joint_positions[:, 2])
    assert table["epsilon"].tolist() == [0, 1, 2, 3, 4, 5] and table["valid"].tolist() == [False, True] * 3
    assert set(table["object"]) == {"mug"} and table["success"].tolist() == [0, 1] * 3
    assert set(grasps.metrics) <= set(table.columns) and len(grasps[[]].to_pandas()) == 0


def test_without_an_extra_one_line_tells(grasps: graspd.Grasps, monkeypatch: pytest.MonkeyPatch) -> None:
    for library, extra, call in (("pandas", "pandas", grasps.to_pandas), ("viser", "view", grasps.view)):
        monkeypatch.setitem(sys.modules, library, None)
        with pytest.raises(graspd.InputError, match=re.escape(f"pip install 'graspd[{extra}]'")):
            call()


def test_a_notebook_shows_the_best_as_a_small_picture(known: graspd.Grasps) -> None:
    html = known._repr_html_()
    found = re.search(r'<img [^>]*src="data:image/png;base64,([^"]+)"', html)
    assert found and "&lt;3 grasps of barrett on block, 1 valid&gt;" in html
    png = base64.b64decode(found[1])
    assert len(png) <= showing.PICTURE_BYTES and Image.open(io.BytesIO(png)).width > 2 * showing.EDGE


def test_a_notebook_shows_a_table_of_an_unknown_hand(grasps: graspd.Grasps, tmp_path: Path) -> None:
    # The best valid one first; the hand called claw is nowhere.
    assert "<tbody><tr><td>5</td><td>yes</td><td>5</td>" in grasps._repr_html_()
    assert "<table>" in grasps[[]]._repr_html_()
    html = graspd.open(shard(tmp_path / "h.h5", obj="<script>", hand="<b>"))._repr_html_()
    assert "<script>" not in html and "<b>" not in html


@pytest.mark.parametrize("bound", ["PICTURE_S", "PICTURE_BYTES"])
def test_a_picture_out_of_bounds_is_a_table(known: graspd.Grasps, bound: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(showing, bound, -1)
    assert "<table>" in known._repr_html_() and "<img" not in known._repr_html_()


def test_plot_is_a_picture_of_the_best(known: graspd.Grasps, grasps: graspd.Grasps) -> None:
    one, two = known.plot(1, edge=240), known.plot(2, edge=240)
    cells = [np.asarray(sheet)[100:340, 300:520] for sheet in (one, two)]
    assert [bool(np.ptp(cell, axis=(0, 1)).any()) for cell in cells] == [False, True], "the second has a grasp or none"
    with pytest.raises(graspd.InputError, match="no grasp to draw"):
        known[[]].plot()
    with pytest.raises(graspd.NotFoundError, match="claw"):
        grasps.plot()


def test_the_viewer_serves_them(known: graspd.Grasps) -> None:
    pytest.importorskip("viser", reason="needs the extra: pip install graspd[view]")
    viewer = known.view(port=0)
    try:
        assert repr(viewer) == f"<viewer at {viewer.url}>"
        with urllib.request.urlopen(viewer.url) as page:
            assert page.status == 200
    finally:
        viewer.close()


def test_reprs_are_short_and_show_no_key(grasps: graspd.Grasps) -> None:
    client = graspd.Client("http://user:hidden@127.0.0.1:1", key="hidden")
    assert repr(client).startswith("<client of http://") and "hidden" not in repr(client)
    assert repr(grasps.pregrasp) == "<6 postures of 3 joints>"
    assert re.fullmatch(r"<grasp at \(.*\) m, 3 joints, epsilon 5, valid>", repr(grasps[5]))
    assert all(len(repr(one)) < 120 for one in (client, grasps, grasps.pregrasp, grasps[0]))


def test_a_file_of_robust_grasps_says_so_to_every_reader(tmp_path: Path) -> None:
    file = tmp_path / "robust.h5"
    asked = "synth --hand allegro --object block --robust 0.5 --robust-models 2 --fidelity draft -n 2 -o"
    said, grasps = command(asked, file), graspd.open(file)
    assert said["robust_share"] == float(np.round(grasps.metric("robust_share").mean(), 4)) >= 0.5
    assert json.loads(str(grasps.attributes["robust"])) == {"models": 2, "wanted": 0.5}
    assert grasps.column("quality/robust_weakest").dtype == np.uint8
    assert len(grasps.where(lambda g: g.metric("robust_share") >= 0.5)) == 2


def test_grasps_in_scenes_are_robust_if_other_models_lift_them(tmp_path: Path) -> None:
    (tmp_path / "made").mkdir()
    file, copies = tmp_path / "made" / "table.h5", tmp_path / "validated"
    asked = "synth --hand barrett --object block --scene table --scenes 2 --fidelity draft"
    command(f"{asked} -n 2 --want candidates --robust-models 2 -o", file)
    grasps = graspd.open(file)
    lifted, share = grasps.column("quality/success") == 1, grasps.column("quality/robust_share")
    assert lifted.any() and (np.isfinite(share) == lifted).all()
    lift = ("evaluate --protocol lift --robust 3 -o", copies, tmp_path / "made")
    said, copy = command(*lift), graspd.open(copies / "table.h5")
    again = copy.metric("robust_share")
    assert said["robust_share"] == round(float(again[lifted].mean()), 6) and said["robust_n"] == lifted.sum()
    assert [one["robust_share"] is None for one in said["verdicts"]] == (~lifted).tolist() == np.isnan(again).tolist()
    assert json.loads(str(copy.attributes["robust"])) == {"models": 3, "wanted": 0}
    assert copy.attributes["shard_id"] == grasps.attributes["shard_id"]
    for path in ("grasp/hand_pose", "quality/success"):
        assert np.array_equal(copy.column(path), grasps.column(path))
    assert "needs --protocol lift" in refused("evaluate --robust 2 -o", tmp_path / "no.h5", file)
    assert "no --hard" in refused("evaluate --robust 2 --protocol lift --hard -o", tmp_path / "no.h5", file)
    assert "exists already" in refused(*lift) and not (tmp_path / "no.h5").exists()
