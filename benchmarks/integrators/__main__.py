"""Map failures of integrators, gradients, descents, difficult hands, wrong models and difficult scenes.

usage: python -m benchmarks.integrators --out DIR [--only MAP ...] [--quick]
DIR receives stability.json, stability.md and the maps; `graspd stability --from` merges and publishes them. The quick
run takes a minute of CPU time, the full run hours, because its longest descent has 100,000 iterations.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.integrators import descents, flights, gradients, hands, model_errors, scenes
from graspd.service.model.clock import timestamp
from graspd.service.model.studies import Stability, StabilityMap
from graspd.service.model.version import PACKAGE_VERSION
from graspd.studies.stability.report import write
from graspd.studies.stability.shapes import MapOptions
from graspd.worker.engines import backend
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path

SCENES = ("scene_height", "scene_wall", "scene_neighbours", "scene_size")
PHYSICS = ("time_step", "stiffness", "contact_count", "gradient", "starts", "rates", "length")
MAPS = (*PHYSICS, "hands", "model_errors", *SCENES)


def measure(names: Sequence[str], *, quick: bool, say: Callable[[str], object]) -> list[StabilityMap]:
    """Return the named maps; `say` receives a line per map and per cell of a descent."""
    hand, thing = hand_from_path("allegro"), object_from_path("block")
    others = () if quick else ("barrett", "shadow")  # their drives and sizes differ
    count = 4 if quick else 8

    def few(values: Sequence[Any]) -> Sequence[Any]:
        return values[1::2] if quick else values

    def scene(name: str, *axes: tuple[Any, ...]) -> StabilityMap:
        options = MapOptions(2 if quick else 8, "draft", say=say)
        compared = [hand, *map(hand_from_path, others[:1])]
        return scenes.scene_map(name, compared, options, xs=few(axes[0]), ys=few(axes[1]))

    lengths = descents.LENGTHS[:1] if quick else descents.LENGTHS
    maps: dict[str, Callable[[], StabilityMap]] = {
        "time_step": lambda: flights.time_step_map(few(flights.TIME_STEPS), few(flights.SPEEDS)),
        "stiffness": lambda: flights.stiffness_map(
            few(flights.STIFFNESSES), few(flights.MASSES), few(flights.TIME_STEPS)
        ),
        "contact_count": lambda: flights.contact_count_map(flights.COUNTS[:: 2 if quick else 1]),
        "gradient": lambda: gradients.gradient_map(
            few(gradients.SIZES_M), few(gradients.GAPS), repeats=1 if quick else 3
        ),
        "starts": lambda: descents.start_map(hand, thing, count=count, say=say),
        "rates": lambda: descents.rate_map(
            hand, thing, rates=few(descents.RATES), weights=few(descents.WEIGHTS), count=count, say=say
        ),
        "length": lambda: descents.length_map(hand, thing, lengths=lengths, say=say),
        "hands": lambda: hands.hand_map(
            MapOptions(count, "draft" if quick else "standard", say=say),
            fingers=(1, 3) if quick else hands.FINGERS,
            sizes=() if quick else hands.SIZES,
            ratios=() if quick else hands.RATIOS,
            couplings=("each joint",) if quick else hands.COUPLINGS,
        ),
        "model_errors": lambda: model_errors.model_error_map(
            [hand, *map(hand_from_path, others)],
            thing,
            MapOptions(2 if quick else 16, "draft" if quick else "standard", say=say),
            every=3 if quick else 1,
        ),
        "scene_height": partial(scene, "scene_height", scenes.HEIGHTS_MM, scenes.SIDES_MM),
        "scene_wall": partial(scene, "scene_wall", scenes.GAPS_MM, tuple(scenes.WALLS)),
        "scene_neighbours": partial(scene, "scene_neighbours", scenes.GAPS_MM, tuple(scenes.NEIGHBOURS)),
        "scene_size": partial(scene, "scene_size", scenes.RATIOS, scenes.KINDS),
    }
    found = []
    for name in names:
        say(f"map {name}")
        found.append(maps[name]())
    return found


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for the maps")
    parser.add_argument("--only", nargs="+", choices=MAPS, default=PHYSICS)
    parser.add_argument("--quick", action="store_true", help="few cells per map")
    args = parser.parse_args(arguments)
    backend.start_warp()
    import warp as wp

    maps = measure(args.only, quick=args.quick, say=lambda line: sys.stderr.write(f"{line}\n"))
    words = ["python -m benchmarks.integrators", *(["--quick"] if args.quick else [])]
    if args.only != PHYSICS:
        words += ["--only", *args.only]
    versions = {"graspd": PACKAGE_VERSION, "warp": wp.__version__}
    write(Stability(timestamp(), " ".join(words), versions, maps), args.out)


if __name__ == "__main__":
    main()
