"""Evaluation of proposals by lifts of unseen objects and faces."""

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
#: Function from a picture, a number and a generator to that number of proposals, the best first if scored.
Proposer = Callable[[Sight, int, np.random.Generator], Proposals]
#: Proposals per picture, and how many of them are executed; clear proposals come first.
PROPOSED: Final = 8
TAKEN: Final = 2
#: Kinds of exams: the object, or only its resting face, is unseen in training.
OBJECT, FACE = "unseen object", "unseen face"


@dataclass(frozen=True)
class Exam:
    """Pictures of one object, excluded from training."""

    object: str
    kind: str
    """`OBJECT` or `FACE`."""
    model: ObjectModel
    pieces: ConvexPieces
    seen: Sequence[Sight]

    @classmethod
    def of(cls, name: str, kind: str, model: ObjectModel, seen: Sequence[Sight], count: int) -> Exam:
        """Select `count` of the pictures at random, always the same for one name."""
        order = np.random.default_rng(zlib.crc32(name.encode())).permutation(len(seen))
        return cls(name, kind, model, decompose(model), [seen[i] for i in order[:count]])


def proposals_for(hand: HandModel, exam: Exam, proposer: Proposer, *, seed: int) -> tuple[list[Ready], float]:
    """Return the executed proposals of each picture, and the share of proposals that penetrate the table."""
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
    """Yield each exam with a row of results: shares of the executed proposals."""
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
