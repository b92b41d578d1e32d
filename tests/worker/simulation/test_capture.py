"""A rehearsal of CUDA graphs on the CPU: what a capture would record does the same, and touches nothing on the host."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import trimesh
import warp as wp

from graspd.service.model.fidelity import FIDELITIES
from graspd.worker.control.opening import OPENING_STEPS
from graspd.worker.control.postures import pregrasp
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import Posture
from graspd.worker.planners import PlanRequest
from graspd.worker.planners.fast_graspd import planner
from graspd.worker.simulation import launches
from graspd.worker.simulation.launches import Launches
from tests.worker.models import object_from_mesh, two_finger_hand

FIDELITY = FIDELITIES["draft"].model_copy(update={"coarse_iterations": 20, "fine_iterations": 20})


class Graphs:
    """Warp as `Launches` sees it, with a device that is said to be CUDA; counts captures and their replays."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.captured, self.replayed = 0, 0
        names = {name: getattr(wp, name) for name in ("launch",)}
        monkeypatch.setattr(
            launches,
            "wp",
            SimpleNamespace(
                **names,
                get_device=lambda _: SimpleNamespace(is_cuda=True),
                ScopedCapture=self.capture,
                capture_launch=self.replay,
            ),
        )

    def capture(self, device: str) -> Any:
        self.captured += 1
        return wp.ScopedCapture(device=device)

    def replay(self, graph: Any) -> None:
        self.replayed += 1
        wp.capture_launch(graph)


def forbid_the_host(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Inside `Launches.run` nothing is read, written, allocated or loaded; names of what was."""
    broken: list[str] = []
    within = [False]
    plain = Launches.run

    def run(self: Launches, times: int = 1) -> None:
        within[0] = True
        try:
            plain(self, times)
        finally:
            within[0] = False

    def guarded(name: str, real: Any) -> Any:
        def call(*given: Any, **named: Any) -> Any:
            if within[0]:
                broken.append(name)
            return real(*given, **named)

        return call

    monkeypatch.setattr(Launches, "run", run)
    for name in ("numpy", "assign", "fill_", "zero_"):
        monkeypatch.setattr(wp.array, name, guarded(name, getattr(wp.array, name)))
    for name in ("zeros", "empty", "full", "copy", "load_module", "synchronize", "synchronize_device"):
        monkeypatch.setattr(wp, name, guarded(name, getattr(wp, name)))
    return broken


def planned() -> planner.LaunchPart:
    box = object_from_mesh(trimesh.creation.box((0.05, 0.05, 0.08)))
    (part,) = planner.optimise_batch(
        two_finger_hand(), box, PlanRequest(2, FIDELITY, seed=3), ExecutionContext("cpu", threads=1)
    )
    return part


def test_replayed_graphs_give_the_very_hands_of_plain_launches(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = planned()
    graphs = Graphs(monkeypatch)
    replayed = planned()
    assert graphs.captured == 3  # the coarse and the fine phase, and the projection
    steps = FIDELITY.coarse_iterations + FIDELITY.fine_iterations + FIDELITY.polish_iterations
    assert graphs.replayed == steps
    assert plain.state is not None
    assert replayed.state is not None
    for name in ("pivot", "rotation", "q"):
        np.testing.assert_array_equal(getattr(plain.state, name), getattr(replayed.state, name))


def opened() -> Posture:
    """Pregrasps of hands in touch: one that opens along its normals, one that has to open plainly."""
    hand, box = two_finger_hand(), object_from_mesh(trimesh.creation.box((0.06, 0.04, 0.05)))
    grasp = Posture(np.tile([0, 0, -0.095, 1.0, 0, 0, 0], (2, 1)), np.array([[0.4, 0.4], [0.1, 0.8]]))
    return pregrasp(hand, box, grasp)


def test_replayed_graphs_open_hands_as_plain_launches_do(monkeypatch: pytest.MonkeyPatch) -> None:
    plain = opened()
    graphs = Graphs(monkeypatch)
    replayed = opened()
    assert graphs.captured == 2  # along the normals, and plainly
    assert graphs.replayed == 2 * (OPENING_STEPS + 1)
    np.testing.assert_array_equal(plain.joint_positions, replayed.joint_positions)
    np.testing.assert_array_equal(plain.hand_pose, replayed.hand_pose)


def test_nothing_on_the_host_is_touched_between_two_launches(monkeypatch: pytest.MonkeyPatch) -> None:
    Graphs(monkeypatch)
    broken = forbid_the_host(monkeypatch)
    planned()
    opened()
    assert broken == []


def test_the_guard_notices_a_read_between_launches(monkeypatch: pytest.MonkeyPatch) -> None:
    Graphs(monkeypatch)
    broken = forbid_the_host(monkeypatch)
    some = wp.zeros(1, dtype=wp.float32, device="cpu")
    monkeypatch.setattr(Launches, "_launch_all", lambda self: some.numpy())
    Launches("cpu").run()
    assert broken == ["numpy"]
