"""Measure cost and benefit of fast_graspd's settings: each setting in turn has other values than the default.

usage: python -m benchmarks.sweeps --out DIR [--hand HAND] [--object MESH] [--only SETTING ...] [--quick]
DIR receives sweeps.json, sweeps.md and sweeps.png. The full run takes minutes on two cores, the quick run seconds.
"""

from __future__ import annotations

import argparse
import shlex
import sys
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import warp as wp

from benchmarks.sweeps.report import write
from benchmarks.sweeps.settings import sweep_settings
from graspd.service.model.clock import timestamp
from graspd.service.model.version import PACKAGE_VERSION
from graspd.studies.bench import device_name
from graspd.studies.chart.chart import ChartObject
from graspd.worker.engines.devices import Device
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.hands.load import hand_from_path
from graspd.worker.objects.prepare import object_from_path, object_name


def main(arguments: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder for the results")
    parser.add_argument("--hand", default="allegro", help="URDF or built-in hand")
    parser.add_argument("--object", default="mug", help="mesh or built-in object")
    parser.add_argument("--batch", type=int, default=32, help="grasps per call")
    parser.add_argument("--repeats", type=int, default=2, help="calls per value")
    parser.add_argument("--only", nargs="+", default=(), metavar="SETTING", help="settings, such as 'contact solver'")
    parser.add_argument("--quick", action="store_true", help="four values of two settings, four grasps each")
    args = parser.parse_args(arguments)
    if args.quick:
        args.batch, args.repeats = 4, 1
    run = ExecutionContext(Device("auto").resolve())
    rows = sweep_settings(
        hand_from_path(args.hand),
        ChartObject(object_name(Path(args.object)), lambda error: object_from_path(args.object, face_error_m=error)),
        batch=args.batch,
        repeats=args.repeats,
        quick=args.quick,
        run=run,
        knobs=args.only,
        say=partial(print, file=sys.stderr),
    )
    words = sys.argv[1:] if arguments is None else arguments
    sweep = {
        "created": timestamp(),
        "command": shlex.join(["python", "-m", "benchmarks.sweeps", *words]),
        "device": device_name(run.device),
        "threads": run.cores,
        "versions": {"graspd": PACKAGE_VERSION, "warp": wp.config.version},
        "rows": rows,
    }
    write(sweep, args.out)


if __name__ == "__main__":
    main()
