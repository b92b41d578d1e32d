"""The context of work (parts, cores, how it is stopped), and grasps as a base shard has them."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from graspd.service.model.cores import available_cores
from graspd.service.model.domain import JobOptions
from graspd.service.model.errors import InputError, TaskCancelled
from graspd.service.store.columns import SCHEMAS, check_attributes
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.files.provenance import base_attributes
from graspd.worker.grasps import GraspSet, Posture
from tests.worker.models import object_from_mesh, two_finger_hand


def test_a_part_of_a_part_fills_its_share_of_the_whole() -> None:
    told: list[tuple[float, float, str]] = []
    run = ExecutionContext("cuda:7", 3, lambda *what: told.append(what), lambda: True)
    part = run.part(0.5, 1.0).part(0.0, 0.5)
    part.progress(1, 2, "half")
    part.progress(5, 5, "whole")
    part.progress(0, 0, "of nothing")
    assert told == [(0.625, 1.0, "half"), (0.75, 1.0, "whole"), (0.5, 1.0, "of nothing")]
    assert (part.device, part.threads, part.cancelled()) == ("cuda:7", 3, True)


def test_a_quiet_part_tells_nothing_and_can_still_be_stopped() -> None:
    told: list[tuple[float, float, str]] = []
    run = ExecutionContext(progress=lambda *what: told.append(what), cancelled=lambda: True).quiet()
    run.progress(1, 1, "done")
    assert not told
    with pytest.raises(TaskCancelled, match="the work was cancelled"):
        run.check("the work")


def test_without_number_of_threads_it_takes_the_cores_there_are() -> None:
    assert (ExecutionContext().cores, ExecutionContext(threads=3).cores) == (available_cores(), 3)


COUNT, JOINTS = 3, 2


def postures(rng: np.random.Generator) -> Posture:
    return Posture(rng.normal(size=(COUNT, 7)), rng.normal(size=(COUNT, JOINTS)))


def some(*, in_scenes: bool) -> GraspSet:
    rng = np.random.default_rng(3)
    found = GraspSet(postures(rng), postures(rng), postures(rng), rng.normal(size=COUNT))
    if in_scenes:
        found.scene = np.array([2, 0, 1])
        found.approach, found.coming = rng.normal(size=(COUNT, 4, 7)), rng.normal(size=(COUNT, JOINTS))
        found.lift = Posture(rng.normal(size=(COUNT, 7)), found.squeeze.joint_positions)
    return found


@pytest.mark.parametrize("in_scenes", [False, True])
def test_grasps_come_back_from_the_columns_they_went_into(in_scenes: bool) -> None:
    grasps = some(in_scenes=in_scenes)
    columns = grasps.to_columns()
    assert set(columns) <= set(SCHEMAS["base"])
    back = GraspSet.from_columns({**columns, "quality/stability_loss": grasps.stability_loss})
    np.testing.assert_array_equal(back.stability_loss, grasps.stability_loss)
    assert back.to_columns().keys() == columns.keys()
    for path, array in back.to_columns().items():
        np.testing.assert_array_equal(array, columns[path])
    if in_scenes:
        assert back.lift is not None and grasps.lift is not None
        np.testing.assert_array_equal(back.lift.joint_positions, grasps.lift.joint_positions)


@pytest.mark.parametrize(("key", "level"), [("k", "dexgraspbench"), (None, "none")])
def test_a_base_shard_says_who_validated_its_grasps(key: str | None, level: str) -> None:
    box, asked = object_from_mesh(trimesh.creation.box((0.05, 0.05, 0.05))), JobOptions(validation="dexgraspbench")
    said = base_attributes(two_finger_hand(), box, asked, candidates=7, verdict_key=key)
    check_attributes("base", said)
    assert said["verdict_level"] == level and said.get("verdict_key") == key and said["candidates"] == 7


@pytest.mark.parametrize(
    ("kind", "said"), [("base", {"colour": "red"}), ("views", {"mu": 1.0}), ("base", {"candidates": "many"})]
)
def test_attributes_that_the_schema_does_not_have_are_refused(kind: str, said: dict[str, str]) -> None:
    with pytest.raises(InputError, match=next(iter(said))):
        check_attributes(kind, said)
