"""Discrete-event simulation of a week on 1000 preemptible nodes: lost work, repeated tasks, idle time.

usage: python -m benchmarks.week [--nodes 1000] [--days 7] [--cores 1] [--seed 0] [--rates cloud|harsh] [--json FILE]

Costs come from `benchmarks.cost_model` and `benchmarks.fleet`. Rates are assumptions of this module (`Rates`, `HARSH`).
Events are interruptions: nodes that are reclaimed with notice, killed or cut off, a zone that fails, and outages of
controller, Redis and store. Between two interruptions nodes are independent, so all tasks of this time are drawn at
once.

The reactions to interruptions are those that `tests/system` tests on real processes:

- A node with notice returns its task. The work on it is lost, but no attempt.
- A killed node loses the work and an attempt. Its task waits for `GRASPD_LEASE_S` and the next check of the controller.
- A node that is cut off for longer than its lease continues, while another node does the same task. The work of one
is lost, because the store refuses the second result (create-only).
- During an outage of the controller, workers take waiting tasks. During one of Redis, each ends its task and waits.
- During an outage of the store, a task that ends is returned and its work is lost. Later tasks are returned unstarted.
"""

from __future__ import annotations

import argparse
import heapq
import json
import math
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

import numpy as np

from benchmarks.cost_model import Measured
from benchmarks.service_load import say

_DAY_S: Final = 86_400.0
#: Waiting tasks per worker at the start of an outage of the controller, see `service/pipeline/controller.py`.
_WAITING_A_WORKER: Final = 2
#: Tasks per second through controller and index with 512 or more workers, from `python -m benchmarks.fleet`.
CONTROLLER_TASKS_PER_S: Final = 336.0
#: Spread of the time of a task (log-normal sigma), since batches of a pair differ in their number of valid grasps.
_SPREAD: Final = 0.3
_ATTEMPTS: Final = 3


@dataclass(frozen=True)
class Rates:
    """Rates and durations of interruptions."""

    reclaimed_per_day: float = 1 / 3
    """Reclaims of one node, with notice. Clouds with published rates reclaim 5 to 20 % of spot nodes a month; this is
    at least 50 times as much."""
    killed_per_day: float = 1 / 30
    """Ends of one node without notice: out of memory, kernel crash, power failure."""
    cut_off_per_day: float = 1 / 10
    """Network losses of one node, for up to `longest_cut_s`, uniformly distributed."""
    longest_cut_s: float = 120.0
    zone_per_week: float = 1.0
    """Failures of a zone; each kills a third of all nodes at once."""
    replaced_after_s: float = 180.0
    """Time until the worker of a new node takes tasks: boot, pull of images, check of its engine."""
    controller_killed_per_day: float = 1.0
    redis_restarts_per_week: float = 2.0
    redis_away_s: float = 60.0
    store_outages_per_week: float = 2.0
    store_away_s: float = 300.0
    """Two outages a week give an availability of 99.9 %, as object stores state."""


HARSH: Final = Rates(
    reclaimed_per_day=12.0,
    killed_per_day=2.0,
    cut_off_per_day=4.0,
    zone_per_week=7.0,
    controller_killed_per_day=24.0,
    redis_restarts_per_week=14.0,
    store_outages_per_week=7.0,
)


@dataclass
class Told:
    node_s: float = 0.0
    """Time in which nodes ran."""
    done: int = 0
    """Number of tasks with a result in the store."""
    useful_s: float = 0.0
    """Time spent on these tasks."""
    lost_s: Counter[str] = field(default_factory=Counter)
    """Time of lost work, by cause."""
    idle_s: Counter[str] = field(default_factory=Counter)
    """Time in which running nodes were idle, by cause."""
    interruptions: Counter[str] = field(default_factory=Counter)
    done_twice: int = 0
    """Tasks completed by two nodes; the store refused the second result."""
    attempts_lost: int = 0
    failed_for_good: float = 0.0
    """Expected number of tasks that lose all their attempts, if all tasks are equally likely to lose one."""
    most_behind: float = 0.0
    """Largest number of events that waited for a controller."""
    longest_catch_up_s: float = 0.0
    controller_busy: float = 0.0
    """Share of time in which the controller is busy."""

    @property
    def lost(self) -> float:
        """Share of lost work."""
        work = self.useful_s + sum(self.lost_s.values())
        return sum(self.lost_s.values()) / work if work else 0.0


@dataclass
class _Node:
    """A node that at time `since` is `into` seconds into a task of `task_s` seconds."""

    since: float = 0.0
    task_s: float = 0.0
    into: float = 0.0


