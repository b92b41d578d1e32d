"""A published set of objects x five hands through a real service with two workers, which are killed now and then.

    python -m benchmarks.object_run --work DIR --objects 100 --grasps 32 --minutes 50

Adds two published hands, checks the set, and makes the datasets of examples/objects/free.toml and table.toml in parts
of ten objects; the report split comes first. Every few minutes a worker gets SIGKILL; once, at a third of a
part, all processes do, and the same commands continue. The same command continues a run that ended early, and writes
its page."""

from __future__ import annotations

import io
import json
import math
import os
import platform
import random
import signal
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Annotated, Any, Final

import h5py
import numpy as np
import typer
from PIL import Image

import graspd
from benchmarks.gallery import HANDS
from benchmarks.matrix import ExecutionContext
from graspd.api.formatting import duration, size
from graspd.client.add_commands import upload_set
from graspd.commands.objects import kind_of
from graspd.service import user_cache
from graspd.service.index.views import CellView
from graspd.service.model.cores import available_cores
from graspd.service.model.errors import GraspdError
from graspd.service.model.planning import format_outcomes
from graspd.service.model.states import AssetKind
from graspd.service.model.version import PACKAGE_VERSION
from graspd.service.readers.files import open_shards
from graspd.service.store.published_sets import SETS, fetch_objects, fetch_wheel, read_members
from graspd.service.store.store import open_store
from graspd.worker.hands.grasp_widths import largest_width
from graspd.worker.hands.jaws import jaws_of
from graspd.worker.hands.load import load_hand
from graspd.worker.hands.model import HandModel
from graspd.worker.objects.model import ObjectModel
from graspd.worker.objects.shapes import CLASSES
from graspd.worker.planners.fitting import FIT_M, antipodal_pairs
from graspd.worker.rendering.pictures import grasp_pictures
from graspd.worker.rendering.sheets import contact_sheet
from graspd.worker.stages.assets import load_hand_files, prepared_object

SPECS: Final = Path(__file__).parents[1] / "examples" / "objects"
SCENES: Final = ("free", "table")
#: Package of the published hands, and their files.
GRIPPERS: Final = "robosuite/models/assets/grippers/"
#: Object whose rate others are compared with, and its number of grasps per hand.
MUG, MUG_GRASPS = "mug", 64
#: Objects of one dataset; a run that ends early has whole parts with all hands.
PART: Final = 10
#: Objects that are checked at once.
STAGE: Final = 100
SHOWN, WORST = 40, 10
SIZE: Final = (176, 176)
#: Candidates of which failed ones are drawn.
FAILED: Final = 64
#: Planners that are compared, and candidates of each on an object.
METHODS, PLANNED = ("fast_graspd", "autograsp", "graspit", "dfc"), 16
_POLL_S, _PATIENCE_S, _TRIES, _WAIT_S = 5.0, 900.0, 6, 20.0
#: A machine with other work may stop a worker's heartbeats for longer than the default.
_SETTINGS: Final = {"GRASPD_LEASE_S": "45", "GRASPD_STOP_GRACE_S": "60"}


@dataclass
class Kept:
    """Measurements that a continued run needs from earlier ones."""

    seconds: float = 0.0
    workers_killed: int = 0
    service_killed: int = 0
    peak_bytes: int = 0
    add_s: float = 0.0
    added: list[str] = field(default_factory=list)
    widths: dict[str, float] = field(default_factory=dict)
    repeated: dict[str, bool] = field(default_factory=dict)
    fetched: dict[str, Any] = field(default_factory=dict)

    @property
    def shapes(self) -> dict[str, Any]:
        """Accepted objects."""
        return {one["name"]: one for one in self.fetched.get("objects", ()) if one["verdict"] != "refuse"}

    @classmethod
    def load(cls, file: Path) -> Kept:
        return cls(**json.loads(file.read_text())) if file.is_file() else cls()

    def save(self, file: Path) -> None:
        file.write_text(json.dumps(asdict(self)))


