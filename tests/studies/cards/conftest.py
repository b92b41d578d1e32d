"""Datasets with known contents and their cards: built-in assets, grasps drawn at random or as a test wants."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from graspd.service.model import names
from graspd.service.model.planning import message_of, plan
from graspd.service.model.records import JobRecord, Snapshot
from graspd.service.model.states import Stage
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.export import export_shards
from graspd.service.pipeline.datasets.spec import DatasetRequest
from graspd.service.settings import Settings
from graspd.service.store.manifests import publish_shard
from graspd.service.store.records import read_record
from graspd.service.store.shards import json_attribute
from graspd.service.store.store import open_store
from graspd.studies.cards.card import write_card
from graspd.studies.cards.contents import Contents, contents_of_store, pieces
from graspd.studies.cards.numbers import numbers
from graspd.studies.cards.page import render_card
from graspd.studies.cards.tally import tally_of
from graspd.worker.hands.load import hand_from_path
from graspd.worker.stages.context import Output, shard_of
from tests.api import factories
from tests.fakes import fail_task, plan_all
from tests.indexes import empty_index
from tests.memory_queue import MemoryQueue

HANDS = ("allegro", "barrett")
OBJECTS = ("block", "mug")
NAME = "kitchen"
#: Of this joint of this hand the card must say that it never moves.
STILL_HAND, STILL_JOINT = "barrett", "finger_1_spread"
SECONDS = {Stage.SYNTHESIZE: 2.0, Stage.SCENE: 0.5, Stage.RENDER: 1.5}
Array = NDArray[Any]
#: May change a base shard's columns, by hand and object, before it is written.
Change = Callable[[str, str, dict[str, Array]], None]


@dataclass
class Case:
    """A dataset's services and snapshot, its contents, the folder of its card, and the card's figures."""

    services: Services
    snapshot: Snapshot
    contents: Contents
    folder: Path
    card: dict[str, Any]

    @property
    def page(self) -> str:
        return (self.folder / "README.md").read_text()


def case(folder: Path, *, drawn: bool = True, **options: Any) -> Case:
    """The card of a dataset, with its plots or without; options as of `dataset`."""
    services = dataset(folder, **options)
    snapshot = actions.snapshot(services, NAME)[0]
    contents = contents_of_store(services.store, NAME, cache=folder / "cache")
    if drawn:
        card = write_card(contents, folder / "card", licence="CC-BY-4.0")
    else:
        card = undrawn(contents)
        (folder / "card").mkdir()
        (folder / "card" / "README.md").write_text(render_card(card, {}))
    return Case(services, snapshot, contents, folder / "card", card)


def undrawn(contents: Contents) -> dict[str, Any]:
    return numbers(contents, tally_of(contents, pieces(contents)))


@pytest.fixture(scope="package")
def kitchen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Case]:
    """A whole dataset of two hands and two objects; tests only read it."""
    made = case(tmp_path_factory.mktemp(NAME))
    yield made
    made.services.close()


@pytest.fixture(scope="package")
def export(kitchen: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shards of that dataset as `graspd datasets export` writes them; tests only read it."""
    folder = tmp_path_factory.mktemp("export") / NAME
    export_shards(kitchen.snapshot, folder, lambda shard: kitchen.services.store.stream(shard.key))
    return folder


def unchanged(hand: str, obj: str, columns: dict[str, Array]) -> None: ...


def dataset(folder: Path, change: Change = unchanged, fails: Any = None, grasps: int = 40, **options: Any) -> Services:
    """Two hands x two objects, two batches each, with scenes and pictures; of the cell `fails` the first task fails."""
    store, index = open_store((folder / "store").as_uri()), empty_index(f"sqlite:///{folder / 'index.sqlite'}")
    services = Services(Settings(data_dir=folder), store, index, MemoryQueue())
    factories.add_builtins(services)
    given = {"scenes": 2, "views": 1, "width": 24, "height": 16, "stereo": False, **options}
    wanted = {"name": NAME, "hands": HANDS, "objects": OBJECTS, "grasps": grasps, **given}
    actions.create(services, DatasetRequest.model_validate(wanted))
    plan_all(services)
    for cell in services.index.datasets.cells(NAME, limit=200).items:
        record = read_record(JobRecord, services.store, names.job_record(cell.job_id))
        if (cell.hand, cell.object) == fails:
            fail_task(services, record.id, next(plan(record)), kind="MeshError", reason="the mesh is torn")
        else:
            _finish(services, record, change)
    return services


def _finish(services: Services, record: JobRecord, change: Change) -> None:
    request, base = record.request, dict[str, Array]()
    place = {"scene": json_attribute(request.place.model_dump(mode="json"))} if request.in_scene else {}
    for task in plan(record):
        rng = np.random.default_rng([task.batch, *map(ord, request.hand + request.object)])
        if task.stage is Stage.SYNTHESIZE:
            joints = hand_from_path(request.hand).joint_names
            base = _base(rng, joints, task.count, task.batch)
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
            output = Output(factories._views(rng, task.count, request), {"scene_shard": task.inputs[0], **place})
        message = message_of(record, task, attempt=1, max_attempt=3)
        manifest, data = shard_of(message, output, device="cpu", seconds=SECONDS[task.stage], worker="w1")
        publish_shard(services.store, manifest, data)
        services.index.write.add_manifests([manifest])


def _base(rng: np.random.Generator, joints: tuple[str, ...], count: int, batch: int) -> dict[str, Array]:
    columns: dict[str, Array] = {"quality/thresholds_m": np.array([0.001, 0.005])}
    for posture in ("grasp", "pregrasp", "squeeze"):
        columns[f"{posture}/hand_pose"] = factories.poses(rng, count)
        columns[f"{posture}/joint_positions"] = rng.uniform(0.0, 0.5, (count, len(joints)))
    if STILL_JOINT in joints:
        columns["grasp/joint_positions"][:, joints.index(STILL_JOINT)] = -1.0
    for name, scale in (("contact_area_cm2", 40.0), ("epsilon", 0.3), ("wrench_volume", 3.0)):
        columns[f"quality/{name}"] = rng.gamma(9.0, scale / 9, (count, 2))
    small = {"intersection_volume_cm3": 0.01, "penetration_depth_mm": 0.3, "self_penetration_depth_mm": 0.01}
    for name, scale in (small | {"simulated_displacement_cm": 0.05, "stability_loss": 0.05}).items():
        columns[f"quality/{name}"] = rng.gamma(2.0, scale / 2, count)
    columns["quality/contact_links"] = rng.integers(2, 9, count).astype(np.int32)
    columns["quality/valid"] = np.ones(count, np.uint8)
    columns["quality/success"] = np.ones(count, np.int8)
    if batch == 0:
        columns["quality/recheck"] = np.where(np.arange(count) < 8, 1, -1).astype(np.int8)
    return columns
