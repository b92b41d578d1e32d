"""Weights per iteration, and the interface for another method that proposes starts.
The coarse phase shrinks the dilation; the fine phase brings the hand into contact."""

from collections.abc import Sequence
from typing import Final, Protocol

import numpy as np

from graspd.service.model.fidelity import Fidelity
from graspd.service.model.transforms import Floats
from graspd.worker.simulation.data import HandState, Schedule
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.simulation.model import LossOptions, Model
from graspd.worker.simulation.projection import ProjectionOptions

#: Rates of Adam: translation [m], rotation [rad], joints [rad].
COARSE_RATES: Final = (2e-3, 2e-2, 4e-2)
FINE_RATES: Final = (5e-4, 5e-3, 1e-2)
#: The paper's rate of plain gradient descent, equal for all variables in SI units.
PAPER_RATES: Final = (1e-3, 1e-3, 1e-3)
#: Largest dilation of the object [m].
DILATION: Final = 0.01
SELF_WEIGHT: Final = 2e4
#: Length of the attraction term, see `LossOptions` [m]. The term favours enclosing grasps, and more of these hold at
#: half friction. Half this length hardly changes results of a Barrett hand. Twice this length pulls the slender fingers
#: of a Shadow hand into thin walls.
PULL: Final = 3e-4
#: Projection around a free object. Points are attracted from farther away than among obstacles, so more points of the
#: hand touch. Penetration grows by about half of what the additional samples of `pairs.DENSER` remove.
AROUND: Final = ProjectionOptions(hold=5e-3)


def loss_options(fidelity: Fidelity) -> LossOptions:
    """Return the loss options of a fidelity; gradient descent has the paper's penalty on joint limits."""
    paper = fidelity.optimizer == "gd"
    return LossOptions(
        contact_solver=fidelity.contact_solver,
        velocities=fidelity.velocities,
        friction=0.8,
        one_sided=fidelity.leak == "one_sided",
        leak_length=0.02 if fidelity.leak == "one_sided" else 1e3,
        limit_weight=100.0 if paper else 0.0,
        pull=PULL if fidelity.simulate and not paper else 0.0,
        simulate=fidelity.simulate,
        leak=0.1 if fidelity.simulate else 1.0,
    )


def fidelity_in_scenes(fidelity: Fidelity) -> Fidelity:
    """Return the fidelity for scenes. Obstacles leave fewer good approaches, so more hands are needed.
    Starts have the object between the fingers, so few iterations suffice."""
    return fidelity.model_copy(
        update={
            "starts": min(5 * fidelity.starts // 2, 64),
            "finalists": min(2 * fidelity.finalists, 64),
            "coarse_iterations": _share(fidelity.coarse_iterations, 0.25),
            "fine_iterations": _share(fidelity.fine_iterations, 0.375),
            "polish_iterations": _share(fidelity.polish_iterations, 0.6),
        }
    )


def _share(iterations: int, share: float) -> int:
    return int(np.ceil(share * iterations))


def _decayed(rates: tuple[float, float, float], count: int, to: float) -> Floats:
    return np.array(rates) * np.geomspace(1.0, to, max(count, 1))[:count, None]


def coarse_schedule(fidelity: Fidelity) -> Schedule:
    """Return the schedule: dilation falls to 0 at four fifths; Adam's penetration weight grows tenfold."""
    n = fidelity.coarse_iterations
    dilation = DILATION * np.clip(1.0 - np.arange(n) / max(0.8 * n, 1.0), 0.0, 1.0)
    if fidelity.optimizer == "gd":
        return Schedule(dilation, np.zeros(n), np.zeros(n), np.zeros(n), np.tile(PAPER_RATES, (n, 1)))
    penetration = np.geomspace(3e3, 3e4, max(n, 1))[:n]
    return Schedule(dilation, penetration, penetration, np.full(n, SELF_WEIGHT), _decayed(COARSE_RATES, n, 0.25))


def fine_schedule(fidelity: Fidelity) -> Schedule:
    n = fidelity.fine_iterations
    if fidelity.optimizer == "gd":
        return Schedule(np.zeros(n), np.zeros(n), np.zeros(n), np.zeros(n), np.tile(PAPER_RATES, (n, 1)))
    penetration = np.geomspace(1e5, 1e6, max(n, 1))[:n]
    return Schedule(
        np.zeros(n), penetration, 0.3 * penetration, np.full(n, 3 * SELF_WEIGHT), _decayed(FINE_RATES, n, 0.1)
    )


class WarmStart(Protocol):
    """Proposes starts of grasps in scenes."""

    def adapted(self, fidelity: Fidelity) -> Fidelity:
        """Return a result of `fidelity_in_scenes` with adapted numbers of starts and finalists."""

    def __call__(
        self,
        model: Model,
        generators: list[np.random.Generator],
        *,
        each: int,
        placed: PlacedGrasps,
        ways: Sequence[Floats],
    ) -> tuple[HandState, Floats]:
        """See `scene_starts.clear_scene_starts`."""