def main(
    work: Annotated[Path, typer.Option(help="Folder of the service and of the run's state.")],
    out: Annotated[Path, typer.Option(help="Page to write.")] = Path("docs", "results", "objects.md"),
    name: Annotated[str, typer.Option("--set", help="Name of the published set.")] = "pybullet-random",
    objects: Annotated[int, typer.Option(help="Number of objects, drawn by the command's seed; 0: all.")] = 100,
    grasps: Annotated[int, typer.Option(help="Valid grasps of each hand, object and scene.")] = 32,
    hands: Annotated[
        str, typer.Option(help="Names of hands, comma-separated.")
    ] = "allegro,barrett,shadow,robotiq-3f,inspire",
    scenes: Annotated[str, typer.Option(help="free, table or both.")] = "free,table",
    workers: Annotated[int, typer.Option(help="Workers of the service.")] = 2,
    kill_minutes: Annotated[float, typer.Option(help="Minutes between two kills of a worker.")] = 6.0,
    compared: Annotated[int, typer.Option(help="Objects on which the first hand also uses other planners.")] = 0,
    again: Annotated[int, typer.Option(help="Finished cells that an empty service makes again.")] = 1,
    failures: Annotated[bool, typer.Option(help="Draw failed candidates of the worst cells.")] = True,
    minutes: Annotated[float, typer.Option(help="Write the page after this time, even if work remains.")] = math.inf,
) -> None:
    """Run the datasets and write the page; the same command continues."""
    work.mkdir(parents=True, exist_ok=True)
    # The service ends with the command.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    end = time.monotonic() + 60 * minutes
    environment = {k: v for k, v in os.environ.items() if not k.startswith("GRASPD_")} | _SETTINGS
    run = Service(work, environment, workers=workers)
    kept, state = Kept.load(work / "run.json"), work / "run.json"
    run.up()
    try:
        patiently(lambda: add_hands(run, hands.split(",")))
        create = Create(hands, scenes.split(","))
        follow(run, create.commands("mug", [MUG], MUG_GRASPS), kept, end=end)
        done: list[str] = []
        for number, part in enumerate(parts_of(run, kept, name, objects)):
            add_objects(run, kept, name, part)
            wanted = create.commands(f"part-{number}", part, grasps)
            follow(run, wanted, kept, end=end, kill_s=60 * kill_minutes)
            done += part
            kept.save(state)
            if time.monotonic() > end:
                break
        # Its cells are those of the parts, so nothing is made again.
        wanted = create.commands(f"objects-{len(done)}", done, grasps)
        follow(run, wanted, kept, end=end)
        found = {
            one: patiently(lambda one=one: list(run.client().cells(one)))
            for one in (*wanted, *create.commands("mug", [MUG], MUG_GRASPS))
        }
        timings = index_timings(run, list(wanted), work)
        shapes, assets = kept.shapes, Assets(run)
        sheet, failed = out.with_suffix(".webp"), out.with_name(f"{out.stem}-failures.webp")
        fits = find_fits(assets, kept, hands.split(","), done)
        kept.save(state)
        draw_sheet(run, assets, list(wanted), shapes, sheet)
        if failures:
            draw_failures(run, assets, lowest(by_scene(found)), failed)
        finished = [(scene, one) for scene, cells in by_scene(found).items() for one in cells if one.state.is_final]
        kept.repeated |= make_again(run, kept, random.Random(again).sample(finished, min(again, len(finished))))
        kept.save(state)
        others = compare(run, hands.partition(",")[0], done[:compared])
    finally:
        run.stop()
    pictures = sheet.name, failed.name if failures else ""
    command = f"--set {name} --objects {objects} --grasps {grasps} --hands {hands} --scenes {scenes}"
    command += f" --compared {compared}" * bool(compared)
    out.write_text(page(found, shapes, kept, fits, timings, others, command, pictures, work / "data"))
    typer.echo(out.read_text())


class Service(ExecutionContext):
    """A service on a machine with other work: requests are repeated."""

    def graspd(self, *arguments: str) -> dict[str, Any]:
        return patiently(lambda: ExecutionContext.graspd(self, *arguments))


def patiently(action: Callable[[], Any]) -> Any:
    """Return the result of an action, which is repeated after errors of the service."""
    for _ in range(_TRIES - 1):
        try:
            return action()
        except (GraspdError, SystemExit) as error:
            typer.echo(f"{time.strftime('%H:%M:%S')} again: {error}")
            time.sleep(_WAIT_S)
    return action()


