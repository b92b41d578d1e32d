"""Options of the method and fidelity `auto` in a dataset: what its cells ask for, and what stays as it was."""

from __future__ import annotations

import json
from typing import Any

import pytest

from graspd.service.index.rebuild import rebuild
from graspd.service.model import digests, names
from graspd.service.model.domain import JobRequest
from graspd.service.model.errors import ConflictError, InputError
from graspd.service.model.records import DatasetRecord, request_of
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.studies import IN_SCENE
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.cost import estimate
from graspd.service.pipeline.datasets.spec import DatasetRequest
from graspd.service.pipeline.fidelity_choice import Resolver
from graspd.service.store.records import charts_of, load_dataset, publish
from tests.fakes import record_of
from tests.planning import plan_all
from tests.service.pipeline.datasets.makers import jobs_of, wanted

ANNEALED = {"method": "graspit", "options": {"keep": 20, "steps": 40000}}
AUTO = {"fidelity": "auto", "target": "gsr>=0.6"}


def run_of(fidelity: str, speed: float, reached: float, hand: str, object_: str, way: str = "") -> dict[str, Any]:
    what = {"method": "fast_graspd", "fidelity": fidelity, "hand": hand, "object": object_}
    if way:
        return what | {"way": way, "end_to_end_per_second": speed, "lift": reached}
    return what | {"valid_per_second": speed, "gsr": reached, "epsilon": 0.3, "pd_mm": 0.1}


def chart(created: str = "2026-11-21T10:00:00.000Z", *, claw: str = "fine") -> dict[str, Any]:
    """The gripper needs standard on all but the cube, the claw a fidelity of one's choice on all."""
    runs = [run_of("draft", 40, 0.3, "gripper", "ball"), run_of("standard", 15, 0.8, "gripper", "ball")]
    runs += [run_of("draft", 40, 0.9, "gripper", "cube"), run_of(claw, 6, 0.7, "claw", "elsewhere")]
    return {"created": created, "runs": runs}


#: Of each cell, by that chart.
CHOSEN = ["standard", "draft", "fine", "fine"]


def requests_of(services: Services, name: str = "grasps") -> list[JobRequest]:
    plan_all(services)
    return [record_of(services, job).request for job in jobs_of(services, name)]


def test_a_cell_without_options_is_the_job_it_always_was(monkeypatch: pytest.MonkeyPatch) -> None:
    """The id was computed by graspd 0.1.0 before datasets had options."""
    monkeypatch.setattr(digests, "STAGE_REVISIONS", {"synthesize": 1})
    given = {"name": "x", "hands": ["allegro"], "objects": ["mug"], "grasps": 64, "scenes": 2}
    request = request_of(DatasetRequest.model_validate(given).shared, "allegro", "mug")
    assert digests.job_id(request, "0" * 32, "1" * 32) == "3451e42bdce0eab4549fc73883b4bbbd"


def test_options_of_the_method_are_those_of_each_cells_job(either: Services) -> None:
    actions.create(either, wanted(**ANNEALED))
    assert [(r.method, r.options) for r in requests_of(either)] == 4 * [("graspit", {"keep": 20, "steps": 40000})]
    with pytest.raises(ConflictError, match="its options is"):
        actions.create(either, wanted(**ANNEALED | {"options": {"keep": 5}}))


def test_with_auto_each_cell_gets_what_the_chart_promises_for_it(either: Services) -> None:
    publish(either.store, "charts", chart())
    actions.create(either, wanted(**AUTO))
    assert [(r.fidelity, r.target) for r in requests_of(either)] == [(fidelity, "") for fidelity in CHOSEN]
    assert [cell.fidelity for cell in either.index.datasets.cells("grasps").items] == CHOSEN
    assert either.index.datasets.get("grasps").options.target == "gsr>=0.6"
    rebuild(either.index, either.store)
    assert [cell.fidelity for cell in either.index.datasets.cells("grasps").items] == CHOSEN


def test_a_later_chart_changes_nothing_of_a_dataset(services: Services) -> None:
    publish(services.store, "charts", chart())
    actions.create(services, wanted(**AUTO))
    before = jobs_of(services, "grasps")
    actions.create(services, wanted("named", fidelity="fine"))
    assert before[2:] == jobs_of(services, "named")[2:], "each is the job of that fidelity"
    publish(services.store, "charts", chart("2026-11-21T11:00:00.000Z", claw="draft"))
    _, new = actions.create(services, wanted(**AUTO))
    assert not new and jobs_of(services, "grasps") == before
    publish(services.store, "charts", {"created": "2026-11-21T12:00:00.000Z", "runs": []})
    assert actions.create(services, wanted(**AUTO))[1] is False


def test_a_target_out_of_reach_on_one_cell_makes_no_dataset(services: Services) -> None:
    publish(services.store, "charts", chart())
    with pytest.raises(InputError, match=r"no fidelity of fast_graspd meets gsr>=0\.75"):
        actions.create(services, wanted(**AUTO | {"target": "gsr>=0.75"}))
    assert not services.store.exists(names.dataset_record("grasps"))


def test_the_cost_of_auto_is_that_of_the_chosen_fidelities(services: Services) -> None:
    publish(services.store, "charts", chart())
    both = estimate(services.index, wanted(hands=("gripper",), **AUTO), Resolver(services.store))
    apart = [
        estimate(services.index, wanted(hands=("gripper",), objects=(obj,), fidelity=fidelity))
        for obj, fidelity in (("ball", "standard"), ("cube", "draft"))
    ]
    assert both.seconds == pytest.approx(sum(one.seconds for one in apart))


def test_a_record_from_before_has_neither_and_is_read(services: Services) -> None:
    actions.create(services, wanted())
    stored = json.loads(services.store.get(names.dataset_record("grasps")))
    stored["options"] = {k: v for k, v in stored["options"].items() if k not in ("options", "target")}
    del stored["fidelities"]
    assert DatasetRecord.model_validate(stored) == load_dataset(services.store, "grasps")


def test_each_cell_in_scenes_says_how_its_fidelity_was_chosen(either: Services) -> None:
    runs = [run_of("draft", 20, lift, "gripper", obj, IN_SCENE) for obj, lift in (("ball", 0.8), ("cube", 0.92))]
    runs += [run_of("standard", 15, lift, "gripper", obj, IN_SCENE) for obj, lift in (("ball", 0.95), ("cube", 0.99))]
    place = SceneSpec(kind="table")
    created = {"created": "2026-11-21T10:00:00.000Z", "scene": place.model_dump(mode="json")}
    key = publish(either.store, charts_of(place), created | {"runs": runs})
    actions.create(either, wanted(fidelity="auto", target="lift>=0.9", scene="table"))
    rebuild(either.index, either.store)
    cells = either.index.datasets.cells("grasps").items
    assert [cell.fidelity for cell in cells] == ["standard", "draft", "standard", "standard"]
    assert [(c.choice.measured_on, c.choice.reached, c.choice.chart) for c in cells if c.choice] == [
        (on, reached, key)
        for on, reached in [("hand and object", 0.95), ("hand and object", 0.92), ("all", 0.97), ("all", 0.97)]
    ]
    plan_all(either)
    assert [record_of(either, job).choice for job in jobs_of(either, "grasps")] == [cell.choice for cell in cells]
    assert len(load_dataset(either.store, "grasps").choices) == 3
