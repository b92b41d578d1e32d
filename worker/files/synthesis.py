"""Grasps of a hand file on an object file as a job makes them, in this process: a base shard in memory."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from service.model.domain import BATCH_SIZE, SHAKE_NEEDS_A_SCENE, JobOptions
from service.model.errors import InputError, TaskCancelled, did_you_mean, one_of
from service.model.fidelity import FIDELITIES, Fidelity
from service.model.metrics import DIRECTION_CELLS, GraspType, entropy_bits
from service.model.planning import shortfall, totals
from service.model.scene_spec import MOST_SCENES, SceneSpec
from service.store.columns import Attribute
from service.store.shards import json_attribute
from worker.certified import Certified, certified_grasps
from worker.engines.devices import Device
from worker.engines.joins import batches_at_once, parse_join, processes_at_once
from worker.files.provenance import (
    NEIGHBOUR_FACE_ERROR_M,
    base_attributes,
    beside_attributes,
    remembered,
    wrist_attributes,
)
from worker.grasps import joined_columns
from worker.hands.load import hand_from_path
from worker.hands.model import HandModel
from worker.objects.model import ObjectModel
from worker.objects.options import as_asked
from worker.objects.prepare import object_from_path
from worker.planners import planner
from worker.pool.pool import MODULES, Pool
from worker.quality.referee.payload import Limit
from worker.run import FirstJudge, Progress, Run
from worker.scenes.beside import scenes_of
from worker.scenes.rest import rolling_poses
from worker.together import certified_batches, distinct_batches

Arrays = dict[str, NDArray[Any]]
#: Threshold of the metrics that a summary tells [m].
_TOLD_M: Final = 0.005
FREE: Final = SceneSpec()
#: Columns of the scenes that a shard has.
_KEPT: Final = ("scene/object_pose", "scene/rest_probability", "scene/neighbour_pose")


@dataclass(frozen=True)
class Synthesized:
    """A base shard in memory, and what became of all tries."""

    arrays: Arrays
    attributes: dict[str, Attribute]
    batches: list[Certified]
    request: JobOptions
    place: SceneSpec
    interrupted: bool
    """Whether it was stopped before the end."""
    seconds: float
    """Wall time, without the reading of the files [s]."""
    rolling: int = 0
    """Scenes in which the object may roll, see `rolling_poses`."""

    @property
    def reason(self) -> str | None:
        """Why there are fewer grasps than were asked for; None where there are not."""
        request = self.request
        if self.interrupted:
            return f"interrupted: {len(self.arrays['quality/valid'])} of {request.grasps} grasps were there"
        limit, narrow = self.limit, self.narrow
        reason = shortfall(
            len(self.arrays["quality/valid"]),
            request.grasps,
            request.counted,
            sum(batch.tried for batch in self.batches),
            request.budget,
            totals(batch.outcomes for batch in self.batches),
            limit.line if limit is not None and limit.hopeless else "",
        )
        if limit is not None and not limit.hopeless:
            reason = f"{reason}; {limit.line}"
        return f"{reason}; {narrow}" if reason and narrow else reason

    @property
    def narrow(self) -> str | None:
        """The geometric reason where nothing is valid, raw grasps or none; None: there is none."""
        return None if self.arrays["quality/valid"].any() else self.batches[0].narrow

    @property
    def limit(self) -> Limit | None:
        """What the hand lifts at best, where it is told: no grasp was found, for the weight."""
        return None if len(self.arrays["quality/valid"]) else self.batches[0].limit

    def summary(self) -> dict[str, Any]:
        """What a user wants to know first, for JSON."""
        count, request = len(self.arrays["quality/valid"]), self.request
        told: dict[str, Any] = {
            "grasps": count,
            "tried": sum(batch.tried for batch in self.batches),
            "valid": int(self.arrays["quality/valid"].sum()),
            "sound": int(self.arrays["quality/sound"].sum()),
            "referee": request.referee,
            "mass_kg": self.attributes["object_mass_kg"],
            "object_friction": self.attributes["object_friction"],
            "want": request.want,
            "wanted": request.grasps,
            "reason": self.reason,
            "outcomes": totals(batch.outcomes for batch in self.batches),
            "seconds": round(self.seconds, 3),
            "grasps_per_second": round(count / self.seconds, 2),
            "mean": {
                "epsilon": self._mean("epsilon", 4),
                "contact_area_cm2": self._mean("contact_area_cm2", 2),
                "intersection_volume_cm3": self._mean("intersection_volume_cm3", 4),
                "penetration_depth_mm": self._mean("penetration_depth_mm", 3),
            },
        }
        if request.measures_payload:
            told["payload_kg"] = self._median_payload()
        if request.shake:
            told["shake_share"] = self._shake_share()
        if self.limit is not None:
            told["limit"] = self.limit.facts()
        told |= self._diversity()
        if request.models:
            told |= {
                "robust_models": request.models,
                "robust_wanted": request.robust,
                "robust_share": self._mean("robust_share", 4),
                "fragile": sum(batch.rejected.get("fragile", 0) for batch in self.batches),
            }
        if self.place.kind != "free":
            told |= {"scene": self.place.kind, "scenes": len(self.arrays["scene/object_pose"])} | self._shares()
            told |= {"rolling_scenes": self.rolling, "narrow": self.narrow}
        return told

    def _diversity(self) -> dict[str, Any]:
        """Types of the grasps, and the entropies of types and of directions of approach."""
        types = np.bincount(np.asarray(self.arrays["quality/grasp_type"], int), minlength=len(GraspType))
        cells = np.bincount(np.asarray(self.arrays["quality/approach_cell"], int), minlength=DIRECTION_CELLS)
        return {
            "types": {kind.name.lower(): int(types[kind]) for kind in GraspType if types[kind]},
            "type_entropy_bits": round(entropy_bits(types.tolist()), 4),
            "directions_used": int((cells > 0).sum()),
            "direction_entropy_bits": round(entropy_bits(cells.tolist()), 4),
        }

    def _median_payload(self) -> float | None:
        values = np.asarray(self.arrays["quality/payload_kg"], float)
        known = values[np.isfinite(values)]
        return round(float(np.median(known)), 4) if len(known) else None

    def _shake_share(self) -> float | None:
        """Of the grasps that were shaken, the share that survives."""
        values = np.asarray(self.arrays["quality/shake_margin"], float)
        known = values[np.isfinite(values)]
        return round(float((known < 1).mean()), 4) if len(known) else None

    def _mean(self, name: str, digits: int) -> float | None:
        values = self.arrays[f"quality/{name}"]
        if values.ndim == 2:
            values = values[:, int(np.argmin(np.abs(self.arrays["quality/thresholds_m"] - _TOLD_M)))]
        known = values[np.isfinite(values)]
        return round(float(known.mean()), digits) if len(known) else None

    def _shares(self) -> dict[str, float]:
        """Of all grasps that were planned: clear, lifted, lifted at half the friction."""
        planned = sum(batch.planned for batch in self.batches)
        return {
            name: round(sum(batch.shares[name] * batch.planned for batch in self.batches) / max(1, planned), 4)
            for name in self.batches[0].shares
        }


def synthesized(
    hand: str,
    obj: str,
    request: JobOptions,
    *,
    place: SceneSpec = FREE,
    scenes: int = 4,
    mesh: Mapping[str, Any] | None = None,
    device: str = "auto",
    threads: int = 0,
    first_judge: FirstJudge = "auto",
    join: int | str = "auto",
    processes: int = 0,
    progress: Progress | None = None,
    cancelled: Callable[[], bool] | None = None,
    partial: bool = False,
) -> Synthesized:
    """The grasps of a job in one process, without a queue or a server.

    Args:
        hand: a URDF, a ZIP with one, or the name of a built-in hand.
        obj: a mesh or the name of a built-in object.
        request: how many grasps, how made and judged.
        place: where they are used.
        scenes: scenes that the grasps are shared out to.
        mesh: how the object's file is read: units, scale_to, keep_largest, allow_open.
        device: cpu, cuda:0 or auto.
        threads: CPU threads; 0: one per core.
        first_judge: whether MuJoCo Warp gives the clear verdicts; auto: on a GPU, where it is installed.
        join: batches of 32 whose grasps are planned in one launch, or auto; the grasps are the same.
        processes: that judge and measure; 1: this one; 0: on a GPU one for each core less one, else 1.
        progress: told of the grasps that are done, and of how many.
        cancelled: asked often; True: the work stops.
        partial: if it is stopped, what was judged before is the result.

    Raises:
        InputError: unknown method, option, hand, object or device, or a scene without room.
        TaskCancelled: `cancelled` answered True; with `partial`, before anything was judged.
    """
    planner(request.method, request.options, in_scenes=place.kind != "free")  # before the files are read
    if place.kind != "free" and not 1 <= scenes <= MOST_SCENES:
        raise InputError(f"scenes: must be at least 1 and at most {MOST_SCENES}; got {scenes}")
    if threads < 0:
        raise InputError(f"threads: must be at least 0; got {threads}")
    if request.shake and place.kind == "free":
        raise InputError(SHAKE_NEEDS_A_SCENE)
    wanted = parse_join(str(join))
    options = dict(mesh or {})
    model = hand_from_path(hand)
    thing = as_asked(object_from_path(obj, face_error_m=request.knobs.face_error_m, options=options), request)
    chosen = Device(device).resolve()
    began = time.perf_counter()
    others = [object_from_path(one.object, face_error_m=NEIGHBOUR_FACE_ERROR_M) for one in place.neighbours]
    where, poses = None, dict[str, Any]()
    if place.kind != "free":
        where, poses = scenes_of(place, thing, others, count=scenes, seed=request.seed)
    sizes = [min(BATCH_SIZE, request.grasps - first) for first in range(0, request.grasps, BATCH_SIZE)]
    run = Run(chosen, threads, first_judge=first_judge)
    run = run if progress is None else replace(run, progress=progress)
    run = run if cancelled is None else replace(run, cancelled=cancelled)
    joined = batches_at_once(chosen, wanted)
    with _pool(processes_at_once(chosen, processes, threads=threads)) as pool:
        run = replace(run, pool=pool)
        batches = certified_batches(
            model, thing, request, sizes=sizes, join=joined, scenes=where, run=run, partial=partial
        )

        def more(count: int, number: int) -> Certified | None:
            try:
                return certified_grasps(
                    model, thing, request, count=count, batch=number, scenes=where, run=run.quiet(), partial=partial
                )
            except TaskCancelled:
                if not partial:
                    raise
                return None

        batches = distinct_batches(model, request, batches, more)
    interrupted = partial and run.cancelled()
    seconds = time.perf_counter() - began
    arrays = joined_columns([{**batch.grasps.to_columns(), **batch.columns} for batch in batches])
    arrays |= {name: poses[name] for name in _KEPT if name in poses}
    attributes = _attributes(model, thing, request, batches, chosen, seconds) | remembered(hand, obj, options)
    if interrupted:
        attributes["grasps_wanted"] = request.grasps
    if poses:
        attributes |= {"scene": json_attribute(_as_stored(place, others))} | wrist_attributes(model)
        attributes |= beside_attributes(others, [one.object for one in place.neighbours])
    rolling = rolling_poses(thing, poses["scene/object_pose"]) if poses and place.target is None else 0
    made = Synthesized(arrays, attributes, batches, request, place, interrupted, seconds, rolling)
    if made.reason is not None:
        attributes["reason"] = made.reason
    return made


@contextmanager
def _pool(processes: int) -> Iterator[Pool | None]:
    """So many processes beside this one, which start while the first grasps are planned; None for one."""
    if processes == 1:
        yield None
        return
    with Pool(processes, MODULES) as pool:
        pool.start()
        yield pool


def _as_stored(place: SceneSpec, others: Sequence[ObjectModel]) -> dict[str, Any]:
    """The scene as a shard tells it: neighbours by their names, not by files of this machine."""
    said = place.told()
    for one, other in zip(said["neighbours"], others, strict=True):
        one["object"] = other.name
    return said


def chosen_fidelity(name: str, contact_solver: str = "") -> Fidelity:
    """The knobs of a named fidelity, with another contact solver where one is given.

    Raises:
        InputError: unknown fidelity or solver.
    """
    if name not in FIDELITIES:
        raise InputError(f"unknown fidelity {name!r}; choose one of {one_of(name, FIDELITIES)}")
    knobs = FIDELITIES[name].model_dump()
    if contact_solver:
        knobs |= {"contact_solver": contact_solver, "name": f"{name}+{contact_solver}"}
    try:
        return Fidelity(**knobs)
    except ValueError:
        meant = did_you_mean(contact_solver, ("direct", "jacobi", "gauss_seidel"))
        raise InputError(
            f"unknown contact solver {contact_solver!r}; choose direct, jacobi or gauss_seidel{meant}"
        ) from None


def _attributes(
    hand: HandModel, obj: ObjectModel, request: JobOptions, batches: list[Certified], device: str, seconds: float
) -> dict[str, Attribute]:
    attributes: dict[str, Attribute] = {
        "hand": hand.name,
        "hand_digest": hand.digest,
        "object": obj.name,
        "object_digest": obj.digest,
        "method": request.method,
        "fidelity": json_attribute(request.knobs.model_dump(mode="json")),
        "seed": request.seed,
        "batch": 0,
        "device": device,
        "seconds": round(seconds, 4),
    }
    tried = sum(batch.tried for batch in batches)
    outcomes = totals(batch.outcomes for batch in batches)
    return attributes | base_attributes(
        hand, obj, request, tried=tried, verdict_key=batches[0].verdict_key, outcomes=outcomes
    )
