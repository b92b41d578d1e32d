"""The matrix: cells with their yield, actions on chosen ones, datasets made and steered by forms."""

from typing import Any

import pytest
from starlette.testclient import TestClient

from graspd.api.catalog.datasets import CellPair, Datasets
from graspd.api.dashboard.figures import service_grid
from graspd.service.index.queries.grasps import GraspFilter
from graspd.service.index.views import MatrixCell
from graspd.service.model.states import State
from graspd.service.pipeline.backends import Services
from graspd.service.pipeline.datasets import actions
from graspd.service.pipeline.datasets.spec import DatasetRequest
from tests.api.factories import add_job, fail, finish_all
from tests.fakes import plan_all


def cell(**fields: object) -> MatrixCell:
    counts = dict.fromkeys(("jobs", "queued", "running", "failed", "grasps", "valid", "candidates"), 0)
    return MatrixCell.model_validate({"hand": "h", "object": "o"} | counts | fields)


def create(services: Services, **changes: object) -> None:
    wanted = {"name": "k", "hands": ["allegro"], "objects": ["mug"], "grasps": 32}
    actions.create(services, DatasetRequest.model_validate(wanted | changes))


@pytest.mark.parametrize(
    ("counts", "state", "shade"),
    [
        ({"valid": 30, "candidates": 40, "validated": 40}, "succeeded", "y8"),
        ({"running": 1, "failed": 1}, "running", "none"),
        ({"queued": 1, "failed": 1}, "queued", "none"),
        ({"failed": 1, "valid": 0, "candidates": 10, "validated": 10}, "failed", "y0"),
        ({"grasps": 10, "candidates": 10}, "succeeded", "none"),
    ],
)
def test_a_cell_tells_its_state_and_yield(counts: dict[str, int], state: str, shade: str) -> None:
    shown = service_grid([cell(**counts)], ["h"], ["o"]).rows[0][1][0]
    assert shown is not None and (shown.state, shown.shade) == (state, shade)


def test_pairs_without_work_have_a_cell_to_choose() -> None:
    grid = service_grid([cell()], ["h", "i"], ["a", "o"])
    assert grid.hands == ["h", "i"]
    assert [name for name, _ in grid.rows] == ["o", "a"]  # those with work first
    assert all(shown is not None for _, cells in grid.rows for shown in cells)


def test_chosen_pairs_are_submitted(http: TestClient, services: Services) -> None:
    form = {"action": "submit", "cell": ["allegro|mug", "shadow|block"], "grasps": "64", "fidelity": "draft"}
    assert "2 jobs submitted." in http.post("/datasets/cells", data=form).text
    made = {(r.hand, r.object, r.grasps) for r in (job.request for job in services.index.jobs.page().items)}
    assert made == {("allegro", "mug", 64), ("shadow", "block", 64)}


def test_chosen_pairs_are_cancelled_and_retried(http: TestClient, services: Services) -> None:
    waiting, failed = add_job(services), add_job(services, object="block")
    fail(services, failed, "lost")
    pairs = ["allegro|mug", "allegro|block"]
    assert "1 job cancelled." in http.post("/datasets/cells", data={"action": "cancel", "cell": pairs}).text
    assert services.index.jobs.get(waiting.id).state is State.CANCELLED
    assert "2 jobs queued again." in http.post("/datasets/cells", data={"action": "retry", "cell": pairs}).text
    assert services.index.jobs.get(failed.id).state is State.QUEUED


@pytest.mark.parametrize("form", [{"action": "burn"}, {"action": "submit", "grasps": "0"}])
def test_an_action_that_cannot_be_done_says_why(http: TestClient, form: dict[str, str]) -> None:
    answer = http.post("/datasets/cells", data=form | {"cell": "allegro|mug"})
    assert answer.status_code == 422 and "Invalid request" in answer.text


