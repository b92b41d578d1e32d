"""Command line: `graspd hands check`."""

from __future__ import annotations

from json import dumps
from pathlib import Path, PurePosixPath
from typing import Annotated, Any

import typer

from graspd.service.cli import CommandGroup, JsonFlag, print_json, progress_bar
from graspd.service.command_options import with_options
from graspd.service.model.errors import GraspdError, InputError
from graspd.service.model.states import AssetKind
from graspd.service.store.asset_options import HandCommandOptions, hand_options
from graspd.service.store.asset_summary import print_check, self_test_lines
from graspd.service.store.descriptions import description_of
from graspd.worker.execution_context import DEFAULT_CONTEXT, ExecutionContext
from graspd.worker.hands.check import check_hand
from graspd.worker.hands.load import files_from_path, hand_from_path, main_file
from graspd.worker.hands.model import HandModel
from graspd.worker.hands.options import parse_options

app = CommandGroup(add_completion=False)


@app.command("check", epilog="graspd hands check my_hand.urdf --palm base_link --approach 0,0,1 --picture my_hand.png")
@with_options(HandCommandOptions, "asset")
def check(
    file: Annotated[str, typer.Argument(help="URDF, xacro or MJCF file, its folder or ZIP, or a built-in hand.")],
    options: dict[str, Any],
    picture: Annotated[Path | None, typer.Option(help="PNG of the hand: open, in its pre-shape, and closing.")] = None,
    collision: Annotated[bool, typer.Option("--collision", help="Draw collision shapes, not visual meshes.")] = False,
    write: Annotated[Path | None, typer.Option(help="Write all settings and guesses to an asset.json.")] = None,
    self_test: Annotated[bool, typer.Option(help="Run the self-test: 64 grasps of simple shapes, 16 lifts.")] = True,
    json: JsonFlag = False,
) -> None:
    """Check whether a hand can be used, report guesses, and run the self-test. Needs no server."""
    options = hand_options(**options)
    with progress_bar(quiet=json) as progress:
        report = report_hand(file, options, ExecutionContext(progress=progress))
    if picture and report["verdict"] != "refuse":
        _write_picture(hand_from_path(file, options), picture, collision=collision)
    if write and report["verdict"] != "refuse":
        _write(file, options, report, write)
    if not json:
        print_check(AssetKind.HAND, report)
    if self_test and report["verdict"] != "refuse":
        report["self_test"] = _self_test(file, options, quiet=json)
        if not json:
            for label, says in self_test_lines(report):
                typer.echo(f"  {label:<18} {says}")
    if json:
        print_json(report | {"closing": report["facts"].get("closing", {})})
    if report["verdict"] == "refuse":
        raise typer.Exit(InputError.exit_code)


def _self_test(file: str, options: dict[str, Any], *, quiet: bool) -> dict[str, Any]:
    from graspd.worker.stages.hand_self_test import self_test_facts

    with progress_bar(quiet=quiet) as progress:
        progress(0.0, 1.0, "starting the self-test; the first run on a machine compiles its kernels")
        return self_test_facts(lambda: hand_from_path(file, options), ExecutionContext(progress=progress))


def _write_picture(hand: HandModel, picture: Path, *, collision: bool) -> None:
    from graspd.worker.rendering.hands import without_visuals
    from graspd.worker.rendering.portraits import hand_portrait, write_png

    write_png(hand_portrait(without_visuals(hand) if collision else hand), picture)


def _write(file: str, options: dict[str, Any], report: dict[str, Any], target: Path) -> None:
    """Write an asset.json with all settings: from files, from options, and guessed ones."""
    _, files, stated = files_from_path(file)
    settings = parse_options(files, {**stated, **options})
    said = settings.model_dump(mode="json", exclude_unset=True)
    said["file"] = PurePosixPath(main_file(files, settings)).name
    text = dumps({**said, **description_of(report["facts"])}, indent=2)
    try:
        target.write_text(text + "\n")
    except OSError as error:
        raise InputError(f"{target} cannot be written: {error.strerror}") from None


def report_hand(
    file: str, options: dict[str, Any] | None = None, run: ExecutionContext = DEFAULT_CONTEXT
) -> dict[str, Any]:
    """Run `check_hand` on a path; report an unreadable file in the same form."""
    try:
        name, files, stated = files_from_path(file)
    except GraspdError as error:
        return {"verdict": "refuse", "message": str(error), "repairs": [], "facts": {}}
    return check_hand(files, name, {**stated, **(options or {})}, run)
