"""A card in a folder: README.md, card.json, checksums.sha256, plots, and sample pictures."""

import json
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from graspd.service.model.digests import file_sha256
from graspd.service.model.errors import InputError
from graspd.service.pipeline.datasets.export import path_of
from graspd.service.readers import ShardFile, Shards
from graspd.service.store.integrity import CHECKSUMS
from graspd.service.store.shards import open_shard
from graspd.studies.cards.contents import Contents, ShardContents, read_shards
from graspd.studies.cards.numbers import card_content
from graspd.studies.cards.page import render_card
from graspd.studies.cards.plots import draw
from graspd.studies.cards.tally import tally_of
from graspd.worker.rendering import sheets

#: File of sample pictures, and their largest number.
SHEET: Final = "samples.jpg"
MOST: Final = 12
_COLUMNS: Final = 4
_WIDTH: Final = 240
_CAPTION: Final = 18
_QUALITY: Final = 85


def write_card(
    contents: Contents,
    folder: Path,
    *,
    licence: str = "",
    source: str = "",
    progress: Callable[[int, int], None],
    publication: Mapping[str, Any] | None = None,
) -> dict[str, Any]:
    """Read all shards and write the card over an earlier one; return the content of `card.json`.
    A `publication` has other files and checksums than shards, see `render_card`. `progress` is called after each shard
    with the numbers of shards read and of all shards. Raises InputError: the folder cannot be created, or the dataset
    is empty or damaged; StoreUnavailable: the store does not answer."""
    if not contents.shards.of_kind("base"):
        raise InputError(f"{contents.name} has no base shard, so its card would be empty")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"the folder {folder} cannot be created: {error.strerror}") from None

    def report_progress() -> Iterator[ShardContents]:
        for number, piece in enumerate(read_shards(contents), start=1):
            yield piece
            progress(number, len(contents.shards))

    tally = tally_of(contents, report_progress())
    card = card_content(contents, tally, licence=licence, source=source)
    plots = draw(card, tally, folder)
    if write_samples(contents.shards, folder / SHEET):
        plots[SHEET] = "Some of the pictures"
    card["plots"] = list(plots)
    if publication is None:
        (folder / CHECKSUMS).write_text("".join(checksum_lines(contents)))
    (folder / "card.json").write_text(json.dumps(card, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    (folder / "README.md").write_text(render_card(card, plots, publication))
    return card


def checksum_lines(contents: Contents) -> Iterator[str]:
    """Yield lines for `sha256sum -c` in the folder of the export or of the shards."""
    if contents.snapshot is not None:
        yield from (f"{shard.sha256}  {path_of(shard)}\n" for shard in contents.snapshot.shards)
        return
    paths = sorted(contents.shards.path(file) for file in contents.shards)
    root = contents.root or Path()
    for path in paths:
        yield f"{file_sha256(path)}  {path.relative_to(root)}\n"


def write_samples(shards: Shards, file: Path) -> bool:
    """Write a JPEG of sample pictures; return False for a dataset without pictures."""
    chosen = choose_shards(shards.of_kind("views"))
    if not chosen:
        return False
    pictures = [Image.fromarray(_picture(shards.path(one))) for one in chosen]
    heights = [round(one.height * _WIDTH / one.width) for one in pictures]
    line = max(heights) + _CAPTION
    columns = min(_COLUMNS, len(pictures))
    sheet = Image.new("RGB", (_WIDTH * columns, line * -(-len(pictures) // columns)), sheets.PAPER)
    draw = ImageDraw.Draw(sheet)
    for number, (one, shown, height) in enumerate(zip(chosen, pictures, heights, strict=True)):
        left, top = _WIDTH * (number % columns), line * (number // columns)
        sheet.paste(shown.resize((_WIDTH, height), Image.Resampling.LANCZOS), (left, top))
        caption = f"{one.object} ({one.hand})"
        draw.text((left + 4, top + height + 2), caption, fill=sheets.INK, font=sheets.font(11))
    sheet.save(file, quality=_QUALITY)
    return True


def choose_shards(files: tuple[ShardFile, ...]) -> list[ShardFile]:
    """Choose at most `MOST` shards, spread over the objects, with hands in turn."""
    cells: dict[tuple[str, str], list[ShardFile]] = {}
    for file in files:
        cells.setdefault((file.hand, file.object), []).append(file)
    hands = list(dict.fromkeys(hand for hand, _ in cells))
    objects = list(dict.fromkeys(obj for _, obj in cells))
    ranked = sorted(cells, key=lambda cell: (hands.index(cell[0]) - objects.index(cell[1])) % len(hands))
    some = ranked[: max(MOST, len(objects))]
    spread = some if len(some) <= MOST else [some[round(k)] for k in np.linspace(0, len(some) - 1, MOST)]
    # Batches with equal numbers share materials and lights, so different numbers are taken.
    chosen = (cells[cell] for cell in sorted(spread, key=lambda cell: objects.index(cell[1])))
    return [batches[number % len(batches)] for number, batches in enumerate(chosen)]


def _picture(path: Path) -> NDArray[np.uint8]:
    """Return the picture (H, W, 3) of a shard in which the object's box is largest."""
    with open_shard(path) as opened:
        box = np.asarray(opened["box/bounding_box_2d_tight"], float)
        area = np.nan_to_num((box[:, 2] - box[:, 0]) * (box[:, 3] - box[:, 1]), nan=-1.0)
        return np.asarray(opened["image/rgb"][int(np.argmax(area))], np.uint8)
