"""Help shows each word of a command; every mistake is one line on standard error, and never a trace."""

import errno
import inspect
import os
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from typer.testing import CliRunner

import graspd.cli
from graspd.cli import build_app
from graspd.commands.exchange import EXPORTS, IMPORTS
from graspd.service.cli import run_command_line
from tests.shell import completed

GRASPD = f"'{sys.executable}' -m graspd"


def run(line: str) -> subprocess.CompletedProcess[str]:
    return completed(["bash", "-c", line])


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
@pytest.mark.parametrize("command", ["--version", "up --help"])
def test_a_full_disk_behind_the_output_is_one_line(command: str) -> None:
    done = run(f"{GRASPD} {command} > /dev/full")
    assert done.returncode == 1
    assert done.stderr == "graspd: No space left on device; free disk space, or give another path\n"


def test_a_reader_that_has_enough_and_a_closed_output_are_no_fault() -> None:
    done = run(f"set -o pipefail; {GRASPD} --help | true")
    assert (done.returncode, done.stderr) in ((0, ""), (1, ""))
    done = run(f"{GRASPD} --version >&-")
    assert (done.returncode, done.stderr) == (0, "")


def test_a_file_does_not_take_the_place_of_a_closed_output(tmp_path: Path) -> None:
    code = (
        "import os, sys; from graspd.service.cli import run_command_line; "
        "run_command_line(lambda: (os.write(1, b'noise'), open(sys.argv[1], 'w').close(), os.write(1, b'noise')))"
    )
    assert run(f"'{sys.executable}' -c \"{code}\" {tmp_path}/file >&- 2>&-").returncode == 0
    assert (tmp_path / "file").read_bytes() == b""


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (
            OSError(errno.ENOSPC, "No space left on device", "/srv/x.h5"),
            "/srv/x.h5: No space left on device; free disk space, or give another path",
        ),
        (
            PermissionError(errno.EACCES, "Permission denied", "/srv/x.h5"),
            "/srv/x.h5: Permission denied; give another path, or let this user write there",
        ),
        (NotADirectoryError(errno.ENOTDIR, "Not a directory", "a/b"), "a/b: Not a directory"),
        (OSError("Can't write data\n(file write failed)"), "Can't write data (file write failed)"),
        (OSError(errno.EIO, "I/O error at http://me:secret@host/"), "I/O error at http://***@host/"),
        (MemoryError(), "there is not enough memory; provide more, or request less at once"),
    ],
)
def test_a_system_error_names_the_fix(error: BaseException, line: str, capsys: pytest.CaptureFixture[str]) -> None:
    with capsys.disabled(), pytest.MonkeyPatch.context() as patch:
        patch.setattr("graspd.service.cli._discard_output", lambda stream: None)
        patch.setattr("typer.echo", lambda text, err: told.append(text))
        told: list[str] = []
        with pytest.raises(SystemExit) as ended:
            run_command_line(Mock(side_effect=error))
    assert ended.value.code == 1
    assert told == [f"graspd: {line}"]


def test_a_fault_of_graspd_keeps_its_trace() -> None:
    with pytest.raises(ZeroDivisionError):
        run_command_line(lambda: 1 / 0)


#: Words of the libraries that read files, and of pydantic and click.
FOREIGN = ("Errno", "pydantic", "nable to open", "nput should", "Traceback", "Error:", "<unicode string>")
#: FILE stands for what is not there, or is of no kind; the suffix is what a user would give.
_TYPED = """
    synth --hand FILE.urdf --object mug -o OUT.h5
    synth --hand allegro --object FILE.stl -o OUT.h5
    synth --hand allegro --object mug --scene FILE.yaml -o OUT.h5
    synth --hand allegro --object mug --scene FILE.json -o OUT.h5
    synth --hand allegro --object mug --scene table --with FILE.stl -o OUT.h5
    synth --hand allegro --object mug --scene table --method learned --option network=FILE.npz -o OUT.h5
    evaluate FILE.h5; evaluate FILE.json; scene FILE.h5; render FILE.h5; view FILE.h5; pictures FILE.h5
    clouds FILE.h5 -o OUT; grasps where lift --from FILE.h5 -o OUT
    datasets balance FILE.h5 -o OUT; datasets card FILE.h5/ -o OUT
    datasets create x --spec FILE.toml; datasets estimate --spec FILE.json
    hands check FILE.urdf; hands check FILE.zip; objects check FILE.zip; objects check FILE.stl
    bench --hand FILE.urdf
    chart --from FILE.json; stability --from FILE.json
    submit --hand allegro --object mug --scene FILE.json
"""
COMMANDS = (
    *(command.strip() for line in _TYPED.split("\n") for command in line.split(";") if command.strip()),
    *(f"export FILE.h5 --format {name} -o OUT" for name in EXPORTS),
    *(
        f"import FILE.{'json' if name == 'reference' else 'npy'} --format {name} --licence x --source y --hand allegro "
        "--object mug --name n -o OUT"
        for name in IMPORTS
    ),
)
#: Sent to the service as they are: what they hold is its business.
ABSENT = (
    "hands add FILE.urdf",
    "objects add FILE.stl",
    "networks add FILE.npz",
    "submit --hand FILE.urdf --object mug",
    "submit --hand allegro --object FILE.stl",
)


