"""Charts in the store, and the cheapest fidelity that a chart promises."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from service.model.errors import InputError
from service.pipeline import job_actions
from service.pipeline.backends import Parts
from service.pipeline.fidelity_choice import cheapest, parse_target
from service.store.store import open_store
from service.store.study_records import latest, publish
from tests.fakes import request


def run(fidelity: str, speed: float, gsr: float, *, hand: str = "allegro", object_: str = "mug") -> dict[str, Any]:
    return {
        "method": "fast_graspd", "fidelity": fidelity, "hand": hand, "object": object_, "valid_per_second": speed,
        "gsr": gsr, "epsilon": gsr / 2, "pd_mm": 1 - gsr,
    }  # fmt: skip


CHART = {
    "created": "2026-11-21T10:00:00.000Z",
    "runs": [
        run("draft", 40, 0.5), run("standard", 15, 0.8), run("fine", 6, 0.9),
        run("draft", 50, 0.9, hand="barrett"), run("paper", 90, 0.99),
    ],
}  # fmt: skip


def pick(target: str, hand: str = "allegro", object_: str = "mug", chart: dict[str, Any] = CHART) -> str:
    return cheapest(chart, target, method="fast_graspd", hand=hand, object_=object_)


@pytest.mark.parametrize(
    ("target", "expected"),
    [("gsr>=0.4", "draft"), ("gsr >= 0.6", "standard"), ("gsr>=.85", "fine"), ("epsilon>=0.3", "standard"),
     ("pd_mm<=0.15", "fine")],
)  # fmt: skip
def test_the_fastest_fidelity_that_meets_the_target_is_taken(target: str, expected: str) -> None:
    assert pick(target) == expected


def test_what_was_measured_of_the_same_hand_counts_before_the_rest() -> None:
    assert pick("gsr>=0.85", hand="barrett", object_="bowl") == "draft"
    # Of an unknown hand all runs count: draft holds 0.7 on average.
    assert pick("gsr>=0.65", hand="shadow") == "draft"
    assert pick("gsr>=0.75", hand="shadow") == "standard"


def test_a_target_out_of_reach_says_what_was_reached() -> None:
    with pytest.raises(InputError, match=r"best measured gsr is 0\.9"):
        pick("gsr>=0.95")


def test_a_method_that_was_not_measured_has_no_cheapest_fidelity() -> None:
    with pytest.raises(InputError, match="graspd chart --publish"):
        cheapest(CHART, "gsr>=0.5", method="dfc", hand="allegro", object_="mug")


@pytest.mark.parametrize("text", ["gsr", "gsr>0.6", "speed>=3", "gsr<=0.6", "pd_mm>=1", "gsr>=high"])
def test_a_target_of_another_form_is_refused(text: str) -> None:
    with pytest.raises(InputError):
        parse_target(text)


def test_the_chart_published_last_is_the_latest(tmp_path: Path) -> None:
    store = open_store(tmp_path.as_uri())
    assert latest(store, "charts") is None
    publish(store, "charts", {**CHART, "created": "2026-11-21T11:00:00.000Z", "runs": []})
    publish(store, "charts", CHART)
    found = latest(store, "charts")
    assert found is not None and found["created"] == "2026-11-21T11:00:00.000Z"


def test_a_job_with_fidelity_auto_is_stored_with_the_one_the_chart_promises(parts: Parts) -> None:
    publish(parts.store, "charts", CHART)
    job, _ = job_actions.submit(parts, request(fidelity="auto", target="gsr>=0.75"))
    assert (job.request.fidelity, job.request.target) == ("standard", "")
    # It is the job that names the fidelity itself: a later chart does not change it.
    assert job_actions.submit(parts, request(fidelity="standard"))[0].id == job.id


def test_fidelity_auto_without_a_chart_says_how_to_get_one(parts: Parts) -> None:
    with pytest.raises(InputError, match="graspd chart --publish"):
        job_actions.submit(parts, request(fidelity="auto", target="gsr>=0.6"))


@pytest.mark.parametrize("changes", [{"fidelity": "auto"}, {"target": "gsr>=0.6"}, {"fidelity": "superb"}])
def test_auto_and_target_go_together(changes: dict[str, str]) -> None:
    with pytest.raises(ValueError, match=r"target|unknown fidelity"):
        request(**changes)
