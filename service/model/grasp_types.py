"""Names of grasp types that a job may require, and the numbers of the GRASP taxonomy."""

from typing import Final, Literal

_BroadType = Literal["any", "balanced", "power", "precision", "pinch"]
_LinearType = Literal[
    "palmar_pinch", "prismatic_2_finger", "tripod", "prismatic_3_finger", "quadpod", "prismatic_4_finger"
]
_RoundType = Literal["precision_disk", "precision_sphere", "ring", "sphere_3_finger", "sphere_4_finger", "distal"]
_HoldType = Literal[
    "small_diameter", "medium_wrap", "large_diameter", "power_disk", "power_sphere", "fixed_hook", "lateral"
]
#: `any`: no requirement. `balanced`: the types of `BALANCED` in turn, one per batch. Types after `pinch` are those of
#: the GRASP taxonomy (Feix et al., IEEE THMS 2016); `worker.quality.grasp_type` states the rules.
GraspTypeName = Literal[_BroadType, _LinearType, _RoundType, _HoldType]
BALANCED: Final[tuple[GraspTypeName, ...]] = ("power", "precision", "pinch")
#: Numbers of the types in the taxonomy.
TAXONOMY: Final[dict[str, int]] = {
    "large_diameter": 1,
    "small_diameter": 2,
    "medium_wrap": 3,
    "prismatic_4_finger": 6,
    "prismatic_3_finger": 7,
    "prismatic_2_finger": 8,
    "palmar_pinch": 9,
    "power_disk": 10,
    "power_sphere": 11,
    "precision_disk": 12,
    "precision_sphere": 13,
    "tripod": 14,
    "fixed_hook": 15,
    "lateral": 16,
    "distal": 19,
    "sphere_4_finger": 26,
    "quadpod": 27,
    "sphere_3_finger": 28,
    "ring": 31,
}
