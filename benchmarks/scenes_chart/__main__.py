"""Compare grasps planned in a scene with free grasps that are filtered in this scene, by method and fidelity.

usage: python -m benchmarks.scenes_chart --scene table --out DIR [--work DIR] [--publish] [--quick]
DIR receives chart.json, .csv, .md, .png and .svg. `--publish` stores the chart for `fidelity: auto` of jobs in such
scenes. A repeated command with the same `--work` folder continues a stopped run.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from typing import Any

from benchmarks.scenes_chart.comparison import scene_chart
from benchmarks.scenes_chart.report import write
from graspd.commands.studies import PEERS
from graspd.service.cli import load_settings
from graspd.service.model.errors import InputError
from graspd.service.model.fidelity import FIDELITIES, OFFERED
from graspd.service.model.metrics import ROBUST_MODELS
from graspd.service.model.scene_spec import SceneSpec, parse_scene
from graspd.service.store.records import publish_record, scene_chart_kind
from graspd.service.store.store import open_store
from graspd.studies.chart.chart import ChartObject, settings_of
from graspd.worker.engines.devices import Device
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path, object_name


def scene_of(text: str) -> SceneSpec:
    """Return the scene of a kind or file; raise InputError if it has neighbours."""
    spec = parse_scene(text)
    if spec.neighbours:
        raise InputError(f"{text} has neighbours, which a chart does not support; remove them")
    # The object is dropped onto each of its stable faces.
    return spec if spec.target is not None else parse_scene(text, faces="all")


def main(arguments: Sequence[str] | None = None) -> dict[str, Any]:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--scene", default="table", help="table, bin, shelf or a file")
    parser.add_argument("--methods", nargs="+", default=PEERS, help="as in graspd chart")
    parser.add_argument("--hands", nargs="+", default=["allegro", "barrett"], help="URDFs or built-in hands")
    parser.add_argument("--objects", nargs="+", default=["mug", "bottle"], help="meshes or built-in objects")
    parser.add_argument("--fidelities", nargs="+", choices=FIDELITIES, default=OFFERED)
    parser.add_argument("--batch", type=int, default=32, help="grasps per pair")
    parser.add_argument("--baseline-batch", type=int, default=8, help="the same, of methods with a budget of steps")
    parser.add_argument("--option", nargs="+", default=[], metavar="METHOD:NAME=VALUE", help="options of methods")
    parser.add_argument("--threads", type=int, default=0, help="CPU threads; 0: one per core")
    parser.add_argument("--quick", action="store_true", help="one pair and fidelity, four grasps")
    parser.add_argument("--work", type=Path, help="folder in which a stopped run continues")
    parser.add_argument("--out", type=Path, help="folder for the results")
    parser.add_argument("--publish", action="store_true", help="publish to the store")
    parser.add_argument("--data-dir", type=Path, help="data folder of graspd; default: GRASPD_DATA_DIR")
    args = parser.parse_args(arguments)
    spec, models = scene_of(args.scene), ROBUST_MODELS
    if args.quick:
        args.hands, args.objects, args.fidelities = args.hands[:1], args.objects[:1], args.fidelities[:1]
        args.batch, args.baseline_batch, models = 4, 2, 2
    settings = settings_of(
        args.methods,
        args.fidelities,
        batches=[args.batch],
        baseline_batch=args.baseline_batch,
        options=args.option,
        quick=args.quick,
        run=ExecutionContext(Device("auto").resolve(), args.threads),
    )
    things = [
        ChartObject(object_name(Path(text)), lambda error, text=text: object_from_path(text, face_error_m=error))
        for text in args.objects
    ]
    words = sys.argv[1:] if arguments is None else arguments
    command = {"command": shlex.join(["python", "-m", "benchmarks.scenes_chart", *words])}

    def keep(so_far: dict[str, Any]) -> None:
        if args.out is not None:
            write(so_far | command, args.out)

    say = partial(print, file=sys.stderr)
    hands = [hand_from_path(text) for text in args.hands]
    chart = scene_chart(hands, things, settings, spec, models=models, work=args.work, say=say, keep=keep) | command
    keep(chart)
    if args.publish:
        store = open_store(load_settings(data_dir=args.data_dir).resolved_store_url)
        say(f"published as {publish_record(store, scene_chart_kind(spec), chart)}")
    return chart


if __name__ == "__main__":
    main()
