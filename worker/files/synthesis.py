"""Synthesis of grasps as in a job, without a service: from hand and object files to a shard in memory."""

import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import nullcontext
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from graspd.service.model.domain import BATCH_SIZE, NO_NEIGHBOURS, SHAKE_NEEDS_A_SCENE, JobOptions
from graspd.service.model.errors import InputError
from graspd.service.model.local_options import GRASP_FILE, LocalOptions
from graspd.service.model.metrics import DIRECTION_CELLS, GraspType, entropy_bits
from graspd.service.model.planning import explain_shortfall, sum_outcomes
from graspd.service.model.scene_spec import SceneSpec
from graspd.service.model.transforms import Floats
from graspd.service.store import validity
from graspd.service.store.columns import Attribute
from graspd.service.store.manifests import INDEX_THRESHOLD_M
from graspd.service.store.shards import json_attribute, read_shard
from graspd.worker.batched_generation import validated_batches
from graspd.worker.engines.batch_sizes import batches_per_launch, pool_process_count
from graspd.worker.engines.devices import Device
from graspd.worker.execution_context import ExecutionContext, PrefilterMode, Progress
from graspd.worker.files.provenance import (
    NEIGHBOUR_FACE_ERROR_M,
    base_attributes,
    check_wrist_poses,
    neighbour_attributes,
    path_attributes,
    wrist_attributes,
)
from graspd.worker.generation import ValidatedBatch
from graspd.worker.grasps import join_columns
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.options import apply_request
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import planner
from graspd.worker.planners.registry import local_options
from graspd.worker.pool.pool import MODULES, Pool
from graspd.worker.scenes.placement import scenes_of
from graspd.worker.scenes.rest import count_rolling_poses
from graspd.worker.validation.engines.registry import check_engines
from graspd.worker.validation.payload import PayloadLimit

Arrays = dict[str, NDArray[Any]]
FREE: Final = SceneSpec()
#: Scene columns that a shard contains.
_KEPT: Final = ("scene/object_pose", "scene/rest_probability", "scene/neighbour_pose")
#: Metrics with a mean in the summary, and the number of its digits.
_MEANS: Final = {"epsilon": 4, "contact_area_cm2": 2, "intersection_volume_cm3": 4, "penetration_depth_mm": 3}


