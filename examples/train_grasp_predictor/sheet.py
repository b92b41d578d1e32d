"""A page to look at: what the network saw of each held-back object, and the grasps that came of its best proposals."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Final

import numpy as np
from PIL import Image

from examples.train_grasp_predictor.evaluation import Held
from examples.train_grasp_predictor.execution import TAKEN
from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.rendering.pages.pictures import grasp_pictures
from worker.rendering.pages.sheets import label_page

SIDE: Final = 240
#: Proposals of a source drawn for each object: the best of its first pictures.
DRAWN: Final = 3


def page(hand: HandModel, tests: Sequence[Held], made: Mapping[str, Mapping[str, GraspSet]]) -> bytes:
    """PNG with a row for each object.

    Args:
        hand: the hand.
        tests: the held-back objects.
        made: for each source and object the grasps of its pictures, `TAKEN` for each, best first.
    """
    rows, names = [], []
    for held in tests:
        first = np.arange(DRAWN) * TAKEN
        seen = (held.pictures[0].image[:3].numpy().transpose(1, 2, 0) * 255).astype(np.uint8)
        cells = [Image.fromarray(seen).resize((SIDE, SIDE), Image.Resampling.LANCZOS)]
        for grasps in (of_objects[held.name] for of_objects in made.values()):
            shown = grasps.grasp.take(first)
            drawn = grasp_pictures(hand, held.model, shown.hand_pose, shown.joint_positions, (SIDE, SIDE))
            cells += [Image.fromarray(picture) for picture in drawn[:, 0]]
        rows.append(cells)
        names.append([held.name])
    heads = ["seen", *(name if k == 0 else "" for name in made for k in range(DRAWN))]
    subtitle = "the best proposal for each of three pictures, carried out"
    return label_page(rows, heads, names, title="Objects the networks had not seen", subtitle=subtitle)
