"""A job on a table through its three stages, as a worker runs them."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from graspd.service.model import names
from graspd.service.model.planning import message_of, plan
from graspd.service.model.records import AttemptRecord, JobRecord
from graspd.service.model.scene_spec import supports_in
from graspd.service.model.states import AssetKind, Stage
from graspd.service.queue.port import EventKind
from graspd.service.readers import Grasps, Pictures, open_shards
from graspd.service.store.assets import builtin_files
from graspd.service.store.library import publish_asset
from graspd.service.store.manifests import load_manifest, load_shard
from graspd.service.store.records import read_record
from graspd.service.store.shards import Shard
from graspd.service.store.store import Store, open_store
from graspd.worker.files.provenance import placed_of_shard
from graspd.worker.rendering import Extras
from graspd.worker.rendering import render as pictures
from graspd.worker.stages.assets import object_of
from graspd.worker.stages.context import batch_seed
from tests.worker.stages.jobs import STAGES, end_of, job_of

TABLE = {"grasps": 6, "fidelity": "draft", "seed": 3, "rechecks": 0, "scene": "table", "scenes": 2}
TABLE |= {"views": 1, "width": 48, "height": 36}
DOWN = [0, 0, 0, 1, 0, 0, 0]


@dataclass
class Bench:
    """A store with the built-in Barrett hand and block, and a worker."""

    store: Store
    job: JobRecord = field(init=False)

    def run(self, **request: Any) -> tuple[EventKind, str]:
        """Kind and words of the end of a job's first batch."""
        for one in request.get("neighbours", ()):
            files = builtin_files(AssetKind.OBJECT, one["object"])
            one["digest"] = publish_asset(self.store, AssetKind.OBJECT, one["object"], files).digest
        self.job = job_of(self.store, **request)
        end = end_of(self.store, self.job)
        return end.kind, end.message

    def last_attempt(self) -> tuple[str, bool]:
        """Error of the last task's first attempt, and whether it is the last."""
        task = list(plan(self.job))[-1]
        attempt = read_record(AttemptRecord, self.store, names.attempt(task.id, 1))
        return attempt.kind, attempt.last

    def made(self, stage: Stage) -> Shard:
        return load_shard(self.store, stage, next(task for task in plan(self.job) if task.stage is stage).output)


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    bench = Bench(open_store(tmp_path_factory.mktemp("store").as_uri()))
    assert bench.run(**TABLE) == (EventKind.FINISHED, "")
    yield bench


def test_grasps_stand_in_the_scenes_that_were_made_first(table: Bench) -> None:
    first, base = table.made(Stage.SCENE), table.made(Stage.SYNTHESIZE)
    np.testing.assert_array_equal(base["scene/object_pose"], first["scene/object_pose"])
    assert set(np.unique(base["grasp/scene_index"])) <= {0, 1}
    assert len(first["grasp/valid"]) == 0
    manifest = load_manifest(table.store, Stage.SYNTHESIZE, str(base.attributes["shard_id"]))
    assert manifest.valid == 6 == (base["quality/lift_outcome"] == 1).sum()
    assert all(one.clearance_m >= 0.002 and one.lift_hard is not None for one in manifest.grasps)
    assert 0 < manifest.info["lift_share"] <= manifest.info["clear_share"] <= 1


def test_pictures_show_the_scene_with_and_without_the_best_hand(table: Bench) -> None:
    views, base = table.made(Stage.RENDER), table.made(Stage.SYNTHESIZE)
    shown = views["camera/hand_grasp"]
    assert shown.tolist() == [
        max(np.flatnonzero(base["grasp/scene_index"] == s), key=lambda row: base["quality/epsilon"][row, 1])
        for s in (0, 1)
    ]
    assert (views["image/rgb_hand"] != views["image/rgb"]).any(axis=(1, 2, 3)).all()
    assert set(np.unique(views["image/segmentation"])) <= {0, 1, 2}


def test_readers_give_way_of_a_grasp_and_the_grasps_of_a_picture(table: Bench) -> None:
    shards = open_shards(table.store, job=table.job.id)
    columns = ("grasp/approach", "grasp/lift", "grasp/scene_index", "quality/lift_hard", "quality/clearance_m")
    grasps = Grasps(shards, columns)
    assert grasps[0]["grasp/approach"].shape == (6, 7)
    assert len(grasps.arrays()["quality/lift_hard"]) == 6
    pictures = Pictures(shards)
    assert sum(len(picture["grasp/hand_pose"]) for picture in pictures) == 6
    base, views = table.made(Stage.SYNTHESIZE), table.made(Stage.RENDER)
    row = int(pictures[0]["grasp/base_row"][0])
    assert base["grasp/scene_index"][row] == pictures[0]["scene"] == views["camera/scene_index"][0]


