"""Pages of camera pictures: objects at rest, hands in clear grasps, and tables with several objects.

usage: python -m benchmarks.scene_pictures --object mug --object mustard=MESH ... --out FOLDER [--hand allegro ...]
           [--seed 0] [--device cpu]"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.transforms import Floats, apply
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.grasps import Posture
from graspd.worker.hands.kinematics import body_poses
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import PlanRequest, synthesize
from graspd.worker.rendering import sheets
from graspd.worker.rendering.cameras import FIELD_OF_VIEW, GivenCameras, distance_to_fill, look_at
from graspd.worker.rendering.hands import DrawnHand
from graspd.worker.rendering.sheets import label_page, reduce_to_palette
from graspd.worker.rendering.views import Extras, render
from graspd.worker.scenes import Neighbours, drop, drop_together, transfer_grasps

#: Size of one picture [px].
SIZE: Final = (300, 225)
#: Rays per pixel, for pictures of high quality.
SAMPLES: Final = 32
#: Numbers of grasps per round and of scenes, and largest number of rounds until a grasp is clear.
GRASPS: Final = 32
SCENES: Final = 24
ROUNDS: Final = 4
#: Cosine of the camera's elevation for views past a neighbour.
_LEVEL: Final = 0.94
_CHANNELS: Final = ("left", "right", "depth", "normals", "segmentation", "boxes")


def scene_cells(views: Any) -> list[Image.Image]:
    """Return pictures of a shard's first stereo pair: left, right, depth, normals, segmentation, boxes."""
    left, right = np.asarray(views["image/rgb"][:2], np.uint8)
    normals = np.asarray(views["image/normals"][0], float)
    coloured = np.where(normals.any(axis=-1, keepdims=True), 127.5 + 127.5 * normals, 214).round().astype(np.uint8)
    cells = [Image.fromarray(left), Image.fromarray(right), sheets._draw_depth(views, 0), Image.fromarray(coloured)]
    return [*cells, sheets._draw_segmentation(views, 0), sheets._draw_boxes(views, 0)]


def paint(hands: Sequence[HandModel], objects: Sequence[ObjectModel], folder: Path, *, device: str, seed: int) -> None:
    """Write `views.png`, `hands.png` and, for three or more objects, `neighbours.png`."""
    folder.mkdir(parents=True, exist_ok=True)
    pages: dict[str, Callable[[], bytes]] = {
        "views": lambda: _views(objects, device, seed),
        "hands": lambda: _hands(hands, objects, device, seed),
    }
    if len(objects) > 2:
        pages["neighbours"] = lambda: _neighbours(objects, device, seed)
    for name, page in pages.items():
        (folder / f"{name}.png").write_bytes(reduce_to_palette(page()))


def _seen(
    obj: ObjectModel, poses: Floats, device: str, seed: int, extras: Extras, *, stereo: bool
) -> dict[str, NDArray[np.generic]]:
    run, (width, height) = ExecutionContext(device=device), SIZE
    view: dict[str, Any] = {"views": 1, "width": width, "height": height, "samples": SAMPLES}
    return render(obj, poses, seed=seed, extras=extras, stereo=stereo, run=run, **view)


def _views(objects: Sequence[ObjectModel], device: str, seed: int) -> bytes:
    rows, names = [], []
    for k, obj in enumerate(objects):
        poses = drop(obj, count=1, seed=seed + k)["scene/object_pose"]
        rows.append(scene_cells(_seen(obj, poses, device, seed + k, Extras(channels=("normals",)), stereo=True)))
        names.append([obj.name])
    subtitle = "one scene per object; stereo pair with 60 mm baseline"
    return label_page(rows, _CHANNELS, names, title="What the cameras see", subtitle=subtitle)


def _hands(hands: Sequence[HandModel], objects: Sequence[ObjectModel], device: str, seed: int) -> bytes:
    rows, names = [], []
    for k, obj in enumerate(objects):
        cells, below = [], []
        for hand in hands:
            drawn, pose, kept, tried = _fitting(hand, obj, device, seed)
            extras = Extras(cameras=GivenCameras(extrinsics=_camera(drawn, obj, pose)[None]), drawn=drawn)
            seen = _seen(obj, pose[None], device, seed + k, extras, stereo=False)
            cells.append(Image.fromarray(np.asarray(seen["image/rgb_hand"][0], np.uint8)))
            below.append(f"{obj.name}: {kept} of {tried} are clear")
        rows.append(cells)
        names.append(below)
    subtitle = "hand on a trajectory clear of the table; object alone: no clear grasp was found"
    return label_page(rows, [hand.name for hand in hands], names, title="Grasps on the table", subtitle=subtitle)


