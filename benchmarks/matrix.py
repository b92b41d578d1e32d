"""Hands x objects through a whole service that is killed in the middle and restarted.

    python -m benchmarks.matrix DATA --data-dir /tmp/matrix --out docs/results/matrix.md

DATA holds `hands/*/*.urdf` and `objects/*/clean.stl`. At a third of the work every process is killed with SIGKILL; then
the same two commands, `graspd up` and `graspd datasets create`, resume. The page has the result of each cell, the
repeated work, and the error of the estimate."""

from __future__ import annotations

import json
import math
import os
import platform
import signal
import subprocess
import sys
import time
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

import typer

from graspd.api.formatting import duration, size
from graspd.client.client import Client
from graspd.service.index.views import CellView, DatasetView
from graspd.service.model.cores import available_cores
from graspd.service.model.version import PACKAGE_VERSION

#: Name of each hand in the service, and its URDF.
HANDS: Final = {
    "wonik_allegro": "allegro/allegro_hand_right.urdf",
    "barrett_8dof": "barrett/bhand_model.urdf",
    "barrett_bh280": "barrett_bh280/bh280.urdf",
    "shadow_e3m5": "shadow/shadow_hand_right.urdf",
}
DATASET: Final = "matrix"
_POLL_S: Final = 2.0


@dataclass
class ExecutionContext:
    """A service that can be killed and started again."""

    folder: Path
    environment: dict[str, str]
    processes: list[int] = field(default_factory=list)
    url: str = ""
    workers: int = 1

    def up(self) -> float:
        start = time.monotonic()
        log = (self.folder / "up.log").open("ab")
        command = [
            sys.executable,
            "-m",
            "graspd",
            "up",
            "--port",
            "0",
            "--data-dir",
            str(self.folder / "data"),
            "--workers",
            str(self.workers),
            "--json",
        ]
        child = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=log, env=self.environment, text=True, start_new_session=True
        )
        assert child.stdout is not None
        told = json.loads(child.stdout.readline())
        self.url = told["api_url"]
        self.environment["GRASPD_API_URL"] = self.url
        self.processes = [child.pid, *told["processes"].values()]
        return time.monotonic() - start

    def kill(self) -> None:
        for pid in self.processes:
            os.kill(pid, signal.SIGKILL)
        os.waitpid(self.processes[0], 0)

    def stop(self) -> None:
        os.kill(self.processes[0], signal.SIGTERM)
        os.waitpid(self.processes[0], 0)

    def graspd(self, *arguments: str) -> dict[str, Any]:
        command = [sys.executable, "-m", "graspd", *arguments, "--json"]
        done = subprocess.run(command, capture_output=True, text=True, env=self.environment, check=False)
        if done.returncode:
            raise SystemExit(f"{' '.join(arguments)}: {done.stderr}")
        return json.loads(done.stdout.splitlines()[-1])

    def client(self) -> Client:
        return Client(self.url)

    def shards(self) -> dict[str, tuple[str, str]]:
        found = {}
        for file in (self.folder / "data" / "store" / "shards" / "base").glob("*.json"):
            manifest = json.loads(file.read_bytes())
            found[file.stem] = (manifest["sha256"], manifest["created"])
        return found


@dataclass
class Kept:
    """Measurements that a resumed run needs from earlier ones."""

    estimate_s: float = 0.0
    killed_at: float = 0.0
    up_again_s: float = 0.0
    seconds: float = 0.0
    shards: dict[str, tuple[str, str]] = field(default_factory=dict)
    """Shards in the store when the processes were killed."""

    @classmethod
    def load(cls, file: Path) -> Kept:
        if not file.is_file():
            return cls()
        stored = json.loads(file.read_text())
        return cls(**stored | {"shards": {name: tuple(made) for name, made in stored["shards"].items()}})

    def save(self, file: Path) -> None:
        file.write_text(json.dumps(asdict(self)))


