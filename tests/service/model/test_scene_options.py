"""The scene of a job: what may be asked for, and that a job without one is what it was before there were scenes."""

from __future__ import annotations

from typing import Any

import pytest
from pydantic import ValidationError

from graspd.service.model.digests import digest_json, shard_id
from graspd.service.model.domain import SCENES, JobOptions, JobRequest
from graspd.service.model.planning import message_of, plan
from graspd.service.model.records import Member
from graspd.service.model.renamed import original
from graspd.service.model.states import Stage
from graspd.service.model.version import STAGE_REVISIONS
from graspd.service.pipeline.datasets.spec import describe
from graspd.worker.planners.registry import PLANNERS, method
from tests.fakes import request
from tests.service.model.jobs import DIGESTS, HAND, OBJECT, record

#: A job as it was written before jobs had scenes.
PLAIN: dict[str, Any] = (
    {"grasps": 32, "method": "fast_graspd", "fidelity": "standard", "seed": 0, "scenes": 0, "views": 0}
    | {"stereo": False, "width": 320, "height": 240, "channels": [], "friction": 1.0, "want": "valid", "budget": 4.0}
    | {"validation": "standard", "rechecks": 8, "robustness": 0, "options": {}, "target": ""}
)
PLANE = {"kind": "half_space"}


def test_a_job_without_a_scene_keeps_its_id_and_its_record() -> None:
    wanted = {**PLAIN, "hand": "gripper", "object": "ball"}
    job = record(request())
    assert job.request.model_dump(mode="json") == wanted
    said = {"request": original(wanted), "hand": HAND, "object": OBJECT, "revisions": STAGE_REVISIONS}
    assert job.id == digest_json(said)
    (task,) = plan(job)
    assert message_of(job, task, attempt=1, max_attempt=3).model_dump(mode="json")["request"] == wanted


def test_a_dataset_without_a_scene_keeps_its_digest() -> None:
    hands, objects = [Member(name="h", digest=HAND)], [Member(name="o", digest=OBJECT)]
    made = describe("d", hands, objects, JobOptions(), lambda one: (one, None))
    options = {name: value for name, value in PLAIN.items() if name not in ("options", "target")}
    assert made.digest == digest_json(
        {"hands": [["h", HAND]], "objects": [["o", OBJECT]], "options": original(options)}
    )


def test_scenes_after_the_grasps_have_the_address_that_they_had() -> None:
    common = {"hand": HAND, "object": OBJECT, "names": ["gripper", "ball"], "batch": 1, "count": 32, "seed": 0}
    said = {**common, "stage": "scene", "revision": 2, "inputs": ["x"], "scenes": 3}
    of = {"batch": 1, "count": 32, "revision": 2, "inputs": ("x",)}
    assert digest_json(said) == shard_id(Stage.SCENE, request=request(scenes=3), **DIGESTS, **of)


def test_a_job_in_a_scene_makes_its_scenes_first() -> None:
    job = record(request(scene="table", views=2))
    assert job.id != record(request(scenes=SCENES, views=2)).id
    scene, base, views = plan(job)
    assert [task.stage for task in (scene, base, views)] == [Stage.SCENE, Stage.SYNTHESIZE, Stage.RENDER]
    assert (scene.inputs, base.inputs, views.inputs) == ((), (scene.output,), (base.output,))


@pytest.mark.parametrize(
    ("name", "value"),
    [
        *[("scene", "bin"), ("scene", {"supports": [PLANE]}), ("scenes", 5), ("faces", "all"), ("seed", 1)],
        *[("touch", 2), ("touch", -0.5), ("fidelity", "draft")],
    ],
)
def test_whatever_moves_scenes_gives_them_another_address(name: str, value: Any) -> None:
    first = next(plan(record(request(scene="table"))))
    assert next(plan(record(request(**{"scene": "table", name: value})))).output != first.output


def test_where_no_number_of_scenes_is_named_there_are_a_few() -> None:
    assert request(scene="table").scenes == request(scene="table", scenes="0").scenes == SCENES
    assert request(scene="table", scenes=7).scenes == 7
    assert request().scenes == 0


def test_a_document_comes_back_and_fingertips_may_touch_unless_it_says_otherwise() -> None:
    assert "touch" not in request(scene="table").model_dump()
    assert record(request(scene="table", touch=0)).id == record(request(scene="table")).id
    assert request(scene="table").place.touch == 0
    box = {"kind": "box", "size": [0.1, 0.2, 0.3]}
    document = {"supports": [PLANE, box], "touch": -0.5, "target": [0, 0, 1, 1, 0, 0, 0]}
    wanted = request(scene=document)
    assert (wanted.place.kind, len(wanted.place.supports), wanted.place.touch) == ("file", 2, -0.5)
    assert JobRequest.model_validate_json(wanted.model_dump_json()) == wanted
    assert request(scene=document, touch=2).place.touch == 2


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"scene": "tabel"}, "'free', 'table', 'bin' or 'shelf'"),  # codespell:ignore tabel
        ({"scene": {"supports": []}}, "at least 1"),
        ({"scene": {"supports": [{"kind": "half_space", "offset": float("nan")}]}}, "finite number"),
        ({"scene": {"supports": [PLANE], "target": [0, 0, 0, 1, 1, 0, 0]}}, "unit length"),
        ({"scene": {"supports": [PLANE], "file": "/etc/passwd"}}, "Extra inputs"),
        ({"scene": {"supports": [PLANE], "target": [0, 0, 0, 1, 0, 0, 0]}, "faces": "all"}, "lies on one face"),
        ({"faces": "all"}, "lies on no face"),
        ({"touch": 1}, "nothing to touch"),
        ({"scene": "table", "touch": -1.5}, "greater than or equal to -1"),
        ({"scene": "table", "touch": float("nan")}, "finite number"),
        ({"scene": "table", "method": "dfc"}, "plans around free objects only"),
        ({"scene": "table", "method": "learned"}, "needs the option network"),
        ({"scene": "shelf", "method": "learned", "options": {"network": "n"}}, "things on a table"),
        ({"method": "learned", "options": {"network": "n"}}, "things on a table"),
        ({"scene": "table", "robustness": 2}, "six pushes"),
        ({"scene": "table", "scenes": 65}, "less than or equal to 64"),
    ],
)
def test_nonsense_is_refused_in_a_line(changes: dict[str, Any], words: str) -> None:
    with pytest.raises(ValidationError) as refused:
        request(**changes)
    first = refused.value.errors()[0]["msg"]
    assert words in first
    assert "\n" not in first


def test_the_methods_that_know_no_scene_are_those_of_the_engine() -> None:
    known = {name for name in PLANNERS if method(name).in_scenes and not method(name).files}
    taken = set()
    for name in PLANNERS:
        try:
            request(scene="table", method=name)
            taken.add(name)
        except ValidationError:
            pass
    assert taken == known
