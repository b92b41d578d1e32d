"""Jobs through their stages, as a worker runs them: in scenes, in ranges of batches, from a network of the store."""

import json
import re
from dataclasses import dataclass, field

import numpy as np
import pytest
from cachetools import LRUCache

from graspd.baselines.learned.method import table_height
from graspd.service.model import names
from graspd.service.model.digests import digest_bytes, job_id
from graspd.service.model.domain import Asset, JobOptions, JobRequest
from graspd.service.model.errors import DamagedShard, TaskCancelled
from graspd.service.model.messages import IngestMessage
from graspd.service.model.planning import create_task_message, plan_tasks
from graspd.service.model.records import AttemptRecord, JobRecord
from graspd.service.model.scene_spec import build_scene_spec, has_table, scene_supports
from graspd.service.model.states import AssetKind, Stage
from graspd.service.queue.port import Event, EventKind
from graspd.service.readers import Grasps, Pictures, open_shards
from graspd.service.store.assets import builtin_files, pack
from graspd.service.store.library import load_check, publish_asset
from graspd.service.store.manifests import load_manifest, load_shard
from graspd.service.store.network_file import NETWORK_FILE, check_network
from graspd.service.store.records import put_record, read_record
from graspd.service.store.shards import Shard
from graspd.service.store.store import Store, open_store
from graspd.worker import generation
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.files.provenance import scenes_of_shard
from graspd.worker.files.synthesis import synthesize_grasps
from graspd.worker.hands.load import hand_from_path
from graspd.worker.planners import NoStartFound
from graspd.worker.planners import network_cache as known
from graspd.worker.planners.registry import local_options
from graspd.worker.process.runner import Runner
from graspd.worker.rendering import Extras
from graspd.worker.rendering import render as pictures
from graspd.worker.scenes.kinds import supports_of
from graspd.worker.stages import assets, ingest, render, scene, synthesize
from graspd.worker.stages.assets import object_of
from graspd.worker.stages.context import StopReason, TaskContext, batch_seed
from graspd.worker.stages.ranges import base_rows, split_into_batches
from graspd.worker.stages.replay import replay
from tests.fakes import job_record, message_for
from tests.networks import LEARNED, network_files, random_network

STAGES = {Stage.SCENE: scene.run, Stage.SYNTHESIZE: synthesize.run, Stage.RENDER: render.run}
TABLE = {"grasps": 6, "fidelity": "draft", "seed": 3, "rechecks": 0, "scene": "table", "scenes": 2}
TABLE |= {"views": 1, "width": 48, "height": 36}
DOWN = [0, 0, 0, 1, 0, 0, 0]
ASKEW = {"scene": {"supports": [{"kind": "half_space"}], "target": [0, 0, 0.045, 1, 0, 0, 0]}}
ASKEW |= {"neighbours": [{"object": "mug", "pose": [0.02, 0, 0, 1, 0, 0, 0]}]}
SIZE = 3  # batches as small as they can be, so that several take a few seconds
small = pytest.mark.usefixtures("small_batches")


def job_of(store: Store, span: int = 1, **request) -> JobRecord:
    """A job of the built-in hand and object, in the store with them."""
    hand = publish_asset(store, AssetKind.HAND, "barrett", builtin_files(AssetKind.HAND, "barrett"))
    obj = publish_asset(store, AssetKind.OBJECT, "block", builtin_files(AssetKind.OBJECT, "block"))
    wanted = JobRequest(hand="barrett", object="block", **request)
    digests = {"hand_digest": hand.digest, "object_digest": obj.digest}
    job = job_record(wanted, job_id(wanted, *digests.values())).model_copy(update={**digests, "span": span})
    put_record(store, names.job_record_key(job.id), job)
    return job


def end_of(store: Store, job: JobRecord) -> Event:
    runner = Runner(STAGES, worker="w", publish=lambda event: None)
    for task in plan_tasks(job):
        message = create_task_message(job, task, attempt=1, max_attempt=3).model_dump(mode="json", by_alias=True)
        event = runner.run(message, TaskContext(store, ExecutionContext(threads=2)))
        if event.kind is not EventKind.FINISHED:
            break
    return event


