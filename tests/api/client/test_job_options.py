"""Options of a method on the command line."""

from __future__ import annotations

import pytest

from graspd.service.command_options import pairs
from graspd.service.model.errors import InputError


@pytest.mark.parametrize(
    ("text", "value"), [("20", 20), ("-3", -3), ("0.5", 0.5), ("007", "007"), ("nan", "nan"), ("", ""), ("a=b", "a=b")]
)
def test_what_is_written_as_a_number_is_one(text: str, value: object) -> None:
    """`--option keep=20` is the job that `{"keep": 20}` is over HTTP: a string would be another."""
    found = pairs([f"keep={text}"])
    assert found == {"keep": value}
    assert type(found["keep"]) is type(value)


def test_an_option_without_a_value_is_told() -> None:
    with pytest.raises(InputError, match="name=value"):
        pairs(["keep"])
