"""Cards of large matrices, of sums made up: they stay readable, and so do their plots."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image

from graspd.service.readers import Shards
from graspd.studies.cards.contents import AssetFacts, Contents
from graspd.studies.cards.numbers import numbers
from graspd.studies.cards.page import front_matter, page
from graspd.studies.cards.plots import draw
from graspd.studies.cards.tally import CellTally, Tally

OBJECTS = [f"object-{number:03}" for number in range(200)]


def matrix(valid: int) -> tuple[Contents, Tally]:
    """One hand on 200 objects, so many valid grasps each, without their shards."""
    rng = np.random.default_rng(0)
    tally = Tally()
    for name in OBJECTS:
        columns = {"epsilon": [rng.random(50).astype(np.float32)]}
        tally.cells["claw", name] = CellTally(
            grasps=valid, valid=valid, candidates=2 * valid, validated=2 * valid, columns=columns
        )
    extents = {"extents_m": [0.05, 0.06, 0.1]}
    assets = {name: AssetFacts(name, "d" * 32, facts=extents) for name in OBJECTS}
    return Contents("many", Shards(()), {"claw": AssetFacts("claw")}, assets), tally


def test_long_tables_are_folded_and_findings_bounded() -> None:
    contents, tally = matrix(40)
    text = page(numbers(contents, tally), {})
    assert "<details><summary>Objects: 200</summary>" in text
    assert "Licence not recorded** for 200 objects" in text and "and 192 more" in text


def test_the_matrix_of_many_objects_stays_a_picture_of_a_page(tmp_path: Path) -> None:
    contents, tally = matrix(40)
    plots = draw(numbers(contents, tally), tally, tmp_path)
    assert {"yield.png", "quality.png", "sizes.png"} == set(plots)
    for name in plots:
        with Image.open(tmp_path / name) as picture:
            assert picture.height < 1200, name


def test_the_size_in_the_head_is_that_of_the_valid_grasps() -> None:
    for valid, words in ((4, "n<1K"), (40, "1K<n<10K"), (5_000, "1M<n<10M")):
        contents, tally = matrix(valid)
        assert f'size_categories: ["{words}"]' in front_matter(numbers(contents, tally))
