"""What the system refuses is one line on standard error and an exit code, never a trace."""

from __future__ import annotations

import errno
import subprocess
import sys
from pathlib import Path

import pytest

from graspd.service.cli import at_the_door

GRASPD = f"'{sys.executable}' -m graspd"


def run(line: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(["bash", "-c", line], capture_output=True, text=True, check=False)


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="there is no /dev/full here")
@pytest.mark.parametrize("command", ["--version", "up --help"])
def test_a_full_disk_behind_the_output_is_one_line(command: str) -> None:
    done = run(f"{GRASPD} {command} > /dev/full")
    assert done.returncode == 1
    assert done.stderr == "graspd: No space left on device; make room, or name another place\n"


def test_a_reader_that_has_enough_is_no_fault() -> None:
    done = run(f"set -o pipefail; {GRASPD} --help | true")
    assert (done.returncode, done.stderr) in ((0, ""), (1, ""))


def test_a_closed_output_is_no_fault() -> None:
    done = run(f"{GRASPD} --version >&-")
    assert (done.returncode, done.stderr) == (0, "")


def test_a_file_that_is_opened_does_not_take_the_place_of_a_closed_output(tmp_path: Path) -> None:
    code = (
        "import os, sys; from graspd.service.cli import at_the_door; "
        "at_the_door(lambda: (os.write(1, b'noise'), open(sys.argv[1], 'w').close(), os.write(1, b'noise')))"
    )
    done = run(f"'{sys.executable}' -c \"{code}\" {tmp_path}/file >&- 2>&-")
    assert done.returncode == 0
    assert (tmp_path / "file").read_bytes() == b""


@pytest.mark.parametrize(
    ("error", "line"),
    [
        (
            OSError(errno.ENOSPC, "No space left on device", "/srv/x.h5"),
            "/srv/x.h5: No space left on device; make room, or name another place",
        ),
        (
            PermissionError(errno.EACCES, "Permission denied", "/srv/x.h5"),
            "/srv/x.h5: Permission denied; name another place, or let this user write there",
        ),
        (NotADirectoryError(errno.ENOTDIR, "Not a directory", "a/b"), "a/b: Not a directory"),
        (OSError("Can't write data\n(file write failed)"), "Can't write data (file write failed)"),
        (OSError(errno.EIO, "I/O error at http://me:secret@host/"), "I/O error at http://***@host/"),
        (MemoryError(), "there is not enough memory; give it more, or ask for less at once"),
    ],
)
def test_a_refusal_of_the_system_names_the_thing_and_the_fix(
    error: BaseException, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    def command() -> None:
        raise error

    with capsys.disabled(), pytest.MonkeyPatch.context() as patch:
        patch.setattr("graspd.service.cli._silence", lambda stream: None)
        patch.setattr("typer.echo", lambda text, err: told.append(text))
        told: list[str] = []
        with pytest.raises(SystemExit) as ended:
            at_the_door(command)
    assert ended.value.code == 1
    assert told == [f"graspd: {line}"]


def test_a_fault_of_graspd_keeps_its_trace() -> None:
    with pytest.raises(ZeroDivisionError):
        at_the_door(lambda: 1 / 0)
