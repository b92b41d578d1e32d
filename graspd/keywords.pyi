"""Keyword arguments of the options, written by `python -m docs.tables`."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Literal, TypedDict

class JobKeywords(TypedDict, total=False):
    grasps: int
    method: str
    fidelity: str | Mapping[str, Any]
    seed: int
    scene: Literal["free", "table", "bin", "shelf"] | Mapping[str, Any]
    neighbours: Sequence[str | Mapping[str, Any]]
    scenes: int
    views: int
    episodes: Literal["none", "flying", "ur10e", "franka"]
    type: Literal[
        "any",
        "balanced",
        "power",
        "precision",
        "pinch",
        "palmar_pinch",
        "prismatic_2_finger",
        "tripod",
        "prismatic_3_finger",
        "quadpod",
        "prismatic_4_finger",
        "precision_disk",
        "precision_sphere",
        "ring",
        "sphere_3_finger",
        "sphere_4_finger",
        "distal",
        "small_diameter",
        "medium_wrap",
        "large_diameter",
        "power_disk",
        "power_sphere",
        "fixed_hook",
        "lateral",
    ]
    mass: float | None
    want: Literal["valid", "candidates"]
    validation: Literal["dexgraspbench", "standard", "fast", "none"]
    robust: float
    second_engine: Literal["none", "physx", "drake", "all"]
    faces: Literal["drawn", "all"]
    touch: float
    stereo: bool
    width: int
    height: int
    channels: Sequence[Literal["distance", "normals", "occlusion"]]
    film: Sequence[Literal["scene", "wrist"]]
    episode_fps: int
    digits: Sequence[Literal["thumb", "index", "middle", "ring", "little", "sixth"]]
    touch_region: str
    avoid_region: str
    approach_cone: str
    like: str
    friction: float
    density: float | None
    object_friction: float | None
    budget: float
    min_distance: float
    rechecks: int
    robust_models: int
    payload: bool
    min_payload: float
    shake: bool
    second_engine_share: float
    options: Mapping[str, int | float | str]
    target: str

class SynthesizeKeywords(TypedDict, total=False):
    grasps: int
    method: str
    fidelity: str
    seed: int
    scene: str | Path
    neighbours: Sequence[str | Path]
    scenes: int
    type: Literal[
        "any",
        "balanced",
        "power",
        "precision",
        "pinch",
        "palmar_pinch",
        "prismatic_2_finger",
        "tripod",
        "prismatic_3_finger",
        "quadpod",
        "prismatic_4_finger",
        "precision_disk",
        "precision_sphere",
        "ring",
        "sphere_3_finger",
        "sphere_4_finger",
        "distal",
        "small_diameter",
        "medium_wrap",
        "large_diameter",
        "power_disk",
        "power_sphere",
        "fixed_hook",
        "lateral",
    ]
    mass: float | None
    want: Literal["valid", "candidates"]
    validation: Literal["dexgraspbench", "standard", "fast", "none"]
    robust: float
    second_engine: Literal["none", "physx", "drake", "all"]
    faces: Literal["drawn", "all"]
    touch: float | None
    digits: Sequence[Literal["thumb", "index", "middle", "ring", "little", "sixth"]]
    touch_region: str
    avoid_region: str
    approach_cone: str
    like: str | Path
    friction: float
    density: float | None
    object_friction: float | None
    budget: float
    min_distance: float
    robust_models: int
    payload: bool
    min_payload: float
    shake: bool
    second_engine_share: float
    options: Mapping[str, Any]
    units: Literal["m", "mm", "cm", "in"]
    scale_to: float | None
    device: str
    threads: int
    join: int | Literal["auto"]
