"""Grippers that others publish on PyPI, read as they come: `pip install '.[strangers]'`."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest

from graspd.worker.hands.jaws import jaws_of
from graspd.worker.hands.load import hand_from_path


def grippers() -> Path:
    """The folder of `airo-models` with its grippers; nothing of the package is run."""
    found = find_spec("airo_models")
    if found is None or found.origin is None:
        pytest.skip("airo-models is not installed: pip install '.[strangers]'")
    return Path(found.origin).parent / "grippers"


def test_a_robotiq_2f_85_opens_as_far_as_its_maker_says() -> None:
    hand = hand_from_path(str(grippers() / "robotiq_2f_85"))
    jaws = jaws_of(hand)
    assert jaws is not None
    assert hand.dofs == 1
    # Its data sheet: 85 mm between the pads; the file's meshes are off by a millimetre.
    assert jaws.opening == pytest.approx(0.085, abs=0.002)
