"""Self-check of a worker: whether its engine loads and gives plausible results.

Each stage's engine runs on a ball: it validates and measures a grasp, simulates a drop, or renders a picture. This also
loads or compiles the kernels, so the first task does not wait for them."""

from __future__ import annotations

import importlib
import logging
import time
from collections.abc import Callable, Collection, Mapping
from typing import TYPE_CHECKING, Final

import numpy as np

from graspd.service.model.domain import JobRequest
from graspd.service.model.errors import GraspdError
from graspd.service.model.libraries import pause_garbage_collection
from graspd.service.model.states import Stage
from graspd.worker.execution_context import ExecutionContext

if TYPE_CHECKING:
    from graspd.worker.objects.model import ObjectModel

log = logging.getLogger(__name__)
_RADIUS_M: Final = 0.03
_HAND: Final = "barrett"


class EngineError(GraspdError):
    """The engine of this worker does not work; other workers must do its tasks."""

    slug, title = "engine-broken", "The engine of a worker does not work"


def check_engine(device: Callable[[], str], stages: Collection[Stage], *, threads: int = 0) -> None:
    """Check the engines of these stages; `device` returns the name of the Warp device.
    Raises EngineError: a part fails to load, compile or run, or gives implausible results; the message names it."""
    started, name = time.monotonic(), "device"
    try:
        of_device = device()
        for stage in stages:
            name = stage.value
            with pause_garbage_collection():
                importlib.import_module(f"graspd.worker.stages.{name}")
            if stage in _CHECKS:
                _CHECKS[stage](ExecutionContext(of_device, threads))
    except Exception as error:
        raise EngineError(f"{name}: {type(error).__name__}: {' '.join(str(error).split())[:200]}") from error
    log.info("the engine works; the check took %.1f s", time.monotonic() - started)


def _check_synthesis(run: ExecutionContext) -> None:
    from graspd.worker.generation import validated_grasps
    from graspd.worker.hands.load import hand_from_path

    request = JobRequest(hand=_HAND, object="ball", grasps=1, fidelity="draft", want="candidates")
    found = validated_grasps(hand_from_path(_HAND), _faceted_ball(), request, count=1, run=run)
    finite = np.isfinite(found.grasps.grasp.hand_pose).all()
    _require(len(found.grasps) == 1 and finite, "a grasp of a ball is not finite")


def _check_scene(run: ExecutionContext) -> None:
    from graspd.worker.scenes import drop

    height = drop(_faceted_ball(), count=1, seed=0)["scene/object_pose"][0, 2]
    # The origin of the ball's frame is its centre. Because of its facets, the height differs from the radius.
    _require(abs(height - _RADIUS_M) < 0.1 * _RADIUS_M, f"a ball comes to rest at a height of {height:.3g} m")


def _check_pictures(run: ExecutionContext) -> None:
    from graspd.worker.rendering import render

    pose = np.array([[0.0, 0.0, _RADIUS_M, 1.0, 0.0, 0.0, 0.0]])
    made = render(_faceted_ball(), pose, views=1, stereo=False, width=32, height=24, seed=0, run=run)
    _require(int(np.ptp(made["image/rgb"])) > 0, "a picture of a ball shows nothing")


_CHECKS: Final[Mapping[Stage, Callable[[ExecutionContext], None]]] = {
    Stage.SYNTHESIZE: _check_synthesis,
    Stage.SCENE: _check_scene,
    Stage.RENDER: _check_pictures,
}


def _faceted_ball() -> ObjectModel:
    """Return a ball with flat faces, so that it comes to rest."""
    from manifold3d import Manifold

    from graspd.worker.objects.formats.bare import stl_bytes
    from graspd.worker.objects.prepare import load_object
    from graspd.worker.objects.topology import from_manifold

    mesh = stl_bytes(*from_manifold(Manifold.sphere(_RADIUS_M, 12)))
    return load_object({"ball.stl": mesh}, name="ball", digest="", face_error_m=0.0)


def _require(sensible: object, otherwise: str) -> None:
    if not sensible:
        raise ArithmeticError(otherwise)
