"""Command line: `graspd bench`, `graspd stability`, `graspd chart` and `graspd studies`."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from itertools import product
from json import dumps, loads
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Annotated, Any, Final

import typer

from graspd.service.cli import CommandGroup, JsonFlag, load_settings, print_result
from graspd.service.model.clock import timestamp
from graspd.service.model.cores import available_cores
from graspd.service.model.engines import ENGINES
from graspd.service.model.errors import InputError, choices_text
from graspd.service.model.fidelity import FIDELITIES, OFFERED
from graspd.service.model.metrics import ROBUST_MODELS
from graspd.service.model.renamed import convert_chart
from graspd.service.model.studies import Stability, parse_stability
from graspd.service.model.version import PACKAGE_VERSION
from graspd.service.store.records import CHARTS, STABILITY, publish_record
from graspd.service.store.store import open_store
from graspd.worker.engines.devices import Device
from graspd.worker.execution_context import ExecutionContext

app = CommandGroup()


@app.command(epilog="graspd bench --hand allegro --object mug --batch 1 --batch 32 --out bench")
def bench(
    hand: Annotated[str, typer.Option(help="URDF, ZIP with a URDF, or built-in hand.")] = "allegro",
    object_: Annotated[str, typer.Option("--object", help="Mesh or built-in object.")] = "mug",
    fidelity: Annotated[list[str] | None, typer.Option(help="Fidelity; repeatable. Default: all.")] = None,
    batch: Annotated[list[int] | None, typer.Option(min=1, help="Grasps per call; repeatable.")] = None,
    join: Annotated[list[int] | None, typer.Option(min=1, help="Batches per launch; repeatable.")] = None,
    threads: Annotated[list[int] | None, typer.Option(min=1, help="CPU threads; repeatable.")] = None,
    device: Annotated[str, typer.Option(help="Device: cpu, cuda:0 or auto.")] = "auto",
    repeats: Annotated[int, typer.Option(min=1, help="Timed calls per run, of which the median is reported.")] = 3,
    out: Annotated[Path | None, typer.Option(help="Folder for bench.json and bench.md.")] = None,
    json: JsonFlag = False,
) -> None:
    """Measure grasps per second of the planner, without quality metrics, and the time of each step."""
    from graspd.studies.bench import bench as measure
    from graspd.studies.bench import results_table, write
    from graspd.worker.hands.load import hand_from_path
    from graspd.worker.objects.prepare import object_from_path

    resolved = Device(device).resolve()
    result = measure(
        hand_from_path(hand),
        lambda error: object_from_path(object_, face_error_m=error),
        fidelities=[FIDELITIES[name] for name in _check_fidelities(fidelity or OFFERED)],
        batches=batch or [1, 8, 32, 256],
        threads=threads or ([1] if resolved != "cpu" else sorted({1, available_cores()})),
        device=resolved,
        repeats=repeats,
        joins=join or [1],
        say=_echo,
    )
    if out is not None:
        write(result, out)
    print_result(result, results_table(result), json=json)


def _check_fidelities(fidelities: Sequence[str]) -> list[str]:
    for name in fidelities:
        if name not in FIDELITIES:
            raise InputError(f"unknown fidelity {name!r}; choose one of {choices_text(name, FIDELITIES)}")
    return list(fidelities)


STUDIES: Final = ("shapes", "baselines")


@app.command(epilog="graspd stability --only shapes --out stability --publish")
def stability(
    only: Annotated[list[str] | None, typer.Option(help=f"Study: {', '.join(STUDIES)}; repeatable.")] = None,
    hand: Annotated[str, typer.Option(help="URDF or built-in hand.")] = "allegro",
    quick: Annotated[bool, typer.Option("--quick", help="Few cells per map: under a minute of CPU time.")] = False,
    threads: Annotated[int, typer.Option(help="CPU threads; 0: one per core.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Folder for stability.json, stability.md and the maps.")] = None,
    source: Annotated[
        list[Path] | None, typer.Option("--from", help="Use a stability.json instead of measuring; repeatable.")
    ] = None,
    publish: Annotated[bool, typer.Option("--publish", help="Publish to the store, for the dashboard.")] = False,
    data_dir: Annotated[Path | None, typer.Option(help="Data folder of graspd; default: GRASPD_DATA_DIR.")] = None,
    json: JsonFlag = False,
) -> None:
    """Map where planners fail: difficult shapes, for fast_graspd and for the baselines."""
    from graspd.studies.stability.report import markdown, write

    if unknown := [name for name in only or [] if name not in STUDIES]:
        raise InputError(f"there is no study {unknown[0]!r}; choose one of {choices_text(unknown[0], STUDIES)}")
    if source:
        found = _merge([_read_record(path, "stability", parse_stability) for path in source])
        found = replace(found, maps=[one for one in found.maps if not only or one.name in only])
    else:
        found = _measure_maps(tuple(only or STUDIES), hand, quick=quick, threads=threads)
    if out is not None:
        write(found, out)
    key = _publish(STABILITY, found.as_json(), data_dir) if publish else None
    good = {one.name: {panel: one.good_share(panel) for panel in one.panels} for one in found.maps}
    still = {one.name: one.broken_cell_lines() for one in found.maps}
    told = {"good": good, "still_breaks": still, "out": None if out is None else str(out), "published": key}
    print_result(told, markdown(found), json=json)


def _measure_maps(names: tuple[str, ...], hand: str, *, quick: bool, threads: int) -> Stability:
    from graspd.worker.engines import backend

    backend.start_warp()
    import warp as wp

    from graspd.studies.stability.shapes import run_studies

    maps = run_studies(names, hand, quick=quick, work=ExecutionContext(threads=threads), say=_echo)
    return Stability(timestamp(), _command_line(), {"graspd": PACKAGE_VERSION, "warp": wp.__version__}, maps)


def _read_record(path: Path, kind: str, parse: Callable[[Any], Any]) -> Any:
    """Parse a JSON file of `graspd KIND --out`; raise InputError for any other file."""
    try:
        return parse(loads(path.read_text()))
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    except (TypeError, ValueError, RecursionError):
        raise InputError(f"{path} is no {kind}.json; `graspd {kind} --out FOLDER` writes one") from None


def _merge(parts: list[Stability]) -> Stability:
    """Merge several runs; a later map replaces an earlier map of the same name."""
    maps = {one.name: one for part in parts for one in part.maps}
    commands = "; ".join(dict.fromkeys(part.command for part in parts))
    return replace(parts[-1], command=commands, maps=list(maps.values()))


def _publish(kind: str, document: dict[str, Any], data_dir: Path | None) -> str:
    key = publish_record(open_store(load_settings(data_dir=data_dir).resolved_store_url), kind, document)
    _echo(f"published as {key}")
    return key


def _echo(line: str) -> None:
    typer.echo(line, err=True)


several = CommandGroup(help="Studies of grasps and engines.")
app.add_typer(several, name="studies")


@several.command(epilog="graspd studies engines --hands allegro,barrett --objects mug,bottle --out engines")
def engines(
    files: Annotated[list[Path] | None, typer.Argument(help="Grasp files; none: candidates are planned.")] = None,
    names: Annotated[str, typer.Option("--engines", help="Engines, separated by commas.")] = ",".join(ENGINES),
    hands: Annotated[str, typer.Option(help="Hand files or built-in hands, separated by commas.")] = "allegro,barrett",
    objects: Annotated[str, typer.Option(help="Meshes or built-in objects, separated by commas.")] = "mug,bottle",
    scenes: Annotated[str, typer.Option(help="Scenes, separated by commas.")] = "free,table",
    grasps: Annotated[int, typer.Option("--grasps", "-n", min=1, help="Candidates per hand, object, scene.")] = 16,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the candidates.")] = 0,
    threads: Annotated[int, typer.Option(min=0, help="CPU threads; 0: one per core.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Folder for engines.json, engines.md and the candidates.")] = None,
    json: JsonFlag = False,
) -> None:
    """Compare the verdicts of engines on the same grasps, at full and at half friction."""
    from graspd.exchange.inputs import expand_path, load_case
    from graspd.studies.engines import Found, compare_frictions, matrix_lines, plan_candidates, summarise_groups
    from graspd.worker.validation.engines.registry import check_engines

    chosen, found = check_engines(_parts(names)), Found()
    with TemporaryDirectory() as work:
        folder = out or Path(work)
        folder.mkdir(parents=True, exist_ok=True)
        listed = [one for path in files or [] for one in expand_path(path)]
        for hand, obj, scene in product(_parts(hands), _parts(objects), _parts(scenes)) if not files else ():
            file = folder / f"{Path(hand).stem}-{Path(obj).stem}-{Path(scene).stem}.h5"
            _echo(file.stem)
            try:
                listed.append(plan_candidates(hand, obj, scene, grasps, seed, file, threads=threads))
            except InputError as error:
                _echo(f"{file.stem}: {error}")
        for file in listed:
            case = load_case(file)
            place = file.stem.rpartition("-")[2] if not files else "free" if case.placed is None else "scene"
            for friction, verdicts in compare_frictions(case, chosen, threads=threads).items():
                found.setdefault((case.hand.name, place, friction), []).append(verdicts)
    if not found:
        raise InputError("no candidates: the hands cannot grasp these objects")
    rows = summarise_groups(found)
    said = [dict(zip(("hand", "scene", "friction"), key, strict=True)) | row for key, row in rows.items()]
    lines = "\n".join(matrix_lines(rows))
    if out is not None:
        (out / "engines.json").write_text(dumps(said, indent=1))
        (out / "engines.md").write_text(f"{lines}\n")
    print_result({"rows": said}, lines, json=json)


PEERS = ("fast_graspd", "graspit", "graspd2022", "dfc", "autograsp")


@app.command(epilog="graspd chart --methods fast_graspd,autograsp --hands allegro --objects mug,bottle --out chart")
def chart(
    methods: Annotated[
        str, typer.Option(help="Planners, separated by commas; also as NAME:OPTION=VALUE@GRASPS_PER_CALL.")
    ] = ",".join(PEERS),
    hands: Annotated[str, typer.Option(help="URDFs or built-in hands, separated by commas.")] = "allegro,barrett",
    objects: Annotated[str, typer.Option(help="Meshes or built-in objects, separated by commas.")] = "mug,bottle",
    fidelities: Annotated[str, typer.Option(help="Fidelities, separated by commas.")] = ",".join(OFFERED),
    batch: Annotated[str, typer.Option(help="Grasps per call: one or several numbers, separated by commas.")] = "32",
    baseline_batch: Annotated[int, typer.Option(min=1, help="Grasps per call of methods with a budget of steps.")] = 8,
    repeats: Annotated[int, typer.Option(min=1, help="Timed calls per setting, hand and object.")] = 2,
    option: Annotated[
        list[str] | None, typer.Option(help="Option of a method, METHOD:NAME=VALUE: graspit:steps=40000; repeatable.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Small run: seconds instead of an hour.")] = False,
    threads: Annotated[int, typer.Option(min=0, help="CPU threads; 0: one per core.")] = 0,
    device: Annotated[str, typer.Option(help="Device: cpu, cuda:0 or auto.")] = "auto",
    out: Annotated[Path | None, typer.Option(help="Folder for chart.json, .csv, .md, .png and .svg.")] = None,
    remark: Annotated[str, typer.Option(help="Note on the conditions, for the report.")] = "",
    source: Annotated[Path | None, typer.Option("--from", help="Use a chart.json instead of measuring.")] = None,
    publish: Annotated[bool, typer.Option("--publish", help="Publish to the store, for `fidelity: auto`.")] = False,
    data_dir: Annotated[Path | None, typer.Option(help="Data folder of graspd; default: GRASPD_DATA_DIR.")] = None,
    json: JsonFlag = False,
) -> None:
    """Compare methods and fidelities on the same hands and objects: speed, and accuracy in MuJoCo."""
    from graspd.studies.chart.chart import measure_chart, settings_of
    from graspd.studies.chart.report import write
    from graspd.worker.hands.load import hand_from_path

    if source is not None:
        _write_chart(_read_chart(source), out, data_dir, publish=publish, json=json)
        return
    on = ExecutionContext(Device(device).resolve(), threads)
    batches, models_around = [_parse_batch(part) for part in _parts(batch)], ROBUST_MODELS
    if quick:
        hands, objects, fidelities = (_parts(text)[0] for text in (hands, objects, fidelities))
        batches, baseline_batch, repeats, models_around = [4], 2, 1, 2
    levels = _check_fidelities(_parts(fidelities))
    sizes: dict[str, Any] = {"batches": batches, "baseline_batch": baseline_batch}
    chosen = settings_of(_parts(methods), levels, options=option or [], quick=quick, run=on, **sizes)
    models, things = [hand_from_path(part) for part in _parts(hands)], _chart_objects(_parts(objects))
    said = {"command": _command_line(), "remark": remark}

    def save_partial(so_far: dict[str, Any]) -> None:
        if out is not None:
            write(so_far | said, out)

    result = measure_chart(models, things, chosen, repeats=repeats, models=models_around, say=_echo, keep=save_partial)
    _write_chart(result | said, out, data_dir, publish=publish, json=json)


def _write_chart(result: dict[str, Any], out: Path | None, data_dir: Path | None, *, publish: bool, json: bool) -> None:
    from graspd.studies.chart.report import markdown, write

    if out is not None:
        write(result, out)
    if publish:
        _publish(CHARTS, result, data_dir)
    print_result(result, markdown(result), json=json)


def _read_chart(path: Path) -> dict[str, Any]:
    found: dict[str, Any] = _read_record(path, "chart", lambda document: dict(convert_chart(document)))
    if "scene" in found:
        raise InputError(f"{path} is a chart of scenes; benchmarks.scenes_chart writes and publishes those")
    if missing := [key for key in ("created", "runs", "summary", "by_hand", "models") if key not in found]:
        raise InputError(f"{path} is no chart.json of this version: it has no {missing[0]}; measure again")
    return found


def _command_line() -> str:
    """Return the command without local folders, because they differ between machines."""

    def shorten_path(part: str) -> str:
        if "/data/" in part:
            return "DATA/" + part.split("/data/", 1)[1]
        return Path(part).name if part.startswith("/") else part

    words = (",".join(map(shorten_path, word.split(","))) for word in sys.argv[1:])
    return shlex.join(["graspd", *words])


def _parts(text: str) -> list[str]:
    parts = [part.strip() for part in text.split(",") if part.strip()]
    if not parts:
        raise InputError("an option is empty: name at least one method, hand, object and fidelity")
    return parts


def _parse_batch(text: str) -> int:
    if not text.isdigit() or not 1 <= int(text) <= 4096:
        raise InputError(f"--batch {text!r} is no number of grasps from 1 to 4096")
    return int(text)


def _chart_objects(objects: Sequence[str]) -> list[Any]:
    from graspd.studies.chart.chart import ChartObject
    from graspd.worker.objects.prepare import object_from_path, object_name

    def load(text: str, error: float) -> Any:
        return object_from_path(text, face_error_m=error)

    for text in objects:
        load(text, 1e-3)  # Report a wrong file before an hour of work.
    return [ChartObject(object_name(Path(text)), partial(load, text)) for text in objects]
