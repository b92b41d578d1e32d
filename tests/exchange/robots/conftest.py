"""Real grasps, of a free block and of a bottle on a table, as shards that robots are to carry out."""

from pathlib import Path

import pytest

from graspd.worker.engines import backend
from tests.worker.commands_run import graspd

COMMON = "--fidelity draft --want candidates --seed 3 --threads 2"
# Without a validator, so that not all of them lift.
TABLE = f"--hand barrett --object bottle --scene table --scenes 2 -n 6 --validation none {COMMON}"


@pytest.fixture(scope="session", autouse=True)
def engine() -> None:
    backend.start_warp()


def _shard(name: str, words: str):
    @pytest.fixture(scope="session", name=name)
    def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
        file = tmp_path_factory.mktemp(name) / "grasps.h5"
        graspd(f"synth {words} -o", file)
        return file

    return made


# Barrett grasps as they come, feasible or not: of a free block, of a bottle on tables, with fingertips that may press
# into the table, and with a block beside it.
free_shard = _shard("free_shard", f"--hand barrett --object block -n 6 {COMMON}")
table_shard, pressing_shard = _shard("table_shard", TABLE), _shard("pressing_shard", f"{TABLE} --touch -1")
clutter_shard = _shard("clutter_shard", f"{TABLE} --with block")