@dataclass
class Bench:
    """A store with the built-in Barrett hand and block, and a worker."""

    store: Store
    job: JobRecord = field(init=False)

    def run(self, **request) -> tuple[EventKind, str]:
        """Kind and words of the end of a job's first batch."""
        for one in request.get("neighbours", ()):
            files = builtin_files(AssetKind.OBJECT, one["object"])
            one["digest"] = publish_asset(self.store, AssetKind.OBJECT, one["object"], files).digest
        self.job = job_of(self.store, **request)
        end = end_of(self.store, self.job)
        return end.kind, end.message

    def last_attempt(self) -> tuple[str, bool]:
        attempt = read_record(AttemptRecord, self.store, names.attempt_key(list(plan_tasks(self.job))[-1].id, 1))
        return attempt.kind, attempt.last

    def made(self, stage: Stage) -> Shard:
        return load_shard(self.store, stage, next(task for task in plan_tasks(self.job) if task.stage is stage).output)


@pytest.fixture(scope="module")
def table(tmp_path_factory: pytest.TempPathFactory):
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
    epsilon = base["quality/epsilon"][:, 1]
    assert shown.tolist() == [max(np.flatnonzero(base["grasp/scene_index"] == s), key=epsilon.item) for s in (0, 1)]
    assert (views["image/rgb_hand"] != views["image/rgb"]).any(axis=(1, 2, 3)).all()
    assert set(np.unique(views["image/segmentation"])) <= {0, 1, 2}


def test_a_replay_lifts_what_the_validator_lifted_and_its_forces_balance(table: Bench) -> None:
    base = table.made(Stage.SYNTHESIZE)
    found = replay(table.store, str(base.attributes["shard_id"]), 2)
    way = found["way"]
    assert found["outcome"] == "lifted", "the verdict of the file"
    assert [point["name"] for point in way if point["name"]] == ["standoff", "pregrasp", "grasp", "squeeze", "lift"]
    assert (np.diff([point["place"] for point in way]) > 0).all() and way[-1]["place"] == 4
    contacts = np.array(way[-1]["contacts"])
    load = np.array(way[-1]["load"])
    # The object rises against its weight by 10 cm; the validator's limit of motion in the hand is 5 cm.
    assert 0.05 < -np.dot(way[-1]["object_pose"][:3], load) / np.linalg.norm(load) < 0.15
    # Held still: contact forces balance the weight, up to the drift within the hold's early end.
    np.testing.assert_allclose(contacts[:, 6:9].sum(axis=0), -load, atol=0.05 * np.linalg.norm(load))
    assert np.abs(contacts[:, 9:12].sum(axis=0)).max() < 0.1 * np.linalg.norm(load) * 0.05, "10 % of the weight at 5 cm"
    assert (np.einsum("ci,ci->c", contacts[:, 3:6], contacts[:, 6:9]) >= 0).all(), "contacts push"
    assert contacts[:, 12].all(), "the table is left"


def test_a_replay_of_a_free_grasp_pushes_in_six_directions(table: Bench) -> None:
    bench = Bench(table.store)
    assert bench.run(**TABLE | {"scene": "free", "scenes": 0, "views": 0, "grasps": 1})[0] is EventKind.FINISHED
    base = bench.made(Stage.SYNTHESIZE)
    found = replay(bench.store, str(base.attributes["shard_id"]), 0)
    phases = dict.fromkeys(point["phase"] for point in found["way"])
    assert found["outcome"] == "held" and len(phases) == 8, "approach, closing, six pushes"
    pushed = {point["phase"]: np.sign(np.round(point["load"], 6)).tolist() for point in found["way"][1:]}
    assert pushed["closing"] == [0, 0, 0] and pushed["pushed along -y"] == [0, -1, 0]


def test_readers_give_way_of_a_grasp_and_the_grasps_of_a_picture(table: Bench) -> None:
    shards = open_shards(table.store, job=table.job.id)
    columns = ("grasp/approach", "grasp/lift", "grasp/scene_index", "quality/lift_hard", "quality/clearance_m")
    grasps = Grasps(shards, columns)
    assert grasps[0]["grasp/approach"].shape == (6, 7) and len(grasps.arrays()["quality/lift_hard"]) == 6
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
    assert len(scenes_of_shard(base).neighbours) == 2
    assert table.store.exists(names.asset_key(AssetKind.OBJECT, beside[0]["digest"], "model.glb")), "viewers show it"
    alone = render_alone(bench, base)
    assert (views["image/depth"] != alone["image/depth"]).any(), "they are in the picture"
    assert set(np.unique(views["image/segmentation"])) - {0, 1, 2}


