"""The simulated week, against sums that can be done by hand."""

from __future__ import annotations

from dataclasses import replace

import pytest

from benchmarks.week import CONTROLLER_TASKS_PER_S, HARSH, Rates, Told, Week, table, task_seconds

_EVENTS = ("reclaimed_per_day", "killed_per_day", "cut_off_per_day", "zone_per_week", "controller_killed_per_day")
NOTHING = Rates(**dict.fromkeys((*_EVENTS, "redis_restarts_per_week", "store_outages_per_week"), 0))
DAY_S = 86_400.0


def week(rates: Rates, *, nodes: int = 50, days: float = 7.0, task_s: float = 60.0, seed: int = 1) -> Told:
    return Week(nodes=nodes, days=days, task_s=task_s, rates=rates, seed=seed).run()


def test_where_nothing_happens_all_time_is_work() -> None:
    told = week(NOTHING)
    assert (told.lost, told.interruptions, told.idle_s) == (0.0, {}, {})
    assert told.node_s == pytest.approx(50 * 7 * DAY_S)
    # The last task of each node is not done, and the first one was begun before.
    assert told.useful_s == pytest.approx(told.node_s, rel=1e-3)
    mean_s = told.useful_s / told.done
    assert mean_s == pytest.approx(60.0 * 2.718281828 ** (0.3**2 / 2), rel=0.01)


def test_a_reclaimed_node_loses_half_a_task() -> None:
    told = week(replace(NOTHING, reclaimed_per_day=24.0))
    times = told.interruptions["reclaimed"]
    assert times == pytest.approx(50 * 7 * 24, rel=0.03)
    # Mean age of a task that is looked at: E[T^2] / 2 E[T] = 60 exp(1.5 s^2) / 2 for a log-normal one.
    lost_each = told.lost_s["reclaimed"] / times
    assert lost_each == pytest.approx(0.95 * 30 * 2.718281828 ** (1.5 * 0.09), rel=0.06)
    assert told.attempts_lost == 0
    assert told.node_s + times * 180.0 == pytest.approx(50 * 7 * DAY_S, rel=0.01)


def test_a_killed_node_uses_up_an_attempt_and_a_short_cut_none() -> None:
    told = week(replace(NOTHING, killed_per_day=1.0, cut_off_per_day=1.0, longest_cut_s=20.0))
    assert told.attempts_lost == pytest.approx(told.interruptions["killed"], rel=0.02)
    assert told.done_twice == 0 and "cut_off" not in told.lost_s


def test_one_cut_off_beyond_its_lease_works_for_nothing() -> None:
    told = week(replace(NOTHING, cut_off_per_day=10.0))
    # Of cuts of up to 120 s five in six are longer than the lease of 20 s.
    assert told.attempts_lost == pytest.approx(told.interruptions["cut_off"] * 5 / 6, rel=0.05)
    assert 0 < told.done_twice < told.attempts_lost


def test_outages_cost_waiting_and_one_task_a_node() -> None:
    away = replace(NOTHING, redis_restarts_per_week=7.0, redis_away_s=600.0)
    told = week(away)
    assert told.lost == 0.0
    each = told.idle_s["redis"] / told.interruptions["redis"] / 50
    assert each == pytest.approx(600 - 60 * 2.718281828 ** (1.5 * 0.09) / 2, rel=0.03)
    told = week(replace(NOTHING, store_outages_per_week=7.0, store_away_s=600.0))
    assert told.lost_s["store"] == pytest.approx(told.interruptions["store"] * 50 * 60 * 1.144, rel=0.1)
    assert week(replace(NOTHING, controller_killed_per_day=24.0)).idle_s == {}, "two tasks a worker wait for that long"


@pytest.mark.parametrize("seed", [0, 1])
@pytest.mark.parametrize("rates", [Rates(), HARSH])
def test_under_a_hundred_of_the_work_is_lost(rates: Rates, seed: int) -> None:
    told = week(rates, nodes=30, task_s=task_seconds(1), seed=seed)
    assert 0 < told.lost < 0.01
    assert told.failed_for_good < 1e-2
    assert told.controller_busy < 1 and 30 / task_seconds(1) < CONTROLLER_TASKS_PER_S
    assert any(row.startswith("| work lost |") for row in table(told))
