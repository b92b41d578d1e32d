"""Cached candidates of a hand on an object with verdicts and metrics, shared by studies of quality.

A cell is a pair of hand and object, with a number of grasps and a revision of synthesize. Grasps are planned as in a
job. A cell's folder caches all results, so an interrupted study resumes. Studies with equal numbers of grasps share
grasps and verdicts."""

from __future__ import annotations

import argparse
import json
import os
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.version import STAGE_REVISIONS
from graspd.worker.execution_context import DEFAULT_CONTEXT
from graspd.worker.grasps import GraspSet, Posture
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.planners import synthesize
from graspd.worker.planners.port import PlanRequest
from graspd.worker.scenes.rollout import create_rollout
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.key import Level
from graspd.worker.validation.validator import validate

HANDS = {
    "allegro": "allegro/allegro_hand_right.urdf",
    "barrett": "barrett_bh280/bh280.urdf",
    "shadow": "shadow/shadow_hand_right.urdf",
}
#: Seed that was not used to choose any setting.
SEED = 7001
POSTURES = ("grasp", "pregrasp", "squeeze")


@dataclass
class Cell:
    """Candidates of one hand on one object at fidelity standard."""

    folder: Path
    hand_name: str
    object_name: str
    hand: HandModel
    mesh: Path
    count: int

    @cached_property
    def obj(self) -> ObjectModel:
        return object_from_path(self.mesh, face_error_m=FIDELITIES["standard"].face_error_m)

    @property
    def cpu_seconds(self) -> float:
        """CPU time of planning [s]; it depends less on other load than wall time."""
        return float(self.grasps.info["cpu_seconds"])  # type: ignore[arg-type]

    @cached_property
    def grasps(self) -> GraspSet:
        """Candidates with their postures; `seconds` is the wall time of planning, `info` has the CPU time."""
        file = self.folder / "grasps.npz"
        if file.is_file():
            with np.load(file) as stored:
                parts = [Posture(stored[f"{name}_pose"], stored[f"{name}_joints"]) for name in POSTURES]
                info: dict[str, object] = {"cpu_seconds": float(stored["cpu_seconds"])}
                return GraspSet(*parts, stored["loss"], seconds=float(stored["seconds"]), info=info)
        # Prepare kernels and pieces before the timed run.
        decompose(self.obj)
        planned(self.hand, self.obj, count=1, seed=1, fidelity="draft")
        began, cpu = time.perf_counter(), time.process_time()
        found = planned(self.hand, self.obj, count=self.count, seed=SEED)
        found.seconds, cpu = time.perf_counter() - began, time.process_time() - cpu
        found.info = {"cpu_seconds": cpu}
        arrays: dict[str, Any] = {
            "loss": found.stability_loss,
            "seconds": np.array(found.seconds),
            "cpu_seconds": np.array(cpu),
        }
        for name in POSTURES:
            part: Posture = getattr(found, name)
            arrays |= {f"{name}_pose": part.hand_pose, f"{name}_joints": part.joint_positions}
        self.folder.mkdir(parents=True, exist_ok=True)
        partial = file.with_suffix(".tmp.npz")
        np.savez(partial, **arrays)
        partial.replace(file)
        return found

    def verdicts(self, level: Level, hard: bool) -> dict[str, Any]:
        """Return each grasp's `success` and `reasons`, wall and CPU seconds, and a digest of conditions."""

        def make() -> dict[str, Any]:
            grasps, began = self.grasps, time.process_time()
            found = validate(self.hand, self.obj, grasps, level=level, hard=hard)
            return {
                "success": found.success.tolist(),
                "reasons": found.reasons,
                "seconds": found.seconds,
                "cpu_seconds": time.process_time() - began,
                "terms": found.terms,
                "pieces": found.pieces,
                "volume_ratio": found.volume_ratio,
                "excess_mm": found.excess_m * 1e3,
            }

        return self.kept(f"{level}{'-hard' if hard else ''}", make)

    def kept(self, name: str, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Return the result of `make`, cached in the cell's folder."""
        return kept_json(self.folder / f"{name}.json", make)


def planned(hand: HandModel, obj: ObjectModel, *, count: int, seed: int, fidelity: str = "standard") -> GraspSet:
    """Plan candidates of a free object as in a job: with rollouts, and around the object's centre.
    Positions are rounded to the job's grid."""
    rollout = create_rollout(DEFAULT_CONTEXT, hand, obj.centred, lambda: decompose(obj.centred), in_scenes=False)
    found = synthesize(hand, obj.centred, PlanRequest(count, FIDELITIES[fidelity], seed, rollout=rollout))
    return found.moved(np.zeros(3)).moved(obj.centre)


def kept_json(file: Path, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
    """Return the content of a JSON file; if it does not exist, create it from `make`."""
    if not file.is_file():
        write_json(file, make())
    found: dict[str, Any] = json.loads(file.read_text())
    return found


def write_json(file: Path, value: object) -> None:
    """Write atomically, so that a killed run leaves no partial file."""
    file.parent.mkdir(parents=True, exist_ok=True)
    partial = file.with_suffix(f".{os.getpid()}.tmp")
    partial.write_text(json.dumps(value, indent=1, allow_nan=False) + "\n")
    partial.replace(file)


def cell_parser(
    doc: str | None, *, objects: Sequence[str] | None = None, grasps: int = 64, hands: bool = True
) -> argparse.ArgumentParser:
    """Return a parser of data, --work, --hands (if `hands`), --objects and --grasps with these defaults."""
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("--work", type=Path, default=Path("quality-work"))
    if hands:
        parser.add_argument("--hands", nargs="+", default=list(HANDS), choices=list(HANDS))
    parser.add_argument("--objects", nargs="+", default=objects)
    parser.add_argument("--grasps", type=int, default=grasps, help="candidates of each hand on each object")
    return parser


def cells(data: Path, work: Path, hand_name: str, count: int, objects: list[str] | None = None) -> Iterator[Cell]:
    """Yield the cells of one hand for the named objects, by default for all objects of the data folder."""
    hand = hand_from_path(data / "hands" / HANDS[hand_name])
    folder = work / f"{hand_name}-{count}-{STAGE_REVISIONS['synthesize']}"
    for mesh in sorted((data / "objects").glob("*/clean.stl")):
        name = mesh.parent.name
        if not objects or name in objects:
            yield Cell(folder / name, hand_name, name, hand, mesh, count)
