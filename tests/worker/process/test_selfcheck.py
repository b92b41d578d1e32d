"""A worker's check of itself, with the real engine."""

from __future__ import annotations

from typing import Any

import pytest

from graspd.service.model.states import Stage
from graspd.worker import generation
from graspd.worker.process.selfcheck import EngineError, check_engine


@pytest.mark.parametrize("stage", Stage)
def test_the_engine_of_every_stage_passes(stage: Stage) -> None:
    check_engine(lambda: "cpu", (stage,))


def test_an_engine_that_breaks_is_told_in_a_line_with_its_stage(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(*args: Any, **options: Any) -> None:
        raise ImportError("libwarp.so: cannot open\nshared object file")

    monkeypatch.setattr(generation, "validated_grasps", broken)
    with pytest.raises(EngineError) as caught:
        check_engine(lambda: "cpu", (Stage.SYNTHESIZE,))
    assert str(caught.value) == "synthesize: ImportError: libwarp.so: cannot open shared object file"


def test_an_engine_that_gives_nonsense_does_not_pass(monkeypatch: pytest.MonkeyPatch) -> None:
    plan = generation.validated_grasps

    def nonsense(*args: Any, **options: Any) -> Any:
        found = plan(*args, **options)
        found.grasps.grasp.hand_pose[:] = float("nan")
        return found

    monkeypatch.setattr(generation, "validated_grasps", nonsense)
    with pytest.raises(EngineError, match="no number"):
        check_engine(lambda: "cpu", (Stage.SYNTHESIZE,))
