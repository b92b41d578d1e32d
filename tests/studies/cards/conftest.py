"""Cards of one dataset, made once."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from graspd.service.pipeline.datasets.export import export_shards
from graspd.studies.cards.card import write_card
from graspd.studies.cards.contents import Contents, contents_of_store, pieces
from graspd.studies.cards.numbers import numbers
from graspd.studies.cards.page import page
from graspd.studies.cards.tally import tally_of
from tests.studies.cards.makers import Made, dataset


@dataclass
class Case:
    """A dataset, its contents, the folder of its card, and the card's figures."""

    made: Made
    contents: Contents
    folder: Path
    card: dict[str, Any]

    @property
    def page(self) -> str:
        return (self.folder / "README.md").read_text()


def case(folder: Path, *, drawn: bool = True, **options: Any) -> Case:
    """The card of a dataset, with its plots or without; options as of `makers.dataset`."""
    made = dataset(folder, (folder / "store").as_uri(), **options)
    contents = contents_of_store(made.services.store, "kitchen", cache=folder / "cache")
    if drawn:
        card = write_card(contents, folder / "card", licence="CC-BY-4.0")
    else:
        card = numbers(contents, tally_of(contents, pieces(contents)))
        (folder / "card").mkdir()
        (folder / "card" / "README.md").write_text(page(card, {}))
    return Case(made, contents, folder / "card", card)


@pytest.fixture(scope="package")
def kitchen(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Case]:
    """A whole dataset of two hands and two objects; tests only read it."""
    made = case(tmp_path_factory.mktemp("kitchen"))
    yield made
    made.made.services.close()


@pytest.fixture(scope="package")
def export(kitchen: Case, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The shards of that dataset as `graspd datasets export` writes them; tests only read it."""
    folder = tmp_path_factory.mktemp("export") / "kitchen"
    export_shards(kitchen.made.snapshot, folder, lambda shard: kitchen.made.services.store.stream(shard.key))
    return folder
