"""DexGraspNet's annealing: energy weights, step sizes, temperatures, probability of a new contact.

E = E_fc + 100 E_dis + 100 E_pen + 10 E_spen + E_joints
step 0.005 * 0.95^floor(t / 50), each gradient over its root mean square, v <- 0.98 g^2 + 0.02 v
temperature 18 * 0.95^floor(t / 30): a proposal is accepted with probability min(1, exp((E - E') / T))
"""

from __future__ import annotations

from typing import Final

STEPS: Final = 6000
CONTACTS: Final = 4
DISTANCE_WEIGHT: Final = 100.0
PENETRATION_WEIGHT: Final = 100.0
SELF_WEIGHT: Final = 10.0
JOINT_WEIGHT: Final = 1.0
#: Key points of the hand nearer than this count as self-penetration [m].
SELF_GAP_M: Final = 0.02
STEP_SIZE: Final = 0.005
STEP_PERIOD: Final = 50
TEMPERATURE: Final = 18.0
TEMPERATURE_PERIOD: Final = 30
DECAY: Final = 0.95
MOMENT: Final = 0.98
SWITCH: Final = 0.5
