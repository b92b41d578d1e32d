"""The command line: mounts the command groups of the three rooms and imports each only when it is used."""

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

from service.cli import at_the_door
from service.model.imports import imports, own_process
from service.model.refusals import words
from service.model.suggestions import did_you_mean
from service.model.version import PACKAGE_VERSION

#: Command, module of its group, panel of the overview, help.
COMMANDS: Final[tuple[tuple[str, str, str, str], ...]] = (
    (
        "demo",
        "graspd.demo",
        "Start here",
        "The main job on built-in data: grasps, scenes, pictures, and a page that shows them.",
    ),
    ("up", "service.run.commands", "Start here", "The whole service on this machine, until Ctrl-C."),
    (
        "doctor",
        "graspd.doctor",
        "Start here",
        "Check disk, clocks, Redis, store, index, GPU, kernels and ports; say the mend.",
    ),
    ("submit", "api.client.commands", "Jobs", "Submit a job: one hand on one object."),
    ("jobs", "api.client.commands", "Jobs", "List jobs, the newest first."),
    ("status", "api.client.commands", "Jobs", "Stages, progress and quality of a job."),
    ("cancel", "api.client.commands", "Jobs", "Stop a job; what is written stays."),
    ("retry", "api.client.commands", "Jobs", "Run again what failed or was cancelled."),
    ("delete", "api.client.commands", "Jobs", "Remove an ended job; its grasps go where no other job has them."),
    ("restore", "api.client.commands", "Jobs", "Bring back a job that was deleted."),
    ("logs", "api.client.commands", "Jobs", "Failed attempts of a job, with their reasons."),
    ("hands", "api.client.commands", "Jobs", "Check, add, list and show hands."),
    ("objects", "api.client.commands", "Jobs", "Check, add, list and show objects."),
    ("networks", "api.client.commands", "Jobs", "Add, list and show networks that propose grasps of a hand."),
    (
        "datasets",
        "api.client.dataset_commands",
        "Jobs",
        "Hands x objects as one dataset: cost, status, snapshots, files.",
    ),
    ("api", "api.server_command", "Parts of the service", "The HTTP API and the dashboard."),
    ("keeper", "service.run.commands", "Parts of the service", "Reaper, delayed retries and indexer."),
    ("worker", "worker.commands.worker", "Parts of the service", "One worker on one device."),
    ("kernels", "worker.commands.kernels", "Parts of the service", "Compile all kernels ahead of time."),
    ("index", "service.run.commands", "Parts of the service", "Rebuild the index from the store."),
    ("store", "service.run.store_commands", "Parts of the service", "Check the store, and mend it."),
    ("keys", "api.client.commands", "Parts of the service", "Make, list and revoke API keys."),
    ("projects", "api.client.commands", "Parts of the service", "List projects of keys, and limit what each may use."),
    ("webhooks", "api.client.commands", "Jobs", "Addresses that are told when jobs and datasets end."),
    ("tags", "api.client.commands", "Jobs", "Names for grasps of the service, to find them and take them home."),
    ("synth", "worker.commands.synth", "Without a server", "Grasps of a hand file on an object file."),
    ("evaluate", "worker.commands.evaluate", "Without a server", "Quality of grasps, judged by an independent engine."),
    ("scene", "worker.commands.scene", "Without a server", "The object at rest on a table; grasps that fit there."),
    ("render", "worker.commands.render", "Without a server", "Pictures of scenes with their labels."),
    ("chart", "worker.commands.chart", "Studies", "Speed against accuracy of methods and fidelities."),
    ("bench", "worker.commands.bench", "Studies", "Grasps per second, and where the time goes."),
    ("view", "worker.commands.view", "Without a server", "Grasps of a file in 3D in the browser, one at a time."),
    ("pictures", "worker.commands.render", "Without a server", "The best grasps of a file on one sheet."),
    ("grasps", "worker.commands.curate", "Without a server", "Grasps of files and datasets, chosen by their numbers."),
    ("clouds", "worker.commands.clouds", "Without a server", "Pictures as point clouds with their grasps, in files."),
    ("export", "worker.commands.exchange", "Without a server", "Grasps and pictures in the formats of others."),
    ("import", "worker.commands.exchange", "Without a server", "Grasps of others, judged and measured like ours."),
    ("stability", "worker.commands.stability", "Studies", "Where integrators and the planner fail."),
    ("gallery", "worker.commands.gallery", "Studies", "Hands and objects at rest, as a camera sees them."),
    ("bench-render", "worker.commands.gallery", "Studies", "Images per second, and where the time goes."),
)

#: Group of one room, command in it, module of the room that has it, help.
JOINED: Final[tuple[tuple[str, str, str, str], ...]] = (
    ("hands", "check", "worker.commands.hands", "Say whether a hand can be used, and what was guessed about it."),
    ("objects", "check", "worker.commands.objects", "Say whether a mesh can be used, and what was repaired."),
    ("datasets", "balance", "worker.commands.curate", "A part in which no kind of grasps is more frequent."),
    ("datasets", "diff", "worker.commands.curate", "What two datasets do not have in common."),
    ("datasets", "card", "worker.commands.card", "Write a dataset's card: contents, quality, biases, plots."),
)

#: What a room cannot work without, and the extra that brings it: an image has only the rooms it needs.
ROOMS: Final[dict[str, tuple[str, str]]] = {
    "api": ("fastapi", "api"),
    "worker": ("warp", "worker"),
    "graspd.demo": ("warp", "all"),
}


#: Of typer's own, or of the click that an older one stands on.
UsageError: Final[Any] = typer.BadParameter.__base__


