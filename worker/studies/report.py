"""A benchmark as a Markdown table, JSON and a plot."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def table(result: dict[str, Any]) -> str:
    """Markdown: runs, kernel shares, start times."""
    lines = [
        f"{result['hand']} on {result['object']}, {result['device']}, graspd {result['versions']['graspd']}, "
        f"Warp {result['versions']['warp']}",
        "",
        "| fidelity | batch | threads | hand points | faces | its | ms/it | grasps/s | spread | peak MB |",
        "| --- | --: | --: | --: | --: | --: | --: | --: | --: | --: |",
    ]
    lines += [
        f"| {r['fidelity']} | {_batches(r)} | {r['processes']} | {r['coarse_points']}, {r['hand_points']} "
        f"| {r['faces']} | {r['iterations']} | {r['ms_per_iteration']:.2f} | {r['grasps_per_second']:.1f} "
        f"| {100 * r['spread']:.0f} % | {r['peak_memory_mb']:.0f} |"
        for r in result["runs"]
    ]
    for name, phase in result["kernels"].items():
        shares = ", ".join(f"{kernel} {100 * share:.0f} %" for kernel, share in phase["share"].items() if share >= 0.01)
        lines += [
            "",
            f"{name}: {phase['points']} points, {phase['ms_per_iteration']:.2f} ms per iteration on one thread, "
            f"{phase['iterations_to_convergence']:.0f} iterations to convergence "
            f"({shares}); {phase['queries_per_second'] / 1e6:.2f} M distances/s",
        ]
    start = result["start"]
    lines += ["", f"First grasp after {start['first_grasp_s']:.2f} s, the next after {start['next_grasp_s']:.2f} s."]
    return "\n".join(lines)


def _batches(run: dict[str, Any]) -> str:
    """The batch, and how many of it were joined in one launch."""
    return str(run["batch"]) if run["join"] == 1 else f"{run['join']} × {run['batch']}"


def write(result: dict[str, Any], folder: Path) -> None:
    """bench.json, bench.md and bench.png in a folder."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "bench.json").write_text(json.dumps(result, indent=1) + "\n")
    (folder / "bench.md").write_text(table(result) + "\n")
    _plot(result, folder / "bench.png")


def _plot(result: dict[str, Any], path: Path) -> None:
    """Grasps per second over the batch, a line per fidelity and thread count."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(7, 4.2), layout="constrained")
    axes = figure.add_subplot()
    for key in dict.fromkeys((r["fidelity"], r["processes"]) for r in result["runs"]):
        runs = sorted((r for r in result["runs"] if (r["fidelity"], r["processes"]) == key), key=lambda r: r["grasps"])
        label = f"{key[0]}, {key[1]} thread{'s' if key[1] > 1 else ''}"
        axes.plot([r["grasps"] for r in runs], [r["grasps_per_second"] for r in runs], marker="o", label=label)
    batches = sorted({r["grasps"] for r in result["runs"]})
    axes.set_xscale("log", base=2)
    axes.set_xticks(batches, [str(batch) for batch in batches], minor=False)
    axes.set_xlabel("grasps per call")
    axes.set_ylabel("grasps per second")
    axes.set_ylim(bottom=0)
    axes.set_title(f"{result['hand']} on {result['object']}, {result['device']}", loc="left", fontsize=11)
    axes.grid(alpha=0.25)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(frameon=False, fontsize=8)
    figure.savefig(path, dpi=150)
