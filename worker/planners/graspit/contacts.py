"""Virtual contacts: the few places of a hand that are wanted on the object, two on each link's inside and on the palm.

GraspIt! ships them as files for its own hands; here they are found for any hand.
"""

from __future__ import annotations

from typing import Final

from worker.hands.model import HandModel, SurfacePoints
from worker.planners.inner_surface import inside_points

#: Contacts on each link that closes, and on the palm.
EACH: Final = 2
ON_PALM: Final = 3


def virtual_contacts(hand: HandModel) -> SurfacePoints:
    """Points with normals; none on links that neither close nor carry the palm."""
    return inside_points(hand, each=EACH, on_palm=ON_PALM)
