"""Whether an object fits between the jaws of a gripper: told before any work."""

from __future__ import annotations

from typing import Final

from service.model.errors import InputError
from worker.hands.jaws import jaws_of
from worker.hands.model import HandModel
from worker.objects.antipodal import Pairs, antipodal_pairs
from worker.objects.model import ObjectModel

#: What must be left of the opening on each side of the object [m].
FIT_M: Final = 0.001


def fitting_pairs(hand: HandModel, obj: ObjectModel) -> Pairs | None:
    """Pairs of opposite places of an object that fit between the jaws of a hand; None where the hand is no gripper.

    Raises:
        InputError: no pair fits; the message says what opens how far.
    """
    jaws = jaws_of(hand)
    if jaws is None:
        return None
    pairs = antipodal_pairs(obj)
    fits = pairs.narrower(jaws.opening - 2 * FIT_M)
    if len(fits.start):
        return fits
    if not len(pairs.start):
        raise InputError(f"{obj.name} has no two opposite sides that a gripper such as {hand.name} could hold")
    raise InputError(
        f"{hand.name} opens {1e3 * jaws.opening:.0f} mm; the narrowest side of {obj.name} is "
        f"{1e3 * float(pairs.width.min()):.0f} mm: choose a smaller object (--scale-to) or a hand that opens wider"
    )
