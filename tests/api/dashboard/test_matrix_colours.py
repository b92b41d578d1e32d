"""Words on a cell of the matrix can be read whatever its shade, in both schemes."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

STATIC = Path(__file__).parents[3] / "api" / "dashboard" / "static"
#: What WCAG asks for between a text of that size and what it stands on.
CONTRAST = 4.5
_PAIR = r"light-dark\((#\w{6}), (#\w{6})\)"


def luminance(colour: str) -> float:
    parts = [int(colour[at : at + 2], 16) / 255 for at in (1, 3, 5)]
    linear = [part / 12.92 if part <= 0.04045 else ((part + 0.055) / 1.055) ** 2.4 for part in parts]
    return sum(weight * part for weight, part in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


@pytest.mark.parametrize("scheme", [0, 1], ids=["light", "dark"])
def test_a_shade_leaves_its_words_readable(scheme: int) -> None:
    (ink,) = re.findall(rf"--ink: {_PAIR}", (STATIC / "style.css").read_text())
    shades = re.findall(rf"\.y\d+ > div, i\.y\d+ {{ background: {_PAIR}", (STATIC / "pages.css").read_text())
    assert len(shades) == 11
    for shade in shades:
        darker, lighter = sorted((luminance(ink[scheme]), luminance(shade[scheme])))
        assert (lighter + 0.05) / (darker + 0.05) >= CONTRAST, shade