def parts_of(run: Service, kept: Kept, name: str, objects: int) -> Iterator[list[str]]:
    """Yield parts of the drawn objects. Objects are checked in stages; the train split follows the report split."""
    every = sorted(fetch_objects(name))
    drawn = random.Random(0).sample(every, len(every))[: objects or None]
    folder = user_cache.cache_folder("sets") / f"{name}-{SETS[name].version}"
    train: list[str] = []
    for start in range(0, len(drawn), STAGE):
        stage = drawn[start : start + STAGE]
        if len(kept.fetched.get("objects", ())) < start + len(stage):
            # The command draws the same objects.
            count = str(start + len(stage))
            kept.fetched = run.graspd("objects", "fetch", name, "--to", str(folder), "--count", count)
        accepted = {one: kept.shapes[one]["shape"]["split"] for one in stage if one in kept.shapes}
        report = [one for one, split in accepted.items() if split == "report"]
        train += [one for one, split in accepted.items() if split == "train"]
        yield from (report[first : first + PART] for first in range(0, len(report), PART))
    yield from (train[first : first + PART] for first in range(0, len(train), PART))


def add_objects(run: Service, kept: Kept, name: str, part: Sequence[str]) -> None:
    """Add objects of the set that the service does not hold."""
    if not (missing := [one for one in part if one not in kept.added]):
        return
    began, folder = time.monotonic(), Path(kept.fetched["folder"])
    objects = {one: load_folder(folder / one) for one in missing}
    patiently(lambda: upload_set(run.client(), objects, f"{name}-part"))
    kept.added += missing
    kept.add_s += time.monotonic() - began


def load_folder(folder: Path) -> dict[str, bytes]:
    files = (file for file in folder.rglob("*") if file.is_file() and file.name != "check.json")
    return {file.relative_to(folder).as_posix(): file.read_bytes() for file in files}


@dataclass(frozen=True)
class Create:
    hands: str
    scenes: Sequence[str]

    def commands(self, name: str, objects: Sequence[str], grasps: int) -> dict[str, Sequence[str]]:
        """Return the command that makes a dataset of each scene, by its name."""
        return {
            f"{name}-{scene}": (
                *("datasets", "create", f"{name}-{scene}", "--spec", str(SPECS / f"{scene}.toml"), "--yes"),
                *("--hands", self.hands, "--objects", ",".join(objects), "--grasps", str(grasps)),
            )
            for scene in self.scenes
        }


def add_hands(run: Service, wanted: Sequence[str]) -> None:
    """Add the published hands among those wanted from their package."""
    known = {asset.name for asset in run.client().assets(AssetKind.HAND)}
    entries = [one for one in HANDS if one.name in wanted and one.path.startswith(GRIPPERS) and one.name not in known]
    if not entries:
        return
    package = SETS["robosuite"]
    files = read_members(fetch_wheel(package.package, package.version, package.sha256), GRIPPERS + r".+[^/]")
    for name, data in files.items():
        (file := run.folder / "hands" / name).parent.mkdir(parents=True, exist_ok=True)
        file.write_bytes(data)
    for one in entries:
        path = str(run.folder / "hands" / one.path)
        run.graspd(
            "hands", "add", path, "--name", one.name, "--licence", package.licence, "--no-self-test", "--no-wait"
        )
        typer.echo(run.client().wait_for_check(AssetKind.HAND, one.name, timeout_s=_PATIENCE_S).message)


def follow(run: Service, wanted: dict[str, Sequence[str]], kept: Kept, *, end: float, kill_s: float = math.inf) -> None:
    """Create the datasets and wait until they end or time is up; kill a worker every `kill_s`, and all at a third."""
    for command in wanted.values():
        run.graspd(*command)
    last, killed, said = time.monotonic(), time.monotonic(), -1.0
    while True:
        now = time.monotonic()
        kept.seconds, last = kept.seconds + (now - last) * math.isfinite(kill_s), now
        kept.peak_bytes = max(kept.peak_bytes, memory_bytes(run.processes[0]))
        views = patiently(lambda: [run.client().dataset(name) for name in wanted])
        done, tasks = sum(view.tasks_done for view in views), sum(view.tasks for view in views)
        if done / max(1, tasks) > said + 0.02:
            said = done / max(1, tasks)
            valid = ", ".join(f"{view.name} {view.valid} of {view.candidates}" for view in views)
            typer.echo(f"{time.strftime('%H:%M:%S')} {100 * said:.0f} % {valid}")
            kept.save(run.folder / "run.json")
        if all(view.state.is_final for view in views) or now > end:
            return
        if math.isfinite(kill_s) and said > 1 / 3 and not kept.service_killed:
            kept.service_killed += 1
            os.killpg(run.processes[0], signal.SIGKILL)
            os.waitpid(run.processes[0], 0)
            run.up()
            for command in wanted.values():
                run.graspd(*command)
        if now > killed + kill_s:
            killed = now
            workers = patiently(lambda: run.client().send("GET", "/v1/workers").json())
            busy = [one["pid"] for one in workers if one["state"] == "busy"]
            with suppress(ProcessLookupError, IndexError):
                os.kill(random.choice(busy), signal.SIGKILL)
                kept.workers_killed += 1
        time.sleep(_POLL_S)