class LazyGroup(TyperGroup):
    """A group whose overview needs no import: a command's room is imported when the command is called."""

    def main(self, *args: Any, **extra: Any) -> Any:
        """Run it; what cannot be understood is one line and exit code 2, as any other mistake of a caller."""
        try:
            code = super().main(*args, **extra | {"standalone_mode": False})
        except UsageError as error:
            code = error.exit_code
            if said := usage_line(error):  # else it is help, and printed
                typer.echo(f"graspd: {said}", err=True)
        except typer.Abort:
            code = 1
            typer.echo("graspd: stopped at a question", err=True)
        sys.exit(code)

    def resolve_command(self, ctx: Any, args: list[str]) -> tuple[str | None, Any, list[str]]:
        # `graspd bench render` is the benchmark of another room.
        if args[:2] == ["bench", "render"]:
            args = ["bench-render", *args[2:]]
        name, command, rest = super().resolve_command(ctx, args)
        module = next((module for known, module, _, _ in COMMANDS if known == name), None)
        # Completion says nothing of what is not installed.
        if module is None or name is None or (ctx.resilient_parsing and missing_extra(module)):
            return name, command, rest
        # A worker's image has no API, but checks hands and objects.
        room = next((room for parent, child, room, _ in JOINED if [parent, child] == [name, *rest[:1]]), None)
        if room and missing_extra(module):
            return f"{name} {rest[0]}", load(room, rest[0]), rest[1:]
        return name, load(module, name, ctx), rest


class Deferred(TyperCommand):
    """Stands for a command of another room in a group; that room is imported when the command is called."""

    def __init__(self, name: str, module: str, help: str) -> None:
        super().__init__(name, help=help)
        self.module = module

    def make_context(self, info_name: Any, args: Any, parent: Any = None, **extra: Any) -> Any:
        return load(self.module, str(self.name)).make_context(info_name, args, parent, **extra)


def load(module: str, name: str, ctx: Any = None) -> Any:
    """The command of a room, imported now; one line and exit code 1 where that room is not installed."""
    if missing := missing_extra(module):
        typer.echo(
            f"graspd: `graspd {name}` is not part of this install; run pip install 'graspd[{missing}]'", err=True
        )
        raise typer.Exit(1)
    with imports():
        group: Any = typer.main.get_command(import_module(module).app)
    # A Typer with a single command is that command itself, not a group.
    command: Any = group.get_command(ctx, name) if isinstance(group, TyperGroup) else group
    if isinstance(command, TyperGroup):
        for parent, child, room, text in JOINED:
            if parent == name:
                command.add_command(Deferred(child, room, text))
    # A Typer of one command offers completion of its own, which would install that of `graspd`.
    command.params = [one for one in command.params if not str(one.name).endswith("_completion")]
    escape_help(command)
    return command


def usage_line(error: Any) -> str:
    """What is wrong with the words of a command line, and where it says which are right."""
    said = re.sub(r"\.?\s*Did you mean (.*)\?", r"; did you mean \1?", error.format_message()).rstrip(".")
    if hasattr(error, "possibilities"):
        said = f"there is no option {error.option_name}{did_you_mean(error.option_name, error.possibilities or ())}"
    elif isinstance(error.__cause__, ValidationError):
        said = f"{max(error.param.opts, key=len)}: {words(error.__cause__.errors()[0])}"
    else:
        said = said[:1].lower() + said[1:].replace("'", "")
    hint = f"; see `{error.ctx.command_path} --help`" if error.ctx and said and not said.endswith("?") else ""
    return " ".join(f"{said}{hint}".split())


def escape_help(command: Any) -> None:
    """Keep the brackets of a command and of all below it: typer reads help as Rich markup, and `[mm]` as a style.

    `rich.markup.escape` does the same, and takes longer to import than most commands to start.
    """
    for one in (command, *command.params):
        for name in ("help", "short_help", "epilog"):
            if text := getattr(one, name, None):
                setattr(one, name, re.sub(r"\[[a-z#/@][^\[]*?\]", r"\\\g<0>", text))
    for inner in getattr(command, "commands", {}).values():
        escape_help(inner)


def missing_extra(module: str) -> str | None:
    """The extra to install before a module can be used; None if it can be used now."""
    needed, extra = ROOMS.get(module) or ROOMS.get(module.partition(".")[0], ("", ""))
    return extra if needed and find_spec(needed) is None else None


def build() -> typer.Typer:
    """The root command with a light entry for every command."""
    app = typer.Typer(
        cls=LazyGroup,
        help="A grasp-dataset factory: stable, contact-rich multi-finger grasps by differentiable simulation.",
        epilog="Try `graspd demo`, or `graspd COMMAND --help`.",
        no_args_is_help=True,
        pretty_exceptions_enable=False,
    )

    @app.callback(invoke_without_command=True)
    def root(
        version: bool = typer.Option(False, "--version", help="Say the version and stop.", is_eager=True),
    ) -> None:
        if version:
            typer.echo(PACKAGE_VERSION)
            raise typer.Exit

    for name, _, panel, text in COMMANDS:
        app.command(name, help=text, rich_help_panel=panel)(_entry)
    return app


def _entry() -> None:
    """Stands for a command in the overview; `LazyGroup` calls the real one."""


def main() -> None:
    """Entry point of the `graspd` command."""
    own_process()
    # No command draws with MuJoCo; at import it would look for GLFW with a process of its own.
    os.environ.setdefault("MUJOCO_GL", "disable")
    # Pydantic would look through all installed packages for plugins of its own. Whoever wants them sets it to nothing.
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    at_the_door(build())
