"""Stores, shards and tasks of graspd 0.2 are read under today's names, and their addresses stay."""

import io
import json
from pathlib import Path

import h5py
import numpy as np

from graspd.service.model import renamed
from graspd.service.model.domain import JobRequest
from graspd.service.readers.files import open_shards
from graspd.service.readers.grasps import Grasps
from graspd.service.store.records import CHARTS, latest_record, parse_record, publish_record
from graspd.service.store.shards import read_shard, write_shard
from graspd.service.store.store import open_store
from tests.fakes import make_shard, message_for, request

NEW = request(want="candidates", validation="fast", rechecks=3)
OLD = {"want": "raw", "referee": "screen", "audits": 3}


def test_a_request_has_the_names_of_0_2_and_back() -> None:
    document = renamed.original_request(NEW.model_dump(mode="json"))
    assert document.items() >= OLD.items() and "validation" not in document
    assert renamed.has_old_names(json.dumps(document).encode())
    assert parse_record(JobRequest, json.dumps(document).encode(), "a request") == NEW


def test_a_planners_own_options_keep_their_names() -> None:
    own = {"tried": 1, "lane": 2, "want": "raw"}
    made = request(method="other", options=own)
    for document in (made.model_dump(mode="json"), renamed.original_request(made.model_dump(mode="json"))):
        assert renamed.convert_names(document)["options"] == own
    assert renamed.convert_names({"options": made.model_dump(mode="json")})["options"]["options"] == own


def test_a_chart_of_0_2_has_todays_measures() -> None:
    row = {"letter": 0.9, "letter_low": 0.8, "lift_letter_count": 3, "front": ["letter"]}
    today = {"dexgraspbench": 0.9, "dexgraspbench_low": 0.8, "lift_dexgraspbench_count": 3, "front": ["dexgraspbench"]}
    others = {"gsr": 1.0, "options": {"letters": 1}, "remark": "a letter"}
    old = {"by_hand": {"allegro": [row]}, "referee": {"level": "certificate"}, "raw_end_to_end_per_second": 2.0}
    new = {"by_hand": {"allegro": [today]}, "validation": {"level": "standard"}}
    assert renamed.convert_chart(old | others) == new | others | {"candidates_end_to_end_per_second": 2.0}
    store = open_store("memory://")
    publish_record(store, CHARTS, {"created": "2026-11-25", "summary": [row]})
    assert latest_record(store, CHARTS) == {"created": "2026-11-25", "summary": [today]}


def test_only_a_worker_of_0_2_gets_its_names() -> None:
    message = {"request": NEW.model_dump(mode="json"), "stage": "synthesize"}
    assert renamed.message_for_revision(24, "synthesize", message) == message
    assert renamed.message_for_revision(23, "synthesize", message)["request"].items() >= OLD.items()


def test_a_shard_of_0_2_is_read_with_todays_columns_and_attributes(tmp_path: Path) -> None:
    store = open_store("memory://")
    made = read_shard(store.get(make_shard(store, message_for()).key), kind="base")
    arrays = dict(made.arrays) | {"quality/feasible": made.arrays["quality/valid"]}
    told = {name: value for name, value in made.attributes.items() if name != "schema"}
    buffer = io.BytesIO(write_shard("base", arrays, told | {"want": "candidates", "candidates": 7}))
    with h5py.File(buffer, "r+") as file:
        for new, old in renamed.COLUMNS.items():
            if new in file:
                file.move(new, old)
        file.attrs["schema"], file.attrs["want"], file.attrs["tried"] = "graspd/base@1", "raw", 7
        del file.attrs["candidates"]
        assert "quality/sound" in file
    (tmp_path / "old.h5").write_bytes(buffer.getvalue())
    found = read_shard(tmp_path / "old.h5", kind="base")
    np.testing.assert_array_equal(found.arrays["quality/feasible"], arrays["quality/feasible"])
    assert (found.attributes["want"], found.attributes["candidates"]) == ("candidates", 7)
    rows = Grasps(open_shards(tmp_path / "old.h5"), valid=False).arrays("quality/feasible")["quality/feasible"]
    np.testing.assert_array_equal(rows, arrays["quality/feasible"])
