"""JSON and TOML that is nested a hundred thousand deep, wherever a stranger's file or shard may hold some."""

import pytest

from graspd.client.dataset_commands import read_spec
from graspd.commands.studies import _read_maps as read_stability
from graspd.exchange.bench_hand import _read as read_mapping
from graspd.exchange.published import friction
from graspd.service.model.errors import InputError
from graspd.service.readers.trajectories import scene_spec_of
from graspd.service.store.shards import Shard
from graspd.studies.cards.contents import Contents, with_provenance
from graspd.worker.files.provenance import options_of

DEEP = "[" * 100_000 + "]" * 100_000


@pytest.mark.parametrize(
    ("name", "reader"),
    [
        ("spec.json", read_spec),
        ("spec.toml", read_spec),
        ("reference.json", friction),
        ("hand_mapping.json", read_mapping),
        ("stability.json", read_stability),
        ("provenance.json", lambda path: with_provenance(Contents.__new__(Contents), path)),
    ],
)
def test_a_file_that_is_nested_deep_is_refused_in_one_line(name: str, reader, tmp_path) -> None:
    file = tmp_path / name
    file.write_text(f"hands = {DEEP}" if name.endswith("toml") else f'{{"hands": {DEEP}}}')
    with pytest.raises(InputError, match=name) as refused:
        reader(file)
    assert "\n" not in str(refused.value)


def test_an_attribute_that_is_nested_deep_says_nothing() -> None:
    assert options_of(DEEP) == {}
    shard = Shard("base", {"scene": DEEP}, {})
    with pytest.raises(InputError, match="is not a valid scene"):
        scene_spec_of(shard)