def memory_bytes(root: int) -> int:
    """Return the proportional memory of a process and its descendants."""
    parent = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        with suppress(OSError):
            parent[int(stat.parent.name)] = int(stat.read_text().rpartition(")")[2].split()[1])
    family = {root}
    while more := {pid for pid, above in parent.items() if above in family} - family:
        family |= more
    total = 0
    for pid in family:
        with suppress(OSError):
            lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
            total += sum(1024 * int(line.split()[1]) for line in lines if line.startswith("Pss:"))
    return total


def index_timings(run: Service, datasets: Sequence[str], work: Path) -> dict[str, float]:
    """Return times of a page of grasps, of the facets of the grasps' page, and of a snapshot and a card [s]."""

    def time_of(action: Callable[[], Any], repeats: int = 5) -> float:
        times = []
        for _ in range(repeats):
            began = time.monotonic()
            action()
            times.append(time.monotonic() - began)
        return float(np.median(times))

    client, first = run.client(), datasets[0]
    found = {
        "page of 50 grasps": time_of(lambda: client.send("GET", "/v1/grasps", params={"limit": 50})),
        "dashboard page of grasps with its facets": time_of(lambda: client.send("GET", f"/grasps?dataset={first}")),
    }
    for name in datasets:
        run.graspd("datasets", "snapshot", name)
    card = ("datasets", "card", first, "--data-dir", str(work / "data"), "-o", str(work / "card"))
    found["card"] = time_of(lambda: run.graspd(*card), 1)
    return found


class Assets:
    """Prepared hands and objects of a service, by name."""

    def __init__(self, run: Service) -> None:
        self.digests = {kind: {one.name: one.digest for one in run.client().assets(kind)} for kind in AssetKind}
        self.store = open_store(f"file://{run.folder / 'data' / 'store'}", make=False)
        self.hands: dict[str, HandModel] = {}

    def hand(self, name: str) -> HandModel:
        if name not in self.hands:
            digest = self.digests[AssetKind.HAND][name]
            self.hands[name] = load_hand(load_hand_files(self.store, digest), name=name, digest=digest)
        return self.hands[name]

    def object(self, name: str) -> ObjectModel:
        return prepared_object(self.store, self.digests[AssetKind.OBJECT][name], name=name, face_error_m=3e-4)


def opening(hand: HandModel) -> float:
    """Return the largest distance of two opposed surfaces of a hand [m]."""
    jaws = jaws_of(hand)
    return largest_width(hand) if jaws is None else jaws.opening - 2 * FIT_M


def least_width(obj: ObjectModel) -> float:
    """Return the least distance of two opposite points of an object's surface [m]; inf without such points."""
    return float(antipodal_pairs(obj).width.min(initial=math.inf))


def find_fits(assets: Assets, kept: Kept, hands: Sequence[str], objects: Sequence[str]) -> set[tuple[str, str]]:
    """Return the pairs of a hand and an object that is no wider than the hand's opening."""
    kept.widths |= {one: least_width(assets.object(one)) for one in objects if one not in kept.widths}
    openings = {hand: opening(assets.hand(hand)) for hand in hands}
    return {(hand, one) for hand, most in openings.items() for one in objects if kept.widths[one] <= most}


def rejections(data: Path) -> dict[tuple[str, str, str], Counter[str]]:
    """Return the numbers of rejected candidates by outcome, for each hand, scene and object."""
    found: dict[tuple[str, str, str], Counter[str]] = defaultdict(Counter)
    for file in (data / "store" / "shards" / "base").glob("*.json"):
        manifest = json.loads(file.read_bytes())
        scene = "table" if manifest["request"].get("scene") else "free"
        outcomes = manifest["info"].get("outcomes", {})
        found[manifest["hand"], scene, manifest["object"]].update(outcomes)
    return found


