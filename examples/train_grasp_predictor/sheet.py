"""Page of pictures: executed proposals of each source for each unseen object."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Final

import numpy as np
from PIL import Image, ImageDraw

from examples.train_grasp_predictor.evaluation import TAKEN, Exam
from examples.train_grasp_predictor.execution import Lifted, Ready
from examples.train_grasp_predictor.samples import Floats
from graspd.service.model.transforms import apply, quat_rotate
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.rendering.pictures import grasp_pictures
from graspd.worker.rendering.sheets import label_page

SIDE: Final = 200
#: Pictures per object; the first proposal for each is drawn.
DRAWN: Final = 2
_LIFTED, _LOST = (40, 160, 60), (200, 60, 50)

Found = tuple[Exam, list[Ready], Lifted]


def page(hand: HandModel, found: Mapping[str, Mapping[str, Found]]) -> bytes:
    """Return a PNG with a row per object and `DRAWN` pictures per source; a green frame means lifted."""
    rows, names = [], []
    for obj, of_sources in found.items():
        cells = []
        for exam, ready, lifted in of_sources.values():
            for number in range(DRAWN):
                hands, there = ready[number].hands, _lying(exam.model, exam.seen[number].object_pose)
                drawn = grasp_pictures(hand, there, hands.hand_pose[:1], hands.joints[:1], (SIDE, SIDE))[0, 0]
                cells.append(_framed(drawn, lifted=bool(lifted.lift[number * TAKEN])))
        rows.append(cells)
        names.append([obj])
    heads = [name if k == 0 else "" for name in next(iter(found.values())) for k in range(DRAWN)]
    subtitle = "the first proposal for each of two pictures; green: lifted in simulation"
    return label_page(rows, heads, names, title=f"Objects that {hand.name} had not seen", subtitle=subtitle)


def _lying(obj: ObjectModel, pose: Floats) -> ObjectModel:
    """Return the object with its surface moved to a pose on the table."""
    vertices, normals = apply(pose, obj.vertices), quat_rotate(pose[3:], obj.corner_normals)
    return replace(obj, vertices=vertices, corner_normals=normals)


def _framed(picture: np.ndarray, *, lifted: bool) -> Image.Image:
    image = Image.fromarray(picture)
    ImageDraw.Draw(image).rectangle([0, 0, SIDE - 1, SIDE - 1], outline=_LIFTED if lifted else _LOST, width=4)
    return image
