"""Command line: `graspd chart`."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Sequence
from functools import partial
from importlib import import_module
from json import loads
from pathlib import Path
from types import ModuleType
from typing import Annotated, Any

import typer

from service.cli import JsonFlag, emit, load_settings, reporting_errors
from service.model.errors import InputError, one_of
from service.model.fidelity import FIDELITIES, OFFERED
from service.model.robust import MODELS
from service.model.scene_spec import SceneSpec, parse_scene
from worker.engines.devices import Device
from worker.run import Run

app = typer.Typer()

#: What is compared where nothing is named.
PEERS = ("fast_graspd", "graspit", "graspd2022", "dfc", "autograsp")


@app.command(epilog="graspd chart --methods fast_graspd,autograsp --hands allegro --objects mug,bottle --out chart")
@reporting_errors
def chart(
    methods: Annotated[
        str, typer.Option(help="Planners, with commas between; also as NAME:OPTION=VALUE@GRASPS_PER_CALL.")
    ] = ",".join(PEERS),
    hands: Annotated[str, typer.Option(help="URDFs or built-in hands, with commas between.")] = "allegro,barrett",
    objects: Annotated[str, typer.Option(help="Meshes or built-in objects, with commas between.")] = "mug,bottle",
    fidelities: Annotated[str, typer.Option(help="Of methods that have them, with commas between.")] = ",".join(
        OFFERED
    ),
    batch: Annotated[str, typer.Option(help="Grasps per call, with commas between; each is run.")] = "32",
    peer_batch: Annotated[int, typer.Option(min=1, help="Grasps per call of methods with a budget of steps.")] = 8,
    repeats: Annotated[int, typer.Option(min=1, help="Timed calls of each setting on each hand and object.")] = 2,
    option: Annotated[
        list[str] | None, typer.Option(help="METHOD:NAME=VALUE, such as graspit:steps=40000; several times.")
    ] = None,
    quick: Annotated[bool, typer.Option("--quick", help="Little of everything: seconds instead of an hour.")] = False,
    sweep: Annotated[bool, typer.Option("--sweep", help="Also turn fast_graspd's knobs one at a time.")] = False,
    knob: Annotated[
        list[str] | None, typer.Option(help="With --sweep: only this knob, such as 'contact solver'; several times.")
    ] = None,
    threads: Annotated[int, typer.Option(min=0, help="CPU threads; 0: one per core.")] = 0,
    device: Annotated[str, typer.Option(help="cpu, cuda:0 or auto.")] = "auto",
    out: Annotated[Path | None, typer.Option(help="Folder for chart.json, .csv, .md, .png and .svg.")] = None,
    remark: Annotated[str, typer.Option(help="A sentence on the conditions, for the report.")] = "",
    scene: Annotated[
        str,
        typer.Option(help="Other than free: planned in table, bin, shelf or a file, against free ones put there."),
    ] = "free",
    work: Annotated[
        Path | None, typer.Option(help="With --scene: folder that keeps each result; a stopped run goes on there.")
    ] = None,
    source: Annotated[
        Path | None, typer.Option("--from", help="A chart.json: draw and publish it, measure nothing.")
    ] = None,
    publish: Annotated[
        bool, typer.Option("--publish", help="Also into the store, for the dashboard and `fidelity: auto`.")
    ] = False,
    data_dir: Annotated[Path | None, typer.Option(help="Folder of the store; GRASPD_DATA_DIR.")] = None,
    json: JsonFlag = False,
) -> None:
    """Speed against accuracy: every method and fidelity on the same hands and objects, judged by MuJoCo."""
    from worker.hands.load import hand_from_path
    from worker.studies.chart.chart import settings_of
    from worker.studies.chart.sweeps import sweep as turn
    from worker.studies.chart.sweeps import turns

    if source is not None:
        _finish(_read(source), out, data_dir, publish=publish, json=json)
        return
    turns(knobs=knob or ())  # a wrong name is told before an hour of work
    if scene != "free" and sweep:
        raise InputError("--sweep is of free objects' charts; leave out --scene")
    place = _place(scene)
    on = Run(Device(device).resolve(), threads)
    batches, models_around = [_number(part) for part in _parts(batch)], MODELS
    if quick:
        hands, objects, fidelities = (_first(text) for text in (hands, objects, fidelities))
        batches, peer_batch, repeats, models_around = [4], 2, 1, 2
    chosen = settings_of(
        _parts(methods),
        known_fidelities(_parts(fidelities)),
        batches=batches,
        peer_batch=peer_batch,
        options=option or [],
        quick=quick,
        run=on,
    )
    models, things = [hand_from_path(part) for part in _parts(hands)], _things(_parts(objects))
    said = {"command": shlex.join(["graspd", *(_short(word) for word in sys.argv[1:])]), "remark": remark}

    def keep(so_far: dict[str, Any]) -> None:
        if out is not None:
            _write(so_far | said, out)

    if place is None:
        from worker.studies.chart.chart import chart as run

        result = run(models, things, chosen, repeats=repeats, models=models_around, say=_say, keep=keep) | said
    else:
        from worker.studies.chart.scenes import scene_chart

        result = scene_chart(models, things, chosen, place, models=models_around, work=work, say=_say, keep=keep) | said
    if sweep:
        result["sweeps"] = turn(
            models[0], things[0], batch=batches[0], repeats=repeats, quick=quick, run=on, knobs=knob or (), say=_say
        )
    _finish(result, out, data_dir, publish=publish, json=json)


def _finish(result: dict[str, Any], out: Path | None, data_dir: Path | None, *, publish: bool, json: bool) -> None:
    if out is not None:
        _write(result, out)
    if publish:
        _publish(result, data_dir)
    if json:
        emit(result)
    else:
        typer.echo(_report(result).markdown(result))


def _report(chart: dict[str, Any]) -> ModuleType:
    """The module that writes it: a chart in scenes has other columns."""
    return import_module(f"worker.studies.chart.{'scene_report' if 'scene' in chart else 'report'}")


def _write(chart: dict[str, Any], out: Path) -> None:
    _report(chart).write(chart, out)


def _read(path: Path) -> dict[str, Any]:
    try:
        found = loads(path.read_text())
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error.strerror}") from None
    except ValueError:
        found = None
    if not isinstance(found, dict) or not {"created", "runs"} <= found.keys():
        raise InputError(f"{path} is no chart.json; `graspd chart --out FOLDER` writes one")
    if missing := [key for key in ("summary", "by_hand", "models") if key not in found]:
        raise InputError(f"{path} has no {missing[0]}: an earlier graspd measured it, measure again")
    return found


def _place(scene: str) -> SceneSpec | None:
    """The scene of a chart; None: around free objects."""
    if scene == "free":
        return None
    spec = parse_scene(scene)
    if spec.neighbours:
        raise InputError(f"{scene} has neighbours; the chart compares methods among supports alone: leave them out")
    # Every stable face of an object, where it is dropped.
    return spec if spec.target is not None else parse_scene(scene, faces="all")


def _short(word: str) -> str:
    """A word of the command line without the folders of this machine that everybody else calls otherwise."""

    def one(part: str) -> str:
        if "/data/" in part:
            return "DATA/" + part.split("/data/", 1)[1]
        return Path(part).name if part.startswith("/") else part

    return ",".join(one(part) for part in word.split(","))


def _say(line: str) -> None:
    typer.echo(line, err=True)


def _parts(text: str) -> list[str]:
    parts = [part.strip() for part in text.split(",") if part.strip()]
    if not parts:
        raise InputError("an option is empty: name at least one method, hand, object and fidelity")
    return parts


def _first(text: str) -> str:
    return _parts(text)[0]


def _number(text: str) -> int:
    if not text.isdigit() or not 1 <= int(text) <= 4096:
        raise InputError(f"--batch {text!r} is no number of grasps from 1 to 4096")
    return int(text)


def known_fidelities(names: Sequence[str]) -> list[str]:
    """The names, if all are known; raises InputError."""
    if unknown := [name for name in names if name not in FIDELITIES]:
        raise InputError(f"unknown fidelity {unknown[0]!r}; choose of {one_of(unknown[0], FIDELITIES)}")
    return list(names)


def _things(objects: Sequence[str]) -> list[Any]:
    from worker.objects.prepare import name_of, object_from_path
    from worker.studies.chart.chart import Thing

    def load(text: str, error: float) -> Any:
        return object_from_path(text, face_error_m=error)

    for text in objects:
        load(text, 1e-3)  # a wrong file is told before an hour of work
    return [Thing(name_of(Path(text)), partial(load, text)) for text in objects]


def _publish(result: dict[str, Any], data_dir: Path | None) -> None:
    from service.store.records import kind_of, publish
    from service.store.store import open_store

    key = publish(open_store(load_settings(data_dir=data_dir).resolved_store_url), kind_of(result), result)
    _say(f"published as {key}")
