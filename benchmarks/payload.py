"""Error and CPU time of payloads, compared with full tests; ratio of load capacity to payload.

usage: python -m benchmarks.payload DATA_DIR [--hands allegro ...] [--objects 025_mug ...] [--grasps 8] [--scenes 4]
           [--seed 1500] [--free] [--page OUT.md]
       DATA_DIR holds hands/ and objects/; --free: six pushes instead of a lift off a table

Grasps are valid for objects of their published masses. The full test repeats the validator's rise and hold, or each of
its pushes, for each mass of a bisection to 3 %. The ratio is the largest load capacity of a pair's grasps divided by
their largest payload, with squeezes of 50 to 1000 N."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from benchmarks.cells import HANDS
from benchmarks.masses import arguments, masses
from graspd.service.model.domain import JobOptions
from graspd.service.model.fidelity import FIDELITIES
from graspd.service.model.scene_spec import parse_scene
from graspd.worker.control.postures import squeeze
from graspd.worker.generation import ValidatedBatch, validated_grasps
from graspd.worker.grasps import GraspSet, join_grasp_sets
from graspd.worker.hands.load import hand_from_path
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.prepare import object_from_path
from graspd.worker.scenes.placement import scenes_of
from graspd.worker.simulation.environment import PlacedGrasps
from graspd.worker.validation.decomposition import decompose
from graspd.worker.validation.lift import LiftOutcome
from graspd.worker.validation.model import MujocoOptions, scene_of
from graspd.worker.validation.payload import LIFTING, LiftPayload, PushPayload, payload_limit
from graspd.worker.validation.protocol import DIRECTIONS, Outcome, Rollout

SEED: Final = 1500
#: Total normal forces of the stronger squeezes [N].
FORCES_N: Final = (100.0, 200.0, 400.0, 1000.0)
OBJECTS: Final = ("005_tomato_soup_can", "006_mustard_bottle", "025_mug", "061_foam_brick")
HEAD: Final = """# Payload of grasps: error and cost

`python -m benchmarks.payload DATA{option}`: payload of valid grasps, compared with full tests of each mass.

- *Ratio*: payload divided by the payload of full tests; *error*: deviation of the ratio from 1.
- *CPU ms*: mean time per grasp, of the payload and of the full tests.
- *Bound*: largest load capacity of a pair's grasps divided by their largest payload; smallest value of the pairs.
  Squeezes are as planned and of 100 to 1000 N.

{grasps} grasps wanted per pair of hand and object; objects {objects}; seed {seed}.

"""
Floats = NDArray[np.float64]


class WholeLifts(LiftPayload):
    """Payload by the validator's rise and hold."""

    def payload(self, grasps: GraspSet, row: int) -> float:
        self._set_mass(self._own)
        if self._set_up_scene(grasps, row).outcome is not LiftOutcome.NOT_TRIED or not self._close(
            grasps, row, give_up=True
        ):
            return float("nan")
        self._save()

        def bears(mass: float) -> bool:
            self._set_mass(mass)
            self._restore()
            self._goal = np.zeros(3)
            self.data.xfrc_applied[self.scene.object_body, :3] = -self.scene.push_force * self._up
            self._rise(grasps, row)
            rollout = Rollout()
            return self._validate(rollout) is Outcome.HELD and self._hold(rollout) is Outcome.HELD

        return self._heaviest(bears, self._own)


class WholePushes(PushPayload):
    """Payload by the validator's pushes."""

    def payload(self, grasps: GraspSet, row: int) -> float:
        self._set_mass(self._own)
        if self._set_up_test(grasps, row).outcomes[0] is Outcome.PENETRATION or not self._close(
            grasps, row, give_up=True
        ):
            return float("nan")
        self._save()

        def bears(mass: float) -> bool:
            self._set_mass(mass)
            for direction in range(len(DIRECTIONS)):
                self._restore()
                self._push(direction)
                if self._hold(Rollout()) is not Outcome.HELD:
                    return False
            return True

        return self._heaviest(bears, self._own)


