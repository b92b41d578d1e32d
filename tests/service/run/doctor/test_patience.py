"""Checks side by side: one that hangs or breaks off hides none of the others."""

from __future__ import annotations

import threading

from graspd.service.model.errors import StoreUnavailable
from graspd.service.run.doctor.checks import Check, Condition, Finding, good, run_checks


def test_findings_come_in_order_and_one_that_hangs_is_bad() -> None:
    hold = threading.Event()

    def hang() -> Finding:
        hold.wait(30)
        return good("hangs", "late")

    def break_off() -> Finding:
        raise ZeroDivisionError("by nothing")

    def away() -> Finding:
        raise StoreUnavailable("the store is away")

    checks = [
        Check("hangs", hang, limit_s=0.05, mend_hang="restart it"),
        Check("breaks", break_off),
        Check("away", away),
        Check("good", lambda: good("good", "fine")),
    ]
    try:
        found = list(run_checks(checks))
    finally:
        hold.set()
    assert [one.name for one in found] == ["hangs", "breaks", "away", "good"]
    assert [one.condition for one in found] == [Condition.BAD] * 3 + [Condition.GOOD]
    assert found[0].fix == "restart it"
    assert "ZeroDivisionError: by nothing" in found[1].message
    assert found[2].message == "the store is away"
