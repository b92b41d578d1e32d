"""A few real grasps for the formats to carry."""

from functools import cache
from pathlib import Path

import pytest

from graspd.service.model.fidelity import FIDELITIES
from graspd.service.store.shards import Shard, read_shard, write_shard
from graspd.worker.engines import backend
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import synthesize
from graspd.worker.planners.port import PlanRequest
from tests.worker.commands_run import graspd


@pytest.fixture(scope="session")
def hand():
    backend.start_warp()
    return hand_from_path("barrett")


@pytest.fixture(scope="session")
def block():
    return object_from_path("block")


@pytest.fixture(scope="session")
def grasps(hand, block):
    return synthesize(hand, block, PlanRequest(count=4, fidelity=FIDELITIES["draft"], seed=5))


@pytest.fixture(scope="session")
def on_tables(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Shards of grasps on tables with pictures of their scenes, two objects. What is told of the other object's grasps
    and pictures is not true of it: their numbers are the block's, which is all that writers and readers see of them."""
    folder = tmp_path_factory.mktemp("on-tables")
    block, views = folder / "block.h5", folder / "block-views.h5"
    table = "--hand barrett --object block --scene table --scenes 2 -n 8 --want candidates --fidelity draft"
    graspd(f"synth {table} --seed 1 -o", block)  # all eight of these are valid
    graspd("render --views 2 --width 96 --height 72 -o", views, block)
    base, seen = read_shard(block, kind="base"), read_shard(views, kind="views")
    mug = {"object": "mug", "object_digest": object_from_path("mug").digest}
    as_base, as_views = {**mug, "shard_id": "a" * 64}, {**mug, "shard_id": "b" * 64, "base_shard": "a" * 64}
    (folder / "mug.h5").write_bytes(write_shard("base", base.arrays, base.attributes | as_base))
    (folder / "mug-views.h5").write_bytes(write_shard("views", seen.arrays, seen.attributes | as_views))
    return folder


@pytest.fixture(scope="session")
def exported(on_tables: Path, tmp_path_factory: pytest.TempPathFactory):
    """Folder of these in a training format."""

    @cache
    def export(format_: str) -> Path:
        folder = tmp_path_factory.mktemp(format_) / "data"
        every = "" if format_ == "graspgen" else "--all "
        assert graspd(f"export --format {format_} {every}-o", folder, on_tables)["grasps"] == 16
        return folder

    return export


def _exported(name: str, format_: str):
    @pytest.fixture(scope="session", name=name)
    def folder(exported) -> Path:
        return exported(format_)

    return folder


checkout, data = _exported("checkout", "dexlearn"), _exported("data", "graspgen")
folder = _exported("folder", "huggingface")


@pytest.fixture(scope="session")
def stored(on_tables: Path) -> Shard:
    return read_shard(on_tables / "block.h5", kind="base")
