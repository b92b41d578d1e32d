"""What the system refuses, a wrong file among it, is one line on standard error, and never a trace."""

import errno
import subprocess
import sys
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from typer.testing import CliRunner

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
    done = run(f"'{sys.executable}' -c \"{code}\" {tmp_path}/file >&- 2>&-")
    assert done.returncode == 0
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
    chart --from FILE.json; chart --scene FILE.json --quick; stability --from FILE.json
    submit --hand allegro --object mug --scene FILE.json
"""
COMMANDS = (
    *(command.strip() for line in _TYPED.split("\n") for command in line.split(";") if command.strip()),
    *(f"export FILE.h5 --format {name} -o OUT" for name in EXPORTS),
    *(
        f"import FILE.{'json' if name == 'reference' else 'npy'} --format {name} --licence x --source y --hand allegro "
        "--object mug --robot r --name n -o OUT"
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