def lowest(mine: dict[str, list[CellView]]) -> list[tuple[str, CellView]]:
    """Return scenes and finished cells with the lowest shares of valid candidates, the slowest first among equals."""
    cells = [(scene, one) for scene, cells in mine.items() for one in cells if one.state.is_final]
    cells.sort(key=lambda pair: (yield_of([pair[1]]), -pair[1].seconds / max(1, pair[1].valid)))
    return cells[:WORST]


def draw_failures(run: Service, assets: Assets, cells: Sequence[tuple[str, CellView]], file: Path) -> None:
    """Draw the best grasp of each cell, then failed candidates of a job that keeps them, as one sheet of WebP."""
    pictures, captions = [], []
    for scene, cell in cells:
        if cell.valid == cell.candidates:
            continue
        spec = ("--hand", cell.hand, "--object", cell.object, "-n", str(FAILED), "--want", "candidates")
        table = ("--scene", "table", "--scenes", "4") if scene == "table" else ()
        told = run.graspd("submit", *spec, *table, "--object-friction", "0.6", "--wait")
        grasps = graspd.open(f"file://{run.folder / 'data' / 'store'}", job=told["job"])
        epsilon = np.where(grasps.is_valid, np.nan_to_num(grasps.metric("epsilon"), nan=0.0), -1.0)
        rows = [int(epsilon.argmax()), *np.flatnonzero(~grasps.is_valid)[:3].tolist()]
        poses = grasps.hand_pose[rows], grasps.joint_positions[rows]
        drawn = grasp_pictures(assets.hand(cell.hand), assets.object(cell.object), *poses, SIZE, samples=8)
        pictures += list(drawn[:, 0])
        about = f"{cell.object.rpartition('-')[2]} {scene}"
        captions += [[(about, cell.hand), ("", "valid" if grasps.is_valid[row] else "failed")] for row in rows]
    if pictures:
        page = contact_sheet(
            np.array(pictures), captions, title="Best grasp of each cell, then failed candidates", columns=8
        )
        Image.open(io.BytesIO(page)).convert("RGB").save(file, quality=60, method=6)


def make_again(run: Service, kept: Kept, cells: Sequence[tuple[str, CellView]]) -> dict[str, bool]:
    """Make cells in an empty service; return whether each of its shards has the arrays of the run's shard."""
    other = Service(run.folder / "again", dict(run.environment), workers=1)
    other.folder.mkdir(exist_ok=True)
    other.up()
    try:
        for scene, cell in cells:
            add_hands(other, [cell.hand])
            files = {cell.object: load_folder(Path(kept.fetched["folder"]) / cell.object)}
            patiently(lambda files=files: upload_set(other.client(), files, "again"))
            create = Create(cell.hand, [scene])
            follow(
                other, create.commands(f"{cell.hand}-{cell.object}", [cell.object], cell.asked), Kept(), end=math.inf
            )
    finally:
        other.stop()
    found = {}
    for file in sorted((other.folder / "data" / "store" / "shards").rglob("*.h5")):
        first, second = (
            folder / "data" / file.relative_to(other.folder / "data") for folder in (run.folder, other.folder)
        )
        found[file.stem] = first.is_file() and arrays_of(first) == arrays_of(second)
    return found


def arrays_of(file: Path) -> dict[str, tuple[str, tuple[int, ...], bytes]]:
    """Return type, shape and bytes of each array of a shard."""
    found = {}
    with h5py.File(file) as shard:
        shard.visititems(lambda name, item: found.update({name: item[()]} if isinstance(item, h5py.Dataset) else {}))
    return {name: (str(array.dtype), array.shape, array.tobytes()) for name, array in found.items()}


