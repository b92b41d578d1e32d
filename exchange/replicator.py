"""Views in the layout of Omniverse Replicator's BasicWriter.

The export has the image files of `worker.rendering.export`, and arrays of bounding boxes with JSON files of labels,
prims and cameras. USD's conventions: matrices act on row vectors, cameras look along -z with y up."""

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.exchange.plan import prim_name
from graspd.service.model.transforms import Floats
from graspd.service.store.shards import Shard
from graspd.worker.rendering.annotate import BACKGROUND, OBJECT, TABLE
from graspd.worker.rendering.export import export_images, write_json

_ID: Final = ("semanticId", "<u4")
_OCCLUSION: Final = ("occlusionRatio", "<f4")
_BOX_2D: Final = np.dtype([_ID, *((f"{axis}_{end}", "<i4") for end in ("min", "max") for axis in "xy"), _OCCLUSION])
_BOX_3D: Final = np.dtype(
    [
        _ID,
        *((f"{axis}_{end}", "<f4") for end in ("min", "max") for axis in "xyz"),
        ("transform", "<f4", (4, 4)),
        _OCCLUSION,
    ]
)
#: Sensor width to which the focal length refers; USD's default [mm].
APERTURE_MM: Final = 20.955
NEAR_FAR_M: Final = (0.01, 100.0)
#: Rotation from camera axes with z ahead and y down to USD's, with z backward and y up.
_FLIP: Final = np.diag([1.0, -1.0, -1.0, 1.0])


def write(views: Shard, folder: Path) -> list[Path]:
    """Write every picture of a views shard with its annotations; return the files."""
    written = export_images(views, folder, depth="exr")
    name = str(views.attributes.get("object", "object"))
    for view in range(len(views["camera/eye"])):
        written += _write_annotations(views, view, name, folder)
    return written


def box_3d(corners: Floats, extrinsics: Floats) -> tuple[Floats, Floats, Floats]:
    """Return least and greatest corner (3,) of a box in its centred frame, and the frame's pose (4, 4).
    The pose, in the world, acts on row vectors. `corners` (8, 3) are in the camera frame. Corner k has the greatest x,
    y, z along the box's axes if bit 0, 1, 2 of k is set."""
    world = (corners - extrinsics[:3, 3]) @ extrinsics[:3, :3]
    edges = np.stack([world[1 << axis] - world[0] for axis in range(3)])
    half = 0.5 * np.linalg.norm(edges, axis=1)
    transform = np.eye(4)
    transform[:3, :3] = edges / np.maximum(2 * half[:, None], 1e-12)
    transform[3, :3] = world.mean(axis=0)
    return -half, half, transform


def camera_params(views: Shard, view: int) -> dict[str, Any]:
    """Return BasicWriter's parameters of a view's camera."""
    height, width = views["image/rgb"].shape[1:3]
    k, extrinsics = (np.asarray(views[f"camera/{name}"][view], float) for name in ("intrinsics", "extrinsics"))
    near, far = NEAR_FAR_M
    projection = np.array(
        [
            [2 * k[0, 0] / width, 0, 1 - 2 * k[0, 2] / width, 0],
            [0, 2 * k[1, 1] / height, 2 * k[1, 2] / height - 1, 0],
            [0, 0, -(far + near) / (far - near), -2 * far * near / (far - near)],
            [0, 0, -1, 0],
        ]
    )
    return {
        "cameraModel": "pinhole",
        "cameraViewTransform": (_FLIP @ extrinsics).T.ravel().tolist(),
        "cameraProjection": projection.T.ravel().tolist(),
        "cameraFocalLength": float(k[0, 0] * APERTURE_MM / width),
        "cameraAperture": [APERTURE_MM, APERTURE_MM * height / width],
        "cameraNearFar": list(NEAR_FAR_M),
        "metersPerSceneUnit": 1.0,
        "renderProductResolution": [int(width), int(height)],
    }


def _write_annotations(views: Shard, view: int, name: str, folder: Path) -> list[Path]:
    hidden = np.asarray(views.arrays.get("box/occlusion_ratio", np.full(view + 1, np.nan)), float)[view]
    boxes: dict[str, NDArray[Any]] = {}
    for kind in ("tight", "loose"):
        corners = np.asarray(views[f"box/bounding_box_2d_{kind}"][view], float)
        # BasicWriter omits unseen objects, whose box is not finite here.
        found = [(0, *np.rint(corners).astype(int), hidden)] if np.isfinite(corners).all() else []
        boxes[f"bounding_box_2d_{kind}"] = np.array(found, _BOX_2D)
    low, high, transform = box_3d(
        np.asarray(views["box/bounding_box_3d"][view], float), np.asarray(views["camera/extrinsics"][view], float)
    )
    boxes["bounding_box_3d"] = np.array([(0, *low, *high, transform, hidden)], _BOX_3D)
    written = [write_json(folder / f"camera_params_{view:04}.json", camera_params(views, view))]
    for what, rows in boxes.items():
        np.save(folder / f"{what}_{view:04}.npy", rows)
        written.append(folder / f"{what}_{view:04}.npy")
        written.append(write_json(folder / f"{what}_labels_{view:04}.json", {"0": {"class": name}}))
        written.append(
            write_json(folder / f"{what}_prim_paths_{view:04}.json", [f"/World/{prim_name(name)}"] * len(rows))
        )
    labels = {BACKGROUND: "BACKGROUND", TABLE: "table", OBJECT: name}
    said = {str(label): {"class": word} for label, word in labels.items()}
    written.append(write_json(folder / f"semantic_segmentation_labels_{view:04}.json", said))
    return written
