"""Grade of a measured value by the thresholds of weak and broken cells."""

from graspd.service.model.studies import Outcome


def grade(value: float, weak: float, broken: float) -> Outcome:
    if not value < broken:  # Also true for nan.
        return "broken"
    return "good" if value < weak else "weak"
