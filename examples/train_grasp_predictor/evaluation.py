"""What proposals are worth: lifts of objects, and of faces, that nobody was trained on."""

from __future__ import annotations

import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from examples.train_grasp_predictor.execution import Lifted, Ready, carried_out, chosen, made_ready, taken
from examples.train_grasp_predictor.samples import Sight
from graspd.baselines.learned.network import Proposals
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.validation.decomposition import ConvexPieces, decompose
from graspd.worker.validation.lift import LiftOutcome

Row = dict[str, Any]
#: From a picture, a number and a generator to so many proposals, the best first where there is one.
Proposer = Callable[[Sight, int, np.random.Generator], Proposals]
#: Proposals for a picture, of which those that are clear go first, and how many of them are carried out.
PROPOSED: Final = 8
TAKEN: Final = 2
#: What a picture shows that was held back.
OBJECT, FACE = "unseen object", "unseen face"


@dataclass(frozen=True)
class Exam:
    """Pictures of one object that nobody was trained on."""

    object: str
    kind: str
    """`OBJECT` or `FACE`."""
    model: ObjectModel
    pieces: ConvexPieces
    seen: Sequence[Sight]

    @classmethod
    def of(cls, name: str, kind: str, model: ObjectModel, seen: Sequence[Sight], count: int) -> Exam:
        """So many of the pictures, spread over the scenes."""
        order = np.random.default_rng(zlib.crc32(name.encode())).permutation(len(seen))
        return cls(name, kind, model, decompose(model), [seen[i] for i in order[:count]])


def proposals_for(hand: HandModel, exam: Exam, proposer: Proposer, *, seed: int) -> tuple[list[Ready], float]:
    """What is carried out for each picture, and the share of all proposals that would have met the table."""
    ready, table = [], []
    for number, sight in enumerate(exam.seen):
        rng = np.random.default_rng([seed, number, zlib.crc32(exam.object.encode())])
        one = made_ready(hand, proposer(sight, PROPOSED, rng), sight)
        table.append(one.table.mean())
        ready.append(taken(one, chosen(one, TAKEN)))
    return ready, float(np.mean(table))


def examined(
    hand: HandModel, exams: Sequence[Exam], proposer: Proposer, *, seed: int, epsilon: bool
) -> Iterator[tuple[Exam, Row, list[Ready], Lifted]]:
    """One row for each object: shares of the proposals that were carried out."""
    for exam in exams:
        ready, table = proposals_for(hand, exam, proposer, seed=seed)
        lifted = carried_out(hand, exam.model, exam.pieces, ready, list(exam.seen), epsilon=epsilon)
        best = np.arange(0, len(lifted.lift), TAKEN)
        outcomes = np.bincount(lifted.outcome, minlength=len(LiftOutcome))
        row: Row = {
            "object": exam.object,
            "kind": exam.kind,
            "pictures": len(exam.seen),
            "candidates": len(lifted.lift),
            "lift": float(lifted.lift.mean()),
            "best": float(lifted.lift[best].mean()),
            "hard": float(lifted.hard.mean()),
            "table": table,
            "outcomes": {LiftOutcome(k).name.lower(): int(n) for k, n in enumerate(outcomes) if n},
        }
        if epsilon:
            row["epsilon"] = float(np.nanmean(lifted.epsilon))
        yield exam, row, ready, lifted