@dataclass(frozen=True)
class SynthesisResult:
    """Base shard in memory, and the outcomes of all candidates."""

    arrays: Arrays
    attributes: dict[str, Attribute]
    batches: list[ValidatedBatch]
    request: JobOptions
    place: SceneSpec
    interrupted: bool  # whether it was stopped early
    seconds: float  # wall time without loading of the files [s]
    rolling: int = 0  # scenes in which the object may roll, see `count_rolling_poses`

    @property
    def reason(self) -> str | None:
        """Explain why there are fewer grasps than requested; None if there are enough."""
        request, count = self.request, len(self.arrays["quality/valid"])
        if self.interrupted:
            return f"interrupted: {count} of {request.grasps} grasps were finished"
        limit, narrow = self.payload_limit, self.narrow_reason
        candidates = sum(batch.candidates for batch in self.batches)
        outcomes = sum_outcomes(batch.outcomes for batch in self.batches)
        exceeded = limit.line if limit is not None and limit.is_far_exceeded else ""
        reason = explain_shortfall(request, count, candidates, outcomes, limit=exceeded)
        if limit is not None and not limit.is_far_exceeded:
            reason = f"{reason}; {limit.line}"
        return f"{reason}; {narrow}" if reason and narrow else reason

    @property
    def narrow_reason(self) -> str | None:
        """Return the geometric reason why no grasp is valid; None if it is unknown or a grasp is valid."""
        return None if self.arrays["quality/valid"].any() else self.batches[0].narrow

    @property
    def payload_limit(self) -> PayloadLimit | None:
        """Return the payload limit if it explains why no grasp was found."""
        return None if len(self.arrays["quality/valid"]) else self.batches[0].limit

    def summary(self) -> dict[str, Any]:
        """Summarise the result: counts, settings, times and means."""
        count, request = len(self.arrays["quality/valid"]), self.request
        summary: dict[str, Any] = {
            "grasps": count,
            "candidates": sum(batch.candidates for batch in self.batches),
            "valid": int(self.arrays["quality/valid"].sum()),
            "feasible": int(self.arrays["quality/feasible"].sum()),
            "validation": request.validation,
            "mass_kg": self.attributes["object_mass_kg"],
            "object_friction": self.attributes["object_friction"],
            "want": request.want,
            "wanted": request.grasps,
            "reason": self.reason,
            "outcomes": sum_outcomes(batch.outcomes for batch in self.batches),
            "seconds": round(self.seconds, 3),
            "grasps_per_second": round(count / self.seconds, 2),
            "mean": {name: self._mean(name, digits) for name, digits in _MEANS.items()},
        }
        if request.measures_payload:
            payload = self._finite_values("payload_kg")
            summary["payload_kg"] = round(float(np.median(payload)), 4) if len(payload) else None
        if request.shake:
            margin = self._finite_values("shake_margin")
            summary["shake_share"] = round(float((margin < 1).mean()), 4) if len(margin) else None
        if self.payload_limit is not None:
            summary["limit"] = self.payload_limit.facts()
        summary |= self._diversity()
        if request.model_count:
            summary |= {
                "robust_models": request.model_count,
                "robust_wanted": request.robust,
                "robust_share": self._mean("robust_share", 4),
                "not_robust": sum(batch.rejected.get("not_robust", 0) for batch in self.batches),
            }
        if request.second_engines:
            summary["second_engines"] = {"names": request.second_engines, **validity.second_engine_counts(self.arrays)}
        if self.place.kind != "free":
            summary |= {"scene": self.place.kind, "scenes": len(self.arrays["scene/object_pose"])} | self._shares()
            summary |= {"rolling_scenes": self.rolling, "narrow": self.narrow_reason}
        return summary

    def _diversity(self) -> dict[str, Any]:
        types = np.bincount(np.asarray(self.arrays["quality/grasp_type"], int), minlength=len(GraspType))
        cells = np.bincount(np.asarray(self.arrays["quality/approach_cell"], int), minlength=DIRECTION_CELLS)
        return {
            "types": {kind.name.lower(): int(types[kind]) for kind in GraspType if types[kind]},
            "type_entropy_bits": round(entropy_bits(types.tolist()), 4),
            "directions_used": int((cells > 0).sum()),
            "direction_entropy_bits": round(entropy_bits(cells.tolist()), 4),
        }

    def _finite_values(self, name: str) -> Floats:
        values = np.asarray(self.arrays[f"quality/{name}"], float)
        return values[np.isfinite(values)]

    def _mean(self, name: str, digits: int) -> float | None:
        values = self.arrays[f"quality/{name}"]
        if values.ndim == 2:
            values = values[:, int(np.argmin(np.abs(self.arrays["quality/thresholds_m"] - INDEX_THRESHOLD_M)))]
        known = values[np.isfinite(values)]
        return round(float(known.mean()), digits) if len(known) else None

    def _shares(self) -> dict[str, float]:
        planned = sum(batch.planned for batch in self.batches)
        return {
            name: round(sum(batch.shares[name] * batch.planned for batch in self.batches) / max(1, planned), 4)
            for name in self.batches[0].shares
        }


def synthesize_with_options(hand: str, obj: str, options: LocalOptions, **run: Any) -> SynthesisResult:
    """Run `synthesize_grasps` with a local user's options; `run` are its further arguments."""
    pose = wrist_pose(str(options.like), hand, obj, options.mesh_options)
    return synthesize_grasps(
        hand,
        obj,
        options.job_options(local_options(options.method, options.options), pose),
        place=options.scene_spec,
        scenes=options.scenes,
        mesh=options.mesh_options,
        device=options.device,
        threads=options.threads,
        join=None if options.join == "auto" else options.join,
        **run,
    )


def wrist_pose(like: str, hand: str, obj: str, mesh: Mapping[str, Any]) -> str:
    """Return option `like` as seven numbers; a grasp file without a row stands for its first valid grasp.
    Raises InputError: no such row, no valid grasp, or see `check_wrist_poses`."""
    if (found := GRASP_FILE.fullmatch(like)) is None:
        return like
    shard = read_shard(Path(found[1]), kind="base")
    check_wrist_poses(shard, hand, obj, mesh)
    rows = np.arange(len(shard["quality/valid"]))
    if found[2] is not None and int(found[2]) >= len(rows):
        raise InputError(f"{found[1]} has {len(rows)} grasps, numbered from 0: row {found[2]} does not exist")
    if not len(rows := rows[[int(found[2])]] if found[2] else rows[validity.valid_mask(shard.arrays)]):
        raise InputError(f"{found[1]} has no valid grasp: choose a row, such as {found[1]}:0")
    return ", ".join(f"{value:.7g}" for value in np.asarray(shard["grasp/hand_pose"], float)[rows[0]])


