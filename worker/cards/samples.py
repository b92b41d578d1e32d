"""A sheet of pictures out of a dataset: one of each of some pairs of hand and object."""

from __future__ import annotations

from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from service.readers import ShardFile, Shards
from service.store.shards import open_shard
from worker.rendering.pages import typography

MOST: Final = 12
_COLUMNS: Final = 4
_WIDTH: Final = 240
_CAPTION: Final = 18
_QUALITY: Final = 85


def write_samples(shards: Shards, file: Path) -> bool:
    """Write a JPEG; False if the dataset has no pictures. Of each shard that is shown all is fetched."""
    chosen = choose(shards.of("views"))
    if not chosen:
        return False
    pictures = [Image.fromarray(_picture(shards.path(one))) for one in chosen]
    heights = [round(one.height * _WIDTH / one.width) for one in pictures]
    line = max(heights) + _CAPTION
    columns = min(_COLUMNS, len(pictures))
    sheet = Image.new("RGB", (_WIDTH * columns, line * -(-len(pictures) // columns)), typography.PAPER)
    draw = ImageDraw.Draw(sheet)
    for number, (one, shown, height) in enumerate(zip(chosen, pictures, heights, strict=True)):
        left, top = _WIDTH * (number % columns), line * (number // columns)
        sheet.paste(shown.resize((_WIDTH, height), Image.Resampling.LANCZOS), (left, top))
        caption = f"{one.object} ({one.hand})"
        draw.text((left + 4, top + height + 2), caption, fill=typography.INK, font=typography.font(11))
    sheet.save(file, quality=_QUALITY)
    return True


def choose(files: tuple[ShardFile, ...], most: int = MOST) -> list[ShardFile]:
    """At most so many shards: of each object in turn one of another hand, spread over all objects."""
    cells: dict[tuple[str, str], list[ShardFile]] = {}
    for file in files:
        cells.setdefault((file.hand, file.object), []).append(file)
    hands = list(dict.fromkeys(hand for hand, _ in cells))
    objects = list(dict.fromkeys(obj for _, obj in cells))
    ranked = sorted(cells, key=lambda cell: (hands.index(cell[0]) - objects.index(cell[1])) % len(hands))
    some = ranked[: max(most, len(objects))]
    spread = some if len(some) <= most else [some[round(k)] for k in np.linspace(0, len(some) - 1, most)]
    # Another batch of each: those of one number have materials and lamps in common.
    chosen = (cells[cell] for cell in sorted(spread, key=lambda cell: objects.index(cell[1])))
    return [batches[number % len(batches)] for number, batches in enumerate(chosen)]


def _picture(path: Path) -> NDArray[np.uint8]:
    """(H, W, 3) the picture of a shard in which the object's box is largest."""
    with open_shard(path) as opened:
        box = np.asarray(opened["box/bounding_box_2d_tight"], float)
        area = np.nan_to_num((box[:, 2] - box[:, 0]) * (box[:, 3] - box[:, 1]), nan=-1.0)
        return np.asarray(opened["image/rgb"][int(np.argmax(area))], np.uint8)
