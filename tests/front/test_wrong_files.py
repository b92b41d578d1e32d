"""A file that is not there, or is none of its kind: one line that names it, in no library's words."""

from __future__ import annotations

from pathlib import Path

import pytest
from typer.testing import CliRunner

from graspd.cli import build
from graspd.commands.exchange import EXPORTS, IMPORTS

#: Words of the libraries that read files, and of pydantic and click.
FOREIGN = (
    "Errno",
    "pydantic",
    "nable to open",
    "nput should",
    "Traceback",
    "Error:",
    "<unicode string>",
    "errors.pydantic",
)
#: FILE stands for what is not there, or is of no kind; the suffix is what a user would give.
COMMANDS = (
    "synth --hand FILE.urdf --object mug -o OUT.h5",
    "synth --hand allegro --object FILE.stl -o OUT.h5",
    "synth --hand allegro --object mug --scene FILE.yaml -o OUT.h5",
    "synth --hand allegro --object mug --scene FILE.json -o OUT.h5",
    "synth --hand allegro --object mug --scene table --with FILE.stl -o OUT.h5",
    "synth --hand allegro --object mug --scene table --method learned --option network=FILE.npz -o OUT.h5",
    "evaluate FILE.h5",
    "evaluate FILE.json",
    "scene FILE.h5",
    "render FILE.h5",
    "view FILE.h5",
    "pictures FILE.h5",
    "clouds FILE.h5 -o OUT",
    "grasps where lift --from FILE.h5 -o OUT",
    "datasets balance FILE.h5 -o OUT",
    "datasets card FILE.h5/ -o OUT",
    "datasets diff FILE.h5 FILE.h5",
    "datasets create x --spec FILE.toml",
    "datasets estimate --spec FILE.json",
    "hands check FILE.urdf",
    "hands check FILE.zip",
    "objects check FILE.zip",
    "objects check FILE.stl",
    "bench --hand FILE.urdf",
    "admin bench-render --object FILE.stl",
    "chart --from FILE.json",
    "chart --scene FILE.json --quick",
    "stability --from FILE.json",
    "admin gallery --hand FILE.urdf -o OUT",
    "submit --hand allegro --object mug --scene FILE.json",
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
    done = CliRunner().invoke(build(), command.split(), env={"GRASPD_API_URL": "http://127.0.0.1:9"})
    assert done.exit_code == 2, done.output
    line = done.stderr.splitlines()[-1]
    assert line.startswith("graspd: ") and not any(word in done.stderr for word in FOREIGN), done.stderr
    assert done.stderr.strip() == line
    return line


@pytest.mark.parametrize("command", COMMANDS + ABSENT)
def test_a_file_that_is_not_there_is_named(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert "FILE" in refused(command, tmp_path, monkeypatch)


@pytest.mark.parametrize("command", COMMANDS)
def test_a_file_of_no_kind_is_named(command: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for word in command.split():
        path = Path(word.rpartition("=")[2].rstrip("/"))
        if path.stem == "FILE":
            (tmp_path / path.name).write_bytes(b"{no")
    assert "FILE" in refused(command, tmp_path, monkeypatch)


def test_a_folder_in_the_place_of_a_file_is_refused_before_the_work(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert "is a folder" in refused("synth --hand allegro --object mug -o .", tmp_path, monkeypatch)
