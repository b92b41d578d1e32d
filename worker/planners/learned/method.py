"""How `learned` is offered."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from pydantic import Field

from service.model.base import Digest
from service.model.errors import InputError
from service.model.fidelity import Fidelity
from worker.grasps import GraspSet
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.planners.fast_graspd.planner import plan, plan_joined
from worker.planners.learned.known import keep_file, kept
from worker.planners.learned.seeds import Seeds
from worker.planners.port import Asked, Method, Options, Wanted
from worker.run import Run


class LearnedOptions(Options):
    """Which network, and how far it is followed."""

    network: Digest = Field(description="digest of the network; on the command line its file, in a job its name")
    starts: int = Field(4, ge=1, le=32, description="proposals of each grasp that set out")


class Learned:
    """fast_graspd from a network's proposals."""

    def __init__(self, options: LearnedOptions) -> None:
        self.options = options

    def __call__(self, hand: HandModel, obj: ObjectModel, wanted: Wanted, run: Run) -> GraspSet:
        """See `worker.planners.Planner`."""
        return plan(hand, obj, wanted, run, warm=self._seeds(hand))

    def joined(self, hand: HandModel, obj: ObjectModel, asked: Sequence[Asked]) -> list[GraspSet | Exception]:
        """See `worker.planners.Joined`."""
        return plan_joined(hand, obj, asked, warm=self._seeds(hand))

    def _seeds(self, hand: HandModel) -> Seeds:
        network = kept(self.options.network)
        if network.joint_names != hand.joint_names or network.hand_digest != hand.digest:
            raise InputError(
                f"network {self.options.network[:12]} proposes grasps of {network.hand} ({network.hand_digest[:12]}), "
                f"not of {hand.name} ({hand.digest[:12]})"
            )
        return Seeds(network, self.options.starts)


METHOD: Final = Method(
    summary="fast_graspd from the proposals of a network that saw the object on its table",
    source="unpublished; PointNet, CVPR 2017, and flow matching, ICLR 2023",
    planner=Learned,
    joined=lambda options: Learned(options).joined,
    in_scenes=True,
    in_parts=True,
    free=False,
    options=LearnedOptions,
    uses=tuple(name for name in Fidelity.model_fields if name not in ("name", "starts")),
    files={"network": keep_file},
)