def test_a_dataset_is_made_watched_retried_and_frozen(http: TestClient, services: Services) -> None:
    form = {"name": "kitchen", "grasps": "32", "fidelity": "draft", "hands": ["allegro"], "objects": ["mug", "block"]}
    page = http.post("/datasets", data=form).text
    assert "kitchen" in page
    assert page.count('class="cell queued') == 2
    plan_all(services)
    chosen = {"action": "cancel", "cell": [services.index.datasets.cells("kitchen").items[0].job_id]}
    assert "1 job cancelled" in http.post("/datasets/kitchen/cells", data=chosen).text
    assert http.post("/datasets/kitchen/retry").status_code == 200
    assert "a dataset has no action 'burn'" in http.post("/datasets/kitchen/burn").json()["detail"]
    finish_all(services, add_job(services, fidelity="draft"))
    assert "The snapshot is taken" in http.post("/datasets/kitchen/snapshot").text
    assert len(services.index.datasets.snapshots("kitchen").items) == 1


def test_a_dataset_is_made_in_scenes_with_neighbours(http: TestClient, services: Services) -> None:
    form = {"name": "clutter", "grasps": "32", "hands": ["allegro"], "objects": ["mug"], "neighbours": "block, bottle"}
    assert "on a table with neighbours block, bottle" in http.post("/datasets", data=form | {"scene": "table"}).text
    assert [one.object for one in services.index.datasets.get("clutter").options.all_neighbours] == ["block", "bottle"]
    wrong = http.post("/datasets", data=form | {"name": "afloat"})
    assert wrong.status_code == 422 and "neighbours need a scene" in wrong.text
    assert 'value="block, bottle"' in wrong.text and 'value="afloat"' in wrong.text, "what was typed stays"
    wrong = http.post("/datasets", data=form | {"name": "too-deep", "touch": "-3", "scene": "table"})
    assert wrong.status_code == 422
    assert 'name="touch" type="number" min="-1" max="2" step="any" value="-3"' in wrong.text


def test_cells_of_one_state_are_a_list(http: TestClient, services: Services) -> None:
    create(services, objects=["mug", "block"])
    assert http.get("/datasets/k", params={"state": "queued"}).text.count('name="cell"') == 2
    assert "No cell is failed" in http.get("/datasets/k", params={"state": "failed"}).text


@pytest.mark.parametrize(
    ("options", "shown"),
    [({"validation": "none"}, "32 feasible"), ({"validation": "none", "want": "candidates"}, "32 kept")],
)
def test_unvalidated_grasps_are_not_named_valid(http: TestClient, services: Services, options: Any, shown: str) -> None:
    create(services, **options)
    plan_all(services)
    finish_all(services, add_job(services, **options))
    http.post("/datasets/k/snapshot")
    word = shown.partition(" ")[2]
    matrix_page, list_page = http.get("/datasets/k").text, http.get("/datasets/k", params={"state": "succeeded"}).text
    assert shown in matrix_page and f">{word.capitalize()} grasps<" in matrix_page and "Valid" not in matrix_page
    assert f">{word.capitalize()}</th>" in list_page and ">32</td>" in list_page
    assert f"<dt>{word.capitalize()}</dt><dd>32" in http.get("/datasets").text
    assert http.get("/v1/datasets/k").json()["valid_yield"] is None
    assert "not validated" in http.get("/compare?one=k&other=k").text
    home = http.get("/").text
    assert f"32 of 32 {word}" in home and f'32<span class="sub">{word}' in home


def test_a_dataset_and_a_job_have_the_same_options(http: TestClient, services: Services) -> None:
    asked = {"min_payload": "0.5", "shake": "true", "scene": "table", "robust": "0.75"}
    form = {"name": "heavy", "grasps": "32", "hands": ["allegro"], "objects": ["mug"], **asked}
    assert "heavy" in http.post("/datasets", data=form).text
    pair = {"hand": "allegro", "object": "mug"}
    http.post("/submit", data=pair | asked)
    job = services.index.jobs.page().items[0].request
    for options in (services.index.datasets.get("heavy").options, job):
        assert (options.min_payload, options.shake, options.robust) == (0.5, True, 0.75)
    refused = http.post("/submit", data=pair | {"shake": "true"})
    assert refused.status_code == 422 and "a lift out of a scene" in refused.text


