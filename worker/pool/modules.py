"""Modules whose work the processes of a `Pool` do for a worker.

They are named and not imported: a worker is there before its engine is.
"""

from __future__ import annotations

from typing import Final

MODULES: Final = ("worker.quality.referee.judge", "worker.quality.table")
