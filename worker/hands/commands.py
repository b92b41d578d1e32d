"""Command line: `graspd hands check`."""

from __future__ import annotations

import json
from typing import Annotated, Any

import typer

from service.errors import GraspdError, InputError
from worker.hands.check import check_hand
from worker.hands.load import files_from_path


def check(
    file: Annotated[str, typer.Argument(help="a URDF, a ZIP of its folder, or the name of a built-in hand")],
    palm: Annotated[str | None, typer.Option(help="link that is the palm")] = None,
    approach: Annotated[str | None, typer.Option(help="direction out of the palm, in its frame: x,y,z")] = None,
    root: Annotated[str | None, typer.Option(help="link to begin at; forearm and wrist above it are dropped")] = None,
    fix: Annotated[list[str] | None, typer.Option(help="freeze a joint: JOINT=VALUE")] = None,
    pre_shape: Annotated[list[str] | None, typer.Option(help="value on approach: JOINT=VALUE")] = None,
    as_json: Annotated[bool, typer.Option("--json", help="one JSON object on the last line")] = False,
) -> None:
    """Say whether a hand can be used, and what was guessed about it.

    Example: graspd hands check my_hand.urdf --palm base_link --approach 0,0,1
    """
    report = report_hand(file, hand_options(palm=palm, approach=approach, root=root, fix=fix, pre_shape=pre_shape))
    typer.echo(json.dumps(report) if as_json else f"{report['verdict']}: {report['message']}")
    if report["verdict"] == "refuse":
        raise typer.Exit(2)


def report_hand(file: str, options: dict[str, Any] | None = None) -> dict[str, Any]:
    """`check_hand` of a path; what cannot even be read is refused in the same form."""
    try:
        name, files, stated = files_from_path(file)
    except GraspdError as error:
        return {"verdict": "refuse", "message": str(error), "repairs": [], "facts": {}}
    return check_hand(files, name, {**stated, **(options or {})})


def hand_options(
    *, palm: str | None, approach: str | None, root: str | None, fix: list[str] | None, pre_shape: list[str] | None
) -> dict[str, Any]:
    """Keys of `HandOptions` from the texts of the command line."""
    options: dict[str, Any] = {}
    if palm:
        options["palm"] = {"link": palm}
    if approach:
        try:
            x, y, z = (float(part) for part in approach.split(","))
        except ValueError:
            raise InputError(f"--approach {approach!r} must be three numbers: 0,0,1") from None
        options["approach"] = (x, y, z)
    if root:
        options["root"] = root
    for key, pairs in (("fix", fix), ("preshape", pre_shape)):
        if pairs:
            options[key] = dict(_assignment(pair) for pair in pairs)
    return options


def _assignment(text: str) -> tuple[str, float]:
    name, _, value = text.partition("=")
    try:
        return name, float(value)
    except ValueError:
        raise InputError(f"{text!r} must be JOINT=VALUE with a number") from None