@pytest.fixture
def jobs(http: TestClient, services: Services) -> dict[str, str]:
    validated = add_job(services, want="candidates")
    unvalidated = add_job(services, grasps=320, validation="none", want="candidates")
    for record in (validated, unvalidated):
        finish_all(services, record)
    return {"validated": validated.id, "unvalidated": unvalidated.id}


def share(http: TestClient, job: str) -> float:
    rows = http.get("/v1/grasps", params={"job": job, "limit": 200}).json()["items"]
    return sum(row["valid"] for row in rows) / len(rows)


def test_service_and_job_count_as_tries_only_what_was_validated(http: TestClient, jobs: dict[str, str]) -> None:
    stats = http.get("/v1/stats").json()
    assert (stats["candidates"], stats["validated"]) == (352, 32)
    told = {name: http.get(f"/v1/jobs/{job}").json() for name, job in jobs.items()}
    assert stats["valid_yield"] == told["validated"]["valid_yield"] == share(http, jobs["validated"])
    assert (told["unvalidated"]["validated"], told["unvalidated"]["valid_yield"]) == (0, None)
    words = f"{int(100 * share(http, jobs['validated']) + 1e-9)} %"
    home = http.get("/").text
    assert words in home and "320 candidates not validated" in home
    assert words in http.get("/datasets").text


def test_unvalidated_grasps_are_not_among_the_rejected(http: TestClient, jobs: dict[str, str]) -> None:
    def found(**query: str) -> set[str]:
        rows = http.get("/v1/grasps", params={"limit": 200, **query}).json()["items"]
        assert rows
        return {str(row["success"]) for row in rows}

    rejected = http.get("/v1/grasps", params={"limit": 200, "valid": "false"}).json()["items"]
    assert rejected and all(row["success"] is False for row in rejected)
    assert found(validated="false") == found(where="not validated") == {"None"}
    assert "None" not in found(validated="true") | found(where="validated and not valid")


def _two(services: Services) -> None:
    """`rough` is done, one cell of draft grasps; `fine` has another object besides and no grasp yet."""
    create(services, name="rough", fidelity="draft")
    create(services, name="fine", objects=["mug", "block"])
    plan_all(services)
    finish_all(services, add_job(services, fidelity="draft"))


def test_the_page_of_two_datasets_shows_what_differs_and_every_cell(http: TestClient, services: Services) -> None:
    _two(services)
    page = " ".join(http.get("/compare", params={"one": "rough", "other": "fine"}).text.split())
    assert "Fidelity</th><td" in page and ">draft</td>" in page and ">standard</td>" in page
    assert "Objects of its own</th>" in page and ">block</td>" in page
    assert page.count("<td>allegro</td>") == 2
    assert page.count('<figure class="card histo twin">') > 3
    assert "options are the same" not in page
    page = http.get("/compare", params={"one": "rough", "other": "rough"}).text
    assert "options are the same" in page and "+0 points" in page
    assert "No grasp yet" in http.get("/compare", params={"one": "fine", "other": "fine"}).text
    assert http.get("/compare", params={"one": "rough", "other": "gone"}).status_code == 404
    page = http.get("/compare").text
    assert page.count("<option>rough</option>") == page.count("<option>fine</option>") == 2
    assert "/compare?one=rough&amp;other=fine" in http.get("/datasets").text


def test_distributions_of_two_share_bins_and_too_many_cells_are_left_out(
    services: Services, monkeypatch: pytest.MonkeyPatch
) -> None:
    _two(services)
    filters = [GraspFilter(dataset="rough", valid=valid) for valid in (True, False, None)]
    one, other, both = services.index.statistics.compare_distributions(filters, ["epsilon"], bins=7)["epsilon"]
    assert one is not None and other is not None and both is not None
    assert (one.low, one.high) == (other.low, other.high)
    assert [a + b for a, b in zip(one.counts, other.counts, strict=True)] == both.counts
    monkeypatch.setattr("graspd.api.catalog.datasets.MOST_CELLS", 1)
    datasets = Datasets(services, None)  # type: ignore[arg-type]
    assert datasets.compare("rough", "fine").pairs == [] and CellPair("hand", "object", None, None).gain is None