def main(
    data: Annotated[Path, typer.Argument(help="Folder with hands/ and objects/.")],
    data_dir: Annotated[Path, typer.Option(help="Folder of the service and its log.")],
    out: Annotated[Path, typer.Option(help="Page to write.")],
    grasps: Annotated[int, typer.Option(help="Valid grasps of each cell.")] = 32,
    fidelity: Annotated[str, typer.Option(help="draft, standard or fine.")] = "standard",
    kill_at: Annotated[float, typer.Option(help="Share of the work at which all processes are killed.")] = 0.33,
    minutes: Annotated[float, typer.Option(help="Write the page after this time, even if work remains.")] = math.inf,
) -> None:
    """Run the matrix and write the page; the same command resumes work that is unfinished after `minutes`."""
    data_dir.mkdir(parents=True, exist_ok=True)
    run = ExecutionContext(data_dir, {k: v for k, v in os.environ.items() if not k.startswith("GRASPD_")})
    kept = Kept.load(data_dir / "run.json")
    end = time.monotonic() + 60 * minutes
    run.up()
    for name, urdf in HANDS.items():
        typer.echo(run.graspd("hands", "add", str(data / "hands" / urdf), "--name", name, "--no-self-test")["message"])
    create = (
        "datasets",
        "create",
        DATASET,
        "--hands",
        ",".join(HANDS),
        "--objects",
        str(data / "objects"),
        "--grasps",
        str(grasps),
        "--fidelity",
        fidelity,
        "--yes",
    )
    start = time.monotonic()
    estimate = run.graspd(*create)["estimate"]
    kept.estimate_s = kept.estimate_s or estimate["seconds"]
    if not kept.shards:
        kept.killed_at = follow(run, until=kill_at, end=end)
        run.kill()
        kept.shards = run.shards()
        kept.up_again_s = run.up()
        run.graspd(*create)
    follow(run, until=1.0, end=end)
    kept.seconds += time.monotonic() - start
    kept.save(data_dir / "run.json")
    after = run.shards()
    found, cells = run.client().dataset(DATASET), list(run.client().cells(DATASET))
    check = run.graspd("admin", "index", "rebuild", "--check", "--data-dir", str(data_dir / "data"))
    run.stop()
    facts = {
        "progress when killed": f"{100 * kept.killed_at:.0f} % of the tasks, {len(kept.shards)} shards in the store",
        "restart": f"{kept.up_again_s:.1f} s",
        "shards made again": str(sum(after.get(name) != made for name, made in kept.shards.items())),
        "differences between index and store": str(len(check["differences"])),
        "wall time": duration(kept.seconds),
        "worker time": duration(found.seconds),
        "estimate before the start": duration(kept.estimate_s),
        "size": size(found.size_bytes),
    }
    out.write_text(page(found, cells, facts, f"--grasps {grasps} --fidelity {fidelity}"))
    typer.echo(out.read_text())


def follow(run: ExecutionContext, *, until: float, end: float) -> float:
    """Wait until a share of the tasks is done, the dataset has ended, or time is up; return the share."""
    said = 0.0
    while True:
        found = run.client().dataset(DATASET)
        if found.progress - said > 0.02:
            said = found.progress
            typer.echo(f"{time.strftime('%H:%M:%S')} {100 * found.progress:.0f} % {found.valid} of {found.candidates}")
        if found.state.is_final or found.tasks_done >= until * found.tasks or time.monotonic() > end:
            return found.tasks_done / found.tasks
        time.sleep(_POLL_S)


def page(found: DatasetView, cells: list[CellView], facts: dict[str, str], options: str) -> str:
    at = {(cell.hand, cell.object): cell for cell in cells}
    lines = [
        "# Four hands, fourteen objects",
        "",
        f"`python -m benchmarks.matrix DATA --data-dir DIR --out docs/results/matrix.md {options}`",
        "",
        f"graspd {PACKAGE_VERSION}, {platform.machine()}, {available_cores()} CPU cores, {found.created[:10]}. URDFs",
        "and meshes were used unchanged, without options. At a third of the work every process was killed with",
        "SIGKILL; then the same commands resumed the work.",
        "",
        "| what | |",
        "| --- | --- |",
        *(f"| {name} | {value} |" for name, value in facts.items()),
        "",
        "Each cell: valid and wanted grasps, valid share of candidates, worker seconds per valid grasp.",
        "",
        f"| object | {' | '.join(found.hands)} |",
        "| --- " * (len(found.hands) + 1) + "|",
    ]
    lines += [f"| {obj} | {' | '.join(_cell(at[hand, obj]) for hand in found.hands)} |" for obj in found.objects]
    sums = [[cell for cell in cells if cell.hand == hand] for hand in found.hands]
    lines.append(f"| **all** | {' | '.join(_sum(of_hand) for of_hand in sums)} |")
    failed = [cell for cell in cells if cell.reason]
    lines += ["", *(f"- {cell.hand} on {cell.object} failed: {cell.reason}" for cell in failed)]
    if missing := [cell for cell in cells if not cell.state.is_final]:
        lines += ["", f"{len(missing)} of {len(cells)} cells were unfinished when this page was written."]
    return "\n".join(lines).rstrip() + "\n"


def _cell(cell: CellView) -> str:
    if cell.reason:
        return "failed"
    if not cell.grasps:
        return ""
    each = f"{cell.seconds / cell.valid:.2f} s" if cell.valid else "-"
    return f"{cell.valid}/{cell.asked}, {100 * (cell.valid_yield or 0):.0f} %, {each}"


def _sum(cells: list[CellView]) -> str:
    valid, candidates = sum(c.valid for c in cells), max(1, sum(c.candidates for c in cells))
    each = f"{sum(c.seconds for c in cells) / valid:.2f} s" if valid else "-"
    return f"{valid}/{sum(c.asked for c in cells)}, {100 * valid / candidates:.0f} %, {each}"


if __name__ == "__main__":
    typer.run(main)