def refused(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(build_app(), command.split(), env={"GRASPD_API_URL": "http://127.0.0.1:9"})
    assert done.exit_code == 2, done.output
    line = done.stderr.splitlines()[-1]
    assert line.startswith("graspd: ") and not any(word in done.stderr for word in FOREIGN), done.stderr
    assert done.stderr.strip() == line
    return line


@pytest.mark.parametrize("command", COMMANDS + ABSENT)
def test_a_file_that_is_absent_or_of_no_kind_is_named(command: str, tmp_path: Path, monkeypatch: Any) -> None:
    assert "FILE" in refused(command, tmp_path, monkeypatch), "it is not there"
    for word in command.split() if command in COMMANDS else ():
        path = Path(word.rpartition("=")[2].rstrip("/"))
        if path.stem == "FILE":
            (tmp_path / path.name).write_bytes(b"{no")
    assert "FILE" in refused(command, tmp_path, monkeypatch)


@pytest.mark.parametrize(("out", "says"), [(".", "is a folder"), ("none/g.h5", "none does not exist; create it")])
def test_an_output_that_cannot_be_is_refused_first(tmp_path: Path, monkeypatch: Any, out: str, says: str) -> None:
    assert says in refused(f"synth --hand allegro --object mug -o {out}", tmp_path, monkeypatch)


OFFERED = {"": "synth", "admin ker": "kernels", "admin index re": "rebuild", "datasets cr": "create"}
OFFERED |= {"export --for": "--format", "datasets card --li": "--licence"}
#: Of a number that is no count: its unit, or the word of one without.
UNIT = re.compile(r"\[\w+\]|\b(mm|kg|kg/m3|metres|coefficient|share|candidates)\b", re.IGNORECASE)


@pytest.mark.parametrize(
    ("command", "line"),
    [
        ("store verify", "no such command store; did you mean restore?"),
        ("admin stor", "no such command stor; did you mean store?"),
        ("jbos", "no such command jbos; did you mean jobs?"),
        ("datasets lst", "no such command lst; did you mean list?"),
        ("submit --handd allegro", "there is no option --handd; did you mean --hand?"),
        ("submit", "missing option --hand; see `graspd submit --help`"),
        ("submit --hand", "option --hand requires an argument"),
        ("submit --hand allegro --object mug -n 0", "--grasps: must be at least 1"),
        ("submit --hand x --object y --grasps many", "--grasps: must be a whole number; see `graspd submit --help`"),
        (
            "jobs --state runing",  # codespell:ignore runing
            "--state: must be one of queued, running, succeeded, failed, cancelled; did you mean running?",
        ),
        ("export x.h5 --format mjcf -o out", "there is no export format 'mjcf'"),
        ("export x.h5 --depth tiff -o out", "there is no depth format 'tiff'"),
        ("datasets card ./x --snapshot 0f -o out", "./x is a folder; --snapshot goes with the name of a dataset"),
        ("doctor --only disk,weather", "there is no check weather; choose from disk"),
        ("evaluate g.h5 --robust 2 --protocol displacement", "--robust repeats pushes or lifts in perturbed models"),
        ("evaluate g.h5 --robust 2 -o none/g.h5", "none/g.h5 cannot be written: choose a file in an existing folder"),
        ("evaluate g.json --robust 2 -o g.h5", "g.json is no shard of graspd"),
        ("objects add notes.txt --scale-to 0.1,0.2", "several sizes need a mesh file or a folder of meshes"),
        ("worker --workers 2 --once --stages none", "--burst, --once and --max-tasks are for a single worker"),
        ("hands check allegro --closing ja=2", "--closing ja=2 must be -1, 0 or 1"),
        ("hands check allegro --closing ja", "--closing 'ja' must be JOINT=VALUE with a number"),
        ("hands check allegro --xacro x", "--xacro 'x' must be NAME=VALUE"),
        ("tags add good", "select grasps: SHARD:ROW, or --where, --job, --dataset"),
        ("tags add good abc:1 --where valid", "give SHARD:ROW, or --where, --job and --dataset, not both"),
        ("tags add good abc:1 abc", "'abc' does not name a grasp; write SHARD:ROW"),
        ("tags export good -o good.h5", "good.h5: the name of the file must end in .zip, .csv or .json"),
    ],
)
def test_a_mistake_is_one_line(command: str, line: str) -> None:
    done = CliRunner().invoke(
        build_app(), command.split(), prog_name="graspd", env={"GRASPD_API_URL": "http://[::1]:9"}
    )
    assert done.exit_code == 2 and done.stderr.startswith(f"graspd: {line}") and done.stderr.count("\n") == 1


def test_a_group_without_a_command_shows_its_help() -> None:
    done = CliRunner().invoke(build_app(), ["tags"], prog_name="graspd")
    assert done.exit_code == 2 and not done.stderr and "Usage: graspd tags" in done.stdout


@pytest.mark.parametrize(("typed", "offered"), OFFERED.items())
def test_completion_knows_commands_without_the_engine(typed: str, offered: str) -> None:
    code = "import sys; sys.argv[0] = 'graspd'; from graspd.cli import main\ntry: main()\n"
    code += "finally: print('warp' in sys.modules, file=sys.stderr)"
    words = {"COMP_WORDS": f"graspd {typed}", "COMP_CWORD": str(1 + typed.count(" "))}
    asked = os.environ | {"_GRASPD_COMPLETE": "complete_bash"} | words
    done = completed([sys.executable, "-c", code], env=asked)
    assert offered in done.stdout.split()
    assert done.stderr.strip() == "False"


def commands(command: Any, path: str) -> Iterator[tuple[str, Any]]:
    if isinstance(command, graspd.cli.DeferredCommand):
        command = graspd.cli.load_command(command.module, path.rpartition(" ")[2])
    yield path, command
    for name, inner in getattr(command, "commands", {}).items():
        yield from commands(inner, f"{path} {name}")


@pytest.fixture(scope="module")
def every() -> dict[str, Any]:
    return {
        path: one
        for name, module, _, _ in graspd.cli.COMMANDS
        for path, one in commands(graspd.cli.load_command(module, name), f"graspd {name}")
    }


def test_help_loses_no_word(every: dict[str, Any], monkeypatch: pytest.MonkeyPatch, capsys: Any) -> None:
    # Wide enough that no line is broken; typer reads the width at import.
    monkeypatch.setattr("typer.rich_utils.MAX_WIDTH", 4000)
    lost = []
    for path, command in every.items():
        command.make_context(path, ["--help"], resilient_parsing=True).get_help()
        shown = " ".join(capsys.readouterr().out.split())
        told = [command.help, command.epilog, *(getattr(one, "help", None) for one in command.params)]
        for text in filter(None, told):
            said = " ".join(inspect.cleandoc(text.partition("\f")[0]).replace("\\[", "[").split())
            if said not in shown:
                lost.append(f"{path}: {said}")
    assert len(every) > 60
    assert not lost, "\n".join(lost)


def test_every_option_has_a_help_with_its_unit(every: dict[str, Any]) -> None:
    options = [(path, one) for path, command in every.items() for one in command.params if one.opts[0][:1] == "-"]
    numbers = [(path, one) for path, one in options if "float" in str(one.type_descriptor.annotation)]
    silent = [f"{path} {one.opts[0]}" for path, one in options if not one.help]
    no_unit = [f"{path} {one.opts[0]}: {one.help}" for path, one in numbers if not UNIT.search(one.help)]
    assert len(numbers) > 20
    assert (silent, no_unit) == ([], [])