def compare(run: Service, hand: str, objects: Sequence[str]) -> list[tuple[str, ...]]:
    """Return a row of figures of each planner on the same objects, free and at level dexgraspbench."""
    rows = []
    for method in METHODS if objects else ():
        jobs: list[dict[str, Any]] = []
        # All jobs wait in the queue before the first result is awaited.
        for wait in ((), ("--wait",)):
            jobs = [run.graspd("submit", *job_of(hand, one, method), *wait) for one in objects]
        made, valid = (sum(job[key] for job in jobs) for key in ("grasps", "valid"))
        spent = sum(job["stages"]["synthesize"]["seconds"] for job in jobs)
        any_valid = np.mean([job["valid"] > 0 for job in jobs])
        share = f"{valid / max(1, made):.3f}"
        rows.append((method, str(len(jobs)), str(made), share, f"{any_valid:.2f}", f"{spent / max(1, valid):.2f}"))
    return rows


def job_of(hand: str, obj: str, method: str) -> tuple[str, ...]:
    """Return options of a job that keeps all candidates."""
    terms = ("--want", "candidates", "--validation", "dexgraspbench")
    return ("--hand", hand, "--object", obj, "--method", method, "-n", str(PLANNED), *terms)


def draw_sheet(run: Service, assets: Assets, datasets: Sequence[str], shapes: dict[str, Any], file: Path) -> None:
    """Draw random report objects, each with its best valid grasp by epsilon, as one sheet of WebP; hands take turns."""
    url = f"file://{run.folder / 'data' / 'store'}"
    held: dict[str, dict[str, tuple[float, Any, Any]]] = defaultdict(dict)
    for dataset in datasets:
        for hand in sorted({one.hand for one in open_shards(url, dataset=dataset).of_kind("base")}):
            grasps = graspd.open(url, dataset=dataset, hand=hand)
            epsilon = np.where(grasps.is_valid, np.nan_to_num(grasps.metric("epsilon"), nan=0.0), -1.0)
            for name in np.unique(grasps.columns["object"]):
                best = int(np.where(grasps.columns["object"] == name, epsilon, -2.0).argmax())
                if epsilon[best] > held[str(name)].get(hand, (-1.0,))[0]:
                    pose = (grasps.hand_pose[best], grasps.joint_positions[best])
                    held[str(name)][hand] = (float(epsilon[best]), *pose)
    report = [name for name in sorted(held) if held[name] and shapes[name]["shape"]["split"] == "report"]
    drawn = sorted(random.Random(0).sample(report, min(SHOWN, len(report))))
    pictures, captions = [], []
    for number, name in enumerate(drawn):
        hand = sorted(held[name])[number % len(held[name])]
        _, pose, joints = held[name][hand]
        pictures.append(
            grasp_pictures(assets.hand(hand), assets.object(name), pose[None], joints[None], SIZE, samples=8)[0, 0]
        )
        captions.append([(name.rpartition("-")[2], shapes[name]["shape"]["class"]), ("", hand)])
    if pictures:
        page = contact_sheet(np.array(pictures), captions, title="Report objects, best valid grasps", columns=8)
        Image.open(io.BytesIO(page)).convert("RGB").save(file, quality=60, method=6)


def by_scene(found: dict[str, list[CellView]], prefix: str = "objects-") -> dict[str, list[CellView]]:
    return {name.rpartition("-")[2]: cells for name, cells in found.items() if name.startswith(prefix)}