class Week:
    """State of the simulation: nodes, their tasks and interruptions."""

    def __init__(
        self, *, nodes: int, days: float, task_s: float, rates: Rates, lease_s: float = 20.0, seed: int = 0
    ) -> None:
        """Create the nodes; `task_s` is the median time of a task [s]."""
        self._end = days * _DAY_S
        self._task_s, self._rates, self._lease_s = task_s, rates, lease_s
        self._rng = np.random.default_rng(seed)
        self._nodes = [_Node() for _ in range(nodes)]
        self._store_away: tuple[float, float] = (-1.0, -1.0)
        self.told = Told()
        self._events: list[tuple[float, int, str, int]] = []
        self._number = 0

    def run(self) -> Told:
        for one in self._nodes:
            one.task_s = self._drawn()
            # Nodes of a fleet are not synchronous.
            one.into = self._rng.random() * one.task_s
        self._plan()
        while self._events:
            at, _, what, who = heapq.heappop(self._events)
            self.told.interruptions[what] += 1
            if who >= 0:
                self._interrupt(at, what, who)
            else:
                getattr(self, f"_{what}")(at)
        for number in range(len(self._nodes)):
            self._work(number, self._end)
            node = self._nodes[number]
            self.told.useful_s += node.into  # the task continues after the week
        per_s = self.told.done / self._end
        self.told.controller_busy = per_s / CONTROLLER_TASKS_PER_S
        self.told.failed_for_good = self.told.done * (self.told.attempts_lost / max(1, self.told.done)) ** _ATTEMPTS
        return self.told

    def _plan(self) -> None:
        rates = self._rates
        for what, per_day in {
            "reclaimed": rates.reclaimed_per_day,
            "killed": rates.killed_per_day,
            "cut_off": rates.cut_off_per_day,
        }.items():
            for who in range(len(self._nodes)):
                for at in self._times(self._rng.poisson(per_day * self._end / _DAY_S)):
                    self._add(at, what, who)
        for what, per_day in {
            "zone": rates.zone_per_week / 7,
            "controller": rates.controller_killed_per_day,
            "redis": rates.redis_restarts_per_week / 7,
            "store": rates.store_outages_per_week / 7,
        }.items():
            # Use the expected number, so that rare outages always occur.
            for at in self._times(round(per_day * self._end / _DAY_S)):
                self._add(at, what, -1)

    def _times(self, count: int) -> np.ndarray:
        return self._rng.random(count) * self._end

    def _add(self, at: float, what: str, who: int) -> None:
        self._number += 1
        heapq.heappush(self._events, (float(at), self._number, what, who))

    def _drawn(self) -> float:
        return float(self._task_s * math.exp(_SPREAD * self._rng.standard_normal()))

    def _work(self, who: int, until: float) -> None:
        """Let a node do tasks until the given time, at which it is in the middle of one."""
        node = self._nodes[who]
        if until <= node.since:
            return
        left = node.into + until - node.since
        self.told.node_s += until - node.since
        node.since = until
        if left >= node.task_s:
            left -= node.task_s
            self.told.done, self.told.useful_s = self.told.done + 1, self.told.useful_s + node.task_s
            node.task_s = self._drawn()
            while left >= node.task_s:
                count = 16 + int(1.1 * left / self._task_s)
                drawn = self._task_s * np.exp(_SPREAD * self._rng.standard_normal(count))
                drawn[0] = node.task_s
                ends = np.cumsum(drawn)
                finished = min(int(np.searchsorted(ends, left, side="right")), count - 1)
                self.told.done += finished
                self.told.useful_s += float(ends[finished - 1])
                left -= float(ends[finished - 1])
                node.task_s = float(drawn[finished])
        node.into = left

    def _interrupt(self, at: float, what: str, who: int) -> None:
        node = self._nodes[who]
        if at < node.since:
            return  # the node is not running at that time
        self._work(who, at)
        if what == "cut_off":
            self._cut_off(at, who)
            return
        self.told.lost_s[what] += node.into
        self.told.attempts_lost += what == "killed"
        self._replace(at, who)

    def _replace(self, at: float, who: int) -> None:
        self._nodes[who] = _Node(since=at + self._rates.replaced_after_s, task_s=self._drawn())

    def _cut_off(self, at: float, who: int) -> None:
        """Cut a node off: it ends its task but cannot report it until the network is back."""
        node = self._nodes[who]
        seconds = self._rng.random() * self._rates.longest_cut_s
        rest = node.task_s - node.into
        back = at + max(seconds, rest)
        if seconds > self._lease_s:
            # Its lease has expired: another node does the task, and this work is lost.
            self.told.attempts_lost += 1
            self.told.lost_s["cut_off"] += node.task_s if seconds > rest else node.into + min(seconds, rest)
            self.told.done_twice += seconds > rest
            back = at + seconds
        else:
            self.told.done, self.told.useful_s = self.told.done + 1, self.told.useful_s + node.task_s
        self.told.idle_s["cut_off"] += max(0.0, seconds - rest)
        self.told.node_s += back - at
        self._nodes[who] = _Node(since=back, task_s=self._drawn())

    def _zone(self, at: float) -> None:
        for who in range(0, len(self._nodes), 3):
            if at >= self._nodes[who].since:
                self._interrupt(at, "killed", who)

    def _controller(self, at: float) -> None:
        """Stop the controller until another takes over; workers take waiting tasks, and events wait."""
        away = self._lease_s * 4 / 3
        rate = self._rate()
        self._stall(at, "controller", at + _WAITING_A_WORKER * self._task_s, at + away)
        behind = rate * away
        self.told.most_behind = max(self.told.most_behind, behind)
        if rate < CONTROLLER_TASKS_PER_S:
            self.told.longest_catch_up_s = max(self.told.longest_catch_up_s, behind / (CONTROLLER_TASKS_PER_S - rate))

    def _redis(self, at: float) -> None:
        self._stall(at, "redis", at, at + self._rates.redis_away_s)

    def _stall(self, at: float, what: str, empty: float, back: float) -> None:
        """Hand out no task between `empty` and `back`: each node ends its task, then waits."""
        if empty >= back:
            return
        for who, node in enumerate(self._nodes):
            if empty < node.since:
                continue
            self._work(who, empty)
            ends = empty + node.task_s - node.into
            if ends >= back:
                continue
            self.told.done, self.told.useful_s = self.told.done + 1, self.told.useful_s + node.task_s
            self.told.idle_s[what] += back - ends
            self.told.node_s += back - empty
            self._nodes[who] = _Node(since=back, task_s=self._drawn())

    def _store(self, at: float) -> None:
        back = at + self._rates.store_away_s
        for who, node in enumerate(self._nodes):
            if at < node.since:
                continue
            self._work(who, at)
            ends = at + node.task_s - node.into
            if ends < back:
                self.told.lost_s["store"] += node.task_s
                self.told.idle_s["store"] += back - ends
                self.told.node_s += back - at
                self._nodes[who] = _Node(since=back, task_s=self._drawn())

    def _rate(self) -> float:
        mean_s = self._task_s * math.exp(_SPREAD**2 / 2)
        return len(self._nodes) / mean_s


