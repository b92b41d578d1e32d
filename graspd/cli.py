"""Root of the command line, with a list of the commands of all packages.

A module is imported on its first use."""

from __future__ import annotations

import os
import re
import sys
from importlib import import_module
from importlib.util import find_spec
from typing import Any, Final

import typer
from pydantic import ValidationError
from typer.core import TyperCommand, TyperGroup

from graspd.service.cli import run_command_line
from graspd.service.model.base import problem_text
from graspd.service.model.errors import did_you_mean
from graspd.service.model.libraries import freeze_imports, pause_garbage_collection
from graspd.service.model.version import PACKAGE_VERSION

#: Name, module, panel of the overview, and help of each command.
COMMANDS: Final[tuple[tuple[str, str, str, str], ...]] = (
    ("demo", "graspd.demo", "Make grasps", "Make grasps, scenes and pictures of built-in data, and a results page."),
    ("synth", "graspd.commands.synth", "Make grasps", "Generate grasps of a hand file on an object file."),
    ("transfer", "graspd.commands.scene", "Make grasps", "Transfer grasps of a file to another hand."),
    ("evaluate", "graspd.commands.evaluate", "Make grasps", "Validate grasps in MuJoCo, an independent engine."),
    ("scene", "graspd.commands.scene", "Make grasps", "Drop the object on a table and select clear grasps."),
    ("episodes", "graspd.commands.episodes", "Make grasps", "Execute grasps by an arm or a flying hand in MuJoCo."),
    ("render", "graspd.commands.render", "Make grasps", "Render pictures of scenes with labels."),
    ("chart", "graspd.commands.studies", "Make grasps", "Compare speed and accuracy of methods and fidelities."),
    ("bench", "graspd.commands.studies", "Make grasps", "Measure grasps per second and the time of each step."),
    ("stability", "graspd.commands.studies", "Make grasps", "Map where planners fail."),
    ("studies", "graspd.commands.studies", "Make grasps", "Compare engines on the same grasps."),
    ("pictures", "graspd.commands.render", "Use grasps", "Draw the best grasps of a file on one sheet."),
    ("view", "graspd.commands.render", "Use grasps", "Show grasps of a file in 3D in the browser."),
    ("grasps", "graspd.commands.curate", "Use grasps", "Select grasps of files and datasets by their metrics."),
    ("clouds", "graspd.commands.curate", "Use grasps", "Convert pictures to point clouds with grasps."),
    ("export", "graspd.commands.exchange", "Use grasps", "Export grasps and pictures to other formats."),
    ("import", "graspd.commands.exchange", "Use grasps", "Import grasps from other formats and validate them."),
    ("simready", "graspd.commands.exchange", "Use grasps", "Add grasps to the USD file of their object (SimReady)."),
    ("up", "graspd.service.run.commands", "Service", "Run the whole service on this machine until Ctrl-C."),
    ("submit", "graspd.client.commands", "Service", "Submit a job: one hand on one object."),
    ("jobs", "graspd.client.commands", "Service", "List jobs, newest first."),
    ("status", "graspd.client.commands", "Service", "Show stages, progress and quality of a job."),
    ("logs", "graspd.client.commands", "Service", "Show failed attempts of a job with their reasons."),
    ("cancel", "graspd.client.commands", "Service", "Cancel a job; finished grasps remain."),
    ("retry", "graspd.client.commands", "Service", "Run failed and cancelled tasks of a job again."),
    ("delete", "graspd.client.commands", "Service", "Delete an ended job and grasps that no other job uses."),
    ("restore", "graspd.client.commands", "Service", "Restore a deleted job."),
    ("datasets", "graspd.client.dataset_commands", "Service", "Make datasets of many hands and objects."),
    ("hands", "graspd.client.commands", "Service", "Check, add, list and show hands."),
    ("objects", "graspd.client.commands", "Service", "Check, add, list and show objects."),
    ("networks", "graspd.client.commands", "Service", "Add, list and show networks that propose grasps."),
    ("tags", "graspd.client.commands", "Service", "Tag grasps; list and export tagged ones."),
    ("webhooks", "graspd.client.commands", "Service", "Notify URLs when jobs and datasets end."),
    ("doctor", "graspd.doctor", "Administration", "Check Redis, store, index, GPU and more; suggest fixes."),
    ("api", "graspd.api.server_command", "Administration", "Run the HTTP API and the dashboard."),
    ("controller", "graspd.service.run.commands", "Administration", "Run the controller: retries, lost leases, index."),
    ("worker", "graspd.commands.worker", "Administration", "Run workers, each on one device."),
    ("keys", "graspd.client.commands", "Administration", "Make, list and revoke API keys."),
    ("projects", "graspd.client.commands", "Administration", "List projects of keys and set their limits."),
    ("admin", "graspd.admin", "Administration", "Maintenance: kernels, index, store."),
)