def _fitting(hand: HandModel, obj: ObjectModel, device: str, seed: int) -> tuple[DrawnHand, Floats, int, int]:
    """Return the grasp with largest clearance, the object's pose, and the numbers of clear and all grasps."""
    scenes = drop(obj, count=SCENES, seed=seed)["scene/object_pose"]
    kept, tried, best = 0, 0, -np.inf
    for batch in range(ROUNDS):
        found = synthesize(hand, obj, PlanRequest(GRASPS, FIDELITIES["draft"], seed, batch), ExecutionContext(device))
        placed = transfer_grasps(hand, found.grasp, found.pregrasp, scenes)
        clearance = np.asarray(placed["grasp/table_clearance_m"], float)
        kept, tried = kept + int(placed["grasp/valid"].sum()), tried + len(clearance)
        row = int(np.argmax(clearance))
        if clearance[row] > best:
            best = float(clearance[row])
            number = row if placed["grasp/valid"][row] else -1
            posture = Posture(
                np.asarray(placed["grasp/hand_pose"], float)[[row]],
                np.asarray(found.grasp.joint_positions, float)[[int(placed["grasp/base_index"][row])]],
            )
            pose = scenes[int(placed["grasp/scene_index"][row])]
        if kept:
            break
    drawn = DrawnHand(hand, np.array([number], np.int32), posture.hand_pose, posture.joint_positions)
    return drawn, pose, kept, tried


def _camera(drawn: DrawnHand, obj: ObjectModel, pose: Floats) -> Floats:
    """Return extrinsics of a camera that sees object and fingers, across the approach direction."""
    hand = drawn.hand
    (bodies,) = body_poses(hand, drawn.hand_pose, drawn.joint_positions)
    points = np.concatenate([apply(bodies[p.body], p.vertices) for p in hand.pieces])
    solid = apply(pose, obj.hull_vertices)
    middle = 0.5 * (solid.min(axis=0) + solid.max(axis=0))
    # A forearm may extend beyond the picture.
    near = points[np.linalg.norm(points - middle, axis=1) < obj.radius + 0.12] if drawn.grasp[0] >= 0 else points[:0]
    near = np.concatenate([near, solid])
    centre = 0.5 * (near.min(axis=0) + near.max(axis=0))
    radius = float(np.linalg.norm(near - centre, axis=1).max())
    palm = bodies[0, :2] - middle[:2]
    azimuth = float(np.arctan2(palm[1], palm[0])) + np.radians(65.0)
    rise = np.radians(24.0)
    direction = np.array([np.cos(azimuth) * np.cos(rise), np.sin(azimuth) * np.cos(rise), np.sin(rise)])
    return look_at(centre + distance_to_fill(radius, FIELD_OF_VIEW, 1.05) * direction, centre)


def _neighbours(objects: Sequence[ObjectModel], device: str, seed: int) -> bytes:
    rows, names = [], []
    for k in range(min(3, len(objects))):
        first, *others = [objects[(k + j) % len(objects)] for j in range(min(4, len(objects)))]
        scene = drop_together(first, others, count=1, seed=seed + k)
        poses, beside = scene["scene/object_pose"], Neighbours(others, scene["scene/neighbour_pose"])
        extras = Extras(channels=("normals", "occlusion"), cameras=_past(poses, first, beside), neighbours=beside)
        seen = _seen(first, poses, device, seed + k, extras, stereo=True)
        rows.append(scene_cells(seen))
        hidden = float(np.asarray(seen["box/occlusion_ratio"])[0])
        names.append([f"{first.name}, {100 * hidden:.0f} % hidden"])
    subtitle = "labels 3, 4, ... are the neighbours; boxes are the grasped object's"
    return label_page(rows, _CHANNELS, names, title="Several objects", subtitle=subtitle)


def _past(poses: Floats, obj: ObjectModel, beside: Neighbours) -> GivenCameras:
    """Return a camera that sees the object past its nearest neighbour; the neighbour hides a part."""
    middles = np.stack([apply(pose, o.centre_of_mass) for o, pose in zip(beside.objects, beside.poses[0], strict=True)])
    middle = apply(poses[0], obj.centre_of_mass)
    nearest = int(np.argmin(np.linalg.norm(middles - middle, axis=1)))
    across = (middles[nearest] - middle)[:2]
    direction = np.append(_LEVEL * across / np.linalg.norm(across), np.sqrt(1 - _LEVEL**2))
    centre = 0.5 * (middle + middles[nearest])
    radius = 0.5 * float(np.linalg.norm(across)) + max(obj.radius, beside.objects[nearest].radius)
    return GivenCameras(
        extrinsics=look_at(centre + distance_to_fill(radius, FIELD_OF_VIEW, 1.0) * direction, centre)[None]
    )


def _object(text: str) -> ObjectModel:
    name, _, path = text.rpartition("=")
    obj = object_from_path(path, face_error_m=3e-4)
    return replace(obj, name=name) if name else obj


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--object", action="append", required=True, help="built-in object, mesh, or NAME=MESH")
    parser.add_argument("--hand", action="append", help="URDF or built-in hand")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--device", default="cpu")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    hands = [hand_from_path(name) for name in args.hand or ["allegro", "barrett", "shadow"]]
    objects = [_object(name) for name in args.object]
    paint(hands, objects, args.out, device=args.device, seed=args.seed)


if __name__ == "__main__":
    main()
