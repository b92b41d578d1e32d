"""Grasps as a table of pandas, in a notebook and in the viewer; short `repr`s; errors that name the range."""

from __future__ import annotations

import base64
import io
import re
import sys
import urllib.request
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import graspd
from graspd import display as showing
from graspd.service.store.shards import write_shard
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from tests.front.test_grasps import columns, shard
from tests.worker.models import attributes_of

KEY = "a-key-that-nobody-sees"


@pytest.fixture
def grasps(tmp_path: Path) -> graspd.Grasps:
    return graspd.open(shard(tmp_path / "g.h5", joints="abx"))


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


def test_without_pandas_one_line_says_how_to_get_it(grasps: graspd.Grasps, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pandas", None)
    with pytest.raises(graspd.InputError, match=re.escape("pip install 'graspd[pandas]'")):
        grasps.to_pandas()


def test_a_notebook_shows_the_best_as_a_small_picture(known: graspd.Grasps) -> None:
    html = known._repr_html_()
    found = re.search(r'<img [^>]*src="data:image/png;base64,([^"]+)"', html)
    assert found and "&lt;3 grasps of barrett on block, 1 valid&gt;" in html
    png = base64.b64decode(found[1])
    assert len(png) <= showing.PICTURE_BYTES and Image.open(io.BytesIO(png)).width > 2 * showing.EDGE


def test_a_notebook_shows_a_table_where_nothing_can_be_drawn(
    grasps: graspd.Grasps, known: graspd.Grasps, monkeypatch: pytest.MonkeyPatch
) -> None:
    # The best valid one first; the hand called claw is nowhere.
    assert "<tbody><tr><td>5</td><td>yes</td><td>5</td>" in grasps._repr_html_()
    assert "<table>" in grasps[[]]._repr_html_()
    for bound in ("PICTURE_S", "PICTURE_BYTES"):
        with monkeypatch.context() as tight:
            tight.setattr(showing, bound, -1)
            html = known._repr_html_()
            assert "<table>" in html and "<img" not in html


def test_names_cannot_write_html(tmp_path: Path) -> None:
    html = graspd.open(shard(tmp_path / "g.h5", obj="<script>", hand="<b>"))._repr_html_()
    assert "<script>" not in html and "<b>" not in html


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
    client = graspd.Client(f"http://user:{KEY}@127.0.0.1:1", key=KEY)
    assert repr(client).startswith("<client of http://") and KEY not in repr(client)
    assert repr(grasps.pregrasp) == "<6 postures of 3 joints>"
    assert re.fullmatch(r"<grasp at \(.*\) m, 3 joints, epsilon 5, valid>", repr(grasps[5]))
    assert all(len(repr(one)) < 120 for one in (client, grasps, grasps.pregrasp, grasps[0]))


def test_grasps_of_another_object_are_not_saved_as_the_firsts(tmp_path: Path) -> None:
    shard(tmp_path / "a.h5"), shard(tmp_path / "b.h5", obj="bowl")
    both = graspd.open(tmp_path)
    first, second = both.objects
    of = {name: both.where(lambda g, name=name: g.column("object") == name) for name in (first, second)}
    with pytest.raises(graspd.InputError, match=f"open the file of {second} alone"):
        of[second].save(tmp_path / "c.h5")
    assert graspd.open(of[first].save(tmp_path / "d.h5")).objects == [first]