def main() -> None:
    parser = arguments(__doc__, SEED)
    parser.add_argument("--free", action="store_true")
    parser.set_defaults(grasps=8, objects=list(OBJECTS))
    given = parser.parse_args()
    rows = [
        "| hand | grasps | median ratio | median error | 90th percentile of error | CPU ms | CPU ms of full tests | "
        "bound |",
        "|---|--:|--:|--:|--:|--:|--:|--:|",
    ]
    for name in given.hands:
        hand = hand_from_path(str(given.data / "hands" / HANDS[name]))
        found = [of_pair(given, hand, obj, mass) for obj, mass in masses(given.data).items() if obj in given.objects]
        ratio, milliseconds, whole = (np.concatenate(part) for part in zip(*(one[:3] for one in found), strict=True))
        error = np.abs(ratio - 1)
        rows.append(
            f"| {name} | {len(ratio)} | {np.median(ratio):.2f} | {np.median(error):.2f} | "
            f"{np.percentile(error, 90):.2f} | {milliseconds.mean():.0f} | {whole.mean():.0f} | "
            f"{min(one[3] for one in found):.1f} |"
        )
        print(rows[-1], flush=True)  # noqa: T201
    if given.page:
        told = {"option": " --free" if given.free else "", "grasps": given.grasps, "seed": given.seed}
        given.page.write_text(HEAD.format(objects=", ".join(given.objects), **told) + "\n".join(rows) + "\n")


def of_pair(given: Any, hand: HandModel, name: str, mass: float) -> tuple[Floats, Floats, Floats, float]:
    """Return for each valid grasp of a pair the ratio of payload to full tests, and both CPU times [ms].
    The last value is the grasps' largest load capacity divided by their largest payload."""
    grasps, obj, placed = valid_grasps(given, hand, given.data / "objects" / name / "clean.stl", mass)
    around = (placed.supports,) if placed is not None else ()
    # A root on a weld yields, so that hand and object move.
    whole = LIFTING if placed is None else MujocoOptions()
    scenes = [scene_of(hand, obj, decompose(obj), physics, *around) for physics in (LIFTING, whole)]
    tests: list[LiftPayload | PushPayload]
    if placed is None:
        tests = [PushPayload(scenes[0]), WholePushes(scenes[1])]
    else:
        tests = [LiftPayload(scenes[0], placed), WholeLifts(scenes[1], placed)]
    kilograms, milliseconds = np.empty((2, len(grasps))), np.empty((2, len(grasps)))
    for row in range(len(grasps)):
        for k, test in enumerate(tests):
            began = time.process_time()
            kilograms[k, row] = test.payload(grasps, row)
            milliseconds[k, row] = 1e3 * (time.process_time() - began)
    # Grasps are valid, so they lift at least the object.
    kilograms = np.nan_to_num(kilograms, nan=obj.mass)
    strongest = payload_limit(
        hand,
        obj,
        squeezed(hand, obj, grasps),
        pieces=decompose(obj),
        placed=placed and placed.take(every(grasps)),
        least=1,
    )
    bound = strongest.bound_kg / strongest.lifts_kg if strongest is not None else float("nan")
    return kilograms[0] / kilograms[1], milliseconds[0], milliseconds[1], bound


def squeezed(hand: HandModel, obj: ObjectModel, grasps: GraspSet) -> GraspSet:
    """Return the grasps unchanged, then with the squeezes of `FORCES_N`."""
    stronger = [squeeze(hand, obj, grasps.grasp, total_normal_force=force) for force in FORCES_N]
    return join_grasp_sets([grasps, *(replace(grasps, squeeze=one) for one in stronger)])


def every(grasps: GraspSet) -> NDArray[np.intp]:
    return np.tile(np.arange(len(grasps)), 1 + len(FORCES_N))


def valid_grasps(
    given: Any, hand: HandModel, mesh: Path, mass: float
) -> tuple[GraspSet, ObjectModel, PlacedGrasps | None]:
    """Return valid grasps in the frame of the object's centre, the object, and scenes (None if free)."""
    obj = object_from_path(str(mesh), face_error_m=FIDELITIES["standard"].face_error_m).with_mass(mass=mass)
    request = JobOptions(grasps=given.grasps, rechecks=0, seed=given.seed)
    scenes = None
    if not given.free:
        scenes, _ = scenes_of(parse_scene("table"), obj, [], count=given.scenes, seed=given.seed)
    made: ValidatedBatch = validated_grasps(hand, obj, request, count=given.grasps, scenes=scenes)
    grasps = made.grasps.moved(np.negative(obj.centre))
    if scenes is None or grasps.scene is None:
        return grasps, obj.centred, None
    return grasps, obj.centred, scenes.centred(obj).placed(grasps.scene)


if __name__ == "__main__":
    main()