#: Commands in a group of another package: group, name, module and help.
JOINED: Final[tuple[tuple[str, str, str, str], ...]] = (
    ("admin", "kernels", "graspd.commands.worker", "Compile all kernels ahead of time."),
    ("admin", "index", "graspd.service.run.commands", "Rebuild the index from the store or export its tables."),
    ("admin", "store", "graspd.service.run.store_commands", "Verify and repair the store."),
    ("hands", "check", "graspd.commands.hands", "Check whether a hand can be used, and report guesses."),
    ("objects", "check", "graspd.commands.objects", "Check whether a mesh can be used, and report repairs."),
    ("objects", "fetch", "graspd.commands.objects", "Fetch a published set of objects from the package index."),
    ("datasets", "balance", "graspd.commands.curate", "Write a subset in which no kind of grasps dominates."),
    ("datasets", "card", "graspd.commands.exchange", "Write a dataset's card: contents, quality, biases, plots."),
    ("datasets", "publish", "graspd.commands.exchange", "Write a dataset for a hub, and upload it."),
)

#: For each package: a module that it needs, and the extra that installs this module.
PACKAGES: Final[dict[str, tuple[str, str]]] = {
    "graspd.api": ("fastapi", "api"),
    "graspd.client": ("fastapi", "api"),
    "graspd.commands": ("warp", "worker"),
    "graspd.demo": ("warp", "all"),
}

UsageError: Final[Any] = typer.BadParameter.__base__


class LazyGroup(TyperGroup):
    """Group whose overview needs no import; a call of a command imports its package."""

    def main(self, *args: Any, **extra: Any) -> Any:
        """Run the command; a usage error prints one line and exits with code 2."""
        try:
            code = super().main(*args, **extra | {"standalone_mode": False})
        except UsageError as error:
            code = error.exit_code
            if line := usage_line(error):  # Without a line, help is already printed.
                typer.echo(f"graspd: {line}", err=True)
        except typer.Abort:
            code = 1
            typer.echo("graspd: stopped at a prompt", err=True)
        sys.exit(code)

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        name, command, rest = super().resolve_command(ctx, args)
        module = next((module for known, module, _, _ in COMMANDS if known == name), None)
        # Completion omits commands whose package is not installed.
        if module is None or name is None or (ctx.resilient_parsing and missing_extra(module)):
            return name, command, rest
        # Without the API, as in a worker's image, `hands check` and `objects check` still work.
        package = next((package for parent, child, package, _ in JOINED if [parent, child] == [name, *rest[:1]]), None)
        if package and missing_extra(module):
            return f"{name} {rest[0]}", load_command(package, rest[0], ctx), rest[1:]
        return name, load_command(module, name, ctx), rest


class DeferredCommand(TyperCommand):
    """Placeholder in a group for a command of another package; a call imports that package."""

    def __init__(self, name: str, module: str, help: str) -> None:
        super().__init__(name, help=help)
        self.module = module

    def make_context(self, info_name: Any, args: Any, parent: Any = None, **extra: Any) -> Any:
        if extra.get("resilient_parsing") and missing_extra(self.module):
            return super().make_context(info_name, args, parent, **extra)
        return load_command(self.module, str(self.name), parent).make_context(info_name, args, parent, **extra)


