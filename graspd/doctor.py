"""`graspd doctor`: check everything an installation depends on, and print a fix for each fault."""

from __future__ import annotations

import dataclasses
import logging
import os
import sys
import threading
from collections.abc import Callable
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import Annotated, Final

import typer

from graspd.cli import missing_extra
from graspd.service.cli import CommandGroup, JsonFlag, load_settings, print_json
from graspd.service.model.errors import InputError
from graspd.service.run.doctor import backends, fleet, machine
from graspd.service.run.doctor.checks import THREADS, Check, Condition, Finding, run_checks, skipped
from graspd.service.settings import Settings

app = CommandGroup(no_args_is_help=False)
#: Time limit of a full comparison, which reads every record of the store [s].
_FULL_S: Final = 24 * 3600.0
_COLOURS: Final = {"good": "green", "warning": "yellow", "bad": "red", "skipped": "bright_black"}


@app.command(epilog="graspd doctor --only redis,store,clocks")
def doctor(
    only: Annotated[str | None, typer.Option(help="Checks to run, separated by commas; default: all.")] = None,
    full: Annotated[bool, typer.Option("--full", help="Compare all rows of a large index, not only names.")] = False,
    data_dir: Annotated[Path | None, typer.Option(help="Data folder of graspd; default: GRASPD_DATA_DIR.")] = None,
    json: JsonFlag = False,
) -> None:
    """Check disk, clocks, Redis, store, index, GPU, kernels and ports, and suggest fixes.

    It changes nothing, and may run next to the service. Exit code 1: there is a fault.
    """
    settings = load_settings(data_dir=data_dir)
    logging.basicConfig(level=logging.ERROR)
    checks = _select(all_checks(settings, full=full), only)
    found = []
    for finding in run_checks(checks):
        found.append(finding)
        if not json:
            _show(finding)
    counts = {condition: sum(one.condition is condition for one in found) for condition in Condition}
    is_well = counts[Condition.BAD] == 0
    if json:
        told = [{"name": one.name, **dataclasses.asdict(one), "ok": one.ok} for one in found]
        print_json({"ok": is_well, "checks": told, **{condition.value: number for condition, number in counts.items()}})
    else:
        typer.echo(", ".join(f"{number} {condition.value}" for condition, number in counts.items() if number), err=True)
    _exit(0 if is_well else 1)


def _exit(code: int) -> None:
    """Exit with a code, even while the thread of a check hangs."""
    sys.stdout.flush()
    sys.stderr.flush()
    if any(thread.name.startswith(THREADS) for thread in threading.enumerate()):
        os._exit(code)
    raise typer.Exit(code)


#: Module, function and time limit [s] of checks whose packages an install may lack.
_FURTHER: Final = {
    "keys": ("graspd.api.access.doctor", "check_keys", 60.0),
    "gpu": ("graspd.commands.doctor", "check_gpu", 125.0),
    "kernels": ("graspd.commands.doctor", "check_kernels", 905.0),
}


def all_checks(settings: Settings, *, full: bool = False) -> list[Check]:
    """Return the checks of all packages; with `full`, all rows of the index are compared with the store."""
    compare = partial(backends.compare_index_with_store, full=full)
    checks: dict[str, tuple[Callable[[Settings], Finding], float]] = {
        "disk": (machine.check_disk, 60.0),
        "data-folder": (machine.check_data_folder, 60.0),
        "limits": (lambda _: machine.check_limits(), 60.0),
        "redis": (backends.check_redis, 60.0),
        "redis-persistence": (backends.check_persistence, 60.0),
        "store": (backends.check_configured_store, 120.0),
        "index": (backends.check_index, 60.0),
        "identity": (backends.check_index_identity, 60.0),
        "index-is-store": (compare, _FULL_S if full else 120.0),
        "damage": (backends.check_store_damage, 60.0),
        "clocks": (fleet.check_clocks, 120.0),
        "controller": (fleet.check_controller, 60.0),
        "workers": (fleet.check_workers, 60.0),
        "port": (fleet.check_port, 60.0),
        **{name: (partial(_look, module, function), limit_s) for name, (module, function, limit_s) in _FURTHER.items()},
    }
    return [Check(name, partial(look, settings), limit_s) for name, (look, limit_s) in checks.items()]


def _look(module: str, function: str, settings: Settings) -> Finding:
    if extra := missing_extra(module):
        return skipped(f"graspd[{extra}] is not part of this install")
    found: Finding = getattr(import_module(module), function)(settings)
    return found


def _select(checks: list[Check], only: str | None) -> list[Check]:
    if only is None:
        return checks
    wanted = {name.strip() for name in only.split(",")}
    if unknown := wanted - {check.name for check in checks}:
        known = ", ".join(check.name for check in checks)
        raise InputError(f"there is no check {', '.join(sorted(unknown))}; choose from {known}")
    return [check for check in checks if check.name in wanted]


def _show(finding: Finding) -> None:
    mark = typer.style(f"{finding.condition.value:8}", fg=_COLOURS[finding.condition])
    typer.echo(f"{mark} {finding.name:17} {finding.message}")
    if finding.fix:
        typer.echo(f"{'':26} fix: {finding.fix}")
