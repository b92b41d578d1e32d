"""A simulation that blows up: MuJoCo resets it and goes on, and nobody may take that for a grasp that holds."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from graspd.worker.engines.mujoco_warnings import void
from graspd.worker.validation.displacement import simulated_displacement_cm
from graspd.worker.validation.model import MujocoOptions, build
from graspd.worker.validation.protocol import Outcome, Test
from graspd.worker.validation.validator import validate
from tests.worker.validation.test_validator import BOX, PADS, WHOLE, grasp_of


class Exploding(Test):
    """The first push makes a velocity infinite."""

    def _push(self, direction: int) -> None:
        super()._push(direction)
        self.data.qvel[0] = np.inf


@pytest.mark.parametrize("level", ["dexgraspbench", "standard"])
def test_a_blown_up_push_is_not_held(level: str) -> None:
    test = Exploding(build(PADS, BOX, WHOLE, MujocoOptions()))
    rollout = test.dexgraspbench(grasp_of(), 0) if level == "dexgraspbench" else test.standard(grasp_of(), 0)
    assert rollout.outcomes[0] is Outcome.DIVERGED
    assert not rollout.success
    # What the guard is for: after MuJoCo's reset the object stands where it began.
    assert test._motion()[0] < 0.05


def test_the_next_grasp_is_validated_afresh() -> None:
    test = Exploding(build(PADS, BOX, WHOLE, MujocoOptions()))
    test.standard(grasp_of(), 0)
    assert void(test.data)
    Test._start(test, grasp_of(), 0)
    assert not void(test.data)


def test_a_screen_that_blew_up_asks_the_certificate(monkeypatch: pytest.MonkeyPatch) -> None:
    """The coarse physics are less stable: that they fail says nothing of the grasp."""
    push = Test._push

    def poisoned(self: Test, direction: int) -> None:
        push(self, direction)
        if self.scene.physics.root == "fixed":
            self.data.qvel[0] = np.inf

    monkeypatch.setattr(Test, "_push", poisoned)
    assert validate(PADS, BOX, grasp_of(), level="fast", pieces=WHOLE).success.tolist() == [1]


def test_a_displacement_that_is_no_number_is_told_as_none(monkeypatch: pytest.MonkeyPatch) -> None:
    step = mujoco.mj_step

    def poisoned(model: object, data: mujoco.MjData, nstep: int) -> None:
        data.qvel[0] = np.nan
        step(model, data, nstep=nstep)

    monkeypatch.setattr(mujoco, "mj_step", poisoned)
    assert np.isnan(simulated_displacement_cm(PADS, BOX, grasp_of().grasp, pieces=WHOLE)[0])


def test_warnings_leave_no_file_in_the_working_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    Exploding(build(PADS, BOX, WHOLE, MujocoOptions())).standard(grasp_of(), 0)
    assert list(tmp_path.iterdir()) == []