def task_seconds(cores: int, measured: Measured | None = None) -> float:
    """Return the time of a batch of 32 valid grasps on a node with this number of cores [s]."""
    found = measured or Measured()
    return 32 * found.core_s_per_grasp / cores / found.busy


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, default=1000)
    parser.add_argument("--days", type=float, default=7.0)
    parser.add_argument("--cores", type=int, default=1, help="cores of a node")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rates", choices=("cloud", "harsh"), default="cloud")
    parser.add_argument("--json", type=Path, help="file for the figures")
    given = parser.parse_args(arguments)
    rates = Rates() if given.rates == "cloud" else HARSH
    told = Week(
        nodes=given.nodes, days=given.days, task_s=task_seconds(given.cores), rates=rates, seed=given.seed
    ).run()
    for line in table(told):
        say(line)
    if given.json:
        given.json.write_text(json.dumps({**vars(told), "lost": told.lost}, indent=2) + "\n")


def table(told: Told) -> list[str]:
    work = told.useful_s + sum(told.lost_s.values())
    idle = sorted(told.idle_s.items())
    rows = [
        ("node hours", f"{told.node_s / 3600:,.0f}"),
        ("tasks done", f"{told.done:,}"),
        ("valid grasps", f"{32 * told.done:,}"),
        *(
            (f"interruptions: {what.replace('_', ' ')}", f"{times:,}")
            for what, times in sorted(told.interruptions.items())
        ),
        ("work lost, all causes", f"{100 * told.lost:.3f} %"),
        *(
            (f"work lost: {what.replace('_', ' ')}", f"{100 * s / work:.4f} %")
            for what, s in sorted(told.lost_s.items())
        ),
        ("tasks done by two nodes (the second result is refused)", f"{told.done_twice:,}"),
        ("attempts lost", f"{told.attempts_lost:,}"),
        ("tasks expected to lose all attempts", f"{told.failed_for_good:.2g}"),
        *((f"idle time: {what.replace('_', ' ')}", f"{100 * s / told.node_s:.4f} %") for what, s in idle),
        ("controller, busy share of its time", f"{100 * told.controller_busy:.0f} %"),
        ("most events that waited for a new controller", f"{told.most_behind:,.0f}"),
        ("longest time to process waiting events", f"{told.longest_catch_up_s:.0f} s"),
    ]
    return ["| what | |", "| --- | --: |", *(f"| {name} | {value} |" for name, value in rows)]


if __name__ == "__main__":
    main()
