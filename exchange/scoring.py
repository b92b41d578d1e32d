"""Validation and metrics of imported grasps, written as base shards with their origin."""

from pathlib import Path

import numpy as np

from graspd.exchange.imported import ImportedGrasps, Origin, write_mesh
from graspd.exchange.plan import plain_name
from graspd.service.model.digests import digest_files, digest_json
from graspd.service.model.domain import JobRequest
from graspd.service.model.errors import InputError
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.states import AssetKind
from graspd.service.store.columns import Attribute
from graspd.service.store.shards import json_attribute, write_shard
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.files.provenance import base_attributes
from graspd.worker.generation import score_grasps
from graspd.worker.objects.options import apply_request
from graspd.worker.objects.prepare import files_from_path


def write_scored(
    found: ImportedGrasps,
    origin: Origin,
    folder: Path,
    *,
    validation: str,
    friction: float,
    ordinal: int = 0,
    run: ExecutionContext = DEFAULT_CONTEXT,
) -> Path:
    """Validate and measure a set of grasps; write a base shard and the object's mesh to `folder`.
    Grasps in scenes get a new trajectory and a lift test. Raises InputError: the file exists, or no such level."""
    name = plain_name(found.name)
    path = folder / f"{plain_name(found.hand.name)}-{name}-{ordinal:03}.h5"
    if path.exists():
        raise InputError(f"{path} exists already; give another folder as --output")
    try:
        wanted = {"grasps": max(1, len(found.grasps)), "want": "candidates", "rechecks": 0}
        pair = {"hand": plain_name(found.hand.name), "object": name}
        request = JobRequest.model_validate(pair | wanted | {"validation": validation, "friction": friction})
    except ValueError:
        raise InputError(f"unknown level {validation!r}; choose dexgraspbench, standard, fast or none") from None
    scenes = None if found.placed is None else found.placed.all_scenes
    obj = apply_request(found.obj, request)
    made = score_grasps(found.hand, obj, found.grasps, request, scenes=scenes, run=run)
    folder.mkdir(parents=True, exist_ok=True)
    mesh = write_mesh(found.obj, folder / f"{name}-{found.scale:g}.obj")
    digest = digest_files(AssetKind.OBJECT, files_from_path(mesh)[1])
    attributes: dict[str, Attribute] = {
        "hand": found.hand.name,
        "hand_digest": found.hand.digest,
        "object": name,
        "object_digest": digest,
        "object_scale": found.scale,
        "method": f"imported:{origin.format}",
        "source": origin.source,
        "licence": origin.licence,
        "fidelity": json_attribute({"face_error_m": 0.0}),
        "shard_id": digest_json([origin.source, found.hand.digest, digest, ordinal, len(found.grasps)]),
        "batch": ordinal,
    }
    attributes |= base_attributes(found.hand, obj, request, candidates=made.candidates, verdict_key=made.verdict_key)
    arrays = {**made.grasps.to_columns(), **made.columns}
    if found.published is not None and (found.published >= 0).any():
        arrays["quality/published"] = found.published
    if scenes is not None:
        # Importers support no other scene than a table.
        attributes["scene"] = json_attribute(SceneSpec(kind="table").model_dump(mode="json"))
        arrays["scene/object_pose"] = scenes.object_pose
        arrays["scene/rest_probability"] = np.full(len(scenes.object_pose), np.nan)
    path.write_bytes(write_shard("base", arrays, attributes))
    return path
