"""Where grasps happen: an object at rest on a table, and the grasps that a hand can reach there."""

from __future__ import annotations

from worker.scenes.clearance import transfer
from worker.scenes.neighbours import Neighbours, drop_together
from worker.scenes.simulate import drop

__all__ = ["Neighbours", "drop", "drop_together", "transfer"]
