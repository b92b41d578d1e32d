"""Rendering benchmark: images per second; time shares of tracing, shading, annotation, compression and writing."""

from __future__ import annotations

import io
import statistics
import tempfile
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final, NamedTuple

import h5py
import numpy as np
from numpy.typing import NDArray

from graspd.service.model.domain import EXTRA_CHANNELS
from graspd.service.store.shards import write_shard
from graspd.studies.bench import clock_of
from graspd.worker.execution_context import ExecutionContext
from graspd.worker.objects.model import ObjectModel
from graspd.worker.rendering.scene_setup import CameraPlan, Setting
from graspd.worker.rendering.views import SAMPLES, Extras, render
from graspd.worker.scenes.simulate import drop

SCENES: Final = 2
VIEWS: Final = 4
#: Storage options of pictures; the first is that of `service.store.shards`.
COMPRESSIONS: Final[dict[str, dict[str, Any]]] = {
    "gzip 1 + shuffle": {"compression": "gzip", "compression_opts": 1, "shuffle": True},
    "lzf + shuffle": {"compression": "lzf", "shuffle": True},
    "none": {},
}


class Timing(NamedTuple):
    """Seconds of repeated runs: core-seconds on a CPU (nearly independent of other load), else wall clock."""

    median: float
    spread: float
    """Half the difference between the fastest and the slowest run, as a share of the median."""


Timer = Callable[[Callable[[], object]], Timing]


def bench_render(obj: ObjectModel, *, width: int, height: int, device: str, repeats: int = 3) -> dict[str, Any]:
    """Measure `SCENES * VIEWS` pictures of an object with all channels, on one core or one GPU.

    Returns:
        `images`, `images_per_second` (rendered, annotated, compressed and written), `rendered_per_second` (in memory),
        `bare_per_second` (the ray tracer alone with the same rays), their ratio `of_bare`, `share` of each part,
        `spread` of the repeats, and `compression` (bytes and seconds of each storage option).
    """
    poses = drop(obj, count=SCENES, seed=0)["scene/object_pose"]
    setting = Setting([obj], poses[:, None], CameraPlan(VIEWS, width, height, None), seed=0, samples=SAMPLES)
    bare_shot = replace(setting.shot, shaded=False)
    extras = Extras(channels=EXTRA_CHANNELS)

    def whole() -> dict[str, NDArray[np.generic]]:
        size: dict[str, Any] = {"views": VIEWS, "stereo": False, "width": width, "height": height}
        return render(obj, poses, seed=0, extras=extras, run=ExecutionContext(device, 1), **size)

    arrays = whole()
    timer = partial(_timed, clock=clock_of(device), repeats=repeats)
    stage = setting.stage(device)
    bare = timer(lambda: stage.shoot(bare_shot, ExecutionContext(device, 1)))
    plain = timer(lambda: setting.shoot(ExecutionContext(device, 1)))
    rendered = timer(whole)
    packed = timer(lambda: write_shard("views", arrays, {}))
    stored = {name: _store(arrays, options, timer) for name, options in COMPRESSIONS.items()}
    with tempfile.TemporaryDirectory(prefix="graspd-bench-") as folder:
        data, path = write_shard("views", arrays, {}), Path(folder) / "views.h5"
        written = timer(lambda: path.write_bytes(data))
    total = rendered.median + packed.median + written.median
    count = len(arrays["image/rgb"])
    loose = min(stored["none"]["seconds"], packed.median)
    parts = {
        "ray tracing": min(bare.median, plain.median),
        "shading": max(0.0, plain.median - bare.median),
        "annotation": max(0.0, rendered.median - plain.median),
        "compression": packed.median - loose,
        "write": loose + written.median,
    }
    return {
        "object": obj.name,
        "faces": len(obj.faces),
        "width": width,
        "height": height,
        "device": device,
        "images": count,
        "samples": SAMPLES,
        "images_per_second": count / total,
        "rendered_per_second": count / rendered.median,
        "bare_per_second": count / bare.median,
        "of_bare": bare.median / rendered.median,
        "share": {name: seconds / sum(parts.values()) for name, seconds in parts.items()},
        "spread": {"bare": bare.spread, "rendered": rendered.spread, "packed": packed.spread},
        "compression": stored,
    }


def _timed(run: Callable[[], object], *, clock: Callable[[], float], repeats: int) -> Timing:
    run()  # to warm up
    seconds = []
    for _ in range(repeats):
        started = clock()
        run()
        seconds.append(clock() - started)
    median = statistics.median(seconds)
    return Timing(median, 0.5 * (max(seconds) - min(seconds)) / median if median else 0.0)


def _store(arrays: Mapping[str, NDArray[np.generic]], options: dict[str, Any], timer: Timer) -> dict[str, float]:
    """Return bytes and seconds of writing and reading a shard's pictures with one storage option."""
    pictures = {path: array for path, array in arrays.items() if path.startswith("image/")}

    def write() -> bytes:
        buffer = io.BytesIO()
        with h5py.File(buffer, "w", libver="v110") as file:
            for path, array in pictures.items():
                file.create_dataset(path, data=array, track_times=False, **options)
        return buffer.getvalue()

    def read(data: bytes) -> None:
        with h5py.File(io.BytesIO(data), "r") as file:
            for path in pictures:
                np.asarray(file[path])

    data = write()
    return {
        "bytes": len(data) / len(pictures["image/rgb"]),
        "seconds": timer(write).median,
        "read_seconds": timer(lambda: read(data)).median,
    }


def tables(results: list[dict[str, Any]]) -> str:
    """Return the figures as two Markdown tables."""
    unit = "core-second" if results[0]["device"] == "cpu" else "second"
    names = list(results[0]["share"])
    lines = [
        f"| picture | all in all, images per {unit} | rendered | bare ray tracer | of bare | {' | '.join(names)} |",
        "| --- " * (5 + len(names)) + "|",
    ]
    for r in results:
        shares = " | ".join(f"{100 * r['share'][name]:.0f} %" for name in names)
        lines.append(
            f"| {r['width']} x {r['height']} | {r['images_per_second']:.2f} | {r['rendered_per_second']:.2f} "
            f"(± {100 * r['spread']['rendered']:.0f} %) | {r['bare_per_second']:.2f} "
            f"(± {100 * r['spread']['bare']:.0f} %) | {r['of_bare']:.2f} | {shares} |"
        )
    lines += ["", "| picture | stored as | kB per view | write, ms | read, ms |", "| --- " * 5 + "|"]
    for r in results:
        for name, s in r["compression"].items():
            write, read = (1e3 * s[key] / r["images"] for key in ("seconds", "read_seconds"))
            lines.append(
                f"| {r['width']} x {r['height']} | {name} | {s['bytes'] / 1e3:.0f} | {write:.1f} | {read:.1f} |"
            )
    return "\n".join(lines)