def render_alone(bench: Bench, base: Shard) -> dict:
    message = create_task_message(bench.job, list(plan_tasks(bench.job))[-1], attempt=1, max_attempt=3)
    request, obj = bench.job.request, object_of(bench.store, message)
    options = {"views": 1, "stereo": False, "width": request.width, "height": request.height}
    extras = Extras(supports=scene_supports(request.scene_spec))
    return pictures(obj, np.asarray(base["scene/object_pose"]), **options, seed=batch_seed(message), extras=extras)


def test_a_scene_without_a_way_in_fails_the_job_and_says_so(table: Bench) -> None:
    walls = [{"kind": "box", "size": [0.4, 0.02, 0.6], "pose": [0, s * 0.05, 0.3, 1, 0, 0, 0]} for s in (-1, 1)]
    walls += [{"kind": "box", "size": [0.02, 0.4, 0.6], "pose": [s * 0.07, 0, 0.3, 1, 0, 0, 0]} for s in (-1, 1)]
    shaft = {"supports": [{"kind": "half_space"}, *walls], "target": [0, 0, 0.03, 1, 0, 0, 0]}
    bench = Bench(table.store)
    kind, words = bench.run(**TABLE | {"scene": shaft, "grasps": 2, "budget": 1, "views": 0})
    assert kind is EventKind.FAILED and "\n" not in words
    assert bench.last_attempt() == ("SceneError", True), "it is not tried again"


@pytest.mark.parametrize(
    ("scene", "grasps", "says", "error"),
    [
        ("table", 8, "is valid: ", "LoadError"),
        ("free", 8, "is valid: ", "LoadError"),
        # Too few for the limit of the hand.
        ("table", 2, r"is valid in its scene \(table\): 2 below the required payload; ", "SceneError"),
    ],
)
def test_payload_out_of_reach_fails_job_with_what_the_hand_lifts(table, scene: str, grasps: int, says, error) -> None:
    bench = Bench(table.store)
    wanted = {"scene": scene, "scenes": 0, "views": 0, "grasps": grasps, "budget": 1, "min_payload": 90}
    kind, words = bench.run(**TABLE | wanted)
    assert kind is EventKind.FAILED
    says += r"barrett lifts [\d.]+ kg at friction .*; 90 kg are wanted"
    assert re.search(f"none of {grasps} candidates {says}", words)
    assert bench.last_attempt() == (error, True), "it is not tried again"


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (ASKEW, r"block and mug overlap by [\d.]+ mm in scene 0; move one of them"),
        ({"scene": {"supports": [{"kind": "half_space", "offset": 0.5}], "target": DOWN}}, "deep in support 0"),
        ({"scene": "table", "method": "elsewhere"}, "unknown method"),
    ],
)
def test_what_only_a_worker_can_know_fails_the_job_in_a_line(table: Bench, changes: dict, words: str) -> None:
    kind, said = Bench(table.store).run(**TABLE | {"views": 0, "grasps": 1} | changes)
    assert kind is EventKind.FAILED and re.search(words, said)


