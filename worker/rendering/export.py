"""Export of views as image files: PNG, OpenEXR, and a JSON per picture with its camera and boxes."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final, Literal

import numpy as np
import OpenEXR
from numpy.typing import NDArray
from PIL import Image

from graspd.service.model.errors import InputError
from graspd.service.store.shards import Shard
from graspd.worker.rendering.annotate import BACKGROUND, OBJECT, TABLE

DepthFormat = Literal["exr", "png"]
#: One step of a 16-bit depth PNG [m]: the PNG reaches 6.5 m; 0 means no surface.
PNG_STEP_M: Final = 1e-4
_EYES: Final = ("mono", "left", "right")
#: Datasets and their file names in Replicator's BasicWriter.
_DISTANCES: Final = {"image/depth": "distance_to_image_plane", "image/distance": "distance_to_camera"}


def export_images(views: Shard, folder: Path, *, depth: DepthFormat = "exr") -> list[Path]:
    """Write every picture of a views shard under Replicator's BasicWriter file names; return the files.
    Per picture: `rgb_NNNN.png` (8 bits), `semantic_segmentation_NNNN.png` (8 bits, the labels themselves),
    `view_NNNN.json`; the depth as `distance_to_image_plane_NNNN.exr` (float32 [m], channel Z, inf for no surface)
    or `.png` (16 bits, steps of 0.1 mm, 0 for no surface). If the shard has them: `distance_to_camera_NNNN`,
    `normals_NNNN.exr` (half, X Y Z), `rgb_hand_NNNN.png`. For all pictures: `labels.json`. The folder is created if
    absent. Raises InputError: the folder cannot be written, or has such files already."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InputError(f"{folder} cannot be created: {error.strerror}; give another folder as --output") from None
    if any(folder.glob("view_*.json")):
        raise InputError(f"{folder} contains exported views already; give another folder as --output")
    written = [write_json(folder / "labels.json", _labels(views))]
    for view in range(len(views["camera/eye"])):
        written += _export_view(views, view, folder, depth)
    return written


def _export_view(views: Shard, view: int, folder: Path, depth: DepthFormat) -> list[Path]:
    def path(name: str, suffix: str) -> Path:
        return folder / f"{name}_{view:04}.{suffix}"

    written = [
        export_png(path("rgb", "png"), views["image/rgb"][view]),
        export_png(path("semantic_segmentation", "png"), views["image/segmentation"][view]),
        write_json(path("view", "json"), describe(views, view)),
    ]
    for dataset, name in _DISTANCES.items():
        if dataset in views.arrays:
            metres, file = np.asarray(views[dataset][view], np.float32), path(name, depth)
            written.append(export_exr(file, "Z", [metres]) if depth == "exr" else _export_depth_png(file, metres))
    if "image/normals" in views.arrays:
        written.append(export_exr(path("normals", "exr"), "XYZ", np.moveaxis(views["image/normals"][view], -1, 0)))
    if "image/rgb_hand" in views.arrays:
        written.append(export_png(path("rgb_hand", "png"), views["image/rgb_hand"][view]))
    return written


def describe(views: Shard, view: int) -> dict[str, Any]:
    """Return camera and boxes of one picture; a box is None where the object is not visible."""
    height, width = views["image/rgb"].shape[1:3]
    e = np.asarray(views["camera/extrinsics"][view], float)
    facts: dict[str, Any] = {
        "scene": int(views["camera/scene_index"][view]),
        "eye": _EYES[int(views["camera/eye"][view])],
        "width": int(width),
        "height": int(height),
        "intrinsics": views["camera/intrinsics"][view].tolist(),
        "extrinsics": e.tolist(),
        "position": (-e[:3, :3].T @ e[:3, 3]).tolist(),
        "stereo_baseline_m": float(views["camera/stereo_baseline_m"][view]),
        "distortion": [],
    }
    for name in ("bounding_box_2d_tight", "bounding_box_2d_loose", "bounding_box_3d", "occlusion_ratio"):
        if f"box/{name}" in views.arrays:
            value = np.asarray(views[f"box/{name}"][view], float)
            facts[name] = value.tolist() if np.isfinite(value).all() else None
    if "camera/hand_grasp" in views.arrays:
        facts["hand_grasp"] = int(views["camera/hand_grasp"][view])
    return facts


def _labels(views: Shard) -> dict[str, dict[str, str]]:
    names = {BACKGROUND: "background", TABLE: "table", OBJECT: str(views.attributes.get("object", "object"))}
    neighbours = views.attributes.get("neighbours", [])
    names |= {OBJECT + 1 + k: name for k, name in enumerate(neighbours if isinstance(neighbours, list) else [])}
    return {str(label): {"class": name} for label, name in names.items()}


def export_png(path: Path, pixels: NDArray[Any]) -> Path:
    """Write an image of 8 or 16 bits."""
    Image.fromarray(np.ascontiguousarray(pixels)).save(path, compress_level=1)
    return path


def _export_depth_png(path: Path, metres: NDArray[np.float32]) -> Path:
    steps = np.where(np.isfinite(metres), np.asarray(metres, float) / PNG_STEP_M, 0.0)
    # Distances beyond 16 bits are clipped to the largest value instead of wrapping round.
    return export_png(path, np.clip(np.rint(steps), 0, 65535).astype(np.uint16))


def export_exr(path: Path, names: str, planes: Sequence[NDArray[Any]] | NDArray[Any]) -> Path:
    """Write channels of one letter each as OpenEXR, in the type of their planes (H, W)."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    channels = {name: np.ascontiguousarray(plane) for name, plane in zip(names, planes, strict=True)}
    with OpenEXR.File(header, channels, 1) as file:
        file.write(str(path))
    return path


def write_json(path: Path, value: Any) -> Path:
    """Write a JSON file; nan and infinity are refused."""
    path.write_text(json.dumps(value, allow_nan=False) + "\n")
    return path
