"""What an evaluator learns from: hands that are carried out for pictures that its network was trained on.

First proposals of the network and moved grasps of its data; then, round by round, what an evaluator of the candidates
so far chooses and moves: where it believes most, its errors cost most (policies, too, are taught where they themselves
lead to: DAgger, Ross et al., AISTATS 2011).
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

#: Pictures of each object that are practised with at first; proposals, and grasps of the data, for each of them.
PICTURES: Final = 32
PROPOSED: Final = 8
GRASPS: Final = 8
#: Pictures of each object in each later round, and what is chosen for each of them.
LATER: Final = 24
CHOSEN: Final = 16
#: Proposals that these are chosen among: fewer than later, for what they teach is where errors lie.
AMONG: Final = 32
#: Sizes of the moves of these grasps, in turn.
SIZES: Final = (0.0, 0.5, 1.0, 2.0)
#: How often an evaluator's own choices are tried, and learned from.
AGAIN: Final = 2

#: From the rows of a scene's grasps, a picture of it and a generator to hands.
_HandsFor = Callable[[Floats, Sight, np.random.Generator], Proposals]


@dataclass(frozen=True)
class TrainingRun:
    """Hands carried out in the scenes of one source's data."""

    hand: HandModel
    models: Mapping[str, ObjectModel]
    """Objects by name."""
    given: Sequence[TrainedModel]
    """The data, object by object."""
    seen: Sequence[Sight]
    """Pictures; those whose scene has grasps are practised with."""
    source: Proposer
    """What the network proposes."""

    def tries(self, *, seed: int) -> Attempts:
        """All rounds."""
        rng = np.random.default_rng(seed)
        tries = self.candidates(self.beginning, PICTURES, rng)
        for _ in range(AGAIN):
            refined = RefinedHands(self.hand, learned(self.hand, tries, seed=seed), self.source, begun=AMONG)
            tries = tries.and_those(self.candidates(partial(_chosen, refined), LATER, rng))
        return tries

    def candidates(self, hands_for: _HandsFor, pictures: int, rng: np.random.Generator) -> Attempts:
        """What becomes of hands for so many pictures of each object."""
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
        """What the first round tries: proposals, then moved grasps of the scene."""
        drawn = decode(rows[rng.choice(len(rows), GRASPS)], np.zeros(3))
        return joined(self.source(sight, PROPOSED, rng), moved(self.hand, drawn, np.resize(SIZES, GRASPS), rng))


def _chosen(refined: RefinedHands, rows: Floats, sight: Sight, rng: np.random.Generator) -> Proposals:
    return refined(sight, CHOSEN, rng)
