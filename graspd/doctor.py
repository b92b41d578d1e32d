"""`graspd doctor`: check everything an installation depends on, and print a fix for each fault."""

from __future__ import annotations

import dataclasses
import logging
import os
import sys
import threading
from functools import partial
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


def all_checks(settings: Settings, *, full: bool = False) -> list[Check]:
    """Return the checks of all packages; a check of a missing package reports that it is not installed.

    With `full`, all rows of the index are compared with the store.
    """
    full_s = _FULL_S if full else 120.0
    checks = [
        Check("disk", partial(machine.check_disk, settings)),
        Check("data-folder", partial(machine.check_data_folder, settings)),
        Check("limits", machine.check_limits),
        Check("redis", partial(backends.check_redis, settings)),
        Check("redis-persistence", partial(backends.check_persistence, settings)),
        Check("store", partial(backends.check_configured_store, settings), limit_s=120.0),
        Check("index", partial(backends.check_index, settings)),
        Check("identity", partial(backends.check_index_identity, settings)),
        Check("index-is-store", partial(backends.compare_index_with_store, settings, full=full), limit_s=full_s),
        Check("damage", partial(backends.check_store_damage, settings)),
        Check("clocks", partial(fleet.check_clocks, settings), limit_s=120.0),
        Check("controller", partial(fleet.check_controller, settings)),
        Check("workers", partial(fleet.check_workers, settings)),
        Check("port", partial(fleet.check_port, settings)),
    ]
    if missing_extra("graspd.api"):
        checks.append(_skipped_check("keys", "api"))
    else:
        from graspd.api.access.doctor import check_keys

        checks.append(Check("keys", partial(check_keys, settings)))
    if missing_extra("graspd.commands"):
        return [*checks, _skipped_check("gpu", "worker"), _skipped_check("kernels", "worker")]
    from graspd.commands.doctor import checks_of

    return checks + checks_of(settings)


def _skipped_check(name: str, extra: str) -> Check:
    return Check(name, lambda: skipped(f"graspd[{extra}] is not part of this install"))


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