@pytest.fixture
def small_batches(monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("graspd.service.model.domain", "graspd.service.model.planning", "graspd.worker.stages.ranges"):
        monkeypatch.setattr(f"{module}.BATCH_SIZE", SIZE)


def made(store: Store, span: int, **request) -> tuple[JobRecord, list[tuple]]:
    job = job_of(store, span, fidelity="draft", seed=3, **request)
    end = end_of(store, job)
    assert end.kind is EventKind.FINISHED, end
    tasks = [(task.stage, task.output) for task in plan_tasks(job)]
    return job, [(stage, load_shard(store, stage, out), load_manifest(store, stage, out)) for stage, out in tasks]


@small
@pytest.mark.parametrize(
    "request_of",
    [{"scenes": 2}, {"rechecks": SIZE}, {"scene": "table", "scenes": 2, "budget": 20}],
    ids=["scenes after", "rechecks of the first batch", "scenes before"],
)
def test_a_range_is_its_batches_one_after_the_other(request_of: dict) -> None:
    apart = made(open_store("memory://"), 1, grasps=2 * SIZE + 1, **request_of)[1]
    _, together = made(open_store("memory://"), 3, grasps=2 * SIZE + 1, **request_of)
    assert len(apart) == 3 * len(together) > 0
    for stage, whole, manifest in together:
        parts = [shard for of, shard, _ in apart if of is stage]
        of_parts = [one for of, _, one in apart if of is stage]
        scenes = np.cumsum([0, *(len(part.arrays.get("scene/object_pose", ())) for part in parts)])
        bases = np.cumsum([0, *(len(shard["grasp/hand_pose"]) for of, shard, _ in apart if of is Stage.SYNTHESIZE)])
        assert whole.arrays.keys() == {path for part in parts for path in part.arrays}
        for path, column in whole.arrays.items():
            if path == "quality/thresholds_m":
                np.testing.assert_array_equal(column, parts[0][path])
                continue
            # Only some batches are rechecked.
            pieces = [part.arrays.get(path, np.full(len(part["grasp/hand_pose"]), -1)) for part in parts]
            if (firsts := {"grasp/scene_index": scenes, "grasp/base_index": bases}.get(path)) is not None:
                pieces = [piece + first for piece, first in zip(pieces, firsts, strict=False)]
            np.testing.assert_array_equal(column, np.concatenate(pieces), err_msg=path)
        assert manifest.batches == 3 and manifest.valid == sum(one.valid for one in of_parts)
        assert manifest.candidates == sum(one.candidates for one in of_parts)
        assert manifest.rechecked == sum(one.rechecked for one in of_parts)
        if stage is Stage.SYNTHESIZE:
            assert whole.attributes["batch_rows"] == str([one.count for one in of_parts])
            assert manifest.info["planned"] == sum(one.info["planned"] for one in of_parts)
            assert manifest.grasps == sum((one.grasps for one in of_parts), ())


@small
def test_a_base_shard_of_other_batches_is_refused() -> None:
    base = Shard("base", {"batch_rows": f"[{SIZE}, {SIZE}]"}, {"grasp/hand_pose": np.zeros((2 * SIZE, 7))})
    message = message_for(Stage.SCENE, scenes=1).model_copy(update={"count": 2 * SIZE})
    assert base_rows(base, message) == [range(SIZE), range(SIZE, 2 * SIZE)]
    assert [(one.batch, one.count) for one in split_into_batches(message)] == [(0, SIZE), (1, SIZE)]
    with pytest.raises(DamagedShard, match="2 batches"):
        base_rows(base, message.model_copy(update={"count": 3 * SIZE}))


@small
def test_range_tells_how_far_it_is_and_stops_where_it_is_told_to(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("graspd.worker.stages.context.REPORT_EVERY_S", 0.0)
    store = open_store("memory://")
    job, _ = made(store, 2, grasps=2 * SIZE, want="candidates")
    message = create_task_message(job, next(plan_tasks(job)), attempt=1, max_attempt=1)
    told: list[float] = []

    def tell(done: float, total: float, _: str) -> None:
        told.append(done / total)
        if len(told) == stops_at:
            context.stop(StopReason.CANCELLED)

    for stops_at in (0, 1):
        told.clear()
        context = TaskContext(store, ExecutionContext(threads=2), tell=tell)
        if stops_at:
            with pytest.raises(TaskCancelled):
                synthesize.run(message, context)
            assert told[-1] < 0.5, "it ends in its first batch"
        else:
            synthesize.run(message, context)
            assert told == sorted(told)
            assert any(0 < share < 0.5 for share in told) and any(0.5 < share < 1 for share in told)


@small
def test_a_batch_without_a_place_has_no_grasps(monkeypatch) -> None:
    """As where none is found within the budget: the grasps of the other batches stay."""
    whole = generation.validated_grasps

    def some(*given, batch: int, **options):
        if batch == 1:
            raise NoStartFound("no hand finds a way in")
        return whole(*given, batch=batch, **options)

    monkeypatch.setattr("graspd.worker.batched_generation.validated_grasps", some)
    asked = {"grasps": 2 * SIZE + 1, "scene": "table", "scenes": 2, "budget": 20}
    _, (_, (_, base, manifest)) = made(open_store("memory://"), 3, **asked)
    assert base.attributes["batch_rows"] == f"[{SIZE}, 0, 1]"
    assert set(base["grasp/scene_index"]) <= {0, 1, 4, 5}, "the scenes of the batch are there, and empty"
    assert len(base["scene/object_pose"]) == 6
    assert manifest.count == SIZE + 1


@pytest.fixture(scope="module")
def files() -> dict[str, bytes]:
    hand = hand_from_path("barrett")
    return network_files(random_network(hand.joint_names, hand=hand.name, digest=hand.digest))


@pytest.fixture
def store(tmp_path) -> Store:
    return open_store((tmp_path / "store").as_uri())


@pytest.fixture
def network(store: Store, files: dict[str, bytes], monkeypatch: pytest.MonkeyPatch) -> Asset:
    monkeypatch.setattr(known, "_known", LRUCache(16))
    monkeypatch.setattr(assets, "_cache", LRUCache(16))
    return publish_asset(store, AssetKind.NETWORK, "net", files)


def test_the_grasps_of_a_job_are_those_of_synth_with_the_file(store: Store, network: Asset, files, tmp_path) -> None:
    job = job_of(store, **LEARNED, options={"network": network.digest, "starts": 2})
    end = end_of(store, job)
    assert end.kind is EventKind.FINISHED, end
    made = load_shard(store, Stage.SYNTHESIZE, list(plan_tasks(job))[-1].output)
    (tmp_path / "net.npz").write_bytes(files[NETWORK_FILE])
    own = local_options("learned", {"network": str(tmp_path / "net.npz"), "starts": 2})
    assert own["network"] == digest_bytes(files[NETWORK_FILE]) != network.digest
    request = JobOptions(**LEARNED, options=own)
    alone = synthesize_grasps("barrett", "block", request, place=request.scene_spec, scenes=2, device="cpu", threads=2)
    assert set(made.arrays) == set(alone.arrays) and len(made["grasp/hand_pose"]) == 3
    for name, values in alone.arrays.items():
        np.testing.assert_array_equal(made[name], values, err_msg=name)
    without = JobOptions(**{**LEARNED, "method": "fast_graspd"})
    other = synthesize_grasps("barrett", "block", without, place=without.scene_spec, scenes=2, device="cpu", threads=2)
    assert (made["grasp/hand_pose"] != other.arrays["grasp/hand_pose"]).any(), "the network is followed"


def test_files_that_are_not_what_their_digest_says_fail_the_job(store: Store, network: Asset, files) -> None:
    key = names.asset_key(AssetKind.NETWORK, network.digest, "files.zip")
    store.delete(key)
    store.put(key, pack(files | {NETWORK_FILE: files[NETWORK_FILE][:-1]}))
    for digest, told in ((network.digest, f"network {network.digest} in the store is damaged"), ("e" * 32, "e" * 32)):
        end = end_of(store, job_of(store, **LEARNED, options={"network": digest}))
        assert end.kind is not EventKind.FINISHED and "\n" not in end.message and told in end.message


def test_a_worker_reads_a_network_once(store: Store, network: Asset, monkeypatch: pytest.MonkeyPatch) -> None:
    job = job_of(store, **LEARNED, options={"network": network.digest})
    message = create_task_message(job, next(plan_tasks(job)), attempt=1, max_attempt=3)
    assets.cache_network(store, message)
    monkeypatch.setattr(assets, "load_asset_files", None)
    assets.cache_network(store, message)
    assert known.load_network(network.digest).hand == "barrett"


def test_a_network_whose_finding_was_lost_is_checked_by_a_worker(store: Store, network: Asset, files) -> None:
    message = IngestMessage(schema_=2, task_id="i", kind=AssetKind.NETWORK, name="net", digest=network.digest)
    ingest.run(message, TaskContext(store))
    found = load_check(store, AssetKind.NETWORK, network.digest)
    assert found == json.loads(json.dumps(check_network(files, "net")))
    assert not store.exists(names.asset_key(AssetKind.NETWORK, network.digest, "model.glb"))


@pytest.mark.parametrize(
    "scene",
    [
        "table",
        "bin",
        "shelf",
        {"supports": [{"kind": "half_space", "normal": [0, 0, 5], "offset": 0.3}]},
        {"supports": [{"kind": "half_space", "normal": [0, 0, -1]}]},
        {"supports": [{"kind": "half_space", "normal": [0.001, 0, 1]}]},
        {"supports": [{"kind": "half_space", "normal": [0.01, 0, 1]}]},
        {"supports": [{"kind": "box", "size": [1, 1, 0.1]}]},
    ],
)
def test_scene_is_refused_at_door_where_planner_finds_no_table(scene) -> None:
    place = JobOptions(scene=scene).scene_spec
    assert place == build_scene_spec(JobOptions(scene=scene).scene, faces="drawn", touch=0.0, beside=())
    try:
        table_height(supports_of(place))
    except Exception:
        assert not has_table(place)
    else:
        assert has_table(place)
