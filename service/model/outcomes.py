"""What became of the candidates of a job, by name, and the sentence that says why it found fewer grasps than asked."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Final

#: Outcomes of candidates that are not kept, in the order in which they are tested, with their words.
OUTCOMES: Final = {
    "diverged": "without a finite posture",
    "no_place": "without a clear place or way in the scene",
    "touched_on_the_way": "touched on the way",
    "penetration": "inside the object when simulated",
    "lost_while_closing": "lost while closing",
    "not_lifted": "not lifted",
    "turned": "turned in the hand",
    "slipped": "slipped",
    "neighbour_moved": "moved a neighbour",
    "unstable": "unstable in simulation",
    "gate_penetration": "too deep in the object (gate)",
    "gate_self_penetration": "hand too deep in itself (gate)",
    "gate_contacts": "did not oppose: fewer than two links in contact (gate)",
    "fragile": "held in too few models",
    "weak": "lifted less than the wanted payload",
    "alike": "too similar to another",
    "repeated": "repeated attempts",
}


def totals(parts: Iterable[Mapping[str, int]]) -> dict[str, int]:
    """Sums by outcome over several counts, those above zero, in the order of `OUTCOMES`."""
    found: dict[str, int] = dict.fromkeys(OUTCOMES, 0)
    for part in parts:
        for name, count in part.items():
            found[name] = found.get(name, 0) + int(count)
    return {name: count for name, count in found.items() if count}


def told(outcomes: Mapping[str, int]) -> str:
    """The counts in words, the most frequent first."""
    order = sorted(outcomes.items(), key=lambda pair: -pair[1])
    return ", ".join(f"{count:,} {OUTCOMES.get(name, name.replace('_', ' '))}" for name, count in order if count)


def shortfall(
    found: int, wanted: int, counted: str, tried: int, budget: float, outcomes: Mapping[str, int], limit: str = ""
) -> str | None:
    """Why fewer grasps were found than wanted, in a sentence; None where all were.

    Args:
        found: grasps that count.
        wanted: grasps asked for.
        counted: which grasps count: valid or sound.
        tried: candidates planned.
        budget: tries for each grasp wanted, at most: candidates and repeated attempts.
        outcomes: candidates that were not kept, by `OUTCOMES`, and the repeated attempts.
        limit: what the hand lifts at best, in place of the budget that ended.
    """
    if found >= wanted:
        return None
    lost, tries = told(outcomes), tried + outcomes.get("repeated", 0)
    ended = limit or f"the budget of {budget:g} tries for each ended first"
    return f"found {found:,} of {wanted:,} {counted} grasps in {tries:,} tries{': ' if lost else ''}{lost}; {ended}"


def limit_told(hand: str, friction: float, grasps: int, lifts: float, bound: float, wanted: float | None = None) -> str:
    """What a hand lifts at best, in a sentence.

    Args:
        hand: its name.
        friction: Coulomb coefficient.
        grasps: that were measured.
        lifts: payload of the best of them [kg].
        bound: that none exceeds by actuator effort and friction [kg]; inf: there is none.
        wanted: mass that it should lift [kg]; None: nobody asked for one.
    """
    most = f", and at most {bound:.2g} kg by actuator effort" if math.isfinite(bound) else ""
    less = "" if wanted is None else f"; {wanted:.3g} kg are wanted"
    return f"{hand} lifts {lifts:.2g} kg at friction {friction:g} in the best of {grasps} grasps{most}{less}"
