"""What came of an export, for the user."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any


@dataclass
class Written:
    """What came of an export."""

    counts: dict[str, Any]
    notes: list[str] = field(default_factory=list)
    """Lines for the user: what was assumed, what was left out and why."""