def page(
    found: dict[str, list[CellView]],
    shapes: dict[str, Any],
    kept: Kept,
    fits: set[tuple[str, str]],
    timings: dict[str, float],
    others: list[tuple[str, ...]],
    command: str,
    pictures: tuple[str, str],
    data: Path,
) -> str:
    (sheet, failed), mine = pictures, by_scene(found)
    mug = by_scene(found, "mug-")
    every = [cell for cells in mine.values() for cell in cells]
    valid, spent = sum(cell.valid for cell in every), sum(cell.seconds for cell in every)
    times, rejected = kept.fetched["check_s"], rejections(data)
    report = {name for name, one in shapes.items() if one["shape"]["split"] == "report"}
    whole = {one.object for one in every} - {one.object for one in every if not one.state.is_final}
    rate, of_mug = valid / max(spent, 1e-9), mug_rate(mine, mug)
    facts = {
        "objects accepted": f"{kept.fetched['accepted']} of {len(kept.fetched['objects'])}",
        "report objects, of those checked": f"{len(report)}",
        "finished with all hands and scenes": f"{len(whole & report)} report, {len(whole - report)} train objects",
        "CPU time of a check": f"p50 {times['p50']} s, p99 {times['p99']} s, largest {times['largest']:.2f} s",
        "addition to the service": f"{duration(kept.add_s)} for {len(kept.added)} objects",
        "valid grasps": f"{valid:,} of {sum(cell.candidates for cell in every):,} candidates",
        "wall time": duration(kept.seconds),
        "load of the machine at the end, of all programs": f"{os.getloadavg()[2]:.0f} on {available_cores()} cores",
        "worker time": duration(spent),
        "valid grasps per worker second": f"{rate:.2f}, {rate / of_mug:.0%} of the mug's {of_mug:.2f}"
        if of_mug
        else f"{rate:.2f}",
        "workers killed": f"{kept.workers_killed}, and {kept.service_killed} time all processes",
        "failed attempts, each repeated": str(sum(cell.attempts_failed for cell in every)),
        "shards made again in an empty service": f"{sum(kept.repeated.values())} of {len(kept.repeated)} bit-identical",
        "unfinished cells": f"{sum(not cell.state.is_final for cell in every)} of {len(every)}",
        "peak memory of all processes": size(kept.peak_bytes),
        "disk: shards; all data": f"{size(folder_bytes(data / 'store' / 'shards'))}; {size(folder_bytes(data))}",
        **{f"index: {name}": f"{seconds:.2f} s" for name, seconds in timings.items()},
    }
    lines = [
        "# A set of objects",
        "",
        f"`python -m benchmarks.object_run --work DIR {command}`",
        "",
        f"graspd {PACKAGE_VERSION}, {platform.machine()}, {available_cores()} CPU cores, {time.strftime('%Y-%m-%d')}. "
        "Specs: [free](../../examples/objects/free.toml), [table](../../examples/objects/table.toml).",
        "",
        *table(("what", ""), facts.items()),
        "",
        f"![Report objects with their best grasps]({sheet})",
        "",
        "## Hands",
        "",
        "*Fit*: objects with two opposite surface points (normals within 20° of their line) no further apart than the "
        "widest gap of the hand's opposed pads, times 1.06, plus 6 mm; for grippers, their opening less 2 mm. *1*, "
        "*all*: share of these with at least one, and with all requested valid grasps. *Worst tenth*: mean share of "
        "valid candidates over the tenth of objects with the lowest. *Time*: worker seconds per valid grasp, and in "
        "brackets for the mug. Only finished cells count.",
        "",
        *table(
            (
                "hand",
                "scene",
                "split",
                "objects",
                "fit",
                "valid / candidates",
                "yield",
                "1",
                "all",
                "worst tenth",
                "time",
            ),
            (
                (
                    hand,
                    scene,
                    split,
                    *figures(chosen, fits),
                    cost(chosen, [one for one in mug[scene] if one.hand == hand]),
                )
                for scene, cells in mine.items()
                for hand in dict.fromkeys(one.hand for one in cells)
                for split in ("train", "report")
                if (chosen := ended(cells, shapes, hand=hand, split=split))
            ),
        ),
        "",
        "## Shape classes",
        "",
        *table(
            ("class", "scene", "cells", "fit", "valid / candidates", "yield", "1", "all", "worst tenth"),
            (
                (kind, scene, *figures(chosen, fits))
                for kind in CLASSES
                for scene, cells in mine.items()
                if (chosen := ended(cells, shapes, **{"class": kind}))
            ),
        ),
        "",
        *planners_section(others, next(iter(every)).hand if every else ""),
        "## Refusals and repairs",
        "",
        *table(
            ("objects", ""),
            [
                *((str(n), f"refused: {kind}") for kind, n in kept.fetched["refused"].items()),
                *((str(n), kind) for kind, n in sorted(kept.fetched["repairs"].items(), key=lambda item: -item[1])),
            ],
        ),
        "",
        "## Shortfalls",
        "",
        *table(
            ("cells", "reason"),
            [(str(n), kind) for kind, n in Counter(kind_of(one.reason) for one in every if one.reason).most_common(12)],
        ),
        "",
        "## Failures",
        "",
        "Outcomes of rejected candidates. *Repeated attempts* are further starts of the planner in scenes.",
        "",
        *table(
            ("hand", "scene", "outcomes"),
            (
                (hand, scene, format_outcomes(lost) or "none")
                for scene, cells in mine.items()
                for hand in dict.fromkeys(one.hand for one in cells)
                if (lost := sum((rejected[hand, scene, one.object] for one in cells if one.hand == hand), Counter()))
            ),
        ),
        "",
        f"The {WORST} cells with the lowest share of valid candidates:",
        "",
        *([f"![Best grasp and failed candidates of these cells]({failed})", ""] if failed else []),
        *table(
            (
                *("object", "class", "split", "sides [mm]", "hand", "scene"),
                "valid / candidates",
                "time [s]",
                "outcomes",
            ),
            (failure(scene, one, shapes, rejected[one.hand, scene, one.object]) for scene, one in lowest(mine)),
        ),
    ]
    return "\n".join(lines) + "\n"


