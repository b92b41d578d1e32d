"""A network's proposals as starts of fast_graspd's descent: the open hand of each, where it is clear."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from service.model.errors import SceneError
from service.model.fidelity import Fidelity
from service.model.scene_spec import UPRIGHT
from service.model.transforms import Floats, compose, invert, quat_conjugate, quat_rotate
from worker.planners.fast_graspd.scene_starts import ROOM, clear_scene_starts
from worker.planners.fast_graspd.starts import CLEAR, Probe
from worker.planners.learned.network import ProposalNetwork, cloud_inputs, conditions, decode, flow
from worker.planners.learned.sight import Seen
from worker.simulation.data import HandState
from worker.simulation.model import Model
from worker.simulation.surroundings import UP, Obstacle, Placed

#: Steps back along the way in while something touches [m].
RETREATS: Final = (0.0, 0.01, 0.02, 0.035, 0.055, 0.08)
#: Proposals of a grasp, shared out to its starts: as many as are computed at once.
PROPOSALS: Final = 32
#: A palm that is farther from the object's bounding ball is no start [m].
FAR_M: Final = 0.15


@dataclass(frozen=True)
class Seeds:
    """A `WarmStart` from the proposals of a network. A start none of whose proposals comes free is one that fast_graspd
    finds itself."""

    network: ProposalNetwork
    starts: int
    """Hands of each grasp that set out."""

    def adapted(self, fidelity: Fidelity) -> Fidelity:
        """See `WarmStart`."""
        finalists = min(fidelity.finalists, self.starts)
        return fidelity.model_copy(update={"starts": self.starts, "finalists": finalists})

    def __call__(
        self, model: Model, generators: list[np.random.Generator], *, each: int, placed: Placed, ways: Sequence[Floats]
    ) -> tuple[HandState, Floats]:
        """See `scene_starts.clear_scene_starts`.

        Raises:
            SceneError: the scenes have no table.
        """
        scene = np.repeat(placed.index, each)
        drawn, away = self._proposed(model, generators, each, placed)
        state, depth = _clear(model, drawn, away, scene, placed)
        rest = np.flatnonzero(depth > CLEAR)
        if len(rest):
            own, depth[rest] = clear_scene_starts(
                model, [generators[i] for i in rest], each=1, placed=placed.take(rest // each), ways=ways
            )
            state.pivot[rest], state.rotation[rest], state.q[rest] = own.pivot, own.rotation, own.q
        return state, depth

    def _proposed(
        self, model: Model, generators: list[np.random.Generator], each: int, placed: Placed
    ) -> tuple[HandState, Floats]:
        """Hands (n * draws) as proposed, open, those of a start side by side, and (n * draws, 3) ways out; object
        frame."""
        hand, obj, table = model.hand.model, model.obj.model, table_height(placed.supports)
        seen, draws = Seen.of(obj), max(1, PROPOSALS // each)
        pivot, rotation, q, away = [], [], [], []
        for number, scene in enumerate(placed.index.tolist()):
            mine = generators[number * each : (number + 1) * each]
            pose = np.asarray(placed.object_pose[scene], float)
            cloud = seen.cloud(pose, seen.camera(pose, mine[0]), self.network.points, mine[0])
            inputs, anchor = cloud_inputs(*cloud, table)
            condition = conditions(self.network, inputs[None], anchor[2:] - table)
            # A grasp's proposals are computed apart from those of others, so that they cannot depend on these.
            noise = np.concatenate([g.standard_normal((draws, self.network.numbers)) for g in mine])
            rows = flow(self.network, noise.astype(np.float32), np.repeat(condition, len(noise), axis=0))
            found = decode(rows, anchor)
            at = compose(invert(pose), found.hand_pose)
            pivot.append(at[:, :3] + quat_rotate(at[:, 3:], hand.palm.centre) - obj.centre_of_mass)
            rotation.append(at[:, 3:])
            q.append(np.clip(hand.reduce(found.pregrasp), hand.lower, hand.upper))
            away.append(-quat_rotate(quat_conjugate(pose[3:]), found.approach))
        return HandState(*map(np.concatenate, (pivot, rotation, q))), np.concatenate(away)


def table_height(supports: Sequence[Obstacle]) -> float:
    """z of the table among the supports of a scene [m].

    Raises:
        SceneError: there is none: no half-space below a level plane.
    """
    heights = [float(o.planes[0, 3]) for o in supports if len(o.planes) == 1 and o.planes[0, :3] @ UP > UPRIGHT]
    if not heights:
        raise SceneError("method learned proposes grasps of things on a table; this scene has none, choose fast_graspd")
    return max(heights)


def _clear(
    model: Model, drawn: HandState, away: Floats, scene: NDArray[np.intp], placed: Placed
) -> tuple[HandState, Floats]:
    """Of the hands of each start (n) the one that is clear at the fewest steps back, and its depth (n,) [m]; inf where
    there is none. What a hand lacks of its room from obstacles it is raised first."""
    count, probe = len(scene), Probe(model, len(scene), room=ROOM)
    draws = len(drawn.pivot) // count
    near = (np.linalg.norm(drawn.pivot, axis=1) < model.obj.model.radius + FAR_M).reshape(count, draws)
    up = np.array([s.up for s in placed.scenes])[scene]
    raised = np.zeros_like(drawn.pivot)
    for draw in range(draws):
        rows = np.arange(count) * draws + draw
        probe.data.set_scenes(scene)
        probe.depths(drawn[rows])
        raised[rows] = probe.data.depths.obstacles.numpy()[:count, None].astype(float) * up
    best, depth = drawn[np.arange(count) * draws], np.full(count, np.inf)
    for back, draw in product(RETREATS, range(draws)):
        left = np.flatnonzero((depth > CLEAR) & near[:, draw])
        if not len(left):
            continue
        rows = left * draws + draw
        states = drawn[rows]
        states.pivot[:] += raised[rows] + back * away[rows]
        probe.data.set_scenes(scene[left])
        found = probe.depths(states)
        clear = np.flatnonzero(found <= CLEAR)
        taken = left[clear]
        depth[taken] = found[clear]
        best.pivot[taken], best.rotation[taken], best.q[taken] = (
            part[clear] for part in (states.pivot, states.rotation, states.q)
        )
    return best, depth
