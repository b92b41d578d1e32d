"""Transfer of grasps to another hand: type, region and approach of the source; files that lead to their object."""

import json

import numpy as np
import pytest

from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError
from graspd.service.model.transforms import quat_rotate
from graspd.service.store.shards import Shard, read_shard, write_shard
from graspd.worker.files.synthesis import synthesize_grasps
from graspd.worker.files.transfer import CONE_DEG, MARGIN_M, contact_boxes, transfer_grasps
from graspd.worker.grasps import Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path


@pytest.fixture(scope="module")
def source() -> Shard:
    request = JobOptions(grasps=2, seed=1, fidelity="draft", mass=0.1, rechecks=0)
    made = synthesize_grasps("barrett", "block", request)
    return read_shard(write_shard("base", made.arrays, {**made.attributes, "shard_id": "a" * 32}), kind="base")


def test_transferred_grasps_have_type_region_and_approach_of_their_source(source: Shard) -> None:
    arrays, attributes = transfer_grasps(source, "allegro")
    made = read_shard(write_shard("base", arrays, attributes), kind="base")
    rows = json.loads(str(attributes["transferred_from"]))["rows"]
    assert len(rows) and (made["quality/valid"] == 1).all() and attributes["hand"] == "allegro"
    assert made["quality/grasp_type"].tolist() == np.asarray(source["quality/grasp_type"])[rows].tolist()
    obj, grasps = object_from_path("block"), {}
    for name, shard in (("barrett", source), ("allegro", made)):
        hand, grasp = hand_from_path(name), Posture.from_columns(shard.arrays)
        approach = quat_rotate(grasp.hand_pose[:, 3:], hand.palm.approach)
        grasps[name] = contact_boxes(hand, obj, grasp), approach
    (boxes, ways), (found, own) = grasps["barrett"], grasps["allegro"]
    # At most 5 % of the contact area may be outside the box: its corners exceed it by less than a fingertip's radius.
    assert (found[:, 0] > boxes[rows, 0] - MARGIN_M - 0.01).all() and (
        found[:, 1] < boxes[rows, 1] + MARGIN_M + 0.01
    ).all()
    assert (np.einsum("ni,ni->n", own, ways[rows]) >= np.cos(np.deg2rad(CONE_DEG))).all()


def test_grasps_in_scenes_and_files_without_valid_grasps_are_refused(source: Shard) -> None:
    for arrays, attributes, message in (
        (source.arrays, {"scene": "{}"}, "transfer grasps of a free object"),
        ({**source.arrays, "quality/valid": np.zeros(2, np.uint8)}, {}, "no valid grasp"),
    ):
        shard = Shard(**{**vars(source), "arrays": arrays, "attributes": {**source.attributes, **attributes}})
        with pytest.raises(InputError, match=message):
            transfer_grasps(shard, "allegro")
