"""The context of work: parts of parts, quiet parts, the cores it takes, and how it is stopped."""

import pytest

from graspd.service.model.cores import available_cores
from graspd.service.model.errors import TaskCancelled
from graspd.worker.execution_context import ExecutionContext


def test_a_part_of_a_part_fills_its_share_of_the_whole() -> None:
    told: list[tuple[float, float, str]] = []
    run = ExecutionContext("cuda:7", 3, lambda *what: told.append(what), lambda: True)
    part = run.part(0.5, 1.0).part(0.0, 0.5)
    part.progress(1, 2, "half")
    part.progress(5, 5, "whole")
    part.progress(0, 0, "of nothing")
    assert told == [(0.625, 1.0, "half"), (0.75, 1.0, "whole"), (0.5, 1.0, "of nothing")]
    assert (part.device, part.threads, part.cancelled()) == ("cuda:7", 3, True)


def test_a_quiet_part_tells_nothing_and_can_still_be_stopped() -> None:
    told: list[tuple[float, float, str]] = []
    run = ExecutionContext(progress=lambda *what: told.append(what), cancelled=lambda: True).quiet()
    run.progress(1, 1, "done")
    assert not told
    with pytest.raises(TaskCancelled, match="the work was cancelled"):
        run.check("the work")


def test_without_a_number_of_threads_it_takes_the_cores_there_are() -> None:
    assert (ExecutionContext().cores, ExecutionContext(threads=3).cores) == (available_cores(), 3)
