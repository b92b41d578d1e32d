"""A card in a folder: README.md, card.json, checksums.sha256 and plots."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Final

from service.model.errors import InputError
from service.pipeline.datasets.export import path_of
from worker.cards.contents import Contents
from worker.cards.numbers import numbers
from worker.cards.page import page
from worker.cards.plots import draw
from worker.cards.reading import Piece, pieces
from worker.cards.samples import write_samples
from worker.cards.tally import tally_of

#: Pictures out of the dataset.
SHEET: Final = "samples.jpg"
#: Told after each shard: how many are done, of how many.
Progress = Callable[[int, int], None]


def write_card(
    contents: Contents,
    folder: Path,
    *,
    licence: str = "",
    source: str = "",
    progress: Progress = lambda done, total: None,
) -> dict[str, Any]:
    """Read all shards and write the card; what an earlier card left there is written over.

    Returns:
        the figures, as in `card.json`, and under `plots` the names of the pictures.

    Raises:
        InputError: the folder cannot be made, the dataset holds no grasp, or a shard is not what its checksum says.
        StoreUnavailable: the store does not answer.
    """
    if not contents.shards.of("base"):
        raise InputError(f"{contents.name} holds no base shard: there is nothing to say of it yet")
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"the folder {folder} cannot be made: {error.strerror}") from None
    tally = tally_of(contents, _counted(pieces(contents), len(contents.shards), progress))
    card = numbers(contents, tally, licence=licence, source=source)
    plots = draw(card, tally, folder)
    if write_samples(contents.shards, folder / SHEET):
        plots[SHEET] = "Some of the pictures"
    card["plots"] = list(plots)
    (folder / "checksums.sha256").write_text("".join(checksums(contents)))
    (folder / "card.json").write_text(json.dumps(card, indent=1, ensure_ascii=False, allow_nan=False) + "\n")
    (folder / "README.md").write_text(page(card, plots))
    return card


def checksums(contents: Contents) -> Iterator[str]:
    """Lines as `sha256sum -c` reads them, in the folder of an export or in that of the shards."""
    if contents.snapshot is not None:
        yield from (f"{shard.sha256}  {path_of(shard)}\n" for shard in contents.snapshot.shards)
        return
    paths = sorted(contents.shards.path(file) for file in contents.shards)
    root = contents.root or Path()
    for path in paths:
        with path.open("rb") as opened:
            yield f"{hashlib.file_digest(opened, 'sha256').hexdigest()}  {path.relative_to(root)}\n"


def _counted(found: Iterator[Piece], total: int, progress: Progress) -> Iterator[Piece]:
    for number, piece in enumerate(found, start=1):
        yield piece
        progress(number, total)
