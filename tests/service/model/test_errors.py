"""What every error of graspd keeps: one line, whatever it quotes."""

from __future__ import annotations

import pytest

from graspd.service.model.errors import ERRORS, GraspdError


@pytest.mark.parametrize("kind", ERRORS.values(), ids=ERRORS.keys())
def test_a_quoted_line_break_does_not_make_a_second_line(kind: type[GraspdError]) -> None:
    assert str(kind("asset.json: a\n  b: unknown key")) == "asset.json: a b: unknown key"


@pytest.mark.parametrize("character", ["\r", "\x1b", "\x85", "\u2028", "\x00"])
def test_separators_and_escapes_of_a_terminal_do_not_come_through(character: str) -> None:
    assert str(GraspdError(f"a{character}b")).isprintable()


def test_a_message_in_another_script_stays_as_it_is() -> None:
    assert str(GraspdError("no hand 'Hände 手'")) == "no hand 'Hände 手'"
