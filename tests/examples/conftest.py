"""The hand of the examples' tests."""

from __future__ import annotations

import pytest

from graspd.worker.engines import backend
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel


@pytest.fixture(scope="session")
def hand() -> HandModel:
    backend.start()
    return hand_from_path("barrett")
