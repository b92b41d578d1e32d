"""Code shared by all commands: one-line errors with exit codes, JSON output, logs."""

from __future__ import annotations

import contextlib
import errno
import functools
import io
import json
import os
import signal
import stat
import sys
from collections.abc import Callable, Collection, Iterable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn, ParamSpec, TextIO, TypeVar

import typer
from pydantic import BaseModel, ValidationError

from graspd.service.model.base import first_error
from graspd.service.model.errors import GraspdError, InputError, without_secrets
from graspd.service.telemetry import set_up_logs

if TYPE_CHECKING:
    from rich.console import Console
    from rich.table import Table

    from graspd.service.settings import Settings

P = ParamSpec("P")
R = TypeVar("R")

DataDir = Annotated[Path | None, typer.Option("--data-dir", help="Data folder of graspd; default: GRASPD_DATA_DIR.")]
JsonFlag = Annotated[bool, typer.Option("--json", help="Print one JSON object on the last line.")]


def report_errors(command: Callable[P, R]) -> Callable[P, R]:
    """Decorate a command: errors become a line on stderr and exit code 2 (input), 130 (Ctrl-C) or 1."""

    @functools.wraps(command)
    def wrapper(*args: P.args, **kwargs: P.kwargs) -> R:
        try:
            return command(*args, **kwargs)
        except GraspdError as error:
            fail(str(error), error.exit_code)
        except ValidationError as error:
            fail(first_error(error), InputError.exit_code)
        except BrokenPipeError:
            _discard_output(sys.stdout)  # The reader (head, less) has closed the pipe.
            raise typer.Exit(0) from None
        except KeyboardInterrupt:
            fail("interrupted", 130)

    return wrapper


class CommandGroup(typer.Typer):
    def command(self, *names: Any, **options: Any) -> Callable[[Callable[P, R]], Callable[P, R]]:  # type: ignore[override]
        add = super().command(*names, **options)
        return lambda command: add(report_errors(command))


def run_command_line(command: Callable[[], object]) -> None:
    """Run the command; report system errors in one line. Other exceptions keep their traceback."""
    for descriptor in range(3):
        try:
            os.fstat(descriptor)
        except OSError:
            # Otherwise the next opened file gets this descriptor, and the printed output is written to it.
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)
    for stream in (sys.stdout, sys.stderr):
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        try:
            command()
        finally:
            if sys.stdout is not None:
                sys.stdout.flush()
    except BrokenPipeError:
        _discard_output(sys.stdout)
        sys.exit(0)
    except (OSError, MemoryError) as error:
        _discard_output(sys.stdout)
        with contextlib.suppress(OSError, typer.Exit):
            fail(_system_error_text(error), 1)
        sys.exit(1)


def _system_error_text(error: OSError | MemoryError) -> str:
    if isinstance(error, MemoryError):
        return "there is not enough memory; provide more, or request less at once"
    paths = ", ".join(str(name) for name in (error.filename, error.filename2) if name is not None)
    problem = f"{paths}: {error.strerror}" if paths and error.strerror else error.strerror or str(error)
    fixes = {
        errno.EACCES: "give another path, or let this user write there",
        errno.EROFS: "give another path",
        errno.ENOENT: "check the name",
        **dict.fromkeys((errno.ENOSPC, errno.EDQUOT), "free disk space, or give another path"),
    }
    return without_secrets(f"{problem}; {fixes[error.errno]}" if error.errno in fixes else problem)


def _discard_output(stream: TextIO | None) -> None:
    with contextlib.suppress(OSError, ValueError):
        if stream is not None:
            os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())


def write_output(path: Path, content: bytes | Iterable[bytes]) -> None:
    """Write an output file atomically; a device, a pipe or the target of a link is written directly."""
    pieces = [content] if isinstance(content, bytes) else content
    if path.is_symlink() or (path.exists() and not path.is_file()):
        with path.open("wb") as file:
            file.writelines(pieces)
        return
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            file.writelines(pieces)
        if path.exists():
            part.chmod(path.stat().st_mode)
        part.replace(path)
    finally:
        part.unlink(missing_ok=True)


@contextlib.contextmanager
def catch_stop_signals() -> Iterator[list[int]]:
    """Yield a list that receives the first stop signal (Ctrl-C, SIGTERM); a second one ends the process."""
    received: list[int] = []
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}

    def restore() -> None:
        for number, handler in before.items():
            signal.signal(number, handler)

    def record(number: int, _: Any) -> None:
        received.append(number)
        restore()

    try:
        for number in before:
            signal.signal(number, record)
    except ValueError:  # Only the main thread can set signal handlers.
        before = {}
    try:
        yield received
    finally:
        restore()


def fail(message: str, code: int) -> NoReturn:
    typer.echo(f"graspd: {' '.join(message.split())}", err=True)
    raise typer.Exit(code)


def plain_console(*, stderr: bool = False) -> Console:
    """Return a console that prints verbatim; Rich would read `[red]` as a style and `:x:` as an emoji."""
    from rich.console import Console

    return Console(stderr=stderr, markup=False, emoji=False, highlight=False)


@contextlib.contextmanager
def progress_bar(*, quiet: bool) -> Iterator[Callable[[float, float, str], None]]:
    """Show a bar on a terminal, unless `quiet`; yield a function of finished work, all work and a message."""
    if quiet or not sys.stderr.isatty():
        yield lambda done, total, message: None
        return
    from rich import progress as rich

    parts = (rich.BarColumn(), rich.MofNCompleteColumn(), rich.TimeElapsedColumn(), rich.TimeRemainingColumn())
    text = rich.TextColumn("{task.description}", markup=False)
    with rich.Progress(text, *parts, console=plain_console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=None)
        yield lambda done, total, message: bar.update(task, completed=done, total=total, description=message)


def plain_table(*headings: str, whole: Collection[str] = ()) -> Table:
    from rich.table import Table

    table = Table(box=None, header_style="bold", padding=(0, 2, 0, 0))
    for name in headings:
        table.add_column(name, no_wrap=name in whole, overflow="fold")
    return table


def print_json(value: BaseModel | dict[str, Any]) -> None:
    plain = value.model_dump(mode="json") if isinstance(value, BaseModel) else value
    typer.echo(json.dumps(plain, allow_nan=False, default=str))


def print_result(value: BaseModel | dict[str, Any], text: str, *, json: bool) -> None:
    if json:
        print_json(value)
    else:
        typer.echo(text)


def load_settings(**overrides: Any) -> Settings:
    """Load settings from the environment and the given command options; InputError for an invalid value."""
    from graspd.service.settings import GONE, Settings

    if gone := [f"{name} was removed: {GONE[name]}" for name in sorted(GONE) if os.environ.get(name)]:
        raise InputError("; ".join(gone))
    try:
        return Settings(**{name: value for name, value in overrides.items() if value is not None})
    except ValidationError as error:
        place, text = error.errors()[0]["loc"], first_error(error)
        raise InputError(f"GRASPD_{place[0]}".upper() + text.removeprefix(str(place[0])) if place else text) from None


def set_up_process(settings: Settings, process: str) -> None:
    """Log to stderr under a process name; make the data folder and all new files private to the user."""
    set_up_logs(settings, process)
    os.umask(0o077)
    with contextlib.suppress(OSError):
        status = settings.data_dir.stat()
        if status.st_uid == os.getuid() and stat.S_IMODE(status.st_mode) != 0o700:
            settings.data_dir.chmod(0o700)
