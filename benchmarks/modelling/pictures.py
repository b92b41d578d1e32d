"""Influence of shadows, samples, back faces and mesh faces on pictures; depth error against the mesh."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from benchmarks.modelling.common import SEED, Row, cpu, object_of
from graspd.service.model.transforms import apply, invert
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.rendering.cameras import Cameras
from graspd.worker.rendering.scene_setup import CameraPlan, SceneSetup
from graspd.worker.rendering.scenery import Pictures
from graspd.worker.rendering.views import SAMPLES as SAMPLES_DEFAULT
from graspd.worker.scenes.simulate import drop

SCENES, VIEWS = 2, 2
SAMPLES = (2, 4, 12, 24)
#: Rays per pixel of the reference, and of the default.
MANY, RAYS = 96, SAMPLES_DEFAULT


def study(data: Path | None, name: str, width: int = 160) -> dict[str, Any]:
    """Return costs relative to `RAYS` rays, and root mean square differences of colours.
    Other numbers of rays are compared with `MANY` rays, other settings with `RAYS` rays."""
    obj, full = object_of(data, name), object_of(data, name, 0.0)
    poses = drop(obj, count=SCENES, seed=SEED)["scene/object_pose"]
    plan = CameraPlan(VIEWS, width, width * 3 // 4, None)
    setting = SceneSetup([obj], poses[:, None], plan, seed=SEED, samples=RAYS)
    _shoot(setting, 2)
    best, _ = _shoot(setting, MANY)
    rows: list[Row] = []
    plain, base = _shoot(setting, RAYS)
    for samples in SAMPLES:
        pictures, seconds = _shoot(setting, samples)
        rows.append(_row(f"{samples} rays per pixel", pictures, best, seconds / base))
    config = setting.stage("cpu")._config
    for what, flag in (("without shadows", "enable_shadows"), ("with back faces", "enable_backface_culling")):
        before = getattr(config, flag)
        setattr(config, flag, False)
        # Compile the kernel of this setting before the timed run.
        _shoot(setting, 2)
        pictures, seconds = _shoot(setting, RAYS)
        setattr(config, flag, before)
        rows.append(_row(what, pictures, plain, seconds / base))
    other = SceneSetup([full], poses[:, None], plan, seed=SEED, samples=RAYS)
    # Keep the cameras, since cameras computed from the other hull differ by rounding.
    other.shot = replace(other.shot, extrinsics=setting.shot.extrinsics)
    _shoot(other, 2)
    pictures, seconds = _shoot(other, RAYS)
    rows.append(_row(f"all {len(full.faces)} faces instead of {len(obj.faces)}", pictures, plain, seconds / base))
    return {
        "object": name,
        "pictures": len(best.rgb),
        "size": [width, width * 3 // 4],
        "rays": rows,
        "object_share_of_pixels": float((best.shape == 1).mean()),
        "depth_to_mesh_mm": depth_error_mm(setting, best, full.vertices, full.faces),
    }


def _shoot(setting: SceneSetup, samples: int) -> tuple[Pictures, float]:
    setting.shot = replace(setting.shot, samples=samples)
    with cpu() as clock:
        pictures = setting.render(ExecutionContext(threads=1))
    return pictures, clock.seconds


def _row(name: str, pictures: Pictures, reference: Pictures, ratio: float) -> Row:
    seen, near = reference.shape >= 0, (pictures.shape == 1) & (reference.shape == 1)
    off = pictures.rgb[seen].astype(float) - reference.rgb[seen]
    return {
        "picture": name,
        "cost_ratio": ratio,
        "rms_of_255": float(np.sqrt((off**2).mean())),
        "labels_changed": float((pictures.shape != reference.shape).mean()),
        "depth_changed_mm": 1e3 * float(np.abs(pictures.depth[near] - reference.depth[near]).mean()),
    }


def depth_error_mm(setting: SceneSetup, pictures: Pictures, vertices: Any, faces: Any) -> dict[str, float]:
    """Return distances of the object's unprojected pixels from a mesh: median, 99th percentile [mm]."""
    shot = setting.shot
    points = Cameras(shot.width, shot.height, shot.intrinsics, shot.extrinsics).unproject(pictures.depth)
    local = [
        apply(invert(setting.object_pose[world]), points[v][pictures.shape[v] == 1])
        for v, world in enumerate(shot.world)
    ]
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    rows = np.concatenate(local)
    rows = rows[np.random.default_rng(0).permutation(len(rows))[:2000]]
    away = 1e3 * np.abs(trimesh.proximity.closest_point(mesh, rows)[1])
    return {"median": float(np.median(away)), "p99": float(np.percentile(away, 99)), "n": len(rows)}
