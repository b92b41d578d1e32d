"""Training data of an evaluator: hands executed for the training pictures of a proposal network.

The first round executes proposals of the network and perturbed grasps of its data. Each later round trains an evaluator
on all attempts so far, and executes the hands that it selects and refines. So the evaluator learns from its own errors,
as policies do in DAgger (Ross et al., AISTATS 2011).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np

from examples.train_grasp_predictor.evaluation import Proposer
from examples.train_grasp_predictor.evaluator import Attempts, learned
from examples.train_grasp_predictor.execution import carried_out, made_ready
from examples.train_grasp_predictor.refinement import RefinedHands, joined, moved
from examples.train_grasp_predictor.samples import Floats, Sight, TrainedModel, each_scene
from graspd.baselines.learned.network import Proposals, decode
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.validation.decomposition import decompose

#: First round: pictures per object, and proposals and grasps of the data per picture.
PICTURES: Final = 32
PROPOSED: Final = 8
GRASPS: Final = 8
#: Later rounds: pictures per object, and selected hands per picture.
LATER: Final = 24
CHOSEN: Final = 16
#: Proposals from which these hands are selected: fewer than in evaluation, because the aim is to find errors.
AMONG: Final = 32
#: Sizes of the perturbations of grasps, used in turn.
SIZES: Final = (0.0, 0.5, 1.0, 2.0)
#: Number of later rounds.
AGAIN: Final = 2

#: Function from the rows of a scene's grasps, a picture of the scene and a generator to hands.
_HandsFor = Callable[[Floats, Sight, np.random.Generator], Proposals]


@dataclass(frozen=True)
class TrainingRun:
    """Execution of hands in the scenes of one source."""

    hand: HandModel
    models: Mapping[str, ObjectModel]
    """Objects by name."""
    given: Sequence[TrainedModel]
    """Grasps of the source, one entry per object."""
    seen: Sequence[Sight]
    """Pictures; only those of scenes with grasps are used."""
    source: Proposer
    """Proposer of the network."""

    def tries(self, *, seed: int) -> Attempts:
        """Run all rounds and return their attempts."""
        rng = np.random.default_rng(seed)
        tries = self.candidates(self.beginning, PICTURES, rng)
        for _ in range(AGAIN):
            refined = RefinedHands(self.hand, learned(self.hand, tries, seed=seed), self.source, begun=AMONG)
            tries = tries.and_those(self.candidates(partial(_chosen, refined), LATER, rng))
        return tries

    def candidates(self, hands_for: _HandsFor, pictures: int, rng: np.random.Generator) -> Attempts:
        """Execute hands for at most `pictures` pictures of each object."""
        sights: list[Sight] = []
        hands: list[Proposals] = []
        lifted = []
        for part in self.given:
            rows = dict(each_scene(part))
            mine = [sight for sight in self.seen if sight.scene in rows]
            chosen = [mine[i] for i in rng.permutation(len(mine))[:pictures]]
            if not chosen:
                continue
            found = (hands_for(part.rows[rows[sight.scene]], sight, rng) for sight in chosen)
            ready = [made_ready(self.hand, one, sight) for one, sight in zip(found, chosen, strict=True)]
            obj = self.models[chosen[0].scene.object]
            lifted.append(carried_out(self.hand, obj, decompose(obj), ready, chosen, epsilon=False).lift)
            sights += chosen
            hands += [one.hands for one in ready]
        return Attempts.of(self.hand, sights, hands, np.concatenate(lifted))

    def beginning(self, rows: Floats, sight: Sight, rng: np.random.Generator) -> Proposals:
        """Return the hands of the first round: proposals, then perturbed grasps of the scene."""
        drawn = decode(rows[rng.choice(len(rows), GRASPS)], np.zeros(3))
        return joined(self.source(sight, PROPOSED, rng), moved(self.hand, drawn, np.resize(SIZES, GRASPS), rng))


def _chosen(refined: RefinedHands, rows: Floats, sight: Sight, rng: np.random.Generator) -> Proposals:
    return refined(sight, CHOSEN, rng)
