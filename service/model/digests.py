"""Digests of inputs as ids of files, jobs and shards; repeated runs of a task write one shard."""

import hashlib
import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Final

from graspd.service.model.domain import JobRequest, count_batches
from graspd.service.model.metrics import MIN_DISTANCE_M
from graspd.service.model.renamed import original_request
from graspd.service.model.states import AssetKind, Stage
from graspd.service.model.version import STAGE_REVISIONS

#: Revision to increase when payloads change but grasps do not.
_PAYLOAD_REVISION: Final = 2


def digest_bytes(data: bytes) -> str:
    """Return the first 32 hexadecimal digits of the SHA-256 of `data`."""
    return hashlib.sha256(data).hexdigest()[:32]


def file_sha256(path: Path) -> str:
    """Return the whole SHA-256 of a file in hexadecimal digits, as checksum lists state it."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def digest_json(value: object) -> str:
    """Return the digest of canonical JSON: sorted keys, no spaces, shortest round-trip floats."""
    text = json.dumps(value, sort_keys=True, separators=(",", ":"), allow_nan=False, ensure_ascii=True)
    return digest_bytes(text.encode())


def digest_files(kind: AssetKind, files: Mapping[str, bytes]) -> str:
    # `service.store.assets.ZipFiles`, an archive on disk, knows the digests.
    digest = getattr(files, "digest", lambda name: digest_bytes(files[name]))
    return digest_json({"kind": kind, "files": {name: digest(name) for name in files}})


def digest_variant(digest: str, options: Mapping[str, object] | None) -> str:
    """Return the digest of a hand or object read with these options; without options, `digest`."""
    return digest_json({"files": digest, "options": dict(options)}) if options else digest


def shard_id(
    stage: Stage,
    *,
    request: JobRequest,
    hand_digest: str,
    object_digest: str,
    batch: int,
    count: int,
    revision: int,
    inputs: Iterable[str] = (),
) -> str:
    """Return the id of the shard that a stage makes: the digest of all inputs that affect the result."""
    inputs_of: dict[str, object] = {
        "stage": stage,
        "revision": revision,
        "hand": hand_digest,
        "object": object_digest,
        "names": [request.hand, request.object],
        "batch": batch,
        "count": count,
        "seed": request.seed,
        "inputs": sorted(inputs),
    }
    if stage is Stage.SYNTHESIZE:
        inputs_of |= {
            "method": request.method,
            "fidelity": request.resolved_fidelity.model_dump(mode="json"),
            "friction": request.friction,
            **({"options": request.options} if request.options else {}),
            **({"matter": request.object_properties} if request.object_properties else {}),
            **_validation_inputs(request, range(batch, batch + count_batches(count))),
        }
    elif stage is Stage.SCENE:
        inputs_of |= {"scenes": request.scenes}
        if request.in_scene:
            # Scenes made before the grasps depend on the planner's mesh of the object.
            inputs_of |= {
                "scene": request.scene_spec.model_dump(mode="json"),
                "face_error_m": request.resolved_fidelity.face_error_m,
            }
    elif stage is Stage.RENDER:
        inputs_of |= {k: getattr(request, k) for k in ("views", "stereo", "width", "height", "channels")}
    elif stage is Stage.EPISODE:
        inputs_of |= {k: getattr(request, k) for k in ("episodes", "film", "episode_fps")}
        inputs_of |= {k: getattr(request, k) for k in ("width", "height") if request.film}
    return digest_json(inputs_of)


def _validation_inputs(request: JobRequest, batches: range) -> dict[str, object]:
    found: dict[str, object] = {}
    if request.want == "valid":
        found |= {"want": request.want, "budget": request.budget}
        # Digests omit the default distance, so a new default needs a new revision of the stage.
        found |= {} if request.min_distance == MIN_DISTANCE_M else {"min_distance": request.min_distance}
    if request.validation != "none":
        rechecks = sum(map(request.rechecks_of, batches))
        found |= {"validation": request.validation, "rechecks": rechecks}
    if request.model_count:
        found |= {"robust": [request.model_count, request.robust]}
    if request.measures_payload:
        found |= {"payload": [_PAYLOAD_REVISION, request.min_payload]}
    if request.second_engines:
        found |= {"engines": [request.second_engines, 1.0 if request.robust else request.second_engine_share]}
    if request.shake:
        found |= {"shake": True}
    return original_request(found)


def job_id(request: JobRequest, hand_digest: str, object_digest: str, project: str = "") -> str:
    """Return the id of a job: equal requests for the same hand, object and project are one job."""
    original = original_request(request.model_dump(mode="json"))
    # Jobs without episodes keep their ids from before this stage.
    revisions = {k: v for k, v in STAGE_REVISIONS.items() if k != Stage.EPISODE or request.has_episodes}
    inputs = {"request": original, "hand": hand_digest, "object": object_digest, "revisions": revisions}
    return digest_json(inputs | ({"project": project} if project else {}))