def synthesize_grasps(
    hand: str,
    obj: str,
    request: JobOptions,
    *,
    place: SceneSpec = FREE,
    scenes: int = 4,
    mesh: Mapping[str, Any] | None = None,
    device: str = "auto",
    threads: int = 0,
    prefilter: PrefilterMode = "auto",
    join: int | None = None,
    processes: int = 0,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
    partial: bool = False,
) -> SynthesisResult:
    """Make the grasps of a job in scene `place`; `hand` and `obj` are files or built-in names.
    `mesh` has options for the object's file. `join` batches are one launch of the planner; None fills a GPU.
    `processes` validate and measure: 1 is this process alone, 0 stands for `pool_process_count`. Raises InputError: an
    invalid argument, or a scene without space. TaskCancelled: cancelled; with `partial`, only before any validation."""
    planner(request.method, request.options, in_scenes=place.kind != "free")  # before the files are read
    check_engines(request.second_engines)
    if request.second_engines and place.neighbours:
        raise InputError(NO_NEIGHBOURS)
    if request.shake and place.kind == "free":
        raise InputError(SHAKE_NEEDS_A_SCENE)
    options = dict(mesh or {})
    model = hand_from_path(hand)
    thing = apply_request(
        object_from_path(obj, face_error_m=request.resolved_fidelity.face_error_m, options=options), request
    )
    chosen = Device(device).resolve()
    began = time.perf_counter()
    others = [object_from_path(one.object, face_error_m=NEIGHBOUR_FACE_ERROR_M) for one in place.neighbours]
    where, poses = None, dict[str, Any]()
    if place.kind != "free":
        where, poses = scenes_of(place, thing, others, count=scenes, seed=request.seed)
    sizes = [min(BATCH_SIZE, request.grasps - first) for first in range(0, request.grasps, BATCH_SIZE)]
    run = ExecutionContext(chosen, threads, prefilter=prefilter)
    run = run if progress is None else replace(run, progress=progress)
    run = run if cancelled is None else replace(run, cancelled=cancelled)
    joined = batches_per_launch(chosen, join)
    count = pool_process_count(chosen, processes, threads=threads)
    with Pool(count, MODULES) if count > 1 else nullcontext() as pool:
        if pool is not None:
            pool.start()  # while the first grasps are planned
        run = replace(run, pool=pool)
        batches = validated_batches(
            model, thing, request, sizes=sizes, join=joined, scenes=where, run=run, partial=partial
        )
    interrupted = partial and run.cancelled()
    seconds = time.perf_counter() - began
    arrays = join_columns([{**batch.grasps.to_columns(), **batch.columns} for batch in batches])
    arrays |= {name: poses[name] for name in _KEPT if name in poses}
    attributes = _attributes(model, thing, request, batches, chosen, seconds) | path_attributes(hand, obj, options)
    if interrupted:
        attributes["grasps_wanted"] = request.grasps
    if poses:
        attributes |= {"scene": json_attribute(_stored_scene(place, others))} | wrist_attributes(model)
        attributes |= neighbour_attributes(others, [one.object for one in place.neighbours])
    rolling = count_rolling_poses(thing, poses["scene/object_pose"]) if poses and place.target is None else 0
    made = SynthesisResult(arrays, attributes, batches, request, place, interrupted, seconds, rolling)
    if made.reason is not None:
        attributes["reason"] = made.reason
    return made


def _stored_scene(place: SceneSpec, others: Sequence[ObjectModel]) -> dict[str, Any]:
    """Return the scene as stored in a shard: neighbours by name, not by local file."""
    said = place.to_attribute()
    for one, other in zip(said["neighbours"], others, strict=True):
        one["object"] = other.name
    return said


def _attributes(
    hand: HandModel, obj: ObjectModel, request: JobOptions, batches: list[ValidatedBatch], device: str, seconds: float
) -> dict[str, Attribute]:
    attributes: dict[str, Attribute] = {
        "hand": hand.name,
        "hand_digest": hand.digest,
        "object": obj.name,
        "object_digest": obj.digest,
        "method": request.method,
        "fidelity": json_attribute(request.resolved_fidelity.model_dump(mode="json")),
        "seed": request.seed,
        "batch": 0,
        "device": device,
        "seconds": round(seconds, 4),
    }
    candidates = sum(batch.candidates for batch in batches)
    outcomes, key = sum_outcomes(batch.outcomes for batch in batches), batches[0].verdict_key
    return attributes | base_attributes(hand, obj, request, candidates=candidates, verdict_key=key, outcomes=outcomes)
