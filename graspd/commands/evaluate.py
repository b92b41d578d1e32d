"""Command line: `graspd evaluate`."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Annotated, Any, Final

import typer
from rich.box import SIMPLE_HEAD
from rich.table import Table

from graspd.exchange.inputs import expand_path, load_case
from graspd.service.cli import CommandGroup, JsonFlag, plain_console, print_json, progress_bar, write_output
from graspd.service.model.errors import InputError
from graspd.service.model.metrics import AXIS_MEANINGS, MOST_ROBUST_MODELS
from graspd.service.store.shards import inherited_attributes, json_attribute, read_shard, write_shard
from graspd.studies.engines import compare_engines, matrix_lines, summarise
from graspd.studies.evaluation import checked_level, combine_rows, evaluate
from graspd.worker.execution_context import ExecutionContext, Progress
from graspd.worker.files.subsets import require_empty_folder
from graspd.worker.validation.engines.registry import EngineVerdicts, check_engines, engine_columns
from graspd.worker.validation.robust import Robustness

app = CommandGroup(add_completion=False)

_COLUMNS: Final = (
    *(("n", "n", 0), ("gsr", "GSR", 2), ("sgs", "SGS", 2), ("pd_mm", "PD", 2), ("spd_mm", "SPD", 2)),
    *(("ca_cm2", "CA", 1), ("iv_cm3", "IV", 2), ("epsilon", "ε", 2), ("wrench_volume", "Vol", 2)),
    *(("sd_cm", "SD", 2), ("diversity", "D", 2)),
)


@app.command(name="evaluate", epilog="graspd evaluate grasps.h5 --level dexgraspbench")
def evaluate_command(
    files: Annotated[list[Path], typer.Argument(help="Base shards, reference JSON files, DexGraspBench folders.")],
    protocol: Annotated[
        str, typer.Option(help="dexgraspbench: six pushes; lift: lift in the scene; displacement: motion in 0.15 s.")
    ] = "dexgraspbench",
    level: Annotated[str, typer.Option(help="Level: dexgraspbench, standard, fast; lifts: dexgraspbench, lift.")] = "",
    hard: Annotated[bool, typer.Option("--hard", help="Half friction, and a tenth of the torsional friction.")] = False,
    hand: Annotated[str | None, typer.Option(help="Hand file; default: found by its digest.")] = None,
    object: Annotated[str | None, typer.Option(help="Object file; default: found by its digest.")] = None,
    robust: Annotated[int, typer.Option(min=0, max=MOST_ROBUST_MODELS, help="Perturbed models, such as 8.")] = 0,
    friction: Annotated[
        float | None, typer.Option(min=0.01, max=3.0, help="Friction coefficient for ε; default: that of the file.")
    ] = None,
    engines: Annotated[
        str, typer.Option("--engines", "--engine", help="Engines to compare: mujoco, physx, drake; commas between.")
    ] = "",
    out: Annotated[Path | None, typer.Option("-o", "--out", help="Copy with columns of --robust or --engines.")] = None,
    threads: Annotated[int, typer.Option(min=0, help="CPU threads; 0: one per core.")] = 0,
    json: JsonFlag = False,
) -> None:
    """Measure grasps (medians; ε and areas at 5 mm) and validate them in an independent engine."""
    level = checked_level(protocol, level)
    if robust and protocol == "displacement":
        raise InputError("--robust repeats pushes or lifts in perturbed models: use --protocol dexgraspbench or lift")
    several = check_engines([one.strip() for one in engines.split(",")]) if engines else ()
    if several and (robust or protocol == "displacement"):
        raise InputError("--engines compares verdicts on pushes or lifts alone, without --robust")
    listed = [one for path in files for one in expand_path(path)]
    copies = _copy_paths(files, listed, out, columns=bool(robust or several), hard=hard)
    rows: list[dict[str, Any]] = []
    verdicts: dict[str, list[EngineVerdicts]] = {}
    with progress_bar(quiet=json) as report:
        for file in listed:
            case = load_case(file, hand=hand, obj=object)
            if copies and (case.placed is None) == (protocol == "lift"):
                needed = "--protocol lift for grasps in scenes, or dexgraspbench for free grasps"
                raise InputError(f"{file}: -o needs {needed}")
            run = ExecutionContext(threads=threads, progress=partial(_report_progress, report, case.name))
            if several:
                if protocol == "lift" and case.placed is None:
                    raise InputError(f"{file} has free grasps, but a lift test needs a scene: graspd synth --scene")
                found = compare_engines(case, several, lift=protocol == "lift", level=level, hard=hard, run=run)
                verdicts[str(file)] = found
                if copies:
                    write_copy(file, copies[file], engine_columns(found), {"engines": ",".join(several)})
                continue
            row = evaluate(
                case,
                protocol=protocol,  # type: ignore[arg-type]
                level=level,
                hard=hard,
                friction=friction,
                models=robust,
                tell=partial(_write_robust, file, copies[file]) if copies else lambda found: None,
                run=run,
            )
            rows.append({"file": str(file), **row})
    if several:
        _report_engines(verdicts, json=json)
        return
    _report(rows, json=json)


def _report(rows: list[dict[str, Any]], *, json: bool) -> None:
    whole = combine_rows([{key: value for key, value in row.items() if key != "file"} for row in rows])
    if json:
        verdicts = [{"file": row["file"], **one} for row in rows for one in row.pop("verdicts", [])]
        whole.pop("verdicts", None)
        print_json(whole | {"verdicts": verdicts, "files": rows})
    else:
        plain_console().print(_table(rows, whole))
        if whole.get("robust_share") is not None:
            typer.echo(_format_robustness(whole))
        for row in rows:
            if "note" in row:
                typer.echo(row["note"], err=True)


def _copy_paths(
    paths: list[Path], files: list[Path], out: Path | None, *, columns: bool, hard: bool
) -> dict[Path, Path]:
    if out is None:
        return {}
    if not columns or hard or len(paths) != 1:
        raise InputError("-o needs --robust N or --engines, no --hard, and one file or folder")
    if other := next((file for file in files if file.suffix != ".h5"), None):
        raise InputError(f"{other} is no shard of graspd: only shards can store the results")
    if paths[0].is_dir():
        require_empty_folder(out)
        return {file: out / file.relative_to(paths[0]) for file in files}
    if not out.parent.is_dir() or out.is_dir():
        raise InputError(f"{out} cannot be written: choose a file in an existing folder")
    return {files[0]: out}


def _format_robustness(whole: dict[str, Any]) -> str:
    words = {axis.word: name for axis, name in AXIS_MEANINGS.items()}
    axes = sorted(whole["robust_axes"].items(), key=lambda pair: pair[1]["share"])
    each = ", ".join(f"{words[axis]} {one['share']:.2f}" for axis, one in axes)
    models = f"{whole['robust_share']:.2f} of {whole['robust_models']} perturbed models"
    return f"robust: {whole['robust_n']} held grasps hold in {models}\nby perturbed parameter: {each}"


def _report_progress(report: Progress, name: str, done: float, total: float, what: str) -> None:
    report(done, total, f"{name}: {what}")


def _table(rows: list[dict[str, Any]], whole: dict[str, Any]) -> Table:
    stated = f"{whole['protocol']}, {whole['level'] or 'not validated'}{', hard' if whole['hard'] else ''}"
    friction = " ".join(sorted({f"{row['mu']:g}" for row in rows}))
    looks: dict[str, Any] = {"title_justify": "left", "caption_justify": "left", "box": SIMPLE_HEAD}
    table = Table(
        title=f"{stated}; ε at μ = {friction}, contact at 5 mm; medians",
        caption="GSR: held share; SGS: held grasps per s; PD, SPD: penetration, self-penetration [mm]; CA: contact "
        "area [cm²]; IV: intersection volume [cm³]; SD: displacement [cm]; D: variance share of the first component",
        padding=(0, 1, 0, 0),
        pad_edge=False,
        **looks,
    )
    table.add_column("grasps", max_width=16, overflow="fold")
    for _, heading, _ in _COLUMNS:
        table.add_column(heading, justify="right", no_wrap=True)
    for row in rows:
        table.add_row(Path(row["file"]).stem, *(_cell_text(row[key], digits) for key, _, digits in _COLUMNS))
    if len(rows) > 1:
        table.add_section()
        table.add_row("all", *(_cell_text(whole[key], digits) for key, _, digits in _COLUMNS))
    return table


def _cell_text(value: float | None, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f}"


def _write_robust(source: Path, out: Path, found: Robustness) -> None:
    said = json_attribute({"models": found.held.shape[1], "wanted": found.wanted})
    write_copy(source, out, found.columns, {"robust": said})


def write_copy(source: Path, out: Path, columns: Mapping[str, Any], attributes: Mapping[str, str]) -> None:
    """Write a base shard with further columns and attributes; all else, including its id, is unchanged."""
    shard = read_shard(source, kind="base")
    data = write_shard("base", {**shard.arrays, **columns}, {**inherited_attributes(shard), **attributes})
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        write_output(out, data)
    except OSError as error:
        raise InputError(f"{out} cannot be written: {error.strerror}") from None


def _report_engines(verdicts: dict[str, list[EngineVerdicts]], *, json: bool) -> None:
    whole = summarise(list(verdicts.values()))
    if json:
        files = [
            {
                "file": file,
                **summarise([found]),
                "held": {one.engine: one.success.tolist() for one in found},
                "reasons": {one.engine: one.reasons for one in found},
            }
            for file, found in verdicts.items()
        ]
        print_json(whole | {"files": files})
        return
    rows = {(Path(file).stem,): summarise([found]) for file, found in verdicts.items()}
    typer.echo("\n".join(matrix_lines(rows | ({("all",): whole} if len(rows) > 1 else {}), ("grasps",))))
