"""How `fast_graspd` is offered."""

from __future__ import annotations

from typing import Final

from service.model.fidelity import Fidelity
from worker.planners.fast_graspd.planner import plan, plan_joined
from worker.planners.port import Method

METHOD: Final = Method(
    summary="gradient descent through a differentiable contact simulation",
    source="D. Turpin et al., Fast-Grasp'D, ICRA 2023",
    planner=lambda options: plan,
    joined=lambda options: plan_joined,
    in_scenes=True,
    in_parts=True,
    uses=tuple(name for name in Fidelity.model_fields if name != "name"),
)
