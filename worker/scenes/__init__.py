"""Scenes: objects at rest on a table, and the grasps that a hand can reach there."""

from graspd.worker.scenes.clearance import transfer_grasps
from graspd.worker.scenes.neighbours import Neighbours, drop_together
from graspd.worker.scenes.simulate import drop

__all__ = ["Neighbours", "drop", "drop_together", "transfer_grasps"]