def load_command(module: str, name: str, ctx: Any = None) -> Any:
    """Import a command; print one line and exit with code 1 if its package is not installed."""
    if missing := missing_extra(module):
        path = f"{ctx.command_path} {name}" if ctx else f"graspd {name}"
        typer.echo(f"graspd: `{path}` is not part of this install; run pip install 'graspd[{missing}]'", err=True)
        raise typer.Exit(1)
    with pause_garbage_collection():
        group: Any = typer.main.get_command(import_module(module).app)
    # typer turns an app with one command into that command, not into a group.
    command: Any = group.get_command(ctx, name) if isinstance(group, TyperGroup) else group
    if isinstance(command, TyperGroup):
        for parent, child, package, text in JOINED:
            if parent == name:
                command.add_command(DeferredCommand(child, package, text))
    # typer adds completion options to a single command; they would install completion for `graspd` itself.
    command.params = [one for one in command.params if not str(one.name).endswith("_completion")]
    escape_help(command)
    return command


def usage_line(error: Any) -> str:
    """Return one line with the usage error and a hint; empty if there is nothing to report."""
    said = re.sub(r"\.?\s*Did you mean (.*)\?", r"; did you mean \1?", error.format_message()).rstrip(".")
    if hasattr(error, "possibilities"):
        said = f"there is no option {error.option_name}{did_you_mean(error.option_name, error.possibilities or ())}"
    elif isinstance(error.__cause__, ValidationError):
        said = f"{max(error.param.opts, key=len)}: {problem_text(error.__cause__.errors()[0])}"
    else:
        said = said[:1].lower() + said[1:].replace("'", "")
    hint = f"; see `{error.ctx.command_path} --help`" if error.ctx and said and not said.endswith("?") else ""
    return " ".join(f"{said}{hint}".split())


def escape_help(command: Any) -> None:
    """Escape brackets in the help of a command and its subcommands: typer reads `[mm]` as Rich markup."""
    # `rich.markup.escape` does the same, but its import is slow.
    for one in (command, *command.params):
        for name in ("help", "short_help", "epilog"):
            if text := getattr(one, name, None):
                setattr(one, name, re.sub(r"\[[a-z#/@][^\[]*?\]", r"\\\g<0>", text))
    for inner in getattr(command, "commands", {}).values():
        escape_help(inner)


def missing_extra(module: str) -> str | None:
    """Return the extra that installs what a module needs; None if it is installed."""
    needed, extra = next((PACKAGES[name] for name in PACKAGES if f"{module}.".startswith(f"{name}.")), ("", ""))
    return extra if needed and find_spec(needed) is None else None


def build_app() -> typer.Typer:
    app = typer.Typer(
        cls=LazyGroup,
        help="Make datasets of stable, contact-rich multi-finger grasps by differentiable simulation.",
        epilog="Try `graspd demo`, or `graspd COMMAND --help`.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
    )

    @app.callback(invoke_without_command=True)
    def root(
        version: bool = typer.Option(False, "--version", help="Print the version and exit.", is_eager=True),
    ) -> None:
        if version:
            typer.echo(PACKAGE_VERSION)
            raise typer.Exit

    for name, _, panel, text in COMMANDS:
        app.command(name, help=text, rich_help_panel=panel)(_entry)
    return app


def _entry() -> None:
    """Represent a command in the overview; `LazyGroup` loads the real one."""


def main() -> None:
    freeze_imports()
    # Commands do not draw with MuJoCo. Without this setting, its import would start a process to search for GLFW.
    os.environ.setdefault("MUJOCO_GL", "disable")
    # Without this setting, pydantic searches all installed packages for plugins; an empty variable enables them.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    run_command_line(build_app())
