"""A week of a thousand nodes that come and go, as discrete events: what is lost, what is done twice, what waits.

usage: python -m benchmarks.week [--nodes 1000] [--days 7] [--cores 1] [--seed 0] [--rates cloud|harsh] [--json FILE]

Costs are those of `benchmarks.cost_model` and `benchmarks.fleet`; rates are options of this file (`Rates`, `HARSH`),
no cloud's promise. Events are what interrupts: nodes reclaimed with notice, killed, cut off, a zone that fails, and
controller, Redis and store that are away. Between two of them nothing that a node does depends on another, so its tasks
are drawn at once.

What the parts do about it is taken from what the tests of `tests/system` hold real processes to:

- a node with notice hands its task back: the work on it is lost, no attempt is used up;
- one that is killed loses the work and an attempt; its task waits for `GRASPD_LEASE_S` and a look of the controller;
- one that is cut off for longer than that goes on; another does the same task meanwhile, and one of both is work for
  nothing. The second result is refused by the store (create-only), so there is one;
- while the controller is away workers live on what waits; while Redis is away each ends its task and waits;
- while the store is away a task that ends cannot put its result: it is handed back, and its work is lost. The next ones
  are handed back before they begin.
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
#: Waiting tasks that a controller that is away leaves behind for each worker, `service/pipeline/controller.py`.
_WAITING_A_WORKER: Final = 2
#: Tasks a second through controller and index with 512 workers and more, `python -m benchmarks.fleet`.
CONTROLLER_TASKS_PER_S: Final = 336.0
#: Spread of the time of a task: batches of one pair differ by as much as their valid grasps do (log-normal sigma).
_SPREAD: Final = 0.3
_ATTEMPTS: Final = 3


@dataclass(frozen=True)
class Rates:
    """How often things go wrong, and for how long."""

    reclaimed_per_day: float = 1 / 3
    """Of one node, with notice. Clouds that say how often they take spot nodes back name 5 to 20 % a month; this is 50
    times as often."""
    killed_per_day: float = 1 / 30
    """Of one node, without notice: memory, kernel, power."""
    cut_off_per_day: float = 1 / 10
    """Of one node: the network is away for up to `longest_cut_s`, evenly spread."""
    longest_cut_s: float = 120.0
    zone_per_week: float = 1.0
    """A third of all nodes killed at once."""
    replaced_after_s: float = 180.0
    """Until a fresh node's worker takes tasks: boot, pull of images, check of its engine."""
    controller_killed_per_day: float = 1.0
    redis_restarts_per_week: float = 2.0
    redis_away_s: float = 60.0
    store_outages_per_week: float = 2.0
    store_away_s: float = 300.0
    """In a week together 99.9 % of the time there, which is what object stores promise."""


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
    """Time that nodes were there."""
    done: int = 0
    """Tasks whose result is in the store."""
    useful_s: float = 0.0
    """Time spent on those."""
    lost_s: Counter[str] = field(default_factory=Counter)
    """Time spent for nothing, by cause."""
    idle_s: Counter[str] = field(default_factory=Counter)
    """Time in which a node that was there had nothing to do, by cause."""
    interruptions: Counter[str] = field(default_factory=Counter)
    done_twice: int = 0
    """Tasks that two nodes did to their end: the store refused the second result."""
    attempts_lost: int = 0
    failed_for_good: float = 0.0
    """Tasks expected to lose all their attempts, each as likely as any other."""
    most_behind: float = 0.0
    """Most events that waited for a controller."""
    longest_catch_up_s: float = 0.0
    controller_busy: float = 0.0
    """Share of its time that the controller works."""

    @property
    def lost(self) -> float:
        """Share of the work that was for nothing."""
        work = self.useful_s + sum(self.lost_s.values())
        return sum(self.lost_s.values()) / work if work else 0.0


@dataclass
class _Node:
    """A node at work since `since`, `into` seconds into a task that takes `task_s`."""

    since: float = 0.0
    task_s: float = 0.0
    into: float = 0.0


class Week:
    """Nodes, what they do, and what happens to them."""

    def __init__(
        self, *, nodes: int, days: float, task_s: float, rates: Rates, lease_s: float = 20.0, seed: int = 0
    ) -> None:
        """`task_s` is the median time of a task [s]."""
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
            # Nodes of a fleet do not work in step.
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
            self.told.useful_s += node.into  # the week ends, the work does not
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
            # As many as there should be: of one or two a week none may be missing.
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
        """A node does task after task until then; it is in the middle of one afterwards."""
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
            return  # it is not there at that time
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
        """It ends its task, and cannot say so until the network is back."""
        node = self._nodes[who]
        seconds = self._rng.random() * self._rates.longest_cut_s
        rest = node.task_s - node.into
        back = at + max(seconds, rest)
        if seconds > self._lease_s:
            # Its lease is lost, and so is what it did: another node does the task.
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
        """Another takes over; workers live on what waits, and events wait for it."""
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
        """Nobody gets a task between `empty` and `back`: each node ends the one it has, then waits."""
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
    """Time of a batch of 32 valid grasps on a node of so many cores [s]."""
    found = measured or Measured()
    return 32 * found.core_s_per_grasp / cores / found.busy


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--nodes", type=int, default=1000)
    parser.add_argument("--days", type=float, default=7.0)
    parser.add_argument("--cores", type=int, default=1, help="of a node")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rates", choices=("cloud", "harsh"), default="cloud")
    parser.add_argument("--json", type=Path, help="keep the figures there")
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
        *((f"{what.replace('_', ' ')}, times", f"{times:,}") for what, times in sorted(told.interruptions.items())),
        ("work lost", f"{100 * told.lost:.3f} %"),
        *((f"of it by {what.replace('_', ' ')}", f"{100 * s / work:.4f} %") for what, s in sorted(told.lost_s.items())),
        ("done by two nodes, one result kept", f"{told.done_twice:,}"),
        ("attempts used up", f"{told.attempts_lost:,}"),
        ("tasks expected to fail for good", f"{told.failed_for_good:.2g}"),
        *((f"idle, {what.replace('_', ' ')}", f"{100 * s / told.node_s:.4f} %") for what, s in idle),
        ("controller busy", f"{100 * told.controller_busy:.0f} %"),
        ("events behind a controller that took over", f"{told.most_behind:,.0f}"),
        ("they were made up for in", f"{told.longest_catch_up_s:.0f} s"),
    ]
    return ["| what | |", "| --- | --: |", *(f"| {name} | {value} |" for name, value in rows)]


if __name__ == "__main__":
    main()
