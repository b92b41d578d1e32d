"""Words of the charts of speed against accuracy: studies write them, fidelities are chosen by them, pages draw them."""

from __future__ import annotations

from typing import Final

#: Ways of a row of a chart in scenes: planned for the scene, or around a free object and put there afterwards.
IN_SCENE: Final = "in the scene"
FILTERED: Final = "free, filtered"

#: Accuracies that a target may name, and whether more is better: of grasps around a free object, and in scenes.
FREE: Final = {"gsr": True, "letter": True, "hard": True, "robust": True, "epsilon": True, "pd_mm": False}
IN_SCENES: Final = {"lift": True, "lift_letter": True, "lift_hard": True, "robust": True}

#: Speeds, end to end before the planner's own, which is all that charts of graspd 0.1 have.
SPEEDS: Final = ("end_to_end_per_second", "valid_per_second")
