"""Keyword arguments of the options, written by `python -m graspd.service.docs`."""

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
    mass: float | None
    want: Literal["valid", "candidates"]
    validation: Literal["dexgraspbench", "standard", "fast", "none"]
    robust: float
    faces: Literal["drawn", "all"]
    touch: float
    stereo: bool
    width: int
    height: int
    channels: Sequence[Literal["distance", "normals", "occlusion"]]
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
    mass: float | None
    want: Literal["valid", "candidates"]
    validation: Literal["dexgraspbench", "standard", "fast", "none"]
    robust: float
    faces: Literal["drawn", "all"]
    touch: float | None
    friction: float
    density: float | None
    object_friction: float | None
    budget: float
    min_distance: float
    robust_models: int
    payload: bool
    min_payload: float
    shake: bool
    options: Mapping[str, Any]
    units: Literal["m", "mm", "cm", "in"]
    scale_to: float | None
    device: str
    threads: int
    join: int | Literal["auto"]