def test_neighbours_in_a_bin_stand_in_scenes_grasps_and_pictures(table: Bench) -> None:
    bench = Bench(table.store)
    beside = [{"object": "mug"}, {"object": "block"}]
    bench_of = {"scene": "bin", "neighbours": beside, "want": "candidates", "grasps": 2, "scenes": 1}
    assert bench.run(**TABLE | bench_of) == (EventKind.FINISHED, "")
    shards = [bench.made(stage) for stage in STAGES]
    for shard in shards:
        assert shard.attributes["neighbours"] == ["mug", "block"]
        assert shard.attributes["neighbour_digests"] == [one["digest"] for one in beside]
    first, base, views = shards
    assert base["scene/neighbour_pose"].shape == (1, 2, 7)
    np.testing.assert_array_equal(base["scene/neighbour_pose"], first["scene/neighbour_pose"])
    scenes = placed_of_shard(base)
    assert len(scenes.neighbours) == 2
    assert table.store.exists(names.asset_model(AssetKind.OBJECT, beside[0]["digest"])), "viewers show it"
    alone = render_alone(bench, base)
    assert (views["image/depth"] != alone["image/depth"]).any(), "they are in the picture"
    assert set(np.unique(views["image/segmentation"])) - {0, 1, 2}


def render_alone(bench: Bench, base: Shard) -> dict[str, Any]:
    """The pictures of a job's scenes as they would be without neighbours."""
    message = message_of(bench.job, list(plan(bench.job))[-1], attempt=1, max_attempt=3)
    request, obj = bench.job.request, object_of(bench.store, message)
    options = {"views": 1, "stereo": False, "width": request.width, "height": request.height}
    extras = Extras(supports=supports_in(request.place))
    return pictures(obj, np.asarray(base["scene/object_pose"]), **options, seed=batch_seed(message), extras=extras)


def test_a_scene_without_a_way_in_fails_the_job_and_says_so(table: Bench) -> None:
    walls = [{"kind": "box", "size": [0.4, 0.02, 0.6], "pose": [0, s * 0.05, 0.3, 1, 0, 0, 0]} for s in (-1, 1)] + [
        {"kind": "box", "size": [0.02, 0.4, 0.6], "pose": [s * 0.07, 0, 0.3, 1, 0, 0, 0]} for s in (-1, 1)
    ]
    shaft = {"supports": [{"kind": "half_space"}, *walls], "target": [0, 0, 0.03, 1, 0, 0, 0]}
    bench = Bench(table.store)
    kind, words = bench.run(**TABLE | {"scene": shaft, "grasps": 2, "budget": 1, "views": 0})
    assert kind is EventKind.FAILED and "\n" not in words
    assert bench.last_attempt() == ("SceneError", True), "it is not tried again"


@pytest.mark.parametrize("scene", ["table", "free"])
def test_payload_out_of_reach_fails_job_with_what_the_hand_lifts(table: Bench, scene: str) -> None:
    bench = Bench(table.store)
    wanted = {"scene": scene, "scenes": 0, "views": 0, "grasps": 8, "budget": 4, "min_payload": 90}
    kind, words = bench.run(**TABLE | wanted)
    assert kind is EventKind.FAILED
    assert re.search(r"none of 8 candidates is valid: barrett lifts [\d.]+ kg at friction .*; 90 kg are wanted", words)
    assert bench.last_attempt() == ("LoadError", True), "it is not tried again"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {
                "scene": {"supports": [{"kind": "half_space"}], "target": [0, 0, 0.045, 1, 0, 0, 0]},
                "neighbours": [{"object": "mug", "pose": [0.02, 0, 0, 1, 0, 0, 0]}],
            },
            r"block and mug overlap by [\d.]+ mm in scene 0; move one of them",
        ),
        ({"scene": {"supports": [{"kind": "half_space", "offset": 0.5}], "target": DOWN}}, "deep in support 0"),
        ({"scene": "table", "method": "elsewhere"}, "unknown method"),
    ],
)
def test_what_only_a_worker_can_know_fails_the_job_in_a_line(table: Bench, changes: dict[str, Any], words: str) -> None:
    kind, said = Bench(table.store).run(**TABLE | {"views": 0, "grasps": 1} | changes)
    assert kind is EventKind.FAILED and re.search(words, said)