def ended(cells: Iterable[CellView], shapes: dict[str, Any], hand: str = "", **wanted: str) -> list[CellView]:
    """Return the finished cells of a hand, if given, whose objects have the wanted facts of shape."""
    finished = (one for one in cells if one.state.is_final and one.hand == (hand or one.hand))
    return [one for one in finished if wanted.items() <= {**shapes[one.object]["shape"], "sides_m": 0}.items()]


def yield_of(cells: Sequence[CellView]) -> float:
    return sum(one.valid for one in cells) / max(1, sum(one.candidates for one in cells))


def figures(cells: Sequence[CellView], fits: set[tuple[str, str]]) -> tuple[str, ...]:
    """Return numbers of cells, of those whose object fits, and of grasps; yield; shares of cells whose object fits
    with one and all grasps; yield of the worst tenth."""
    shares = sorted(one.valid / max(1, one.candidates) for one in cells)
    fitting = [one for one in cells if (one.hand, one.object) in fits]
    return (
        str(len(cells)),
        str(len(fitting)),
        f"{sum(one.valid for one in cells)} / {sum(one.candidates for one in cells)}",
        f"{yield_of(cells):.3f}",
        f"{np.mean([one.valid >= 1 for one in fitting]):.3f}" if fitting else "",
        f"{np.mean([one.valid >= one.asked for one in fitting]):.3f}" if fitting else "",
        f"{np.mean(shares[: -(-len(shares) // 10)]):.2f}",
    )


def cost(cells: Sequence[CellView], mug: Sequence[CellView]) -> str:
    each = [sum(one.seconds for one in some) / max(1, sum(one.valid for one in some)) for some in (cells, mug)]
    return f"{each[0]:.2f} ({each[1]:.2f})"


def mug_rate(mine: dict[str, list[CellView]], mug: dict[str, list[CellView]]) -> float:
    """Return the mug's valid grasps per worker second, for the same numbers of grasps of each hand and scene."""
    grasps = seconds = 0.0
    for scene, cells in mug.items():
        for one in cells:
            number = sum(other.valid for other in mine[scene] if other.hand == one.hand)
            if one.valid:
                grasps, seconds = grasps + number, seconds + number * one.seconds / one.valid
    return grasps / seconds if seconds else 0.0


def planners_section(rows: Sequence[tuple[str, ...]], hand: str) -> list[str]:
    if not rows:
        return []
    return [
        "## Planners",
        "",
        f"{hand}, free candidates at level `dexgraspbench`, all with graspd's pregrasp and squeeze. Other planners are "
        "graspd's implementations of the published ones, with their default options. *Time*: worker seconds per valid "
        "grasp, validation included.",
        "",
        *table(("planner", "objects", "candidates", "GSR", "OSR", "time"), rows),
        "",
    ]


def failure(scene: str, cell: CellView, shapes: dict[str, Any], lost: Counter[str]) -> tuple[str, ...]:
    """Return a row of the table of the cells with the lowest yield."""
    facts = shapes[cell.object]["shape"]
    sides = " x ".join(f"{1e3 * side:.0f}" for side in facts["sides_m"])
    time_s = f"{cell.seconds / max(1, cell.valid):.2f}"
    about = (cell.object, facts["class"], facts["split"], sides, cell.hand, scene)
    return (*about, f"{cell.valid} / {cell.candidates}", time_s, format_outcomes(lost) or (cell.reason or ""))


def table(names: Sequence[str], rows: Iterable[Sequence[str]]) -> list[str]:
    return [f"| {' | '.join(row)} |" for row in (names, ["---"] * len(names), *rows)]


def folder_bytes(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


if __name__ == "__main__":
    typer.run(main)
