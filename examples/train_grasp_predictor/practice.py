"""What an evaluator learns from: hands that are carried out for pictures that its network was trained on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np

from examples.train_grasp_predictor.evaluation import Proposer
from examples.train_grasp_predictor.evaluator import Tries
from examples.train_grasp_predictor.execution import carried_out, made_ready
from examples.train_grasp_predictor.refinement import joined, moved
from examples.train_grasp_predictor.samples import Sight, Taught, each_scene
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.planners.learned.network import Proposals, decode
from worker.quality.referee.decomposition import decompose

#: Pictures of each object that are practised with; proposals, and grasps of the data, for each of them.
PICTURES: Final = 32
PROPOSED: Final = 8
GRASPS: Final = 8
#: Sizes of the moves of these grasps, in turn.
SIZES: Final = (0.0, 0.5, 1.0, 2.0)


def practised(
    hand: HandModel, models: Mapping[str, ObjectModel], given: Sequence[Taught], seen: Sequence[Sight],
    source: Proposer, *, seed: int,
) -> Tries:  # fmt: skip
    """Proposals of a network, and moved grasps of its data, carried out in the scenes of the data.

    Args:
        hand: the hand.
        models: objects by name.
        given: the data, object by object.
        seen: pictures; those whose scene has grasps are kept.
        source: what the network proposes.
        seed: of all draws.
    """
    rng = np.random.default_rng(seed)
    sights: list[Sight] = []
    hands: list[Proposals] = []
    lifted = []
    for part in given:
        rows = dict(each_scene(part))
        mine = [sight for sight in seen if sight.scene in rows]
        chosen = [mine[i] for i in rng.permutation(len(mine))[:PICTURES]]
        if not chosen:
            continue
        ready = [made_ready(hand, _tried(hand, part, rows[sight.scene], source, sight, rng), sight) for sight in chosen]
        obj = models[chosen[0].scene.object]
        lifted.append(carried_out(hand, obj, decompose(obj), ready, chosen, epsilon=False).lift)
        sights += chosen
        hands += [one.hands for one in ready]
    return Tries.of(hand, sights, hands, np.concatenate(lifted))


def _tried(
    hand: HandModel, part: Taught, rows: np.ndarray, source: Proposer, sight: Sight, rng: np.random.Generator
) -> Proposals:
    drawn = part.rows[rng.choice(rows, GRASPS)]
    return joined(source(sight, PROPOSED, rng), moved(hand, decode(drawn, np.zeros(3)), np.resize(SIZES, GRASPS), rng))
